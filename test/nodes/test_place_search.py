"""When the localizer searches the pose without a request."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from landmark_nav.calibration import Calibration
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.localization.expected_poses import ExpectedPoses
from landmark_nav.localization.looking import LookingConfig
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.localization.relocalization import RelocalizationConfig, Relocalizer
from landmark_nav.messages import decode
from landmark_nav.types import CameraFrame, LandmarkMap, OdometrySample, PoseEstimate

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from rclpy.task import Future

from landmark_nav.nodes.triangulation_localizer import PlaceSearch

SECOND = 10**9
SURE, WIDE = 1e-4 * np.eye(3), np.eye(3)


@pytest.fixture
def prior() -> ExpectedPoses:
    return ExpectedPoses(0.5)


@pytest.fixture
def reported() -> list[Any]:
    return []


@pytest.fixture
def services() -> dict[str, Any]:
    return {}


@pytest.fixture
def ended() -> Future[None]:
    return Future()


@pytest.fixture
def search(
    prior: ExpectedPoses, reported: list[Any], services: dict[str, Any], ended: Future[None]
) -> PlaceSearch:
    publisher = SimpleNamespace(publish=reported.append)

    def offer(service: str, action: Any, **_: Any) -> None:
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
    landmark: Any = SimpleNamespace()
    made.use(LandmarkMap((landmark,)))
    made.add_odometry(OdometrySample(0, np.zeros(3)))
    return made


def fuse(prior: ExpectedPoses, stamp_ns: int, covariance: np.ndarray) -> None:
    pose = PoseEstimate(stamp_ns, np.zeros(3), covariance)
    prior.add(pose, OdometrySample(stamp_ns, np.zeros(3)))


def test_nobody_reported_the_place(search: PlaceSearch) -> None:
    search.consider(0)
    assert search.active


def test_a_fused_pose_that_is_late_is_waited_for(
    search: PlaceSearch, prior: ExpectedPoses
) -> None:
    fuse(prior, 0, SURE)
    search.consider(SECOND)
    assert not search.active
    search.consider(3 * SECOND)
    assert search.active, 'who fused has ended'
    fuse(prior, 3 * SECOND, SURE)
    search.consider(3 * SECOND)
    assert not search.active


def test_a_pose_that_is_not_known(search: PlaceSearch, prior: ExpectedPoses) -> None:
    fuse(prior, 0, WIDE)
    search.consider(0)
    assert search.active


class Finder:
    """Finds a place with every image."""

    in_time = PoseEstimate(SECOND, np.array([1.0, 2.0, 0.5]), SURE)
    landmark_ids = np.array([3, 7])

    def __init__(self, meanwhile: Callable[[], None] = lambda: None) -> None:
        self._meanwhile = meanwhile

    def add_odometry(self, sample: OdometrySample) -> None:
        """Not needed."""

    def add_frame(self, frame: CameraFrame) -> PoseEstimate:
        self._meanwhile()
        return replace(self.in_time, covariance=WIDE)


def frame_at(stamp_ns: int) -> CameraFrame:
    lens = CameraModel(16, 16, 16.0, 16.0, 8.0, 8.0)
    return CameraFrame(stamp_ns, np.zeros((16, 16), np.uint8), lens, 0.0, pan_rate_rad_s=0.7)


def test_a_place_is_reported_with_what_it_was_found_from(
    search: PlaceSearch, reported: list[Any]
) -> None:
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


def test_a_place_in_a_map_that_is_gone_is_not_reported(
    search: PlaceSearch, reported: list[Any]
) -> None:
    search.consider(SECOND)
    search._relocalizer = cast(Relocalizer, Finder(lambda: search.use(search.landmarks)))
    search.look(frame_at(SECOND))
    assert not reported
    assert search.active


def answer(call: Coroutine[None, None, str]) -> str:
    """Go on with a call until it is answered."""
    try:
        while True:
            call.send(None)
    except StopIteration as end:
        return str(end.value)


def test_a_call_is_answered_with_the_place_it_reported(
    search: PlaceSearch, reported: list[Any], services: dict[str, Any]
) -> None:
    call = services['relocalize']()
    call.send(None)
    search._relocalizer = cast(Relocalizer, Finder())
    search.look(frame_at(SECOND))
    assert answer(call) == 'found at (1.00, 2.00) m, 28.6 deg'
    assert len(reported) == 1


def test_a_call_is_not_answered_with_a_place_that_was_not_reported(
    search: PlaceSearch, reported: list[Any], services: dict[str, Any]
) -> None:
    """The search of a lost robot finds the place as the call begins another."""
    call = services['relocalize']()
    search.consider(SECOND)
    search._relocalizer = cast(Relocalizer, Finder(lambda: call.send(None)))
    search.look(frame_at(SECOND))
    with pytest.raises(LandmarkNavError, match='no image came'):
        answer(call)
    assert not reported


def test_calls_during_a_search_get_the_same_answer(
    search: PlaceSearch, reported: list[Any], services: dict[str, Any]
) -> None:
    first, second = services['relocalize'](), services['relocalize']()
    first.send(None)
    search._relocalizer = cast(Relocalizer, Finder())
    second.send(None)
    search.look(frame_at(SECOND))
    assert answer(first) == answer(second) == 'found at (1.00, 2.00) m, 28.6 deg'
    assert len(reported) == 1


def test_a_call_is_not_ended_by_a_pose_that_was_asked_for_before(
    search: PlaceSearch,
    services: dict[str, Any],
    prior: ExpectedPoses,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    call = services['relocalize']()

    def fused(stamp_ns: int, within_s: float) -> PoseEstimate | None:
        call.send(None)
        return prior.recent(stamp_ns, within_s)

    fuse(prior, 0, SURE)
    monkeypatch.setattr(search, '_fused', fused)
    search.consider(0)
    assert search.active
    call.close()


def test_simultaneous_calls_are_refused_together_and_may_be_repeated(
    search: PlaceSearch, services: dict[str, Any]
) -> None:
    first, second, third = (services['relocalize']() for _ in range(3))
    first.send(None)
    second.send(None)
    with pytest.raises(LandmarkNavError, match='no image came'):
        answer(first)
    third.send(None)
    with pytest.raises(LandmarkNavError, match='no image came'):
        second.send(None)
    search._relocalizer = cast(Relocalizer, Finder())
    search.look(frame_at(SECOND))
    assert answer(third).startswith('found at')


def test_the_search_ends_with_its_node(
    search: PlaceSearch, services: dict[str, Any], ended: Future[None]
) -> None:
    call = services['relocalize']()
    call.send(None)
    ended.set_result(None)
    with pytest.raises(LandmarkNavError, match='the search ends with this node'):
        answer(call)
