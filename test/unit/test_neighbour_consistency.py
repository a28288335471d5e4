"""What is found where all around it has changed is trusted little."""

from __future__ import annotations

from dataclasses import replace

from bare_landmarks import bare_landmark
import numpy as np
import pytest
from rendered_drives import camera_image, MOUNT, ROOM, SCENE
from scenes import true_landmark

from landmark_nav.localization.detection.neighbour_consistency import NeighbourConsistency
from landmark_nav.localization.observation import Observation, ObservationConfig, Observer
from landmark_nav.types import CameraFrame, LandmarkMap, PoseEstimate

WEST, SOUTH = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
# Three that hang together, one of another wall about the corner, one far away.
PLACES = [(0.0, 0.3, 1.2), (0.0, 0.6, 1.2), (0.0, 0.7, 1.5), (0.2, 0.0, 1.2), (0.0, 3.0, 1.2)]
NORMALS = [WEST, WEST, WEST, SOUTH, WEST]


@pytest.fixture
def neighbour_consistency() -> NeighbourConsistency:
    landmarks = [
        bare_landmark(k + 1, np.array(place), 1e-6 * np.eye(3), normal=normal)
        for k, (place, normal) in enumerate(zip(PLACES, NORMALS, strict=True))
    ]
    return NeighbourConsistency(LandmarkMap(tuple(landmarks)))


def columns(*places: int) -> np.ndarray:
    return np.array(places, dtype=np.intp)


def test_what_is_found_alone_among_what_is_missing_is_flagged(
    neighbour_consistency: NeighbourConsistency,
) -> None:
    every = columns(0, 1, 2, 3, 4)
    assert not neighbour_consistency.variance_m2(every).any(), 'nothing was looked for'
    neighbour_consistency.note(columns(0, 3, 4), columns(1))
    # The one about the corner, and the one far away, hang with none of them.
    np.testing.assert_array_equal(
        neighbour_consistency.variance_m2(columns(3, 0, 4)) > 0.0, [0, 1, 0]
    )
    neighbour_consistency.note(columns(2), columns())
    assert not neighbour_consistency.variance_m2(columns(0)).any(), (
        'one of its neighbours is still there'
    )
    neighbour_consistency.note(columns(), columns(2))
    assert neighbour_consistency.variance_m2(columns(0)).all()


def test_a_map_without_landmarks() -> None:
    neighbour_consistency = NeighbourConsistency(LandmarkMap(()))
    neighbour_consistency.note(columns(), columns())
    assert neighbour_consistency.variance_m2(columns()).shape == (0,)


def look(
    frame: CameraFrame,
    landmark_map: LandmarkMap,
    pose: np.ndarray,
    before: CameraFrame | None = None,
) -> Observation:
    prior = PoseEstimate(0, pose, np.diag(np.square([0.01, 0.01, 0.005])))
    observer = Observer(landmark_map, MOUNT, ObservationConfig())
    if before is not None:
        assert not len(observer.look(before, prior).detections)
    return observer.look(frame, prior)


def test_bearings_of_an_image_where_the_neighbours_were_exchanged() -> None:
    board = next(board for board in SCENE.boards if board.normal[0] < -0.9)
    viewpoint = np.array([2.5, 2.2, 1.15])
    along = np.array([-0.9, -0.1, 0.3, 1.0])
    landmarks = tuple(
        true_landmark(SCENE, k + 1, board, x, z, viewpoint, sigma_m=1e-3)
        for k, (x, z) in enumerate(zip(along, (0.1, 0.1, -0.05, 0.0), strict=True))
    )
    landmark_map = LandmarkMap(landmarks, walls=ROOM.walls)
    pose = np.array([2.0, 2.2, 0.0])
    frame = camera_image(pose, 0.0, np.random.default_rng(3))
    usual = look(frame, landmark_map, pose)
    assert set(usual.detections.ids) == {1, 2, 3, 4}
    # A lens that was covered says nothing of them.
    dark = replace(frame, stamp_ns=-1, image=np.zeros_like(frame.image))
    later = look(frame, landmark_map, pose, before=dark)
    np.testing.assert_allclose(later.detections.variance_rad2, usual.detections.variance_rad2)
    u, v = np.round(usual.detections.uv_px[2]).astype(int)
    image = frame.image.copy()
    image[v - 14 : v + 15, u - 14 : u + 40] = 128
    changed = look(replace(frame, image=image), landmark_map, pose)
    assert set(changed.detections.ids) == {1, 2, 4}
    sigma = {
        seen: dict(zip(seen.ids.tolist(), np.sqrt(seen.variance_rad2).tolist(), strict=True))
        for seen in (usual.detections, changed.detections)
    }
    before, after = sigma[usual.detections], sigma[changed.detections]
    assert after[2] > 3.0 * before[2]
    # A centimetre, as seen from there.
    assert after[2] == pytest.approx(0.01 / 2.9, rel=0.1)
    for k in (1, 4):
        assert after[k] < 1.2 * before[k]
