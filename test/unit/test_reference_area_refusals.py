"""Papers that are hidden, swapped, moved or alike give a refusal with a reason, no wrong pose."""

from dataclasses import replace
import re

import cv2
import numpy as np
from paper_sweeps import deviations, EAST, error_of, locate, MOUNT, scene_of, sweep_at
import pytest
from scenes import Board, flat_texture, rectangle_room

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.walls import Paper
from landmark_nav.learning.reference_area.model import ReferenceAreaConfig
from landmark_nav.learning.sweep_pipeline import why_seen_otherwise

POSE = np.array([3.5, 2.0, 0.3])
# The same three papers on the opposite wall.
TWINS = tuple(replace(p, center=(0.0, 5.0 - p.center[1], p.center[2])) for p in EAST)


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
        ((EAST[0], replace(EAST[1], color='blue'), replace(EAST[2], color='green')), EAST, ''),
        (EAST + TWINS, EAST, 'ambiguous.*fit alike'),
        (EAST, (), 'names 0 reference papers.*sweep/pose'),
        (EAST, EAST[:2], 'names 2 reference papers.*sweep/pose'),
    ],
    ids=['missing', 'hidden', 'swapped', 'ambiguous', 'none', 'two'],
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
    frames = []
    for frame in sweep.frames:
        grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
        # As JPEG of three channels, the way colour cameras send it in the dark.
        jpeg = cv2.imencode('.jpg', cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))[1]
        image = np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), dtype=np.uint8)
        frames.append(replace(frame, image=image))
    with pytest.raises(LandmarkNavError, match='by their colour, and the images have none'):
        locate(replace(sweep, frames=tuple(frames)), room)


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
    pose = POSE
    sweep, room = covered(share, pose, tall)
    place = locate(sweep, room)
    assert deviations(place, pose).max() < 3.5
    assert np.hypot(*error_of(place, pose)[:2]) < 0.02


@pytest.mark.parametrize(
    'center', [(2.0, 0.0, 1.3), (6.0, 2.38, 1.35), (6.0, 2.3, 1.43), (6.0, 2.315, 1.35)], ids=str
)
def test_papers_that_hang_elsewhere_than_the_room_states(center):
    """A refusal, or, where what is seen of the paper can't be its, the place by the others."""
    given = rectangle_room(papers=EAST)
    hung = (EAST[0], replace(EAST[1], center=center), EAST[2])
    pose = POSE
    sweep = sweep_at(scene_of(given, hung), pose)
    try:
        place = locate(sweep, given)
    except LandmarkNavError as error:
        message = str(error)
    else:
        assert deviations(place, pose).max() < 3.0
        return
    assert re.search('not found: green|do not fit together|no place .* green', message)


@pytest.mark.parametrize('rise_m', [0.1, 0.3, -0.15])
def test_a_camera_at_another_height_is_refused_unless_it_may_stand_there(rise_m):
    room, pose = rectangle_room(papers=EAST), POSE
    sweep = sweep_at(scene_of(room), pose, rise_m=rise_m)
    with pytest.raises(LandmarkNavError) as refused:
        locate(sweep, room)
    given = re.search(r'camera is (\S+) cm (higher|lower) than robot.yaml', str(refused.value))
    assert given is not None
    assert float(given[1]) == pytest.approx(100.0 * abs(rise_m), abs=1.0)
    assert given[2] == ('higher' if rise_m > 0.0 else 'lower')
    place = locate(sweep, room, config=ReferenceAreaConfig(height_sigma_m=0.1))
    assert deviations(place, pose).max() < 3.5
    sigma = np.sqrt(place.covariance[2, 2])
    assert abs(place.height_m - MOUNT.axis_xyz[2] - rise_m) < 3.5 * sigma
    assert sigma < 0.01


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


def test_papers_beside_what_a_partial_sweep_saw_are_not_blamed():
    room = rectangle_room(papers=EAST)
    sweep = sweep_at(scene_of(room), POSE)
    ahead = [wrap_rad(frame.pan_rad) for frame in sweep.frames]
    part = tuple(f for f, pan in zip(sweep.frames, ahead, strict=True) if pan > np.median(ahead))
    assert 0 < len(part) < len(sweep.frames)
    with pytest.raises(LandmarkNavError, match=r'out of what the sweep saw .nothing is seen'):
        locate(replace(sweep, frames=part), room)
