"""When the localizer searches the pose without a request."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from rclpy.task import Future

from landmark_nav.calibration import Calibration
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.localization.expected_poses import ExpectedPoses
from landmark_nav.localization.looking import LookingConfig
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.localization.relocalization import RelocalizationConfig, Relocalizer
from landmark_nav.messages import decode
from landmark_nav.nodes.triangulation_localizer import PlaceSearch
from landmark_nav.types import CameraFrame, LandmarkMap, OdometrySample, PoseEstimate

SECOND = 10**9
SURE, WIDE = 1e-4 * np.eye(3), np.eye(3)


@pytest.fixture
def prior():
    return ExpectedPoses(0.5)


@pytest.fixture
def reported():
    return []


@pytest.fixture
def services():
    return {}


@pytest.fixture
def ended():
    return Future()


@pytest.fixture
def search(prior, reported, services, ended):
    publisher = SimpleNamespace(publish=reported.append)

    def offer(service, action, **_):
        services[service] = action

    node: Any = SimpleNamespace(advertise=lambda _name: publisher, offer=offer, ended=ended)
    made = PlaceSearch(
        node,
        Calibration.of_mount(PanTiltMount()),
        RelocalizationConfig(search_s=0.2),
        'map',
        prior.recent,
        OdometryNoiseConfig(),
        LookingConfig(),
    )
    landmark: Any = SimpleNamespace(edge=False)
    made.use(LandmarkMap((landmark,)))
    made.add_odometry(OdometrySample(0, np.zeros(3)))
    return made


def fuse(prior, stamp_ns, covariance):
    pose = PoseEstimate(stamp_ns, np.zeros(3), covariance)
    prior.add(pose, OdometrySample(stamp_ns, np.zeros(3)))


def test_nobody_reported_the_place(search):
    search.consider(0)
    assert search.active


def test_a_fused_pose_that_is_late_is_waited_for(search, prior):
    fuse(prior, 0, SURE)
    search.consider(SECOND)
    assert not search.active
    search.consider(3 * SECOND)
    assert search.active, 'who fused has ended'
    fuse(prior, 3 * SECOND, SURE)
    search.consider(3 * SECOND)
    assert not search.active


def test_a_pose_that_is_not_known(search, prior):
    fuse(prior, 0, WIDE)
    search.consider(0)
    assert search.active


class Finder:
    """Finds a place with every image."""

    in_time = PoseEstimate(SECOND, np.array([1.0, 2.0, 0.5]), SURE)
    landmark_ids = np.array([3, 7])

    def __init__(self, meanwhile=lambda: None):
        self._meanwhile = meanwhile

    def add_odometry(self, sample):
        """Not needed."""

    def add_frame(self, frame):
        self._meanwhile()
        return replace(self.in_time, covariance=WIDE)


def frame_at(stamp_ns):
    lens = CameraModel(16, 16, 16.0, 16.0, 8.0, 8.0)
    return CameraFrame(stamp_ns, np.zeros((16, 16), np.uint8), lens, 0.0, pan_rate_rad_s=0.7)


def test_a_place_is_reported_with_what_it_was_found_from(search, reported):
    search.consider(SECOND)
    search._relocalizer = cast(Relocalizer, Finder())
    search.look(frame_at(SECOND))
    place = decode.global_pose(reported[0])
    assert place.stamp_ns == SECOND
    np.testing.assert_array_equal(place.pose, Finder.in_time.pose)
    np.testing.assert_array_equal(place.covariance, SURE)
    assert place.ids.tolist() == [3, 7]
    assert place.pan_rate_rad_s == 0.7
    # It takes a moment to become the fused pose; if it does not, the search begins anew.
    search.consider(SECOND + SECOND // 2)
    assert not search.active
    search.consider(3 * SECOND)
    assert search.active


def test_a_place_in_a_map_that_is_gone_is_not_reported(search, reported):
    search.consider(SECOND)
    search._relocalizer = cast(Relocalizer, Finder(lambda: search.use(search.landmarks)))
    search.look(frame_at(SECOND))
    assert not reported
    assert search.active
