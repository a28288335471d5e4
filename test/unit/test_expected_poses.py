"""The prior of an image comes from the fused pose nearest to it."""

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import compose
from landmark_nav.localization.expected_poses import ExpectedPoses, SpreadCorrection
from landmark_nav.types import OdometrySample, PoseEstimate, Refusal

SPEED, RATE = 0.5, 0.8


def circle(stamp_ns):
    """Pose on the circle that constant speeds drive."""
    angle = RATE * stamp_ns * 1e-9
    radius = SPEED / RATE
    return np.array([radius * np.sin(angle), radius * (1.0 - np.cos(angle)), angle])


@pytest.fixture
def track():
    made = ExpectedPoses(0.5)
    for stamp in range(0, 1_000_000_001, 50_000_000):
        pose = circle(stamp)
        made.add(PoseEstimate(stamp, pose, np.eye(3)), OdometrySample(stamp, pose, SPEED, RATE))
    return made


@pytest.mark.parametrize('stamp', [0, 333_000_000, 500_000_000, 1_200_000_000, -300_000_000])
def test_moved_to_the_stamp_by_its_own_speeds(track, stamp):
    prior = track.at(stamp)
    assert isinstance(prior, PoseEstimate)
    assert prior.stamp_ns == stamp
    np.testing.assert_allclose(prior.pose, circle(stamp), atol=1e-9)


def test_too_far_in_time(track):
    refusal = track.at(1_600_000_000)
    assert isinstance(refusal, Refusal)
    assert '+0.60 s' in refusal.detail


def test_what_is_recent(track):
    newest = track.recent(1_500_000_000)
    assert newest is not None
    assert newest.stamp_ns == 10**9
    assert track.recent(1_500_000_001) is None
    # The clock was set back, and nothing was fused since.
    assert track.recent(0) is None


def test_a_clock_set_back_begins_anew(track):
    def fused(stamp, x):
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


def test_nothing_known():
    empty = ExpectedPoses(0.5)
    assert isinstance(empty.at(0), Refusal)
    assert not empty.reaches(0)


SECOND_NS = 1_000_000_000
angles = st.floats(-np.pi, np.pi)
places = st.floats(-50.0, 50.0)
poses = st.tuples(places, places, angles).map(np.array)
small = st.tuples(*3 * [st.floats(-0.3, 0.3)]).map(np.array)


@given(fused=poses, odometry=poses)
def test_without_a_time_all_of_it_comes_at_once(fused, odometry):
    spread = SpreadCorrection(0.0)
    for stamp_ns, pose in enumerate((fused, fused + np.array([1.0, 2.0, 0.5]))):
        error = compose(spread.at(stamp_ns, pose, odometry), odometry) - pose
        assert np.abs([*error[:2], wrap_rad(error[2])]).max() < 1e-9


@given(fused=poses, odometry=poses, correction=small)
def test_a_correction_decays_at_the_base_wherever_odom_begins(fused, odometry, correction):
    spread = SpreadCorrection(2.0)
    spread.at(0, fused, odometry)
    for k in range(1, 9):
        shown = compose(spread.at(k * SECOND_NS // 2, fused + correction, odometry), odometry)
        error = fused + correction - shown
        error[2] = wrap_rad(error[2])
        np.testing.assert_allclose(error, correction * np.exp(-0.25 * k), atol=1e-9)


def test_the_way_between_is_followed_without_lag():
    spread = SpreadCorrection(5.0)
    offset = np.array([3.0, -1.0, 0.7])
    for k in range(20):
        odometry = np.array([0.1 * k, 0.02 * k, 0.05 * k])
        shown = spread.at(k * SECOND_NS // 10, compose(offset, odometry), odometry)
        np.testing.assert_allclose(shown, offset, atol=1e-9)


def test_a_new_start_and_a_clock_set_back_are_not_spread():
    spread = SpreadCorrection(5.0)
    here, there, odometry = np.zeros(3), np.array([4.0, 2.0, 1.0]), np.array([1.0, 1.0, 0.3])
    spread.at(10 * SECOND_NS, here, odometry)
    np.testing.assert_allclose(compose(spread.at(SECOND_NS, there, odometry), odometry), there)
    spread.restart()
    shown = compose(spread.at(2 * SECOND_NS, here, odometry), odometry)
    np.testing.assert_allclose(shown, here, atol=1e-12)
