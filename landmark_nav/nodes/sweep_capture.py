"""Takes a sweep on request: turns the camera step by step and publishes the frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
import hashlib
import logging
from threading import Condition
import time
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from sensor_msgs.msg import CompressedImage

from landmark_nav.configuration import Configuration
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.learning.capture.config import CaptureConfig
from landmark_nav.learning.capture.frames import Look, look_at, Shot
from landmark_nav.learning.capture.sweep import (
    begin_or_resume,
    describe_progress,
    describe_sweep,
    SweepCapture,
)
from landmark_nav.messages import decode
from landmark_nav.messages.encode import sweep_trajectory
from landmark_nav.nodes.configured import calibration_of, configured
from landmark_nav.ros import camera_frames
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.run import run_node
from landmark_nav.ros.topics import ros_factory
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
        """Publish an image, raw or compressed as received, and its calibration with its stamp."""
        info.header.stamp = image.header.stamp
        (self._compressed if isinstance(image, CompressedImage) else self._raw).publish(image)
        self._info.publish(info)

    def end(self, samples: Sequence[JointSample]) -> None:
        """Publish the angles of all frames, which marks the end of the sweep."""
        self._trajectory.publish(sweep_trajectory(ros_factory, samples, self._mount))


_LOG = logging.getLogger(__name__)

# Timeout of a wait for progress.
_POLL_S = 0.1
# Greatest time that such a wait may take; the rest of a longer one is a stall of this process.
_LONGEST_POLL_S = 0.3
# Number of log lines about the progress of a sweep.
_LINES = 8

# Messages of an image and its camera_info.
_Frame = tuple[Any, Any]


class SweepRunner:
    """Runs the current sweep with the pan unit, and keeps the last one."""

    def __init__(
        self,
        config: CaptureConfig,
        commander: camera_frames.PanCommander,
        output: SweepOutput,
        camera_roll_rad: float = 0.0,
    ) -> None:
        self.config = config
        self._commander = commander
        self._output = output
        self._camera_roll_rad = camera_roll_rad
        self._progress = Condition()
        self._sweep: SweepCapture | None = None
        self._running = False
        self._claimed = False
        self._stopped = ''
        self._held_up_ns = 0
        self.pan_rad: float | None = None

    @property
    def stopped(self) -> str:
        """Reason why the current call has to end; empty if it may continue."""
        return self._stopped

    def claim(self, otherwise: str) -> bool:
        """Whether a call may start; if not, the current call is ended with reason `otherwise`."""
        with self._progress:
            if self._claimed:
                self._stopped = otherwise
            else:
                self._claimed, self._stopped = True, ''
                return True
        return False

    def release(self) -> None:
        """Mark the end of a call."""
        with self._progress:
            self._claimed = False

    def run(self, may_go_on: Callable[[], bool]) -> tuple[SweepCapture, str]:
        """
        Take a sweep or resume one; return it and a note on frames kept from before.

        Raises `LandmarkNavError`: the sweep was interrupted; the message says by what.
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
        """Progress of the sweep; None if no sweep is incomplete."""
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
        """Process odometry."""
        with self._progress:
            if self._sweep is not None:
                self._sweep.add_odometry(sample)

    def add_image(self, image: Any, info: Any) -> None:
        """Process an image and its calibration."""
        digest = hashlib.blake2b(image.data, digest_size=16).digest()
        shot = Shot((image, info), decode.stamp_ns(image.header), digest)
        with self._progress:
            if self._sweep is not None and self._running:
                self._sweep.add_frame(shot, self._now_ns())

    def add_joints(self, sample: JointSample) -> None:
        """Process measured angles, which advance the sweep."""
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
        Monotonic time without the stalls of this process.

        Messages that arrive during a stall are still queued, so that a stall does not count as
        silence of the robot.
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

    def _command(self, sweep: SweepCapture) -> None:
        pan_rad = sweep.command(self._now_ns())
        if pan_rad is not None:
            self._commander.command(pan_rad, self.pan_rad)


class SweepCaptureNode(LandmarkNode):
    """Offers ``capture_sweep``; the sweep itself is `learning.capture.SweepCapture`."""

    def __init__(self, **options: Any) -> None:
        super().__init__('sweep_capture', 'sweep', **options)

    def set_up(self) -> None:
        """Read parameters and files; create topics and services."""
        self._config = configured(self, 'sweep_capture', self._reconfigure)
        mount = calibration_of(self, self._config).mount
        command = self._config.command
        self._runner = SweepRunner(
            self._config.capture,
            camera_frames.PanCommander(self, mount, command.type, command.with_tilt),
            SweepOutput(self, mount),
            mount.camera_roll_rad,
        )
        self._result = 'ready'
        self._camera_info: Any = None
        # Tilt reported by a tilt joint with its own driver.
        self._tilt_rad: float | None = None
        camera_frames.listen_for_joints(self, mount, self._on_joints, self._on_tilt)
        self.listen('camera/camera_info', self._on_camera_info)
        self.inputs.expect(
            *camera_frames.image_topics('camera/image_raw', self._config.image_transport)
        )
        self.listen('odom', lambda message: self._runner.add_odometry(decode.odometry(message)))
        # A call during another one interrupts that one.
        self.offer('capture_sweep', self._capture, group=ReentrantCallbackGroup())

    def _reconfigure(self, config: Configuration) -> None:
        """Use changed parameters from the next sweep on."""
        self._config, self._runner.config = config, config.capture

    def health(self) -> Health:
        """Degraded without joint states or calibration, or with a sweep that was interrupted."""
        if self._lacks_input:
            return Health(Level.DEGRADED, 'not ready for a sweep')
        return self._runner.health() or Health(Level.OK, self._result)

    @property
    def _lacks_input(self) -> bool:
        return self._runner.pan_rad is None or self._camera_info is None

    def _capture(self) -> str:
        """Take one sweep; block the caller while other callbacks advance the sweep."""
        if not self._runner.claim(otherwise='capture_sweep was called again'):
            raise LandmarkNavError('the sweep under way is interrupted: call again to go on')
        try:
            return self._take()
        finally:
            self._runner.release()

    def _take(self) -> str:
        start = time.monotonic()
        while self._lacks_input:
            why = self._runner.stopped or ('the node ends' if self.ended.done() else '')
            if why or time.monotonic() - start > self._config.capture.step_timeout_s:
                why = why or '; '.join([self.inputs.waits(), *self.inputs.problems()])
                raise LandmarkNavError(f'no sweep: {why}')
            time.sleep(_POLL_S)
        camera = decode.camera_model(self._camera_info)
        images = camera_frames.ImageSource(
            self, 'camera/image_raw', self._on_image, self._config.image_transport, depth=2
        )
        try:
            sweep, note = self._runner.run(lambda: not self.ended.done())
        finally:
            images.close()
        described = describe_sweep(sweep, camera.half_fov_rad)
        self._result = (
            'ready' if described == 'the full turn' else f'ready; the last sweep: {described}'
        )
        took = f'{len(sweep.kept)} frames in {time.monotonic() - start:.0f} s'
        return f'{took}: {"; ".join(filter(None, (described, note)))}'

    def _on_camera_info(self, message: Any) -> None:
        self._camera_info = message

    def _on_image(self, message: Any) -> None:
        self._runner.add_image(message, self._camera_info)

    def _on_tilt(self, _stamp_ns: int, tilt_rad: float) -> None:
        self._tilt_rad = tilt_rad

    def _on_joints(self, sample: JointSample) -> None:
        if self._tilt_rad is not None:
            sample = replace(sample, tilt_rad=self._tilt_rad)
        self._runner.add_joints(sample)


main = partial(run_node, SweepCaptureNode, threads=3)

if __name__ == '__main__':
    raise SystemExit(main())
