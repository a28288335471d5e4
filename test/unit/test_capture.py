"""A sweep is taken of a camera that overshoots, whose frames come late or at any time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from turning_robot import check_sweep, FakeImage, Robot, SHORT, STEP_NS, TURN

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.learning.capture import Shot
from landmark_nav.types import JointSample


@pytest.mark.parametrize('every', [1, 2, 11])
@pytest.mark.parametrize('late_ns', [1_000_000, 7_000_000, 300_000_000])
def test_keeps_one_still_frame_at_every_angle(every, late_ns):
    class Delayed(Robot):
        """Delivers the image that was taken when its stamp says."""

        def camera_image(self):
            if self.k % every:
                return None
            pan = np.interp(self.now - late_ns, STEP_NS * np.arange(len(self.past)), self.past)
            return FakeImage(float(pan), self.k), self.now - late_ns

    robot = Delayed()
    check_sweep(robot.run())
    stamps = [kept.joints.stamp_ns for kept in robot.sweep.kept]
    assert stamps == sorted(set(stamps))
    assert not robot.sweep.refused


def test_a_step_of_a_coarse_encoder_does_not_keep_it_from_settling():
    class Coarse(Robot):
        def tick(self):
            fine = self.pan
            self.pan += 0.0015 * (self.k % 2)
            super().tick()
            self.pan = fine if self.stuck else self.pan - 0.0015 * ((self.k - 1) % 2)

    assert Coarse().run().done


@pytest.mark.parametrize('seed', range(12))
def test_whatever_comes_every_kept_frame_is_right(seed):
    """An adversary delays, drops, repeats, blurs, breaks and misdates frames and joint states."""
    rng = np.random.default_rng(seed)

    class Hostile(Robot):
        last = None

        def camera_image(self):
            self.mute = bool(rng.random() < 0.2)
            if rng.random() < 0.03:
                self.rate += rng.normal(0.0, 0.3)
            kind = rng.integers(16)
            fresh = FakeImage(self.pan, self.k), self.now - 1_000_000 * int(rng.integers(8))
            if kind == 0:
                return None
            if kind == 1 and self.last:
                return self.last
            if kind == 2 and self.last:
                return self.last[0], fresh[1]
            if kind == 3:
                return fresh[0], fresh[1] + 10**9
            if kind == 4:
                return fresh[0], fresh[1] - 10**9
            if kind == 5:
                return replace(fresh[0], sharpness=0.3), fresh[1]
            if kind == 6:
                return replace(fresh[0], broken='does not decode'), fresh[1]
            self.last = fresh
            return fresh

    config = replace(SHORT, start_rad=0.3, step_rad=0.1, retakes=200, step_timeout_s=5.0)
    robot = Hostile(config)
    check_sweep(robot.run(20_000), 0.3 + 0.1 * np.arange(9))
    assert robot.sweep.refused


@pytest.mark.parametrize('beyond_rad', [-5e-4, 0.0])
def test_a_driver_that_reports_the_pan_within_half_a_turn(beyond_rad):
    class Wrapped(Robot):
        """Half a turn is reported as either, as it happens."""

        def measured(self):
            noise = 2e-4 * (-1.0) ** self.k
            return float(wrap_rad(self.pan + beyond_rad + noise))

    sweep = Wrapped(replace(TURN, step_timeout_s=5.0)).run()
    assert sweep.done
    off = wrap_rad([kept.frame.pan - kept.joints.pan_rad for kept in sweep.kept])
    np.testing.assert_allclose(off, -beyond_rad, atol=2e-3)
    taken = np.sort([kept.frame.pan for kept in sweep.kept])
    wanted = TURN.start_rad + TURN.step_rad * np.arange(24)
    np.testing.assert_allclose(taken, wanted, atol=2e-3)


def test_a_slow_joint_gets_its_time():
    class Slow(Robot):
        def turn(self):
            self.pan += float(np.clip(self.target - self.pan, -0.003, 0.003))

    robot = Slow()
    check_sweep(robot.run())
    assert robot.now > 5 * SHORT.step_timeout_s * 1e9


def test_a_robot_slower_than_the_clock_gets_its_time():
    class Behind(Robot):
        """Ten seconds of the clock are one of the robot's."""

        @property
        def now(self):
            return 10 * self.k * STEP_NS

        def tick(self):
            self.k += 1
            command = self.sweep.command(self.now)
            self.target = self.target if command is None else command
            self.turn()
            stamp = self.k * STEP_NS
            self.sweep.add_frame(Shot(FakeImage(self.pan, self.k), stamp - 1, b'%d' % self.k), 0)
            self.sweep.add_joints(JointSample(stamp, self.pan), self.now)
            self.sweep.check(self.now)

    robot = Behind(replace(SHORT, retake_pause_s=0.0))
    assert robot.run(20_000).done
    assert robot.now > SHORT.step_timeout_s * 1e9 * len(robot.sweep.kept)


def test_time_to_go_is_reported():
    robot = Robot()
    assert robot.sweep.seconds_to_go(robot.now) is None
    robot.until(6)
    reported, start = robot.sweep.seconds_to_go(robot.now), robot.now
    robot.run()
    assert reported == pytest.approx((robot.now - start) * 1e-9, rel=0.5)
    assert robot.sweep.seconds_to_go(robot.now) == 0.0
