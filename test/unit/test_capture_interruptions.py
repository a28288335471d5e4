"""A sweep that was interrupted is gone on with, or begun anew, and says which."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from turning_robot import check_sweep, inspect, Robot, SHORT

from landmark_nav.errors import LandmarkNavError
from landmark_nav.learning.capture import begin_or_resume, SweepCapture
from landmark_nav.types import OdometrySample


def test_it_goes_on_where_it_was_interrupted():
    robot = Robot()
    robot.until(4)
    before = robot.sweep.kept
    robot.sweep.stop('the operator said so')
    with pytest.raises(LandmarkNavError, match=r'frame 5 of 9.*operator.*4 frames are kept'):
        robot.run()
    assert not robot.sweep.why_not_resumed(robot.now)
    robot.sweep.resume(robot.now)
    check_sweep(robot.run())
    assert robot.sweep.kept[:4] == before


@pytest.mark.parametrize('lost', ['joints', 'images'])
def test_it_goes_on_after_a_topic_was_lost(lost):
    robot = Robot()
    robot.until(3)
    words = {
        'joints': 'no joint_states since then',
        'images': r'for an image; the pan is .*, the last image came [\d.]+ s ago',
    }[lost]
    robot.mute = lost == 'joints'
    if lost == 'images':
        robot.camera_image = lambda: None
    with pytest.raises(LandmarkNavError, match=words):
        robot.run()
    robot.mute, robot.camera_image = False, lambda: Robot.camera_image(robot)
    robot.sweep.resume(robot.now)
    check_sweep(robot.run())


def test_a_robot_that_drives_away_ends_it():
    robot = Robot()
    robot.until(3)
    robot.x = 0.005
    robot.until(4)
    robot.x = 0.5
    with pytest.raises(LandmarkNavError, match=r'the robot moved 50\.0 cm'):
        robot.run()
    assert 'moved 50.0 cm' in robot.sweep.why_not_resumed(robot.now)
    robot.x = 0.0
    robot.sweep.add_odometry(OdometrySample(robot.now, np.zeros(3)))
    assert not robot.sweep.why_not_resumed(robot.now)
    assert '700 s have passed' in robot.sweep.why_not_resumed(robot.now + 700 * 10**9)


def test_a_call_goes_on_or_begins_anew_and_reports_it():
    robot = Robot()
    config, now = SHORT, 5 * 10**9
    assert begin_or_resume(None, config, inspect, now)[1] == ''
    robot.until(3)
    robot.sweep.stop('no reason')
    again, note = begin_or_resume(robot.sweep, config, inspect, robot.now)
    assert again is robot.sweep
    assert note == 'gone on after 3 frames of before'
    robot.x = 1.0
    with pytest.raises(LandmarkNavError):
        robot.tick()
    anew, note = begin_or_resume(robot.sweep, config, inspect, robot.now)
    assert not anew.kept
    assert note.startswith('begun anew without 3 frames of before: the robot moved 100.0 cm')
    robot = Robot()
    # A sweep that is complete is not gone on with.
    anew, note = begin_or_resume(robot.run(), config, inspect, robot.now)
    assert (anew is robot.sweep, note) == (False, '')


def test_gives_up_without_joint_states():
    sweep = SweepCapture(replace(SHORT, step_timeout_s=5.0), inspect, 0)
    sweep.check(int(4e9))
    with pytest.raises(LandmarkNavError, match=r'frame 1 of 9.*no joint_states'):
        sweep.check(int(6e9))
