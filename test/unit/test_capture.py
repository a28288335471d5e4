"""A sweep is taken of a camera that overshoots and fails, within its limits, and continued."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.learning.capture.config import CaptureConfig
from landmark_nav.learning.capture.frames import Look, Shot
from landmark_nav.learning.capture.sweep import begin_or_resume, describe_sweep, SweepCapture
from landmark_nav.types import JointSample, OdometrySample

STEP_NS = 20_000_000
SHORT = CaptureConfig(
    start_rad=-1.0, step_rad=0.25, frames=9, pan_min_rad=-1.2, pan_max_rad=1.2,
    step_timeout_s=1.0, retakes=5,
)  # fmt: skip
TURN = replace(
    SHORT, start_rad=-np.pi, step_rad=np.pi / 12, frames=24, pan_min_rad=-np.pi, pan_max_rad=np.pi
)
WANTED = -1.0 + 0.25 * np.arange(9)
AZIMUTH = np.radians(np.arange(-25.0, 26.0))


@dataclass(frozen=True)
class FakeImage:
    """What a camera at `pan` shows; `number` distinguishes two of the same view, as noise does."""

    pan: float
    number: int
    sharpness: float = 1.0
    flat: bool = False
    person: float = np.inf
    broken: str = ''

    @property
    def digest(self):
        return f'{self.pan:.4f} {self.number}'.encode()


def inspect(camera_image):
    if camera_image.broken:
        raise LandmarkNavError(camera_image.broken)
    bearing = wrap_rad(camera_image.pan + AZIMUTH)
    # A poster to the left, a blank wall with noise to the right.
    texture = np.where(bearing > 0.0, 2.0 + np.sin(8.0 * bearing), 0.0)
    if camera_image.flat:
        return Look(AZIMUTH, np.zeros((2, len(AZIMUTH))), True)
    energy = (0.01 + camera_image.sharpness * texture) * (
        1.0 + 0.01 * np.sin(17.0 * camera_image.number)
    )
    energy[np.abs(AZIMUTH - camera_image.person) < 0.15] = 0.004
    return Look(AZIMUTH, np.stack([energy, energy]), False)


class Robot:
    """A lightly damped pan joint, joint states at 50 Hz, a frame with every third of them."""

    def __init__(self, config=SHORT, limits=(-4.0, 4.0)):
        self.pan, self.rate, self.target = 0.0, 0.0, 0.0
        self.limits, self.k, self.rates, self.commands = limits, 0, {}, 0
        self.stuck = self.mute = False
        self.sweep = SweepCapture(config, inspect, 0)
        self.x = 0.0
        self.past = [0.0]

    @property
    def now(self):
        return self.k * STEP_NS

    def turn(self):
        for _ in range(0 if self.stuck else 20):
            self.rate += 1e-3 * (400.0 * (self.target - self.pan) - 12.0 * self.rate)
            self.pan += 1e-3 * self.rate
            if not self.limits[0] <= self.pan <= self.limits[1]:
                self.pan, self.rate = float(np.clip(self.pan, *self.limits)), 0.0

    def camera_image(self):
        """The frame that the camera delivers now, with its stamp; None for none."""
        return FakeImage(self.pan, self.k), self.now - 7_000_000

    def measured(self):
        """The pan that the driver reports."""
        return self.pan

    def tick(self):
        self.k += 1
        command = self.sweep.command(self.now)
        if command is not None:
            self.target, self.commands = command, self.commands + 1
        self.turn()
        self.past.append(self.pan)
        self.sweep.add_odometry(OdometrySample(self.now, np.array([self.x, 0.0, 0.0])))
        if self.k % 3 == 0 and (taken := self.camera_image()) is not None:
            camera_image, stamp = taken
            self.rates[stamp] = self.rate
            self.sweep.add_frame(Shot(camera_image, stamp, camera_image.digest), self.now)
        if not self.mute:
            self.sweep.add_joints(JointSample(self.now, self.measured()), self.now)
        self.sweep.check(self.now)

    def run(self, ticks=6000):
        for _ in range(ticks):
            self.tick()
            if self.sweep.done:
                break
        return self.sweep

    def until(self, frames):
        while len(self.sweep.kept) < frames:
            self.tick()


def pans(sweep):
    return sorted(kept.joints.pan_rad for kept in sweep.kept)


def check_sweep(sweep, wanted=WANTED):
    assert sweep.done
    assert sweep.total == len(wanted)
    np.testing.assert_allclose(pans(sweep), wanted, atol=SHORT.arrival_tolerance_rad)
    for kept in sweep.kept:
        # The image was taken where the sweep says, when it says.
        assert abs(kept.frame.pan - kept.joints.pan_rad) < 0.002
        assert kept.frame.sharpness == 1.0


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
            image, stamp, last = *fresh, self.last or fresh
            bad = [
                None, last, (last[0], stamp), (image, stamp + 10**9), (image, stamp - 10**9),
                (replace(image, sharpness=0.3), stamp),
                (replace(image, broken='does not decode'), stamp),
            ]  # fmt: skip
            if kind < len(bad):
                return bad[kind]
            self.last = fresh
            return fresh

    config = replace(SHORT, start_rad=0.3, step_rad=0.1, retakes=200, step_timeout_s=5.0)
    robot = Hostile(config)
    check_sweep(robot.run(20_000), 0.3 + 0.1 * np.arange(9))
    assert robot.sweep.refused


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


def test_no_angle_within_the_limits_is_refused():
    with pytest.raises(LandmarkNavError, match='no frame within'):
        CaptureConfig(start_rad=1.0, frames=3, pan_min_rad=-0.5, pan_max_rad=0.5)
    with pytest.raises(LandmarkNavError, match='frames'):
        CaptureConfig(frames=0)


def test_what_is_covered_is_reported():
    half = float(AZIMUTH[-1])
    assert describe_sweep(Robot(TURN).run(), half) == 'the full turn'
    reported = describe_sweep(Robot(TURN, limits=(-2.5, 1.9)).run(), half)
    assert reported == (
        'a partial sweep, nothing is seen from pan 130 to 200 deg; '
        'the pan joint stops at -143.2 and 108.9 deg'
    )


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


# What becomes of an image and its stamp, and the reason that is given.
BAD = {
    'blurred or covered': lambda self, image, stamp: (replace(image, sharpness=0.4), stamp),
    'frozen': lambda self, image, stamp: (self.sweep.kept[-1].frame, stamp),
    'badly timed: repeated': lambda self, image, stamp: (
        self.sweep.kept[-1].frame, self.sweep.kept[-1].joints.stamp_ns),
    'badly timed: from the future': lambda self, image, stamp: (image, stamp + 10**9),
    'badly timed: from the past': lambda self, image, stamp: (image, 5),
    'unusable': lambda self, image, stamp: (
        replace(image, broken="image encoding 'yuv' is not supported"), stamp),
}  # fmt: skip


def faulty(kind, last):
    """A robot with such faults, and the reason."""
    return type('Bad', (Faulty,), {'bad': BAD[kind], 'last': last})(), kind.partition(':')[0]


@pytest.mark.parametrize('kind', BAD)
def test_a_bad_frame_is_refused_and_taken_again(kind, caplog):
    robot, reason = faulty(kind, last=12)
    sweep = robot.run()
    check_sweep(sweep)
    assert reason in sweep.refused
    assert 'refused' in caplog.text
    assert reason in caplog.text


@pytest.mark.parametrize('kind', [*BAD][1:])
def test_frames_that_stay_bad_interrupt_it_with_the_reason(kind):
    robot, reason = faulty(kind, last=10**9)
    with pytest.raises(LandmarkNavError, match=f'6 frames refused, the last as {reason}'):
        robot.run()
    with pytest.raises(LandmarkNavError, match=r'frame [56] of 9.*[45] frames are kept'):
        robot.sweep.check(robot.now)
    # Mended, it goes on.
    robot.last = 0
    robot.sweep.resume(robot.now)
    check_sweep(robot.run())


def test_a_camera_frozen_from_the_start_leaves_no_frame():
    robot: Any = Robot()
    robot.camera_image = lambda: (FakeImage(0.0, 0), robot.now - 7_000_000)
    with pytest.raises(LandmarkNavError, match='refused, the last as frozen'):
        robot.run()
    assert not robot.sweep.kept


@pytest.mark.parametrize('seed', range(4))
def test_people_who_pass_do_not_keep_it_from_ending(seed):
    """In four frames of five somebody in plain clothes hides a third of the view."""
    rng = np.random.default_rng(seed)
    robot: Any = Robot(TURN)

    def camera_image():
        person = rng.uniform(-0.4, 0.4) if rng.random() < 0.8 else np.inf
        return FakeImage(robot.pan, robot.k, person=person), robot.now - 7_000_000

    robot.camera_image = camera_image
    check_sweep(robot.run(), -np.pi + np.pi / 12 * np.arange(24))
    assert sum(robot.sweep.refused.values()) < 24


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
    assert robot.sweep.seconds_to_go(robot.now) is None
    robot.until(3)
    assert 0.0 < robot.sweep.seconds_to_go(robot.now) < 60.0
    robot.sweep.stop('no reason')
    again, note = begin_or_resume(robot.sweep, config, inspect, robot.now)
    assert again is robot.sweep
    assert note == 'continued after 3 earlier frames'
    robot.x = 1.0
    with pytest.raises(LandmarkNavError):
        robot.tick()
    anew, note = begin_or_resume(robot.sweep, config, inspect, robot.now)
    assert not anew.kept
    assert note.startswith('begun anew without 3 earlier frames: the robot moved 100.0 cm')
    robot = Robot()
    # A sweep that is complete is not continued.
    anew, note = begin_or_resume(robot.run(), config, inspect, robot.now)
    assert (anew is robot.sweep, note) == (False, '')
