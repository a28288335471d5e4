"""Runs a sweep on what the topics bring, in whichever threads they come."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import hashlib
import logging
from threading import Condition
import time
from typing import Any

from sensor_msgs.msg import CompressedImage

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.learning.capture import (
    begin_or_resume,
    CaptureConfig,
    describe_progress,
    Shot,
    SweepCapture,
)
from landmark_nav.learning.capture.frames import Look, look_at
from landmark_nav.messages import decode
from landmark_nav.messages.encode import sweep_trajectory
from landmark_nav.ros.factory import ros_factory
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.pan_command import PanCommander
from landmark_nav.types import JointSample, OdometrySample


class SweepOutput:
    """Publishers of ``sweep/*``."""

    def __init__(self, node: LandmarkNode, mount: PanTiltMount) -> None:
        self._mount = mount
        self._raw = node.advertise('sweep/image')
        self._compressed = node.advertise('sweep/image/compressed')
        self._info = node.advertise('sweep/camera_info')
        self._trajectory = node.advertise('sweep/trajectory')

    def frame(self, image: Any, info: Any) -> None:
        """Publish a frame in the form it came in, and its calibration with the same stamp."""
        info.header.stamp = image.header.stamp
        (self._compressed if isinstance(image, CompressedImage) else self._raw).publish(image)
        self._info.publish(info)

    def end(self, samples: Sequence[JointSample]) -> None:
        """Publish the angles of all frames, which ends the sweep."""
        self._trajectory.publish(sweep_trajectory(ros_factory, samples, self._mount))


_LOG = logging.getLogger(__name__)

_POLL_S = 0.1
# What waiting for that long may take; whatever is longer, this process was held up itself.
_LONGEST_POLL_S = 0.3
# Log lines of a sweep.
_LINES = 8

# An image and its camera_info.
_Frame = tuple[Any, Any]


class SweepRunner:
    """The sweep under way, or the last one, and the pan unit that it turns."""

    def __init__(
        self,
        config: CaptureConfig,
        commander: PanCommander,
        output: SweepOutput,
        camera_roll_rad: float = 0.0,
    ) -> None:
        self.config = config
        self._commander = commander
        self._output = output
        self._camera_roll_rad = camera_roll_rad
        self._progress = Condition()
        self._sweep: SweepCapture[_Frame] | None = None
        self._running = False
        self._claimed = False
        self._stopped = ''
        self._held_up_ns = 0
        self.pan_rad: float | None = None

    @property
    def stopped(self) -> str:
        """Why the call that is served has to end; nothing if it need not."""
        return self._stopped

    def claim(self, otherwise: str) -> bool:
        """Whether a call may be served now; else the one that is served ends, for that reason."""
        with self._progress:
            if self._claimed:
                self._stopped = otherwise
            else:
                self._claimed, self._stopped = True, ''
                return True
        return False

    def release(self) -> None:
        """The call is served."""
        with self._progress:
            self._claimed = False

    def run(self, may_go_on: Callable[[], bool]) -> tuple[SweepCapture[_Frame], str]:
        """
        Take a sweep, or the rest of one; returns it and what became of earlier frames.

        Raises `LandmarkNavError`: it was interrupted; the message says by what.
        """
        with self._progress:
            sweep, note = begin_or_resume(self._sweep, self.config, self._inspect, self._now_ns())
            self._sweep, self._running = sweep, True
            _LOG.info('sweep %s', note or 'begun')
            try:
                while not sweep.done and may_go_on():
                    if self._stopped:
                        sweep.stop(self._stopped)
                    sweep.check(self._now_ns())
                    self._command(sweep)
                    self._wait()
            finally:
                self._running = False
                if may_go_on():
                    self._commander.command(sweep.reach.nearest(0.0), self.pan_rad)
        if not sweep.done:
            raise LandmarkNavError(
                f'sweep given up after {len(sweep.kept)} of {sweep.total} frames, which end with '
                'this node: call capture_sweep again once it runs'
            )
        self._output.end([kept.joints for kept in sweep.kept])
        return sweep, note

    def health(self) -> Health | None:
        """How the sweep goes; None if there is none that is not complete."""
        with self._progress:
            sweep = self._sweep
            if sweep is None or sweep.done:
                return None
            progress = describe_progress(sweep, self._now_ns())
            refused = {f'refused: {reason}': count for reason, count in sweep.refused.items()}
        if self._running:
            return Health(Level.OK, progress, refused)
        return Health(Level.DEGRADED, f'interrupted, {progress}: call capture_sweep', refused)

    def add_odometry(self, sample: OdometrySample) -> None:
        """Take the robot's place."""
        with self._progress:
            if self._sweep is not None:
                self._sweep.add_odometry(sample)

    def add_image(self, image: Any, info: Any) -> None:
        """Take an image and its calibration."""
        digest = hashlib.blake2b(image.data, digest_size=16).digest()
        shot = Shot((image, info), decode.stamp_ns(image.header), digest)
        with self._progress:
            if self._sweep is not None and self._running:
                self._sweep.add_frame(shot, self._now_ns())

    def add_joints(self, sample: JointSample) -> None:
        """Take measured angles; they move the sweep on."""
        with self._progress:
            self.pan_rad = sample.pan_rad
            sweep = self._sweep
            if sweep is None or not self._running:
                return
            kept = sweep.add_joints(sample, self._now_ns())
            if kept is not None:
                self._output.frame(*kept.frame)
                if len(sweep.kept) % max(1, sweep.total // _LINES) == 0:
                    _LOG.info('%s', describe_progress(sweep, self._now_ns()))
            self._command(sweep)
            if sweep.done:
                self._progress.notify_all()

    def _now_ns(self) -> int:
        """
        Time of this process, without what it was held up for.

        What came meanwhile still lies in the queues: a robot that was not listened to has not
        been silent.
        """
        return time.monotonic_ns() - self._held_up_ns

    def _wait(self) -> None:
        before_ns = time.monotonic_ns()
        self._progress.wait(_POLL_S)
        took_ns = time.monotonic_ns() - before_ns
        self._held_up_ns += max(0, took_ns - int(_LONGEST_POLL_S * 1e9))

    def _inspect(self, frame: _Frame) -> Look:
        image, info = frame
        view = decode.camera_image(image, decode.camera_info(info), grey=True)
        return look_at(*view, self._camera_roll_rad)

    def _command(self, sweep: SweepCapture[_Frame]) -> None:
        pan_rad = sweep.command(self._now_ns())
        if pan_rad is not None:
            self._commander.command(pan_rad, self.pan_rad)
