"""The prior of an image comes from the fused pose nearest to it."""

from __future__ import annotations

import numpy as np
import pytest

from landmark_nav.localization.expected_poses import ExpectedPoses
from landmark_nav.types import OdometrySample, PoseEstimate, Refusal

SPEED, RATE = 0.5, 0.8


def circle(stamp_ns: int) -> np.ndarray:
    """Pose on the circle that constant speeds drive."""
    angle = RATE * stamp_ns * 1e-9
    radius = SPEED / RATE
    return np.array([radius * np.sin(angle), radius * (1.0 - np.cos(angle)), angle])


@pytest.fixture
def track() -> ExpectedPoses:
    made = ExpectedPoses(0.5)
    for stamp in range(0, 1_000_000_001, 50_000_000):
        pose = circle(stamp)
        made.add(PoseEstimate(stamp, pose, np.eye(3)), OdometrySample(stamp, pose, SPEED, RATE))
    return made


@pytest.mark.parametrize('stamp', [0, 333_000_000, 500_000_000, 1_200_000_000, -300_000_000])
def test_moved_to_the_stamp_by_its_own_speeds(track: ExpectedPoses, stamp: int) -> None:
    prior = track.at(stamp)
    assert isinstance(prior, PoseEstimate)
    assert prior.stamp_ns == stamp
    np.testing.assert_allclose(prior.pose, circle(stamp), atol=1e-9)


def test_too_far_in_time(track: ExpectedPoses) -> None:
    refusal = track.at(1_600_000_000)
    assert isinstance(refusal, Refusal)
    assert '+0.60 s' in refusal.detail


def test_what_is_recent(track: ExpectedPoses) -> None:
    newest = track.recent(1_500_000_000)
    assert newest is not None
    assert newest.stamp_ns == 10**9
    assert track.recent(1_500_000_001) is None
    # The clock was set back, and nothing was fused since.
    assert track.recent(0) is None


def test_a_clock_set_back_begins_anew(track: ExpectedPoses) -> None:
    def fused(stamp: int, x: float) -> None:
        pose = np.array([x, 0.0, 0.0])
        track.add(PoseEstimate(stamp, pose, np.eye(3)), OdometrySample(stamp, pose))

    fused(900_000_000, 7.0)
    assert isinstance(track.at(0), PoseEstimate), 'a little late'
    before = track._known
    fused(200_000_000, 8.0)
    assert before, 'another thread may be reading them'
    found = track.at(600_000_000)
    assert isinstance(found, PoseEstimate)
    assert found.pose[0] == 8.0


def test_nothing_known() -> None:
    empty = ExpectedPoses(0.5)
    assert isinstance(empty.at(0), Refusal)
    assert not empty.reaches(0)
