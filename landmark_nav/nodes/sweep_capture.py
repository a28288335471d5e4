"""Takes a sweep on request: turns the camera step by step and publishes the frames it keeps."""

from __future__ import annotations

from dataclasses import dataclass, field
from threading import Condition
import time
from typing import Any

import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from sensor_msgs.msg import CompressedImage

from landmark_nav.errors import LandmarkNavError
from landmark_nav.learning.capture import CaptureConfig, KeptFrame, SweepCapture
from landmark_nav.messages.decode import joint_sample, stamp_ns
from landmark_nav.messages.encode import sweep_trajectory
from landmark_nav.parameters import check_parameters, parameter
from landmark_nav.ros.factory import ros_factory
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.image_source import ImageSource, TRANSPORTS
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.pan_command import PanCommander, PanCommandParameters
from landmark_nav.ros.run import run_node
from landmark_nav.storage.setup_files import load_robot

__all__ = ['Parameters', 'SweepCaptureNode', 'main']

_POLL_S = 0.1


@dataclass(frozen=True)
class Parameters:
    """Of the node ``sweep_capture``."""

    robot_file: str = parameter('', 'robot.yaml: where the turning camera sits')
    image_transport: str = parameter('auto', 'form of camera/image_raw', choices=TRANSPORTS)
    capture: CaptureConfig = field(default_factory=CaptureConfig)
    command: PanCommandParameters = field(default_factory=PanCommandParameters)

    def __post_init__(self) -> None:
        """Check the values."""
        check_parameters(self)


class SweepCaptureNode(LandmarkNode):
    """Offers ``capture_sweep``; the sweep itself is `learning.capture.SweepCapture`."""

    def __init__(self, **options: Any) -> None:
        super().__init__('sweep_capture', 'sweep', **options)
        self._config = self.configure(Parameters)
        self._mount = load_robot(self.required('robot_file', self._config.robot_file))
        self._commander = PanCommander(self, self._mount, self._config.command)
        self._publishers_of_frames = {
            name: self.advertise(name) for name in ('sweep/image', 'sweep/image/compressed')
        }
        self._info_publisher = self.advertise('sweep/camera_info')
        self._trajectory_publisher = self.advertise('sweep/trajectory')
        self._progress = Condition()
        self._sweep: SweepCapture[Any] | None = None
        self._camera_info: Any = None
        self._pan_rad: float | None = None
        self.listen('joint_states', self._on_joints)
        self.listen('camera/camera_info', self._on_camera_info)
        self.offer('capture_sweep', self._capture, group=MutuallyExclusiveCallbackGroup())

    def health(self) -> Health:
        """Degraded as long as there are no joint states or no calibration."""
        inputs = {'joint_states': self._pan_rad, 'camera/camera_info': self._camera_info}
        missing = [name for name, value in inputs.items() if value is None]
        if missing:
            return Health(Level.DEGRADED, f'nothing yet on {", ".join(missing)}')
        sweep = self._sweep
        if sweep is None:
            return Health(Level.OK, 'ready')
        frames = len(sweep.kept)
        return Health(Level.OK, f'frame {frames} of {self._config.capture.frames}')

    def _capture(self) -> str:
        """Take one sweep; blocks its caller while the other callbacks drive it."""
        start = time.monotonic()
        while self._pan_rad is None or self._camera_info is None:
            if time.monotonic() - start > self._config.capture.step_timeout_s:
                raise LandmarkNavError(f'no sweep: {self.health().reason}; start the robot')
            time.sleep(_POLL_S)
        images = ImageSource(
            self, 'camera/image_raw', self._on_image, self._config.image_transport, depth=2
        )
        try:
            with self._progress:
                sweep = self._sweep = SweepCapture(self._config.capture, time.monotonic_ns())
                self._commander.command(sweep.target_rad, self._pan_rad)
                while not sweep.done and self.context.ok():
                    self._progress.wait(_POLL_S)
                    sweep.check_time(time.monotonic_ns())
        finally:
            self._sweep = None
            images.close()
        if not sweep.done:
            raise LandmarkNavError('sweep given up: the node is ending')
        samples = [kept.joints for kept in sweep.kept]
        self._trajectory_publisher.publish(sweep_trajectory(ros_factory, samples, self._mount))
        self._commander.command(0.0, self._pan_rad)
        return f'{len(sweep.kept)} frames in {time.monotonic() - start:.0f} s'

    def _on_camera_info(self, message: Any) -> None:
        self._camera_info = message

    def _on_image(self, message: Any) -> None:
        with self._progress:
            if self._sweep is not None:
                self._sweep.add_frame((message, self._camera_info), stamp_ns(message.header))

    def _on_joints(self, message: Any) -> None:
        sample = joint_sample(message, self._mount)
        if sample is None:
            return
        with self._progress:
            self._pan_rad = sample.pan_rad
            if self._sweep is None:
                return
            kept = self._sweep.add_joints(sample, time.monotonic_ns())
            if kept is not None:
                self._publish_frame(kept)
                if not self._sweep.done:
                    self._commander.command(self._sweep.target_rad, sample.pan_rad)
                self._progress.notify_all()

    def _publish_frame(self, kept: KeptFrame[Any]) -> None:
        image, info = kept.frame
        info.header.stamp = image.header.stamp
        compressed = isinstance(image, CompressedImage)
        name = 'sweep/image/compressed' if compressed else 'sweep/image'
        self._publishers_of_frames[name].publish(image)
        self._info_publisher.publish(info)
        assert self._sweep is not None
        taken, total = len(self._sweep.kept), self._config.capture.frames
        if taken % 12 == 0 or taken == total:
            pan_deg = np.degrees(kept.joints.pan_rad)
            self.get_logger().info(f'frame {taken} of {total} at {pan_deg:.1f} deg')


def main() -> int:
    """Entry point of the executable."""
    return run_node(SweepCaptureNode, threads=2)


if __name__ == '__main__':
    raise SystemExit(main())
