"""Takes a sweep on request: turns the camera step by step and publishes the frames."""

from __future__ import annotations

from dataclasses import replace
import time
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup

from landmark_nav.configuration import Configuration
from landmark_nav.errors import LandmarkNavError
from landmark_nav.learning.capture import describe_sweep
from landmark_nav.messages import decode
from landmark_nav.nodes.configured import calibration_of, configured
from landmark_nav.nodes.sweep_runner import SweepOutput, SweepRunner
from landmark_nav.ros.camera_frames import listen_for_joints
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.image_source import image_topics, ImageSource
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.pan_command import PanCommander
from landmark_nav.ros.run import run_node
from landmark_nav.types import JointSample

_POLL_S = 0.1


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
            PanCommander(self, mount, command.type, command.with_tilt),
            SweepOutput(self, mount),
            mount.camera_roll_rad,
        )
        self._result = 'ready'
        self._camera_info: Any = None
        # Tilt reported by a tilt joint with its own driver.
        self._tilt_rad: float | None = None
        listen_for_joints(self, mount, self._on_joints, self._on_tilt)
        self.listen('camera/camera_info', self._on_camera_info)
        self.inputs.expect(*image_topics('camera/image_raw', self._config.image_transport))
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
        images = ImageSource(
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


def main() -> int:
    """Entry point of the executable."""
    return run_node(SweepCaptureNode, threads=3)


if __name__ == '__main__':
    raise SystemExit(main())
