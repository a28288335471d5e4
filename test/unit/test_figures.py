from functools import partial

from bare_landmarks import bare_landmark
import cv2
import numpy as np
import pytest
from scenes import rectangle_room

from landmark_nav.evaluation.figures import (
    draw_errors,
    draw_map,
    draw_panorama,
    draw_trajectory,
)
from landmark_nav.evaluation.metrics import PoseTrack
from landmark_nav.evaluation.replay import Replay
from landmark_nav.evaluation.run_report import run_errors
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.walls import Paper
from landmark_nav.localization.localizer import LocalizationUpdate
from landmark_nav.localization.observer import Observation
from landmark_nav.types import (
    Candidate,
    Detections,
    LandmarkMap,
    Panorama,
    PoseEstimate,
    Refusal,
)

WALLS = rectangle_room(5.0, 4.0, ()).walls

# How the figures draw landmarks, as OpenCV reads it back.
LANDMARK_BGR = (0x73, 0x9E, 0x00)


def landmark(identity, x):
    normal = np.array([0.0, 1.0, 0.0])
    position = np.array([x, 0.0, 1.2])
    return bare_landmark(identity, position, 1e-4 * np.eye(3), normal=normal, wall_id='south')


def a_map(count=3):
    places = (PoseEstimate(0, np.array([2.0, 2.0, 0.3]), 1e-5 * np.eye(3)),)
    members = tuple(landmark(k, 0.5 + 0.4 * k) for k in range(count))
    return LandmarkMap(members, 'map', WALLS, places)


def a_panorama():
    """A grey one."""
    cylinder, pixels = Cylinder(400, 80, 64.0, 199.5, 40.0), np.full((80, 400, 3), 200, np.uint8)
    return Panorama(0, pixels, np.ones((80, 400), bool), cylinder, np.zeros(3), 0.0, np.eye(4))


def share_of(path, color):
    """Share of an image that has a colour; fails if it is no image."""
    camera_image = cv2.imread(str(path))
    assert camera_image is not None
    return float(np.mean(np.all(np.abs(camera_image.astype(int) - color) < 30, axis=-1)))


def test_map_shows_its_landmarks(tmp_path):
    papers = [Paper('red', (1, 0.02, 1.7), 0.2, 0.3), Paper('#8020c0', (2, 0.02, 1.7), 0.2, 0.3)]
    full, again, empty = (tmp_path / f'{name}.png' for name in ('map', 'again', 'empty'))
    for path, count in ((full, 3), (again, 3), (empty, 0)):
        draw_map(a_map(count), path, papers)
    assert share_of(full, LANDMARK_BGR) > share_of(empty, LANDMARK_BGR)
    assert full.read_bytes() == again.read_bytes()
    assert share_of(full, (0xC0, 0x20, 0x80)) > 0.0


@pytest.mark.parametrize('column', [100.0, 1.0, 399.0])
def test_panorama_marks_what_was_elected(tmp_path, column):
    view = a_panorama()
    candidates = [Candidate(column, 40.0, 20, 20, 1.0)]
    draw_panorama(view, candidates, [landmark(7, 1.0)], tmp_path / 'elected.png')
    draw_panorama(view, candidates, [Refusal('too far')], tmp_path / 'refused.png')
    assert share_of(tmp_path / 'elected.png', LANDMARK_BGR) > 0.0005
    assert share_of(tmp_path / 'refused.png', LANDMARK_BGR) == 0.0


def chosen(fix):
    return fix or Refusal('too few')


def a_run(truth=True, fixed=True):
    updates = []
    for k in range(30):
        pose = np.array([1.0 + 0.05 * k, 1.0, 0.1])
        fused = PoseEstimate(k * 10**8, pose + 0.01, np.diag([4e-4, 1e-4, 1e-5]))
        none = np.empty(0)
        seen = Detections(fused.stamp_ns, np.empty(0, int), none, none, none, np.empty((0, 2)))
        updates.append(
            LocalizationUpdate(
                fused.stamp_ns,
                Observation(seen, {}, partial(chosen, fused if fixed and k % 3 else None)),
                k % 3,
                fused,
                'lost' if k > 25 else 'tracking',
                '',
            )
        )
    stamps = np.arange(30) * 10**8
    poses = np.array([[1.0 + 0.05 * k, 1.0, 0.1] for k in range(30)])
    known = PoseTrack(stamps, poses) if truth else PoseTrack.of([])
    odometry = PoseTrack(stamps, poses + 0.03)
    start = PoseEstimate(0, poses[0], np.eye(3))
    return Replay(start, (), tuple(updates), np.full(30, 0.01), odometry, known, 1.0)


@pytest.mark.parametrize(('truth', 'fixed'), [(True, True), (False, True), (True, False)])
def test_runs_are_drawn_whatever_is_missing(tmp_path, truth, fixed, recwarn):
    run = a_run(truth, fixed)
    draw_trajectory(run, a_map(), tmp_path / 'trajectory.png')
    draw_errors(run, run_errors(run), tmp_path / 'errors.png')
    assert share_of(tmp_path / 'trajectory.png', LANDMARK_BGR) > 0.0
    assert cv2.imread(str(tmp_path / 'errors.png')) is not None
    assert [str(warning.message) for warning in recwarn] == []
