"""Markers for RViz and Foxglove: ends of lines, sizes of ellipses."""

from __future__ import annotations

from typing import Any

from bare_landmarks import bare_landmark
import numpy as np
import pytest
from wire import over_the_wire

from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.walls import Wall
from landmark_nav.messages import encode
from landmark_nav.messages.factory import rosbag_factory
from landmark_nav.types import Detections, LandmarkMap, PoseEstimate, Triplet

FACTORY = rosbag_factory()
ADD = 0
MOUNT = PanTiltMount(axis_xyz=(0.2, 0.1, 1.1), axis_rpy=(0.0, 0.0, 0.3))
CAMERA = CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0)
POSITIONS = np.array([[4.0, 1.0, 1.5], [4.0, -1.0, 1.2], [3.0, 3.0, 1.8], [-2.0, 3.0, 1.0]])
POSE = PoseEstimate(5 * 10**9, np.array([0.5, -0.2, 0.4]), np.diag([0.04, 0.01, 1e-4]))
MAP = LandmarkMap(
    tuple(bare_landmark(10 + k, place, 1e-4 * np.eye(3)) for k, place in enumerate(POSITIONS)),
    walls=(Wall('w', (4.0, -2.0), (4.0, 3.0), 2.5),),
    panorama_poses=(POSE, POSE),
)


def drawn(message):
    """Markers by namespace, after a trip through a bag; those before are cleared first."""
    first, *rest = over_the_wire(message).markers
    assert first.action != ADD
    found: dict[str, list[Any]] = {}
    for marker in rest:
        assert marker.action == ADD
        assert marker.header.frame_id == 'map'
        found.setdefault(marker.ns, []).append(marker)
    keys = [(marker.ns, marker.id) for marker in rest]
    assert len(set(keys)) == len(keys)
    return found


def points(markers):
    (marker,) = markers
    return np.array([(p.x, p.y, p.z) for p in marker.points])


def view(ids, bearings, triplet):
    count = len(ids)
    found = Detections(
        POSE.stamp_ns,
        np.array(ids),
        np.asarray(bearings, float),
        np.full(count, 1e-6),
        np.full(count, 0.9),
        np.zeros((count, 2)),
    )
    return drawn(
        encode.view_markers(FACTORY, POSE, MAP, MOUNT, CAMERA, 0.2, found, triplet, 'map')
    )


def test_the_triplet_is_joined_to_the_axis_and_the_view_is_as_wide_as_the_cameras():
    triplet = Triplet(0, np.array([12, 10, 99]), np.zeros(3), np.zeros(3), np.eye(3), 0.0)
    found = view([], [], triplet)
    np.testing.assert_allclose(points(found['triplet'])[1::2], POSITIONS[[2, 0]])
    fan = points(found['field_of_view'])
    sides = fan[[1, -2], :2] - fan[0, :2]
    azimuths = np.arctan2(sides[:, 1], sides[:, 0])
    assert azimuths[1] - azimuths[0] == pytest.approx(2.0 * CAMERA.half_fov_rad)
    assert azimuths.mean() == pytest.approx(0.4 + 0.3 + 0.2)


def test_ellipses_are_three_sigma_and_the_protection_level():
    turned = np.array([[0.05, 0.02, 0.0], [0.02, 0.03, 0.0], [0.0, 0.0, 1e-4]])
    estimate = PoseEstimate(0, POSE.pose, turned)
    level = PoseEstimate(0, POSE.pose, 16.0 * turned)
    found = drawn(encode.pose_markers(FACTORY, estimate, level))
    for name, sigmas in (('three_sigma', 3.0), ('protection_level', 4.0)):
        off = points(found[name])[:, :2] - POSE.pose[:2]
        distance = np.sqrt(np.sum(off @ np.linalg.inv(turned[:2, :2]) * off, axis=1))
        np.testing.assert_allclose(distance, sigmas)
    assert 'protection_level' not in drawn(encode.pose_markers(FACTORY, estimate))


def test_a_map_shows_each_landmark_its_normal_its_number_and_the_sweeps():
    found = drawn(encode.landmark_markers(FACTORY, MAP, 7))
    normals = points(found['normals']).reshape(-1, 2, 3)
    np.testing.assert_allclose(normals[:, 0], POSITIONS)
    along = normals[:, 1] - normals[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    np.testing.assert_allclose(along, MAP.normals)
    assert [marker.text for marker in found['numbers']] == ['10', '11', '12', '13']
    assert len(found['uncertainty']) == len(found['landmarks']) == len(POSITIONS)
    # An arrow and a word for each.
    assert len(found['sweeps']) == 4
    assert len(points(found['walls'])) == 6
    assert drawn(encode.landmark_markers(FACTORY, LandmarkMap(()), 7)) == {}
