from __future__ import annotations

from dataclasses import replace
from functools import partial

from bare_landmarks import bare_landmark
import cv2
import numpy as np
import pytest

from landmark_nav.evaluation.figures import (
    draw_errors,
    draw_map,
    draw_panorama,
    draw_trajectory,
    run_figures,
)
from landmark_nav.evaluation.figures.style import free_labels, places_of_numbers, rows_of_labels
from landmark_nav.evaluation.metrics import PoseTrack
from landmark_nav.evaluation.replay import Replay
from landmark_nav.evaluation.run_report import run_errors
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.walls import Paper, Wall
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

WALLS = (
    Wall('south', (0.0, 0.0), (5.0, 0.0), 2.5),
    Wall('east', (5.0, 0.0), (5.0, 4.0), 2.5),
    Wall('north', (5.0, 4.0), (0.0, 4.0), 2.5),
    Wall('west', (0.0, 4.0), (0.0, 0.0), 2.5),
)

# How the figures draw landmarks, as OpenCV reads it back.
LANDMARK_BGR = (0x73, 0x9E, 0x00)


def landmark(identity, x):
    return bare_landmark(
        identity,
        np.array([x, 0.0, 1.2]),
        1e-4 * np.eye(3),
        normal=np.array([0.0, 1.0, 0.0]),
        wall_id='south',
    )


def a_map(count=3):
    places = (PoseEstimate(0, np.array([2.0, 2.0, 0.3]), 1e-5 * np.eye(3)),)
    members = tuple(landmark(k, 0.5 + 0.4 * k) for k in range(count))
    return LandmarkMap(members, 'map', WALLS, places)


def share_of(path, color):
    """Share of an image that has a colour; fails if it is no image."""
    camera_image = cv2.imread(str(path))
    assert camera_image is not None
    return float(np.mean(np.all(np.abs(camera_image.astype(int) - color) < 30, axis=-1)))


def test_map_shows_its_landmarks(tmp_path):
    papers = [Paper('red', (1, 0.02, 1.7), 0.2, 0.3), Paper('#8020c0', (2, 0.02, 1.7), 0.2, 0.3)]
    draw_map(a_map(), tmp_path / 'map.png', papers)
    draw_map(a_map(), tmp_path / 'again.png', papers)
    draw_map(a_map(0), tmp_path / 'empty.png')
    assert share_of(tmp_path / 'map.png', LANDMARK_BGR) > share_of(
        tmp_path / 'empty.png', LANDMARK_BGR
    )
    assert (tmp_path / 'map.png').read_bytes() == (tmp_path / 'again.png').read_bytes()
    assert share_of(tmp_path / 'map.png', (0xC0, 0x20, 0x80)) > 0.0


def test_numbers_of_neighbours_do_not_lie_on_each_other():
    along = np.cumsum(np.random.default_rng(0).uniform(0.06, 0.3, 12))
    positions = np.column_stack([along, np.zeros(12)])
    normals = np.tile([0.0, 1.0], (12, 1))
    # Numbers of two digits, and a metre of the room in an inch of the figure.
    places, has_room = places_of_numbers(positions, normals, np.arange(10, 22), 1.0)
    assert np.all(places[:, 1] < 0.0)
    apart = np.abs(places[:, None] - places[None])
    clear = (apart[..., 0] > 0.16) | (apart[..., 1] > 0.09) | np.eye(12, dtype=bool)
    assert clear.all()
    assert 0 < has_room.sum() < 12
    assert places[has_room, 1].min() > places[~has_room, 1].max()


def test_labels_that_are_kept_do_not_overlap_and_those_left_out_lie_on_one_kept():
    rng = np.random.default_rng(2)
    corners, sizes = rng.uniform(0.0, 10.0, (60, 2)), rng.uniform(0.5, 1.5, (60, 2))
    kept = free_labels(corners, sizes)
    low, high = corners[:, None], corners[:, None] + sizes[:, None]
    meet = np.all((low < high.swapaxes(0, 1)) & (low.swapaxes(0, 1) < high), axis=2)
    assert 1 < kept.sum() < 60
    assert np.array_equal(meet[kept][:, kept], np.eye(kept.sum(), dtype=bool))
    assert meet[~kept][:, kept].any(axis=1).all()


def test_a_row_holds_labels_that_do_not_touch_and_no_row_is_wasted():
    rng = np.random.default_rng(1)
    centers, widths = rng.uniform(0.0, 8.0, 30), rng.uniform(0.2, 1.0, 30)
    rows = rows_of_labels(centers, widths)
    low, high = centers - widths / 2.0, centers + widths / 2.0
    meet = (low[:, None] < high) & (low < high[:, None])
    assert not np.any(meet & (rows[:, None] == rows) & ~np.eye(30, dtype=bool))
    # As many rows as labels lie above some place.
    assert rows.max() + 1 == max(np.sum((low <= place) & (place < high)) for place in low)


@pytest.mark.parametrize('column', [100.0, 1.0, 399.0])
def test_panorama_marks_what_was_elected(tmp_path, column):
    view = Panorama(
        0,
        np.full((80, 400, 3), 200, np.uint8),
        np.ones((80, 400), np.bool_),
        Cylinder(400, 80, 64.0, 199.5, 40.0),
        np.zeros(3),
        0.0,
        np.eye(4),
    )
    candidates = [Candidate(column, 40.0, 20, 20, 1.0)]
    draw_panorama(view, candidates, [landmark(7, 1.0)], 1, tmp_path / 'elected.png')
    draw_panorama(view, candidates, [Refusal('too far')], 1, tmp_path / 'refused.png')
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


def test_lines_follow_odometry_where_images_are_far_apart(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(run_figures, 'save', lambda figure, _path: drawn.append(figure))
    run = a_run()
    # Half a circle out of sight.
    stamps = np.arange(0, 29 * 10**8 + 1, 10**7)
    angle = np.pi * stamps / stamps[-1]
    arc = np.column_stack([1.0 - np.cos(angle), np.sin(angle), 0.5 * np.pi - angle])
    run = replace(run, odometry=PoseTrack(stamps, arc), updates=run.updates[::29])
    draw_trajectory(run, a_map(), tmp_path / 'trajectory.png')
    (fused,) = (line for line in drawn[0].axes[0].lines if line.get_label() == 'fused')
    way_m = np.hypot(*np.diff(fused.get_xydata(), axis=0).T)
    assert np.sum(way_m[:-1]) == pytest.approx(np.pi, abs=0.02)


@pytest.mark.parametrize(('truth', 'fixed'), [(True, True), (False, True), (True, False)])
def test_runs_are_drawn_whatever_is_missing(tmp_path, truth, fixed, recwarn):
    run = a_run(truth, fixed)
    draw_trajectory(run, a_map(), tmp_path / 'trajectory.png')
    draw_errors(run, run_errors(run), tmp_path / 'errors.png')
    assert share_of(tmp_path / 'trajectory.png', LANDMARK_BGR) > 0.0
    assert cv2.imread(str(tmp_path / 'errors.png')) is not None
    assert [str(warning.message) for warning in recwarn] == []
