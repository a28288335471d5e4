from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scenes import (
    Board,
    draw_cylinder,
    flat_texture,
    GREY,
    paper_board,
    rectangle_room,
    Scene,
    wall_board,
    with_noise,
)

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.walls import Paper, Room
from landmark_nav.learning.panorama import CylinderImage
from landmark_nav.learning.reference_area import locate_sweep, ReferenceAreaConfig, SweepPlace
from landmark_nav.types import FloatArray

MOUNT = PanTiltMount(axis_xyz=(0.12, 0.01, 1.1))
CYLINDER = Cylinder.with_resolution(380.0, -0.25, 0.25)
CONFIG = ReferenceAreaConfig()

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


def view_of(
    scene: Scene, pose: FloatArray, rng: np.random.Generator | None = None, rise_m: float = 0.0
) -> CylinderImage:
    axis = se2.compose(pose, [*MOUNT.axis_xyz[:2], 0.0])
    center = np.array([axis[0], axis[1], MOUNT.axis_xyz[2] + rise_m])
    sharp = draw_cylinder(scene, CYLINDER, center, float(pose[2]))
    # A lens, and the resampling of frames to a panorama, leave no edge sharper than that.
    image = with_noise(cv2.GaussianBlur(sharp, (0, 0), 0.8), rng)
    return CylinderImage(image, np.ones(image.shape[:2], bool), CYLINDER)


def error_of(place: SweepPlace, pose: FloatArray) -> FloatArray:
    """x, y, heading found minus true."""
    error = place.pose_map_base - pose
    error[2] = wrap_rad(error[2])
    return error


@pytest.mark.parametrize('papers', [EAST, CORNER], ids=['one wall', 'two walls'])
@pytest.mark.parametrize(
    'pose', [(3.5, 2.0, 0.3), (4.2, 3.2, -2.6), (4.1, 2.5, np.pi - 0.02)], ids=str
)
def test_the_place_is_recovered_without_noise(
    papers: tuple[Paper, ...], pose: tuple[float, float, float]
) -> None:
    room = rectangle_room(papers=papers)
    place = locate_sweep(view_of(scene_of(room), np.array(pose)), room, MOUNT, CONFIG)
    error = error_of(place, np.array(pose))
    assert np.hypot(error[0], error[1]) < 0.002
    assert abs(error[2]) < np.radians(0.03)
    assert place.height_m == pytest.approx(MOUNT.axis_xyz[2], abs=0.004)


def test_noise_and_papers_that_hang_askew_stay_within_the_covariance() -> None:
    rng = np.random.default_rng(4)
    room = rectangle_room(papers=CORNER)
    nees, axis_error = [], []
    for _ in range(10):
        pose = np.array([*rng.uniform((2.5, 1.2), (4.2, 3.8)), rng.uniform(-np.pi, np.pi)])
        hung = tuple(
            replace(p, center=_moved(p, room, rng.normal(0.0, CONFIG.paper_sigma_m, 2)))
            for p in CORNER
        )
        rise = float(rng.normal(0.0, CONFIG.height_sigma_m))
        view = view_of(scene_of(room, hung), pose, rng, rise)
        place = locate_sweep(view, room, MOUNT, CONFIG)
        height_error = place.height_m - MOUNT.axis_xyz[2] - rise
        error = np.insert(error_of(place, pose), 2, height_error)
        nees.append(float(error @ np.linalg.solve(place.covariance, error)))
        sigma = np.sqrt(np.diag(place.covariance))
        axis_error.append(np.abs(error) / sigma)
        assert sigma[:2].max() < 0.03
        assert sigma[3] < np.radians(0.4)
    assert np.max(axis_error) < 3.5
    assert 0.1 < np.mean(nees) / 4.0 < 2.0


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
    view = view_of(replace(scene, boards=scene.boards + shadows), pose)
    error = error_of(locate_sweep(view, room, MOUNT, CONFIG), pose)
    assert np.hypot(error[0], error[1]) < 0.006
    assert abs(error[2]) < np.radians(0.1)


def test_other_things_in_the_papers_colours_do_not_lead_astray() -> None:
    room = rectangle_room(papers=EAST)
    others = tuple(
        Paper(color, center, width, height)
        for color, center, width, height in (
            ('red', (0.0, 2.0, 1.2), 0.4, 0.3),
            ('red', (3.0, 0.0, 1.0), 0.21, 0.297),
            ('green', (1.5, 5.0, 1.3), 0.21, 0.297),
            ('green', (6.0, 4.4, 1.2), 0.15, 0.2),
            ('blue', (4.0, 5.0, 1.2), 0.3, 0.3),
            ('blue', (0.0, 3.4, 1.2), 0.21, 0.297),
        )
    )
    pose = np.array([3.2, 2.4, 1.0])
    view = view_of(scene_of(room, EAST + others), pose, np.random.default_rng(1))
    error = error_of(locate_sweep(view, room, MOUNT, CONFIG), pose)
    assert np.hypot(error[0], error[1]) < 0.02
    assert abs(error[2]) < np.radians(0.2)


def test_a_paper_across_the_seam_of_the_panorama_is_found() -> None:
    room = rectangle_room(papers=EAST)
    behind = np.array([3.6, 2.3, np.pi])  # the papers hang at azimuth 180 deg
    error = error_of(locate_sweep(view_of(scene_of(room), behind), room, MOUNT, CONFIG), behind)
    assert np.hypot(error[0], error[1]) < 0.002


def test_a_missing_paper_is_named() -> None:
    room = rectangle_room(papers=EAST)
    view = view_of(scene_of(room, EAST[:2]), np.array([3.5, 2.0, 0.3]))
    with pytest.raises(LandmarkNavError, match='not found: blue of red, green, blue') as caught:
        locate_sweep(view, room, MOUNT, CONFIG)
    assert '\n' not in str(caught.value)


def test_a_paper_that_is_half_covered_gives_no_wrong_place() -> None:
    room = rectangle_room(papers=EAST)
    scene = scene_of(room)
    cover = Board(
        np.array([5.9, 3.68, 1.0]), np.array([-1.0, 0.0, 0.0]), 0.25, 1.0, flat_texture(GREY)
    )
    pose = np.array([3.5, 2.0, 0.3])
    view = view_of(replace(scene, boards=(*scene.boards, cover)), pose)
    try:
        place = locate_sweep(view, room, MOUNT, CONFIG)
    except LandmarkNavError:
        return
    error = error_of(place, pose)
    assert np.all(np.abs(error) < 4.0 * np.sqrt(np.diag(place.covariance)[[0, 1, 3]]))


def test_papers_that_hang_elsewhere_than_the_room_says_are_refused() -> None:
    told = rectangle_room(papers=EAST)
    hung = (EAST[0], replace(EAST[1], center=(2.0, 0.0, 1.3)), EAST[2])
    view = view_of(scene_of(told, hung), np.array([3.5, 2.0, 0.3]))
    with pytest.raises(LandmarkNavError, match=r'check colours, sizes and places'):
        locate_sweep(view, told, MOUNT, CONFIG)


def test_two_places_that_fit_alike_are_named() -> None:
    # The same three papers twice, on opposite walls: which ones does the room mean?
    room = rectangle_room(papers=EAST)
    twins = tuple(replace(p, center=(0.0, 5.0 - p.center[1], p.center[2])) for p in EAST)
    pose = np.array([3.3, 2.4, 0.2])
    view = view_of(scene_of(room, EAST + twins), pose)
    with pytest.raises(LandmarkNavError, match=r'ambiguous.*fit alike'):
        locate_sweep(view, room, MOUNT, CONFIG)


@pytest.mark.parametrize('count', [0, 2])
def test_fewer_than_three_papers_are_no_reference_area(count: int) -> None:
    room = rectangle_room(papers=EAST[:count])
    view = view_of(scene_of(room), np.array([3.5, 2.0, 0.3]))
    with pytest.raises(LandmarkNavError, match=f'names {count} reference papers.*sweep/pose'):
        locate_sweep(view, room, MOUNT, CONFIG)


def test_an_unknown_colour_is_refused_by_name() -> None:
    papers = (*EAST[:2], replace(EAST[2], color='mauve'))
    view = view_of(scene_of(rectangle_room(papers=EAST)), np.array([3.5, 2.0, 0.3]))
    with pytest.raises(LandmarkNavError, match="'mauve' is not known"):
        locate_sweep(view, rectangle_room(papers=papers), MOUNT, CONFIG)
