"""A sweep is taken of a camera that overshoots, whose frames come at any time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.learning.capture import CaptureConfig, SweepCapture
from landmark_nav.types import JointSample

STEP_NS = 20_000_000
SHORT = CaptureConfig(start_rad=-1.0, step_rad=0.25, frames=9, pan_min_rad=-1.2, pan_max_rad=1.2)


class OvershootingUnit:
    """A lightly damped pan joint."""

    def __init__(self):
        self.pan, self.rate, self.target = 0.0, 0.0, 0.0

    def step(self):
        for _ in range(20):
            self.rate += 1e-3 * (400.0 * (self.target - self.pan) - 12.0 * self.rate)
            self.pan += 1e-3 * self.rate


def run(config, frame_every=3, offset_ns=7_000_000, steps=4000, unit=None, frames=True):
    unit = unit or OvershootingUnit()
    sweep = SweepCapture(config, 0)
    rates = {}
    for k in range(1, steps):
        now = k * STEP_NS
        unit.target = sweep.target_rad
        unit.step()
        if frames and k % frame_every == 0:
            rates[now - offset_ns] = unit.rate
            sweep.add_frame(now - offset_ns, now - offset_ns)
        sweep.add_joints(JointSample(now, unit.pan), now)
        sweep.check_time(now)
        if sweep.done:
            break
    return sweep, rates


@pytest.mark.parametrize('frame_every', [1, 3, 11])
def test_keeps_one_still_frame_at_every_angle(frame_every):
    sweep, rates = run(SHORT, frame_every)
    assert sweep.done
    pans = [kept.joints.pan_rad for kept in sweep.kept]
    np.testing.assert_allclose(pans, -1.0 + 0.25 * np.arange(9), atol=SHORT.arrival_tolerance_rad)
    stamps = [kept.frame for kept in sweep.kept]
    assert stamps == sorted(set(stamps))
    assert [kept.joints.stamp_ns for kept in sweep.kept] == stamps
    assert all(abs(rates[stamp]) < 0.05 for stamp in stamps)


def test_a_frame_exposed_before_the_joint_stood_is_not_taken():
    sweep, _ = run(SHORT, frame_every=1, offset_ns=500_000_000, steps=100)
    assert all(k.joints.stamp_ns > 500_000_000 for k in sweep.kept)


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        ({'frames': False}, 'for an image; the pan is'),
        ({'unit': type('Stuck', (OvershootingUnit,), {'step': lambda self: None})()}, '0.00 deg'),
    ],
)
def test_gives_up_with_the_reason(arguments, words):
    with pytest.raises(LandmarkNavError, match=words):
        run(replace(SHORT, step_timeout_s=1.0), **arguments)


def test_gives_up_without_joint_states():
    sweep = SweepCapture(SHORT, 0)
    sweep.check_time(int(4e9))
    with pytest.raises(LandmarkNavError, match=r'frame 1 of 9.*no joint_states'):
        sweep.check_time(int(6e9))


def test_angles_out_of_reach_are_refused():
    with pytest.raises(LandmarkNavError, match='does not fit'):
        CaptureConfig(pan_min_rad=-2.9, pan_max_rad=2.9)
    with pytest.raises(LandmarkNavError, match='frames'):
        CaptureConfig(frames=0)


def test_default_is_a_full_turn():
    config = CaptureConfig()
    assert config.frames * config.step_rad == pytest.approx(2 * np.pi)


def test_a_robot_slower_than_the_clock_gets_its_time():
    unit, sweep, stamp = OvershootingUnit(), SweepCapture(SHORT, 0), 0
    for k in range(20_000):
        # Ten seconds of the clock are one of the robot's.
        now, stamp = 10 * k * STEP_NS, k * STEP_NS
        unit.target = sweep.target_rad
        unit.step()
        sweep.add_frame(stamp, stamp - 1)
        sweep.add_joints(JointSample(stamp, unit.pan), now)
        sweep.check_time(now)
        if sweep.done:
            break
    assert sweep.done
    assert 10 * stamp > SHORT.step_timeout_s * 1e9 * len(sweep.kept)
