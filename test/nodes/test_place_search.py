"""When the localizer looks for its place by itself."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.detection.prior import PriorTrack
from landmark_nav.localization.looking import LookingConfig
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.types import LandmarkMap, OdometrySample, PoseEstimate

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from landmark_nav.nodes.place_search import PlaceSearch, PlaceSearchConfig

SECOND = 10**9
SURE, WIDE = 1e-4 * np.eye(3), np.eye(3)


@pytest.fixture
def prior() -> PriorTrack:
    return PriorTrack(0.5)


@pytest.fixture
def search(prior: PriorTrack) -> PlaceSearch:
    node: Any = SimpleNamespace(advertise=lambda _name: None, offer=lambda *_, **__: None)
    made = PlaceSearch(
        node,
        PanTiltMount(),
        PlaceSearchConfig(),
        'map',
        prior.recent,
        OdometryNoiseConfig(),
        LookingConfig(),
    )
    landmark: Any = SimpleNamespace()
    made.use(LandmarkMap((landmark,)))
    made.add_odometry(OdometrySample(0, np.zeros(3)))
    return made


def fuse(prior: PriorTrack, stamp_ns: int, covariance: np.ndarray) -> None:
    pose = PoseEstimate(stamp_ns, np.zeros(3), covariance)
    prior.add(pose, OdometrySample(stamp_ns, np.zeros(3)))


def test_nobody_told_the_place(search: PlaceSearch) -> None:
    search.consider(0)
    assert search.active


def test_a_fused_pose_that_is_late_is_waited_for(search: PlaceSearch, prior: PriorTrack) -> None:
    fuse(prior, 0, SURE)
    search.consider(SECOND)
    assert not search.active
    search.consider(3 * SECOND)
    assert search.active, 'who fused has ended'
    fuse(prior, 3 * SECOND, SURE)
    search.consider(3 * SECOND)
    assert not search.active


def test_a_pose_that_is_not_known(search: PlaceSearch, prior: PriorTrack) -> None:
    fuse(prior, 0, WIDE)
    search.consider(0)
    assert search.active
