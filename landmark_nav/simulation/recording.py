"""Messages of sweeps and drives of a simulated robot, for bags."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from landmark_nav.messages import encode
from landmark_nav.messages.factory import MessageFactory
from landmark_nav.simulation.drive_path import PathFollower
from landmark_nav.simulation.pan_tilt_unit import PanControl
from landmark_nav.simulation.world import RobotWorld
from landmark_nav.types import CameraFrame, FloatArray, JointSample

_FRAME = 'camera_optical_frame'

# Rate of joint states and odometry on a drive; the physics runs at a multiple of it.
STATE_RATE_HZ = 20

_SETTLE_LIMIT_S = 3.0

# Covariance of odometry messages: constant and large, as in usual drivers.
_ODOMETRY_COVARIANCE = np.diag([0.05, 0.05, 0.05])
_EXACT = np.zeros((3, 3))


class Recorded(NamedTuple):
    """A message, its topic and its stamp, which is also its log time."""

    topic: str
    message: Any
    stamp_ns: int


def sweep_messages(
    world: RobotWorld, factory: MessageFactory, *, frames: int = 72, jpeg_quality: int = 90
) -> Iterator[Recorded]:
    """
    Capture a sweep of evenly spaced images from -180 degrees on, at the pose of the robot.

    Yields ``sweep/image/compressed``, ``sweep/camera_info``, ``joint_states`` and
    ``ground_truth/odom`` for each image, and at the end ``sweep/trajectory``.
    """
    samples: list[JointSample] = []
    for pan in -np.pi + 2.0 * np.pi * np.arange(frames) / frames:
        world.command_pan(float(pan))
        begin_ns = world.stamp_ns
        world.advance(0.1)
        while not world.unit.settled and world.stamp_ns - begin_ns < _SETTLE_LIMIT_S * 1e9:
            world.advance(1.0 / STATE_RATE_HZ)
        frame = world.camera_frame()
        samples.append(JointSample(frame.stamp_ns, frame.pan_rad, frame.tilt_rad))
        yield from _image_messages(frame, factory, 'sweep', 'sweep/image/compressed', jpeg_quality)
        yield _joints(world, factory)
        yield _truth(world, factory)
    world.advance(0.1)
    trajectory = encode.sweep_trajectory(factory, samples, world.mount)
    yield Recorded('sweep/trajectory', trajectory, world.stamp_ns)


def drive_messages(
    world: RobotWorld,
    factory: MessageFactory,
    path_xy: FloatArray,
    pan_control: PanControl,
    *,
    seconds: float,
    speed_m_s: float = 0.35,
    camera_rate_hz: float = 5.0,
    jpeg_quality: int = 90,
) -> Iterator[Recorded]:
    """
    Drive along a path (n, 2) while the camera looks at the walls; the robot stops at its end.

    Yields ``joint_states``, ``odom`` and ``ground_truth/odom`` at 20 Hz,
    ``camera/image_raw/compressed`` and ``camera/camera_info`` at the camera's rate, rounded to 20
    Hz divided by a whole number.
    """
    driver = PathFollower(path_xy, speed_m_s)
    every = max(1, round(STATE_RATE_HZ / camera_rate_hz))
    for k in range(round(seconds * STATE_RATE_HZ)):
        time_s = k / STATE_RATE_HZ
        world.command_velocity(*driver.command(world.true_pose))
        world.command_pan(pan_control.pan(time_s, world.true_pose))
        if k % every == 0:
            frame = world.camera_frame()
            yield from _image_messages(
                frame, factory, 'camera', 'camera/image_raw/compressed', jpeg_quality
            )
        yield _joints(world, factory)
        odometry = encode.odometry(factory, world.odometry_sample(), _ODOMETRY_COVARIANCE)
        yield Recorded('odom', odometry, world.stamp_ns)
        yield _truth(world, factory)
        world.advance(1.0 / STATE_RATE_HZ)


def _image_messages(
    frame: CameraFrame, factory: MessageFactory, camera: str, topic: str, jpeg_quality: int
) -> Sequence[Recorded]:
    stamp = frame.stamp_ns
    image = encode.compressed_image(factory, frame.image, stamp, _FRAME, jpeg_quality)
    info = encode.camera_info(factory, frame.camera, stamp, _FRAME)
    return [Recorded(topic, image, stamp), Recorded(f'{camera}/camera_info', info, stamp)]


def _joints(world: RobotWorld, factory: MessageFactory) -> Recorded:
    sample = world.joint_sample()
    return Recorded(
        'joint_states', encode.joint_state(factory, sample, world.mount), sample.stamp_ns
    )


def _truth(world: RobotWorld, factory: MessageFactory) -> Recorded:
    message = encode.odometry(factory, world.truth_sample(), _EXACT, frame_id='map')
    return Recorded('ground_truth/odom', message, world.stamp_ns)
