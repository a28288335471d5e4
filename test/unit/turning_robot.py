"""A robot whose camera overshoots as it turns, for sweeps that are taken without ROS."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.learning.capture.config import CaptureConfig
from landmark_nav.learning.capture.frames import Look, Shot
from landmark_nav.learning.capture.sweep import SweepCapture
from landmark_nav.types import JointSample, OdometrySample

STEP_NS = 20_000_000
SHORT = CaptureConfig(
    start_rad=-1.0,
    step_rad=0.25,
    frames=9,
    pan_min_rad=-1.2,
    pan_max_rad=1.2,
    step_timeout_s=1.0,
    retakes=5,
)
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
