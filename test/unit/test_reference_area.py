"""Poses of sweeps by papers in any light, or a refusal with its reason; the fault is named."""

from dataclasses import replace
from functools import lru_cache
import re

from builders import nees, pose_error
import cv2
import numpy as np
import pytest
from scenes import Board, draw_frame, flat_texture, paper_board, rectangle_room, Scene, wall_board

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.walls import Paper
from landmark_nav.learning.panorama.synthesis import synthesize_cylinder
from landmark_nav.learning.reference_area.edges import PaperOutlines
from landmark_nav.learning.reference_area.faults import paper_faults, PaperRecord, PaperView
from landmark_nav.learning.reference_area.location import PaperSearch
from landmark_nav.learning.reference_area.model import ReferenceAreaConfig
from landmark_nav.learning.sweep_pipeline import why_seen_otherwise
from landmark_nav.simulation.setup_documents import moved_paper
from landmark_nav.types import Sweep

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


@lru_cache(maxsize=8)
def scene_of(room, papers=None):
    walls = [
        wall_board(wall, flat_texture((g, g, g)))
        for wall, g in zip(room.walls, (170.0, 150.0, 160.0, 140.0), strict=True)
    ]
    shown = room.papers if papers is None else papers
    return Scene((*walls, *(paper_board(paper, room) for paper in shown)))


def sweep_at(
    scene,
    pose,
    rng=None,
    *,
    mount=MOUNT,
    rise_m=0.0,
    tilt_rad=0.0,
    towards=EAST,
    pan_sigma_rad=0.0,
):
    """Frames that look towards some papers, as JPEG with halved colours."""
    axis = mount.axis_pose_map(pose)
    azimuth = se2.bearings(axis, np.array([p.center[:2] for p in towards]))
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
        soft = as_jpeg(cv2.GaussianBlur(frame.image, (0, 0), 0.6), 92)
        frames.append(replace(frame, image=soft, pan_rad=float(pan)))
    return Sweep(0, tuple(frames))


def locate(sweep, room, mount=MOUNT, config=CONFIG):
    view = synthesize_cylinder(sweep, mount)
    return PaperSearch(sweep, view, room, mount, config).located()


def deviations(place, pose):
    """Errors of x, y, heading in their own standard deviations, absolute."""
    return np.abs(pose_error(place.pose_map_base, pose)) / np.sqrt(
        np.diag(place.covariance)[[0, 1, 3]]
    )


def check_place(place, pose, within_m, sigmas):
    assert np.hypot(*pose_error(place.pose_map_base, pose)[:2]) < within_m
    assert deviations(place, pose).max() < sigmas


def as_jpeg(image, quality):
    jpeg = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return cv2.imdecode(jpeg, cv2.IMREAD_COLOR)


def test_noise_and_papers_that_hang_askew_stay_within_the_covariance():
    rng = np.random.default_rng(4)
    room = rectangle_room(papers=CORNER)
    squares = []
    for _ in range(4):
        pose = np.array([*rng.uniform((2.8, 1.6), (4.2, 3.6)), rng.uniform(-np.pi, np.pi)])
        hung = tuple(
            moved_paper(p, room, rng.normal(0.0, CONFIG.paper_sigma_m, 2)) for p in CORNER
        )
        rise = float(rng.normal(0.0, CONFIG.height_sigma_m))
        off = {'rise_m': rise, 'pan_sigma_rad': MOUNT.pan_sigma_rad}
        sweep = sweep_at(scene_of(room, hung), pose, rng, towards=CORNER, **off)
        place = locate(sweep, room)
        height_error = place.height_m - MOUNT.axis_xyz[2] - rise
        error = np.insert(pose_error(place.pose_map_base, pose), 2, height_error)
        squares.append(nees(error, place.covariance))
        sigma = np.sqrt(np.diag(place.covariance))
        assert np.max(np.abs(error) / sigma) < 3.5
        assert sigma[:2].max() < 0.02
        assert sigma[3] < np.radians(0.3)
    assert 0.3 < np.mean(squares) / 4.0 < 2.0


def response(image, gamma):
    return np.asarray(255.0 * (image / 255.0) ** (1.0 / gamma))


def lit(image, *light):
    """Brighter on one side."""
    return np.asarray(image * np.linspace(0.8, 1.2, CAMERA.width)[None, :, None] * light)


@pytest.mark.parametrize(
    'change',
    [
        # What blurs edges blurs light; most cameras write its root: dark papers seem to shrink.
        lambda image: response(image, 1.0),
        lambda image: response(image, 1.8),
        # Dim, warm and cold.
        lambda image: lit(image, 0.35, 0.33, 0.3),
        lambda image: lit(image, 0.6, 0.85, 1.15),
    ],
    ids=['linear', 'gamma', 'dim', 'warm'],
)
def test_other_light_and_response_change_nothing(change):
    room = rectangle_room(papers=EAST)
    pose = np.array([3.4, 2.4, 0.2])
    sweep = sweep_at(scene_of(room), pose)
    images = [np.clip(np.rint(change(f.image)), 0, 255).astype(np.uint8) for f in sweep.frames]
    frames = tuple(replace(f, image=i) for f, i in zip(sweep.frames, images, strict=True))
    check_place(locate(replace(sweep, frames=frames), room), pose, 0.012, 3.0)


def test_other_things_in_the_papers_colours_do_not_mislead():
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
    check_place(locate(sweep, room), pose, 0.02, 3.5)


POSE = np.array([3.5, 2.0, 0.3])
# The same three papers on the opposite wall.
TWINS = tuple(replace(p, center=(0.0, 5.0 - p.center[1], p.center[2])) for p in EAST)
# The upper part of the last one is above the images.
HIGH = (*EAST[:2], replace(EAST[2], center=(6.0, 3.6, 2.05)))


@pytest.mark.parametrize(
    ('hung', 'given', 'message'),
    [
        (EAST[:2], EAST, 'not found: blue of red, green, blue'),
        # Something else of its colour.
        (
            (*EAST[:2], Paper('blue', (6.0, 4.3, 1.1), 0.21, 0.297)),
            EAST,
            'red fits, green fits, blue shows 0 %',
        ),
        # That they are swapped says `paper_faults`, of all sweeps together.
        ((EAST[0], replace(EAST[1], color='blue'), replace(EAST[2], color='green')), EAST, None),
        (EAST + TWINS, EAST, 'ambiguous.*fit alike'),
        (HIGH, HIGH, 'red fits, green fits, blue is cut'),
        (EAST, (), 'names 0 reference papers.*sweep/pose'),
        (EAST, EAST[:2], 'names 2 reference papers.*sweep/pose'),
    ],
    ids=['missing', 'hidden', 'swapped', 'ambiguous', 'cut', 'none', 'two'],
)
def test_papers_that_give_no_place_are_named(hung, given, message):
    room = rectangle_room(papers=given)
    sweep = sweep_at(scene_of(rectangle_room(papers=EAST), hung), POSE, towards=hung)
    with pytest.raises(LandmarkNavError, match=message) as caught:
        locate(sweep, room)
    assert '\n' not in str(caught.value)


def test_images_without_colour_are_reported():
    room = rectangle_room(papers=EAST)
    sweep = sweep_at(scene_of(room), POSE)
    locate(sweep, room)

    def grey(image):
        """As JPEG of three channels, the way colour cameras send it in the dark."""
        return as_jpeg(cv2.merge([cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)] * 3), 95)

    frames = tuple(replace(frame, image=grey(frame.image)) for frame in sweep.frames)
    grey_sweep = replace(sweep, frames=frames)
    with pytest.raises(LandmarkNavError, match='by their colour, and the images have none'):
        locate(grey_sweep, room)
    # It says nothing of where papers hang, so that the next sweep is not doubted for it.
    papers = PaperRecord(room)
    for one in (grey_sweep, sweep):
        papers.add(synthesize_cylinder(one, MOUNT), EYE_M)
        assert papers.faults().fits
    assert len(papers) == 1


def covered(share, pose, tall=False):
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
def test_a_paper_that_is_partly_covered_gives_no_wrong_place(share, tall):
    sweep, room = covered(share, POSE, tall)
    check_place(locate(sweep, room), POSE, 0.02, 3.5)


@pytest.mark.parametrize(
    'center', [(2.0, 0.0, 1.3), (6.0, 2.38, 1.35), (6.0, 2.3, 1.43), (6.0, 2.315, 1.35)], ids=str
)
def test_papers_that_hang_elsewhere_than_the_room_states(center):
    """A refusal, or, where what is seen of the paper can't be its, the place by the others."""
    given = rectangle_room(papers=EAST)
    hung = (EAST[0], replace(EAST[1], center=center), EAST[2])
    sweep = sweep_at(scene_of(given, hung), POSE)
    try:
        assert deviations(locate(sweep, given), POSE).max() < 3.0
    except LandmarkNavError as error:
        why = 'not found: green|do not fit together|no place .* green'
        assert re.search(why, str(error))  # noqa: PT017


ROLLED = replace(MOUNT, camera_roll_rad=np.pi)


@pytest.mark.parametrize(
    ('true', 'given', 'remedy'),
    [
        (ROLLED, MOUNT, 'the camera is .* set camera_roll: 3.1416'),
        (MOUNT, ROLLED, 'set camera_roll: 0,'),
        (
            replace(MOUNT, axis_rpy=(np.pi, 0.0, 0.0)),
            MOUNT,
            r'pan unit is .* pan_axis rpy: \[3.1416, 0',
        ),
        (MOUNT, MOUNT, None),
    ],
)
def test_what_hangs_upside_down_is_reported(true, given, remedy):
    room = rectangle_room(papers=EAST)
    sweep = sweep_at(scene_of(room), POSE, mount=true)
    found = why_seen_otherwise(sweep, room, given, ReferenceAreaConfig())
    assert found is None if remedy is None else re.search(remedy, str(found))


EYE_M = 1.1
AXES = np.array([[3.5, 2.0, 0.3], [2.2, 3.6, -0.8]])
ROOM = rectangle_room(papers=EAST)
# Along the east wall, as seen from inside, left is +y.
LEFT = np.array([0.0, 1.0, 0.0])
SIGMA_RAD = 5e-4

NONE = PaperOutlines(np.zeros((0, 4)), np.zeros(0), np.zeros((0, 4)), np.zeros((0, 4)))


def outlines_of(paper, pose, rng):
    """What is seen of a paper on the east wall from a pose of the pan axis, exactly but noise."""
    center = np.array(paper.center)
    ends = [center + side * 0.5 * paper.width * LEFT for side in (-1.0, 1.0)]
    azimuth = [np.arctan2(end[1] - pose[1], end[0] - pose[0]) - pose[2] for end in ends]
    # Where the bisector of the two directions meets the wall.
    middle = pose[2] + 0.5 * sum(azimuth)
    distance = (center[0] - pose[0]) / np.cos(middle)
    tangent = [(center[2] + up * 0.5 * paper.height - EYE_M) / distance for up in (-1.0, 1.0)]
    seen = np.array([[*azimuth, *tangent]]) + SIGMA_RAD * rng.standard_normal((1, 4))
    return PaperOutlines(seen, np.zeros(1), np.full((1, 4), SIGMA_RAD), np.zeros((1, 4)))


def views_of(papers, seed=0):
    rng = np.random.default_rng(seed)
    return [
        PaperView({p.color: outlines_of(p, pose, rng) for p in papers}, EYE_M) for pose in AXES
    ]


def judged(papers, given=ROOM):
    return paper_faults(views_of(papers), given)


def with_moved(k, left_m=0.0, up_m=0.0):
    x, y, z = EAST[k].center
    moved = replace(EAST[k], center=(x, y + left_m, z + up_m))
    return (*EAST[:k], moved, *EAST[k + 1 :])


@pytest.mark.parametrize('seed', range(6))
def test_papers_that_hang_as_given_fit(seed):
    found = paper_faults(views_of(EAST, seed), ROOM)
    assert found.fits
    assert not found.faults
    assert found.text == ''


@pytest.mark.parametrize(
    ('kind', 'off_m', 'k'),
    [
        *(('along', off_m, k) for off_m, k in ((0.05, 0), (-0.1, 1), (0.2, 2))),
        *(('height', off_m, k) for off_m, k in ((0.05, 2), (-0.1, 0), (0.2, 1))),
    ],
)
def test_a_paper_that_hangs_elsewhere_is_named_with_how_far(kind, off_m, k):
    papers = with_moved(k, left_m=off_m) if kind == 'along' else with_moved(k, up_m=off_m)
    found = judged(papers)
    assert not found.fits
    best = found.faults[0]
    assert (best.kind, best.paper) == (kind, k)
    assert abs(best.value - off_m) < max(4.0 * best.sigma, 0.01)
    assert EAST[k].color in found.text
    # Whatever else explains it as well is another value, not another direction of this one.
    assert all((other.kind, other.paper) != (kind, k) for other in found.faults[1:])


def test_papers_that_changed_colours_are_named():
    swapped = (EAST[0], replace(EAST[1], color='blue'), replace(EAST[2], color='green'))
    assert judged(swapped).faults[0].kind == 'swapped'


def test_a_paper_that_nobody_sees_is_not_laid_to_others_colours():
    # Two faults: green is covered, blue and red hang on each other's places.
    papers = (replace(EAST[0], color='blue'), replace(EAST[2], color='red'))
    views = [PaperView({'green': NONE, **view.outlines}, EYE_M) for view in views_of(papers)]
    found = paper_faults(views, ROOM)
    assert not found.fits
    assert 'swapped' not in [fault.kind for fault in found.faults]


@pytest.mark.parametrize(
    ('kind', 'value', 'width', 'height'),
    [('size', 0.414, 1.414 * EAST[1].width, 1.414 * EAST[1].height),
     ('turned', None, EAST[1].height, EAST[1].width)],
)  # fmt: skip
def test_a_paper_of_another_size_and_one_that_is_turned_are_distinguished(
    kind, value, width, height
):
    found = judged((EAST[0], replace(EAST[1], width=width, height=height), EAST[2])).faults[0]
    assert (found.kind, found.paper) == (kind, 1)
    assert value is None or found.value == pytest.approx(value, abs=0.05)
