"""Frames that are blurred, frozen, misdated or unreadable do not enter a sweep."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from turning_robot import check_sweep, FakeImage, Robot, SHORT, TURN

from landmark_nav.errors import LandmarkNavError
from landmark_nav.learning.capture import CaptureConfig
from landmark_nav.learning.capture.frames import FrameLog
from landmark_nav.learning.capture.joints import JointTrack
from landmark_nav.types import JointSample


class Faulty(Robot):
    """The frames from number `first` to `last` after the fifth was kept are bad."""

    first, last, count = 1, 3, 0

    def bad(self, camera_image, stamp):
        return camera_image, stamp

    def camera_image(self):
        camera_image, stamp = super().camera_image()
        if len(self.sweep.kept) < 5:
            return camera_image, stamp
        # Count those that arrive while the joint is at rest.
        self.count += abs(self.rate) < 0.01 and abs(self.pan - self.target) < 0.005
        bad = self.first <= self.count <= self.last
        return self.bad(camera_image, stamp) if bad else (camera_image, stamp)


def blurred(self, camera_image, stamp):
    return replace(camera_image, sharpness=0.4), stamp


def frozen(self, camera_image, stamp):
    return self.sweep.kept[-1].frame, stamp


def repeated(self, camera_image, stamp):
    return self.sweep.kept[-1].frame, self.sweep.kept[-1].joints.stamp_ns


def from_the_future(self, camera_image, stamp):
    return camera_image, stamp + 10**9


def from_the_past(self, camera_image, stamp):
    return camera_image, 5


def unreadable(self, camera_image, stamp):
    return replace(camera_image, broken="image encoding 'yuv' is not supported"), stamp


BAD = [
    (blurred, 'blurred or covered'),
    (frozen, 'frozen'),
    (repeated, 'badly timed'),
    (from_the_future, 'badly timed'),
    (from_the_past, 'badly timed'),
    (unreadable, 'unusable'),
]


@pytest.mark.parametrize(('bad', 'reason'), BAD)
def test_a_bad_frame_is_refused_and_taken_again(bad, reason, caplog):
    robot = type('Bad', (Faulty,), {'bad': bad, 'last': 12})()
    sweep = robot.run()
    check_sweep(sweep)
    assert sum(sweep.refused.values()) >= 1
    assert reason in sweep.refused
    assert 'refused' in caplog.text
    assert reason in caplog.text


@pytest.mark.parametrize(('bad', 'reason'), BAD[1:])
def test_frames_that_stay_bad_interrupt_it_with_the_reason(bad, reason):
    robot = type('Bad', (Faulty,), {'bad': bad, 'last': 10**9})()
    with pytest.raises(LandmarkNavError, match=f'6 frames refused, the last as {reason}'):
        robot.run()
    with pytest.raises(LandmarkNavError, match=r'frame [56] of 9.*[45] frames are kept'):
        robot.sweep.check(robot.now)
    # Mended, it goes on.
    robot.last = 0
    robot.sweep.resume(robot.now)
    check_sweep(robot.run())


def test_a_camera_frozen_from_the_start_leaves_no_frame():
    class Frozen(Robot):
        def camera_image(self):
            return FakeImage(0.0, 0), self.now - 7_000_000

    robot = Frozen()
    with pytest.raises(LandmarkNavError, match='refused, the last as frozen'):
        robot.run()
    assert not robot.sweep.kept


def test_blank_walls_dark_and_noiseless_views_are_taken():
    class Blank(Robot):
        def camera_image(self):
            return FakeImage(0.0, 0, flat=True), self.now - 7_000_000

    robot = Blank()
    assert robot.run().done
    assert not robot.sweep.refused


def test_a_view_that_stays_less_sharp_is_taken_in_the_end():
    class Foggy(Robot):
        def camera_image(self):
            fog = 0.2 if 0.4 < self.pan < 0.6 else 1.0
            return FakeImage(self.pan, self.k, fog), self.now - 7_000_000

    sweep = Foggy().run()
    assert sweep.done
    assert len(sweep.kept) == 9
    assert 0 < sweep.refused['blurred or covered'] < 10


@pytest.mark.parametrize('seed', range(4))
def test_people_who_pass_do_not_keep_it_from_ending(seed):
    """In four frames of five somebody in plain clothes hides a third of the view."""
    rng = np.random.default_rng(seed)

    class Crowded(Robot):
        def camera_image(self):
            person = rng.uniform(-0.4, 0.4) if rng.random() < 0.8 else np.inf
            return FakeImage(self.pan, self.k, person=person), self.now - 7_000_000

    robot = Crowded(TURN)
    check_sweep(robot.run(), -np.pi + np.pi / 12 * np.arange(24))
    assert sum(robot.sweep.refused.values()) < 24


def test_a_blurred_first_frame_is_found_out_by_its_neighbours():
    class Shaky(Robot):
        def camera_image(self):
            return FakeImage(self.pan, self.k, 0.3 if not self.sweep.kept else 1.0), self.now - 7

    config = replace(SHORT, start_rad=0.2, step_rad=0.1)
    robot = Shaky(config)
    check_sweep(robot.run(), 0.2 + 0.1 * np.arange(9))
    assert robot.sweep.refused['blurred or covered'] == 1


def test_an_image_that_outran_its_joint_state_is_not_frozen_for_ever():
    config = CaptureConfig()
    log, track = FrameLog(config), JointTrack(config)
    track.add(JointSample(0, -0.9))
    # It shows -1.0 already, of which the joint states do not know yet.
    assert not log.seen_elsewhere(b'image', 20_000_000, track)
    for k in range(1, 4):
        track.add(JointSample(20_000_000 * k, -1.0))
        assert not log.seen_elsewhere(b'image', 20_000_000 * k, track)
    track.add(JointSample(10_000_000_000, 0.5))
    assert log.seen_elsewhere(b'image', 10_000_000_000, track)


def test_an_image_whose_pan_was_never_known_is_not_frozen():
    config = CaptureConfig()
    log, track = FrameLog(config), JointTrack(config)
    track.add(JointSample(0, -0.9))
    # It shows 0.5, where the joint came while its states were lost.
    assert not log.seen_elsewhere(b'image', 200_000_000, track)
    for stamp_ns in (10_000_000_000, 10_020_000_000):
        track.add(JointSample(stamp_ns, 0.5))
        assert not log.seen_elsewhere(b'image', stamp_ns, track)
    track.add(JointSample(20_000_000_000, -0.9))
    assert log.seen_elsewhere(b'image', 20_000_000_000, track)
