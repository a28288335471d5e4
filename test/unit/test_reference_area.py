from __future__ import annotations

from dataclasses import replace
import re
import time

import cv2
import numpy as np
import pytest
from scenes import (
    Board,
    draw_frame,
    flat_texture,
    paper_board,
    rectangle_room,
    Scene,
    wall_board,
)

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.walls import Paper, Room
from landmark_nav.learning.panorama import PanoramaConfig, synthesize_cylinder
from landmark_nav.learning.reference_area import locate_sweep, ReferenceAreaConfig, SweepPlace
from landmark_nav.types import FloatArray, Sweep

MOUNT = PanTiltMount(axis_xyz=(0.12, 0.01, 1.1))
CAMERA = CameraModel(420, 240, 380.0, 380.0, 209.0, 120.5, distortion=(-0.15, 0.04))
CONFIG = ReferenceAreaConfig()
TURN = np.radians(np.arange(0.0, 360.0, 20.0))

# Three on one wall, and three on two walls; never at equal distances.
EAST = (
    Paper('red', (6.0, 1.4, 1.2), 0.21, 0.297),
    Paper('green', (6.0, 2.3, 1.35), 0.21, 0.297),
    Paper('blue', (6.0, 3.6, 1.1), 0.21, 0.297),
)
CORNER = (
    Paper('red', (5.1, 5.0, 1.2), 0.297, 0.21),
    Paper('yellow', (6.0, 2.6, 1.3), 0.21, 0.297),
    Paper('blue', (6.0, 4.0, 1.1), 0.21, 0.297),
)


def scene_of(room: Room, papers: tuple[Paper, ...] | None = None) -> Scene:
    walls = [
        wall_board(wall, flat_texture((g, g, g)))
        for wall, g in zip(room.walls, (170.0, 150.0, 160.0, 140.0), strict=True)
    ]
    shown = room.papers if papers is None else papers
    return Scene((*walls, *(paper_board(paper, room) for paper in shown)))


def sweep_at(
    scene: Scene,
    pose: FloatArray,
    rng: np.random.Generator | None = None,
    *,
    mount: PanTiltMount = MOUNT,
    rise_m: float = 0.0,
    tilt_rad: float = 0.0,
    towards: tuple[Paper, ...] = EAST,
    pan_sigma_rad: float = 0.0,
) -> Sweep:
    """Frames that look towards some papers, as JPEG with halved colours."""
    axis = se2.compose(pose, [*mount.axis_xyz[:2], 0.0])
    away = np.array([p.center[:2] for p in towards]) - axis[:2]
    azimuth = np.arctan2(away[:, 1], away[:, 0]) - axis[2]
    raised = replace(mount, axis_xyz=(*mount.axis_xyz[:2], mount.axis_xyz[2] + rise_m))
    frames = []
    for pan in TURN:
        ahead = mount.camera_pose_base(pan)[0][:2, 2]
        off = wrap_rad(np.arctan2(ahead[1], ahead[0]) - azimuth)
        if np.abs(off).min() > np.radians(27.0):
            continue
        slip = 0.0 if rng is None else float(rng.normal(0.0, pan_sigma_rad))
        frame = draw_frame(
            scene, CAMERA, raised, pose, pan + slip, tilt_rad, stamp_ns=len(frames), rng=rng
        )
        # A lens leaves no edge sharper than that.
        soft = cv2.GaussianBlur(frame.image, (0, 0), 0.6)
        jpeg = cv2.imencode('.jpg', soft, [cv2.IMWRITE_JPEG_QUALITY, 92])[1]
        image = np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), dtype=np.uint8)
        frames.append(replace(frame, image=image, pan_rad=float(pan)))
    return Sweep(0, tuple(frames))


def locate(sweep: Sweep, room: Room, mount: PanTiltMount = MOUNT) -> SweepPlace:
    view = synthesize_cylinder(sweep, mount, PanoramaConfig())
    return locate_sweep(sweep, view, room, mount, CONFIG)


def error_of(place: SweepPlace, pose: FloatArray) -> FloatArray:
    """x, y, heading found minus true."""
    error = place.pose_map_base - pose
    error[2] = wrap_rad(error[2])
    return error


@pytest.mark.parametrize('papers', [EAST, CORNER], ids=['one wall', 'two walls'])
@pytest.mark.parametrize('pose', [(3.5, 2.0, 0.3), (4.2, 3.2, -2.6)], ids=str)
def test_the_place_is_recovered_without_noise(
    papers: tuple[Paper, ...], pose: tuple[float, float, float]
) -> None:
    room = rectangle_room(papers=papers)
    place = locate(sweep_at(scene_of(room), np.array(pose), towards=papers), room)
    error = error_of(place, np.array(pose))
    assert np.hypot(error[0], error[1]) < 0.006
    assert abs(error[2]) < np.radians(0.12)
    assert place.height_m == pytest.approx(MOUNT.axis_xyz[2], abs=0.004)
    assert deviations(place, pose).max() < 3.0


def deviations(place: SweepPlace, pose: tuple[float, float, float] | FloatArray) -> FloatArray:
    """Errors of x, y, heading in their own standard deviations, absolute."""
    sigma = np.sqrt(np.diag(place.covariance))[[0, 1, 3]]
    return np.abs(error_of(place, np.asarray(pose))) / sigma


def test_noise_and_papers_that_hang_askew_stay_within_the_covariance() -> None:
    rng = np.random.default_rng(4)
    room = rectangle_room(papers=CORNER)
    nees = []
    for _ in range(4):
        pose = np.array([*rng.uniform((2.8, 1.6), (4.2, 3.6)), rng.uniform(-np.pi, np.pi)])
        hung = tuple(
            replace(p, center=_moved(p, room, rng.normal(0.0, CONFIG.paper_sigma_m, 2)))
            for p in CORNER
        )
        rise = float(rng.normal(0.0, CONFIG.height_sigma_m))
        sweep = sweep_at(
            scene_of(room, hung),
            pose,
            rng,
            rise_m=rise,
            towards=CORNER,
            pan_sigma_rad=CONFIG.pan_sigma_rad,
        )
        place = locate(sweep, room)
        height_error = place.height_m - MOUNT.axis_xyz[2] - rise
        error = np.insert(error_of(place, pose), 2, height_error)
        nees.append(float(error @ np.linalg.solve(place.covariance, error)))
        sigma = np.sqrt(np.diag(place.covariance))
        assert np.max(np.abs(error) / sigma) < 3.5
        assert sigma[:2].max() < 0.02
        assert sigma[3] < np.radians(0.3)
    assert 0.3 < np.mean(nees) / 4.0 < 2.0


def _moved(paper: Paper, room: Room, shift: FloatArray) -> tuple[float, float, float]:
    wall = room.walls[int(room.nearest_wall(np.array(paper.center[:2])))]
    along = np.subtract(wall.end, wall.start) / wall.length
    x, y = np.array(paper.center[:2]) + shift[0] * along
    return (float(x), float(y), paper.center[2] + float(shift[1]))


def test_a_shadow_beside_a_paper_does_not_move_the_place() -> None:
    room = rectangle_room(papers=EAST)
    scene = scene_of(room)
    shadows = tuple(
        Board(
            # A dark strip across the left edge, behind the paper.
            np.array([p.center[0] - 5e-6, p.center[1] + p.width / 2.0, p.center[2]]),
            np.array([-1.0, 0.0, 0.0]),
            0.06,
            p.height + 0.06,
            flat_texture((110.0, 110.0, 110.0)),
        )
        for p in EAST
    )
    pose = np.array([3.6, 2.2, 0.4])
    place = locate(sweep_at(replace(scene, boards=scene.boards + shadows), pose), room)
    error = error_of(place, pose)
    assert np.hypot(error[0], error[1]) < 0.01
    assert abs(error[2]) < np.radians(0.15)


def test_papers_in_linear_and_in_gamma_coded_pictures_give_the_same_place() -> None:
    # What blurs edges blurs light; most cameras write its root: dark papers seem to shrink.
    room = rectangle_room(papers=EAST)
    pose = np.array([3.4, 2.4, 0.2])
    linear = sweep_at(scene_of(room), pose)
    table = np.rint(255.0 * (np.arange(256) / 255.0) ** (1.0 / 1.8)).astype(np.uint8)
    coded = replace(
        linear, frames=tuple(replace(f, image=np.asarray(table[f.image])) for f in linear.frames)
    )
    for sweep in (linear, coded):
        place = locate(sweep, room)
        assert deviations(place, pose).max() < 3.0
        assert np.hypot(*error_of(place, pose)[:2]) < 0.008


@pytest.mark.parametrize('light', [(0.35, 0.33, 0.3), (0.6, 0.85, 1.15)], ids=str)
def test_other_light_changes_nothing(light: tuple[float, float, float]) -> None:
    """Dim, warm and cold light, brighter on one side."""
    room = rectangle_room(papers=EAST)
    pose = np.array([3.4, 2.4, 0.2])
    sweep = sweep_at(scene_of(room), pose)
    slope = np.linspace(0.8, 1.2, CAMERA.width)[None, :, None]
    lit = tuple(
        replace(
            f, image=np.clip(np.rint(f.image * slope * np.array(light)), 0, 255).astype(np.uint8)
        )
        for f in sweep.frames
    )
    place = locate(replace(sweep, frames=lit), room)
    assert np.hypot(*error_of(place, pose)[:2]) < 0.012
    assert deviations(place, pose).max() < 3.0


def test_other_things_in_the_papers_colours_do_not_lead_astray() -> None:
    room = rectangle_room(papers=EAST)
    others = tuple(
        Paper(color, center, width, height)
        for color, center, width, height in (
            ('red', (0.0, 2.0, 1.2), 0.4, 0.3),
            ('red', (6.0, 1.9, 1.3), 0.21, 0.297),
            ('green', (6.0, 3.0, 1.2), 0.21, 0.297),
            ('green', (6.0, 4.4, 1.2), 0.15, 0.2),
            ('blue', (4.0, 5.0, 1.2), 0.3, 0.3),
            ('blue', (6.0, 0.7, 1.3), 0.21, 0.297),
        )
    )
    pose = np.array([3.2, 2.4, 1.0])
    sweep = sweep_at(scene_of(room, EAST + others), pose, np.random.default_rng(1))
    place = locate(sweep, room)
    assert np.hypot(*error_of(place, pose)[:2]) < 0.02
    assert deviations(place, pose).max() < 3.5


def test_a_paper_across_the_seam_of_the_panorama_is_found() -> None:
    room = rectangle_room(papers=EAST)
    behind = np.array([3.6, 2.3, np.pi])  # the papers hang at azimuth 180 deg
    place = locate(sweep_at(scene_of(room), behind), room)
    assert np.hypot(*error_of(place, behind)[:2]) < 0.006


SIX = (
    *EAST,
    Paper('#d07010', (3.0, 5.0, 1.3), 0.21, 0.297),
    Paper('blue', (4.6, 5.0, 1.2), 0.297, 0.21),
    Paper('hsv(280, 60, 60)', (5.2, 0.0, 1.25), 0.3, 0.3),
)


def test_six_papers_on_three_walls_two_of_a_colour() -> None:
    room = rectangle_room(papers=SIX)
    pose = np.array([3.3, 2.6, 0.4])
    sweep = sweep_at(scene_of(room), pose, towards=SIX)
    begin = time.process_time()
    place = locate(sweep, room)
    assert time.process_time() - begin < 6.0
    assert np.hypot(*error_of(place, pose)[:2]) < 0.006
    assert deviations(place, pose).max() < 3.0
    # One of six may be gone.
    fewer = sweep_at(scene_of(room, SIX[1:]), pose, towards=SIX)
    assert np.hypot(*error_of(locate(fewer, room), pose)[:2]) < 0.008


MOUNTS = {
    'tilted up, off the axis': (replace(MOUNT, optical_center_offset=(0.07, 0.01, 0.03)), 0.15),
    'upside down': (replace(MOUNT, axis_rpy=(np.pi, 0.0, 0.0)), 0.0),
    'upside down, off the axis': (
        replace(MOUNT, axis_rpy=(np.pi, 0.0, 0.0), optical_center_offset=(0.05, 0.0, 0.04)),
        -0.1,
    ),
    'leaning, as told': (replace(MOUNT, axis_rpy=(0.04, -0.05, 0.0)), 0.0),
}


@pytest.mark.parametrize('name', MOUNTS)
def test_however_the_camera_is_mounted(name: str) -> None:
    mount, tilt = MOUNTS[name]
    room = rectangle_room(papers=EAST)
    pose = np.array([3.4, 2.2, -0.6])
    sweep = sweep_at(scene_of(room), pose, mount=mount, tilt_rad=tilt)
    place = locate(sweep, room, mount)
    assert np.hypot(*error_of(place, pose)[:2]) < 0.006
    assert deviations(place, pose).max() < 3.0
    pans = np.array([frame.pan_rad for frame in sweep.frames])
    height = mount.camera_pose_base(pans, tilt)[1][:, 2].mean()
    assert place.height_m == pytest.approx(height, abs=0.004)


def test_a_missing_paper_is_named() -> None:
    room = rectangle_room(papers=EAST)
    sweep = sweep_at(scene_of(room, EAST[:2]), np.array([3.5, 2.0, 0.3]))
    with pytest.raises(LandmarkNavError, match='not found: blue of red, green, blue') as caught:
        locate(sweep, room)
    assert '\n' not in str(caught.value)


def test_a_hidden_paper_is_not_mistaken_for_something_of_its_colour() -> None:
    room = rectangle_room(papers=EAST)
    other = Paper('blue', (6.0, 4.3, 1.1), 0.21, 0.297)
    sweep = sweep_at(scene_of(room, (*EAST[:2], other)), np.array([3.5, 2.0, 0.3]))
    with pytest.raises(LandmarkNavError, match=r'red fits, green fits, blue shows 0 %'):
        locate(sweep, room)


def covered(share: float, pose: FloatArray, tall: bool = False) -> tuple[Sweep, Room]:
    """Something grey before the left or the lower part of the blue paper."""
    room = rectangle_room(papers=EAST)
    scene = scene_of(room)
    blue = EAST[2]
    cut = blue.center[1] + blue.width / 2.0 - share * blue.width
    low = blue.center[2] - blue.height / 2.0 + share * blue.height
    cover = Board(
        np.array([5.99, cut + 0.15, 1.0]) if tall else np.array([5.99, 3.6, low - 0.3]),
        np.array([-1.0, 0.0, 0.0]),
        0.3 if tall else 0.8,
        1.2 if tall else 0.6,
        flat_texture((70.0, 75.0, 80.0)),
    )
    return sweep_at(replace(scene, boards=(*scene.boards, cover)), pose), room


@pytest.mark.parametrize('tall', [True, False], ids=['from the left', 'from below'])
@pytest.mark.parametrize('share', [0.15, 0.5])
def test_a_paper_that_is_partly_covered_gives_no_wrong_place(share: float, tall: bool) -> None:
    pose = np.array([3.5, 2.0, 0.3])
    sweep, room = covered(share, pose, tall)
    place = locate(sweep, room)
    assert deviations(place, pose).max() < 3.5
    assert np.hypot(*error_of(place, pose)[:2]) < 0.02


def test_papers_that_changed_places_are_named() -> None:
    told = rectangle_room(papers=EAST)
    hung = (EAST[0], replace(EAST[1], color='blue'), replace(EAST[2], color='green'))
    sweep = sweep_at(scene_of(told, hung), np.array([3.5, 2.0, 0.3]))
    with pytest.raises(LandmarkNavError, match=r'swapped, blue where green .* green where blue'):
        locate(sweep, told)


@pytest.mark.parametrize(
    'center',
    [(2.0, 0.0, 1.3), (6.0, 2.38, 1.35), (6.0, 2.3, 1.43), (6.0, 2.315, 1.35)],
    ids=str,
)
def test_papers_that_hang_elsewhere_than_the_room_says(
    center: tuple[float, float, float],
) -> None:
    """A refusal, or, where what is seen of the paper can't be its, the place by the others."""
    told = rectangle_room(papers=EAST)
    hung = (EAST[0], replace(EAST[1], center=center), EAST[2])
    pose = np.array([3.5, 2.0, 0.3])
    sweep = sweep_at(scene_of(told, hung), pose)
    try:
        place = locate(sweep, told)
    except LandmarkNavError as error:
        message = str(error)
    else:
        assert deviations(place, pose).max() < 3.0
        return
    assert re.search('not found: green|green paper hangs|no place .* green', message)


def test_a_camera_that_hangs_otherwise_than_told_is_refused() -> None:
    room = rectangle_room(papers=EAST)
    pose = np.array([3.5, 2.0, 0.3])
    upside_down = replace(MOUNT, axis_rpy=(np.pi, 0.0, 0.0))
    leaning = replace(MOUNT, axis_rpy=(0.03, 0.04, 0.0))
    for mount in (upside_down, leaning):
        with pytest.raises(LandmarkNavError) as caught:
            locate(sweep_at(scene_of(room), pose, mount=mount), room)
        assert '\n' not in str(caught.value)


def test_two_places_that_fit_alike_are_named() -> None:
    # The same three papers twice, on opposite walls: which ones does the room mean?
    room = rectangle_room(papers=EAST)
    twins = tuple(replace(p, center=(0.0, 5.0 - p.center[1], p.center[2])) for p in EAST)
    pose = np.array([3.3, 2.4, 0.2])
    sweep = sweep_at(scene_of(room, EAST + twins), pose, towards=EAST + twins)
    with pytest.raises(LandmarkNavError, match=r'ambiguous.*fit alike'):
        locate(sweep, room)


@pytest.mark.parametrize('count', [0, 2])
def test_fewer_than_three_papers_are_no_reference_area(count: int) -> None:
    room = rectangle_room(papers=EAST[:count])
    sweep = sweep_at(scene_of(room), np.array([3.5, 2.0, 0.3]))
    with pytest.raises(LandmarkNavError, match=f'names {count} reference papers.*sweep/pose'):
        locate(sweep, room)
