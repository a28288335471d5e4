from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.geometry.se2 import compose, relative
from landmark_nav.localization.odometry.commanded import command_delay_s, integrate_commands
from landmark_nav.localization.odometry.noise import (
    fraction_of_motion,
    Motion,
    motion_variances,
    OdometryNoiseConfig,
    slip_variance,
    twist_motion,
)
from landmark_nav.localization.odometry.track import Distrusted, OdometryTrack
from landmark_nav.types import Detections, OdometrySample

CONFIG = OdometryNoiseConfig()
SPEED, RATE, HERTZ = 0.4, 0.9, 50.0


def sample(seconds, pose=None):
    """Of a robot on a circle."""
    where = twist_motion(SPEED, RATE, seconds) if pose is None else pose
    return OdometrySample(round(seconds * 1e9), np.asarray(where, dtype=float), SPEED, RATE)


def circle_track(until=1.0):
    track = OdometryTrack(CONFIG)
    for k in range(round(until / 0.05) + 1):
        assert track.add(sample(0.05 * k)) is None
    return track


@given(st.floats(-2.0, 2.0), st.floats(-3.0, 3.0), st.floats(0.0, 1.0))
def test_fraction_of_an_arc_is_the_shorter_arc(speed, rate, share):
    whole = twist_motion(speed, rate, 1.0)
    part = fraction_of_motion(whole, share)
    np.testing.assert_allclose(part, twist_motion(speed, rate, share), atol=1e-9)


@given(st.floats(-1.0, -0.01), st.floats(0.01, 3.0))
def test_wheels_slip_aside_in_turns_only(forward, turn):
    variance = slip_variance(Motion(np.array([forward, 0.0, turn]), 1.0), CONFIG)
    assert 0.0 <= variance <= 1.0
    assert slip_variance(Motion(np.array([forward, 0.0, 0.0]), 1.0), CONFIG) == 0.0
    # Steps of any length slip alike.
    half = slip_variance(Motion(np.array([0.5 * forward, 0.0, 0.5 * turn]), 0.5), CONFIG)
    assert half == pytest.approx(variance, abs=1e-9)


def turning(k):
    return twist_motion(SPEED, RATE, k / HERTZ)


def straight(k):
    return twist_motion(SPEED, 0.0, k / HERTZ)


def moved(pose, speeds=lambda k: (SPEED, RATE), late=lambda k: 0.0, count=200):
    """Motion over samples `k` with their poses, speeds and delays of stamps, in periods."""
    track = OdometryTrack(CONFIG)
    for k in range(count + 1):
        track.add(OdometrySample(round(1e9 * (k + late(k)) / HERTZ), pose(k), *speeds(k)))
    return track.motion(0, round(1e9 * (count - 5) / HERTZ))


class TestSteps:
    @pytest.mark.parametrize('speeds', [lambda k: (SPEED, RATE), lambda k: (0.0, 0.0)])
    def test_poses_that_step_are_uncertain_by_the_steps(self, speeds):
        motion = moved(
            lambda k: turning(k) + np.array([0.02, 0.0, 0.03]) * (k // 50), speeds, count=205
        )
        assert motion.steps_m2 == pytest.approx(4 * 0.02**2, rel=0.2)
        assert motion.steps_rad2 == pytest.approx(4 * 0.03**2, rel=0.2)

    def test_jitter_is_no_step(self):
        noise = np.random.default_rng(3).normal(0.0, [0.01, 0.01, 0.005], (201, 3))
        motion = moved(lambda k: turning(k) + noise[k])
        assert motion.steps_m2 < 0.01**2
        assert motion.steps_rad2 < 0.005**2

    def test_speeds_of_another_scale_are_no_steps(self):
        motion = moved(turning, lambda k: (0.7 * SPEED, 0.7 * RATE))
        assert (motion.steps_m2, motion.steps_rad2) == (0.0, 0.0)

    def test_coarse_encoders_and_late_stamps_are_no_steps(self):
        late = 0.8 * (np.random.default_rng(5).random(201) < 0.1)
        ahead = lambda k: (SPEED, 0.0)  # noqa: E731
        for motion in (
            moved(lambda k: np.floor(straight(k) / 0.03) * 0.03, ahead),
            moved(straight, ahead, lambda k: late[k]),
        ):
            assert motion.steps_m2 < motion_variances(motion._replace(steps_m2=0.0), CONFIG)[0]

    def test_absurd_speeds_do_not_spoil_the_motion(self):
        motion = moved(straight, lambda k: (1e200 if k in (50, 51) else SPEED, 0.0), count=100)
        assert np.isfinite([motion.steps_m2, motion.steps_rad2]).all()
        assert motion.steps_m2 < 0.3**2

    def test_filtered_speeds_hardly_count(self):
        """Of a robot that starts, by a driver that reports the speeds of 0.1 s before."""

        def pose(k):
            way = 0.25 * min(k / HERTZ, 1.0) ** 2 + 0.5 * max(k / HERTZ - 1.0, 0.0)
            return twist_motion(way, way, 1.0)

        motion = moved(pose, lambda k: (0.5 * np.clip(k / HERTZ - 0.1, 0.0, 1.0),) * 2, count=100)
        assert motion.steps_m2 < 0.1 * motion_variances(motion, CONFIG)[0]
        assert motion.steps_rad2 < 0.1 * motion_variances(motion, CONFIG)[2]


class TestTrack:
    def test_motion_between_samples_is_on_the_arc(self):
        motion = circle_track().motion(333_000_000, 871_000_000)
        expected = relative(twist_motion(SPEED, RATE, 0.333), twist_motion(SPEED, RATE, 0.871))
        np.testing.assert_allclose(motion.increment, expected, atol=1e-9)
        assert motion.seconds == pytest.approx(0.538)
        assert motion.blind_seconds == 0.0

    def test_a_pose_that_freezes_counts_as_none_from_then_on(self):
        track, whole = circle_track(), circle_track(until=2.0)
        there = twist_motion(SPEED, RATE, 1.0)
        outcomes = [track.add(sample(1.0 + 0.05 * k, there)) for k in range(1, 11)]
        assert outcomes[:2] == [None, None]
        assert {o.reason for o in outcomes[2:] if o is not None} == {'odometry has frozen'}
        assert None not in outcomes[2:]
        assert track.stamps_ns == (0, 10**9)
        np.testing.assert_allclose(
            track.motion(0, 12 * 10**8).increment, whole.motion(0, 12 * 10**8).increment
        )
        assert track.add(sample(1.6)) is None
        np.testing.assert_allclose(
            track.motion(0, 16 * 10**8).increment, whole.motion(0, 16 * 10**8).increment
        )

    def test_a_robot_that_stands_has_not_frozen(self):
        track, here = circle_track(), twist_motion(SPEED, RATE, 1.0)
        for k in range(1, 100):
            still = replace(sample(1.0 + 0.05 * k, here), linear_m_s=0.01, angular_rad_s=-0.01)
            assert track.add(still) is None
        # Speeds may show a start before the pose does.
        assert track.add(sample(6.0, here)) is None
        assert track.add(sample(6.05, here)) is None
        assert track.add(sample(6.1, here)) is not None
        assert track.stamps_ns == (0, round(1e9 * (1.0 + 0.05 * 99)))

    def test_jump_is_bridged_by_the_twist(self):
        track = circle_track()
        jump = np.array([5.0, -3.0, 1.0])
        refusal = track.add(sample(1.05, compose(jump, twist_motion(SPEED, RATE, 1.05))))
        assert refusal.reason == 'odometry jumped'
        assert track.add(sample(1.1, compose(jump, twist_motion(SPEED, RATE, 1.1)))) is None
        motion = track.motion(1_000_000_000, 1_100_000_000)
        np.testing.assert_allclose(motion.increment, twist_motion(SPEED, RATE, 0.1), atol=1e-9)
        assert motion.blind_seconds == pytest.approx(0.05)

    @pytest.mark.parametrize('period_s', [0.005, 0.05, 0.2])
    @pytest.mark.parametrize('begin', [np.array([5.0, -3.0, 1.0]), np.array([0.1, 0.0, 0.0])])
    def test_odometry_that_is_set_to_zero_goes_on_by_its_speeds(self, period_s, begin):
        track = OdometryTrack(CONFIG)
        refusals = []
        for k in range(80):
            since_s = period_s * (k - (40 if k >= 40 else 0))
            pose = twist_motion(SPEED, RATE, since_s)
            pose = pose if k >= 40 else compose(begin, pose)
            refusals.append(track.add(sample(period_s * k, pose)))
        assert [k for k, refusal in enumerate(refusals) if refusal is not None] == [40]
        assert isinstance(refusals[40], Distrusted)
        motion = track.motion(0, round(79e9 * period_s))
        expected = twist_motion(SPEED, RATE, 79 * period_s)
        np.testing.assert_allclose(relative(expected, motion.increment), 0.0, atol=1e-9)
        assert motion.blind_seconds == 0.0


def test_a_source_that_gives_no_speeds_goes_on_as_its_poses_did():
    """As scan matchers publish it."""
    informed, uninformed = circle_track(), OdometryTrack(CONFIG)
    for k in range(11):
        uninformed.add(replace(sample(0.1 * k), linear_m_s=0.0, angular_rad_s=0.0))
    ahead = round(1e9), round(1.1e9)
    expected, motion = informed.motion(*ahead), uninformed.motion(*ahead)
    np.testing.assert_allclose(motion.increment, expected.increment, atol=2e-3)
    assert motion.ahead_s4 == expected.ahead_s4


BEGIN_NS = 1_248_444_175_000_000_000
STEP_NS = 20_000_000


def late_robot(delay_s):
    """A robot that turns to and fro, at random, `delay_s` after the command, 4 m from posts."""
    rng = np.random.default_rng(3)
    stamps = BEGIN_NS + STEP_NS * np.arange(6000)
    turns = np.repeat(rng.uniform(-0.6, 0.6, 150), 40)
    commands = np.column_stack([np.full(6000, 0.05), turns])
    samples = integrate_commands(stamps, commands, delay_s)
    posts = np.array([[4.0, 0.0], [0.0, 4.0], [-4.0, -1.0]])
    detections = []
    for sample in samples[::10]:
        bearing = se2.bearings(sample.pose_odom_base, posts)
        seen = np.abs(bearing) < 0.9
        bearing = bearing + rng.normal(0.0, 0.01, 3)
        none = np.zeros(3)
        found = Detections(
            sample.stamp_ns, np.arange(3), bearing, none, none, np.zeros((3, 2))
        ).chosen(seen)
        detections.append(found)
    return stamps, commands, detections


@pytest.mark.parametrize('delay_s', [0.0, 0.13, 0.4])
def test_the_delay_is_found_without_truth(delay_s):
    assert command_delay_s(*late_robot(delay_s)) == pytest.approx(delay_s, abs=0.011)


def test_nothing_seen_twice_or_never_turned():
    stamps, commands, detections = late_robot(0.2)
    with pytest.raises(LandmarkNavError, match='delay of the commands cannot be found'):
        command_delay_s(stamps, commands, detections[:5])
    with pytest.raises(LandmarkNavError, match='give it'):
        command_delay_s(stamps, commands * [1.0, 0.0], detections)
    with pytest.raises(LandmarkNavError, match='0 bearings'):
        command_delay_s(stamps, commands, [])
