"""A sweep goes through its angles as far as the pan joint turns, and reports what it covers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from turning_robot import AZIMUTH, check_sweep, pans, Robot, TURN

from landmark_nav.errors import LandmarkNavError
from landmark_nav.learning.capture import CaptureConfig, describe_sweep


@pytest.mark.parametrize('start_deg', [-180.0, 30.0, 300.0])
@pytest.mark.parametrize('step_deg', [7.5, -7.5])
def test_any_start_and_direction_make_a_full_turn(start_deg, step_deg):
    config = replace(
        TURN, start_rad=np.radians(start_deg), step_rad=np.radians(step_deg), frames=48
    )
    sweep = Robot(config).run()
    assert sweep.total == 48
    turned = np.sort(np.mod(np.degrees(pans(sweep)) - start_deg, 360.0) + 3.0) % 360.0
    np.testing.assert_allclose(np.sort(turned), 3.0 + 7.5 * np.arange(48), atol=0.6)


def test_limits_by_parameter_leave_steps_out():
    low, high = np.radians([-150.0, 150.0])
    config = replace(
        TURN,
        start_rad=np.radians(30.0),
        step_rad=np.radians(7.5),
        frames=48,
        pan_min_rad=low,
        pan_max_rad=high,
    )
    sweep = Robot(config, limits=(low, high)).run()
    np.testing.assert_allclose(np.degrees(pans(sweep)), np.arange(-150.0, 151.0, 7.5), atol=0.6)
    assert not sweep.reach.stops_rad


def test_a_joint_that_does_not_reach_straight_ahead():
    config = replace(TURN, pan_min_rad=0.5, pan_max_rad=2.5)
    robot = Robot(config, limits=(0.5, 2.5))
    robot.pan = 1.0
    sweep = robot.run()
    wanted = np.pi / 12 * np.arange(24)
    check_sweep(sweep, wanted[(wanted > 0.5) & (wanted < 2.5)])
    # Where it is sent to rest.
    assert sweep.reach.nearest(0.0) == 0.5


def test_limits_are_found_where_the_joint_stops(caplog):
    sweep = Robot(TURN, limits=(-2.5, 1.9)).run()
    assert sweep.done
    wanted = -np.pi + np.pi / 12 * np.arange(24)
    check_sweep(sweep, wanted[(wanted > -2.505) & (wanted < 1.905)])
    np.testing.assert_allclose(sorted(sweep.reach.stops_rad), [-2.5, 1.9], atol=0.01)
    assert 'stops at -143.2 deg' in caplog.text


def test_a_joint_that_gets_stuck_is_not_taken_for_one_with_a_limit():
    robot = Robot(TURN)
    robot.until(7)
    robot.stuck = True
    with pytest.raises(LandmarkNavError, match=r'does not move; 8 frames are kept|does not move'):
        robot.run()
    robot.stuck = False
    robot.sweep.resume(robot.now)
    assert len(robot.run().kept) == 24


def test_a_joint_that_never_moves():
    robot = Robot()
    robot.stuck = True
    with pytest.raises(LandmarkNavError, match=r'frame 1 of 9, -57\.3 deg.*0\.00 deg and does no'):
        robot.run()
    # Sent again, in case that a message was lost.
    assert robot.commands > 1


def test_no_angle_within_the_limits_is_refused():
    with pytest.raises(LandmarkNavError, match='no frame within'):
        CaptureConfig(start_rad=1.0, frames=3, pan_min_rad=-0.5, pan_max_rad=0.5)
    with pytest.raises(LandmarkNavError, match='frames'):
        CaptureConfig(frames=0)


def test_default_is_a_full_turn():
    config = CaptureConfig()
    assert config.frames * config.step_rad == pytest.approx(2 * np.pi)


def test_what_is_covered_is_reported():
    half = float(AZIMUTH[-1])
    assert describe_sweep(Robot(TURN).run(), half) == 'the full turn'
    reported = describe_sweep(Robot(TURN, limits=(-2.5, 1.9)).run(), half)
    assert reported == (
        'a partial sweep, nothing is seen from pan 130 to 200 deg; '
        'the pan joint stops at -143.2 and 108.9 deg'
    )
