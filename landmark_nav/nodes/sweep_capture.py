"""Takes a sweep on request: turns the camera step by step and publishes the frames."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
import hashlib
from threading import Condition
import time
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from sensor_msgs.msg import CompressedImage

from landmark_nav.errors import LandmarkNavError
from landmark_nav.learning.capture.frames import Look, look_at, Shot
from landmark_nav.learning.capture.sweep import (
    begin_or_resume,
    describe_progress,
    describe_sweep,
    SweepCapture,
)
from landmark_nav.messages import decode, encode
from landmark_nav.nodes.configured import ConfiguredNode
from landmark_nav.ros.camera_frames import (
    image_topics,
    ImageSource,
    listen_for_joints,
    PanCommander,
)
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.run import run_node
from landmark_nav.ros.topics import ros_factory
from landmark_nav.types import JointSample

# Timeout of a wait for progress.
_POLL_S = 0.1
# Greatest time that such a wait may take; the rest of a longer one is a stall of this process.
_LONGEST_POLL_S = 0.3
# Number of log lines about the progress of a sweep.
_LINES = 8

# Messages of an image and its camera_info.
_Frame = tuple[Any, Any]


class SweepCaptureNode(ConfiguredNode):
    """Offers ``capture_sweep``; the sweep itself is `learning.capture.SweepCapture`."""

    def __init__(self, **options: Any) -> None:
        super().__init__('sweep_capture', 'sweep', **options)

    def set_up(self) -> None:
        """Read parameters and files; create topics and services."""
        super().set_up()
        self._mount = self._robot().mount
        command = self.config.command
        self._commander = PanCommander(self, self._mount, command.type, command.with_tilt)
        self._images = self.advertise('sweep/image')
        self._compressed = self.advertise('sweep/image/compressed')
        self._infos = self.advertise('sweep/camera_info')
        self._trajectory = self.advertise('sweep/trajectory')
        # Guards the sweep, and wakes the call that takes it.
        self._progress = Condition()
        self._sweep: SweepCapture | None = None
        self._running = self._claimed = False
        # Reason why the current call has to end; empty if it may continue.
        self._stopped = ''
        self._held_up_ns = 0
        self._result = 'ready'
        self._camera_info: Any = None
        self._pan_rad: float | None = None
        # Tilt reported by a tilt joint with its own driver.
        self._tilt_rad: float | None = None
        listen_for_joints(self, self._mount, self._on_joints, self._on_tilt)
        self.listen('camera/camera_info', self._on_camera_info)
        self.inputs.expect(*image_topics('camera/image_raw', self.config.image_transport))
        self.listen('odom', self._on_odometry)
        # A call during another one interrupts that one.
        self.offer('capture_sweep', self._capture, group=ReentrantCallbackGroup())

    def health(self) -> Health:
        """Degraded without joint states or calibration, or with a sweep that was interrupted."""
        if self._lacks_input:
            return Health(Level.DEGRADED, 'not ready for a sweep')
        with self._progress:
            sweep = self._sweep
            if sweep is None or sweep.done:
                return Health(Level.OK, self._result)
            progress = describe_progress(sweep, self._now_ns())
            refused = {f'refused: {reason}': count for reason, count in sweep.refused.items()}
        if self._running:
            return Health(Level.OK, progress, refused)
        return Health(Level.DEGRADED, f'interrupted, {progress}: call capture_sweep', refused)

    @property
    def _lacks_input(self) -> bool:
        return self._pan_rad is None or self._camera_info is None

    def _capture(self) -> str:
        """Take one sweep; block the caller while other callbacks advance the sweep."""
        with self._progress:
            if self._claimed:
                self._stopped = 'capture_sweep was called again'
                raise LandmarkNavError('the sweep under way is interrupted: call again to go on')
            self._claimed, self._stopped = True, ''
        try:
            return self._take()
        finally:
            with self._progress:
                self._claimed = False

    def _take(self) -> str:
        """Take a sweep or resume one, as soon as all inputs are there; describe it."""
        start = time.monotonic()
        while self._lacks_input:
            why = self._stopped or ('the node ends' if self.ended.done() else '')
            if why or time.monotonic() - start > self.config.capture.step_timeout_s:
                why = why or '; '.join([self.inputs.waits(), *self.inputs.problems()])
                raise LandmarkNavError(f'no sweep: {why}')
            time.sleep(_POLL_S)
        camera = decode.camera_model(self._camera_info)
        transport = self.config.image_transport
        images = ImageSource(self, 'camera/image_raw', self._on_image, transport, depth=2)
        try:
            sweep, note = self._run()
        finally:
            images.close()
        samples = [kept.joints for kept in sweep.kept]
        self._trajectory.publish(encode.sweep_trajectory(ros_factory, samples, self._mount))
        described = describe_sweep(sweep, camera.half_fov_rad)
        self._result = (
            'ready' if described == 'the full turn' else f'ready; the last sweep: {described}'
        )
        took = f'{len(samples)} frames in {time.monotonic() - start:.0f} s'
        return f'{took}: {"; ".join(filter(None, (described, note)))}'

    def _run(self) -> tuple[SweepCapture, str]:
        """
        Turn the camera until the sweep is done; return it and a note on frames from before.

        Raises `LandmarkNavError`: the sweep was interrupted; the message says by what.
        """
        with self._progress:
            config, now_ns = self.config.capture, self._now_ns()
            sweep, note = begin_or_resume(self._sweep, config, self._inspect, now_ns)
            self._sweep, self._running = sweep, True
            self.get_logger().info(f'sweep {note or "begun"}')
            try:
                while not sweep.done and not self.ended.done():
                    if self._stopped:
                        sweep.stop(self._stopped)
                    sweep.check(self._now_ns())
                    self._command(sweep)
                    self._wait()
            finally:
                self._running = False
                if not self.ended.done():
                    self._commander.command(sweep.reach.nearest(0.0), self._pan_rad)
        if not sweep.done:
            raise LandmarkNavError(
                f'sweep given up after {len(sweep.kept)} of {sweep.total} frames, which end with '
                'this node: call capture_sweep again once it runs'
            )
        return sweep, note

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
        return look_at(*view, self._mount.camera_roll_rad)

    def _command(self, sweep: SweepCapture) -> None:
        pan_rad = sweep.command(self._now_ns())
        if pan_rad is not None:
            self._commander.command(pan_rad, self._pan_rad)

    def _publish(self, image: Any, info: Any) -> None:
        """Publish an image, raw or compressed as received, and its calibration with its stamp."""
        info.header.stamp = image.header.stamp
        is_compressed = isinstance(image, CompressedImage)
        (self._compressed if is_compressed else self._images).publish(image)
        self._infos.publish(info)

    def _on_camera_info(self, message: Any) -> None:
        self._camera_info = message

    def _on_odometry(self, message: Any) -> None:
        sample = decode.odometry(message)
        with self._progress:
            if self._sweep is not None:
                self._sweep.add_odometry(sample)

    def _on_image(self, message: Any) -> None:
        digest = hashlib.blake2b(message.data, digest_size=16).digest()
        shot = Shot((message, self._camera_info), decode.stamp_ns(message.header), digest)
        with self._progress:
            if self._sweep is not None and self._running:
                self._sweep.add_frame(shot, self._now_ns())

    def _on_tilt(self, _stamp_ns: int, tilt_rad: float) -> None:
        self._tilt_rad = tilt_rad

    def _on_joints(self, sample: JointSample) -> None:
        """Advance the sweep."""
        if self._tilt_rad is not None:
            sample = replace(sample, tilt_rad=self._tilt_rad)
        with self._progress:
            self._pan_rad = sample.pan_rad
            sweep = self._sweep
            if sweep is None or not self._running:
                return
            kept = sweep.add_joints(sample, self._now_ns())
            if kept is not None:
                self._publish(*kept.frame)
                if len(sweep.kept) % max(1, sweep.total // _LINES) == 0:
                    self.get_logger().info(describe_progress(sweep, self._now_ns()))
            self._command(sweep)
            if sweep.done:
                self._progress.notify_all()


main = partial(run_node, SweepCaptureNode, threads=3)

if __name__ == '__main__':
    raise SystemExit(main())
