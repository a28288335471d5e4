"""A sweep is taken over DDS of a small robot that turns a camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from threading import Thread
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.messages import decode, encode
from landmark_nav.ros.factory import ros_factory
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.pan_command import listen_for_pan
from landmark_nav.ros.robot_client import RobotClient
from landmark_nav.types import JointSample

FRAMES = 8
STEP_RAD = 0.25
MOUNT = PanTiltMount((0.08, 0.0, 1.1))
CAMERA = CameraModel(64, 48, 60.0, 60.0, 31.5, 23.5)


class SmallRobot(LandmarkNode):
    """Joint states at 50 Hz, every third with a picture; keeps what a sweep publishes."""

    def __init__(self, transport: str, command: str, stuck: bool, **options: Any) -> None:
        super().__init__('small_robot', 'robot', **options)
        self._pan, self._target, self._stuck, self._count = 0.0, 0.0, stuck, 0
        self._joints = self.advertise('joint_states')
        self._info = self.advertise('camera/camera_info')
        raw = transport == 'raw'
        self._image = self.advertise('camera/image_raw' + ('' if raw else '/compressed'))
        self._encode = encode.image if raw else encode.compressed_image
        listen_for_pan(self, MOUNT, command, self._turn)
        self.images: list[Any] = []
        self.infos: list[Any] = []
        self.trajectories: list[Any] = []
        self.listen('sweep/image' + ('' if raw else '/compressed'), self.images.append)
        self.listen('sweep/camera_info', self.infos.append)
        self.listen('sweep/trajectory', self.trajectories.append)
        self.create_timer(0.02, self._tick)

    def health(self) -> Health:
        return Health(Level.OK, 'running')

    def _turn(self, pan_rad: float) -> None:
        self._target = pan_rad

    def _tick(self) -> None:
        if not self._stuck:
            self._pan += float(np.clip(self._target - self._pan, -0.1, 0.1))
        self._count += 1
        stamp = self.get_clock().now().nanoseconds
        self._joints.publish(encode.joint_state(ros_factory, JointSample(stamp, self._pan), MOUNT))
        if self._count % 3 == 0:
            # The picture tells the pan it was taken at.
            grey = np.full((48, 64), round(100 + 50 * self._pan), np.uint8)
            self._image.publish(self._encode(ros_factory, grey, stamp, 'camera_optical_frame'))
            self._info.publish(encode.camera_info(ros_factory, CAMERA, stamp, 'camera'))


@pytest.fixture
def robot(domain_id: int) -> Iterator[Callable[..., SmallRobot]]:
    context = Context()
    context.init(domain_id=domain_id)
    executor = SingleThreadedExecutor(context=context)

    def spin() -> None:
        try:
            executor.spin()
        except Exception:
            # A timer may publish at the moment of the shutdown.
            if context.ok():
                raise

    def make(
        transport: str = 'raw', command: str = 'JointTrajectory', stuck: bool = False
    ) -> SmallRobot:
        node = SmallRobot(transport, command, stuck, context=context)
        executor.add_node(node)
        thread.start()
        return node

    thread = Thread(target=spin)
    yield make
    context.try_shutdown()
    thread.join(5.0)


def sweep_parameters(setup_files: dict[str, str]) -> dict[str, Any]:
    return {
        'robot_file': setup_files['robot_file'],
        'capture.start_rad': -1.0,
        'capture.step_rad': STEP_RAD,
        'capture.frames': FRAMES,
    }


@pytest.mark.parametrize(
    ('transport', 'command'),
    [
        ('raw', 'JointTrajectory'),
        ('compressed', 'Float64MultiArray'),
        ('compressed', 'JointState'),
    ],
)
def test_every_frame_is_there_with_the_pan_it_was_taken_at(
    transport: str,
    command: str,
    robot: Callable[..., SmallRobot],
    start: Callable[..., None],
    client: RobotClient,
    setup_files: dict[str, str],
) -> None:
    start('sweep_capture', **sweep_parameters(setup_files), **{'command.type': command})
    small = robot(transport, command)
    assert client.call('capture_sweep', 60.0).startswith(f'{FRAMES} frames')
    client.wait(lambda: bool(small.trajectories), 20.0, 'the trajectory')
    client.wait(lambda: len(small.infos) == FRAMES, 20.0, 'all frames')
    samples = decode.sweep_trajectory(small.trajectories[0], MOUNT)
    np.testing.assert_allclose(
        [sample.pan_rad for sample in samples], -1.0 + STEP_RAD * np.arange(FRAMES), atol=0.01
    )
    stamps = [sample.stamp_ns for sample in samples]
    assert [decode.stamp_ns(message.header) for message in small.images] == stamps
    assert [decode.stamp_ns(message.header) for message in small.infos] == stamps
    for sample, message in zip(samples, small.images, strict=True):
        assert abs(float(decode.image(message).mean()) - (100 + 50 * sample.pan_rad)) < 2.0


def test_refusals_say_why_and_leave_the_node_running(
    robot: Callable[..., SmallRobot],
    start: Callable[..., None],
    client: RobotClient,
    setup_files: dict[str, str],
) -> None:
    start('sweep_capture', **sweep_parameters(setup_files), **{'capture.step_timeout_s': 1.0})
    with pytest.raises(LandmarkNavError, match='nothing yet on joint_states'):
        client.call('capture_sweep', 30.0)
    robot(stuck=True)
    client.wait(lambda: client.said('sweep_capture').reason == 'ready', 20.0, 'joint states')
    with pytest.raises(LandmarkNavError, match=r'frame 1 of 8, -57.3 deg.*the pan is 0.00 deg'):
        client.call('capture_sweep', 30.0)
