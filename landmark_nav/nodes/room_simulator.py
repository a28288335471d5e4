"""Simulates a room and a robot in real time: it publishes sensors and obeys commands."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import isfinite
import time
from typing import Any

import numpy as np

from landmark_nav.calibration import Calibration
from landmark_nav.configuration import Configuration
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages import encode
from landmark_nav.nodes.configured import ConfiguredNode
from landmark_nav.ros.camera_frames import listen_for_pan
from landmark_nav.ros.health import Health, Level, steady_clock
from landmark_nav.ros.run import run_node
from landmark_nav.ros.topics import ros_factory, TransformBroadcaster
from landmark_nav.simulation.furnishing import generate_scene
from landmark_nav.simulation.scene import choose_sweep_places
from landmark_nav.simulation.world import DEFAULT_CAMERA, DEFAULT_MOUNT, RobotWorld
from landmark_nav.storage.setup_files import load_camera, load_room

_STEP_S = 1.0 / 60.0
# Odometry comes at half the rate of the joint states.
_STEPS_PER_ODOMETRY = 2
# Greatest lag of the simulation; a longer one is skipped.
_MAX_LAG_S = 20.0
# Greatest difference of stamps and system time, above that of two readings of clocks; beyond it
# stamps jump to the system time.
_MAX_OFF_NS = 250_000_000
_OPTICAL_FRAME = 'camera_optical_frame'
_EXACT = np.zeros((3, 3))
# Least interval of images, and a usual quality of JPEG.
_IMAGE_PERIOD_NS, _JPEG_QUALITY = 100_000_000, 92
# Time without cmd_vel after which the robot stops, as with the drivers of real bases.
_COMMAND_TIMEOUT_S = 0.5


class RoomSimulatorNode(ConfiguredNode):
    """`simulation.world.RobotWorld` on topics, in system time even with `use_sim_time`."""

    def __init__(self, **options: Any) -> None:
        super().__init__('room_simulator', 'robot', **options)

    def set_up(self) -> None:
        """Read parameters and files; create topics and services."""
        super().set_up()
        config = self.config
        known = self._robot() if config.robot_file else Calibration.of_mount(DEFAULT_MOUNT)
        self._mount, tilt_rad = known.mount, known['camera_tilt'][0]
        self._began_s = time.monotonic()
        self._world = _build(config, self._mount, tilt_rad, time.time_ns())
        self._steps = self._image_count = self._image_due_ns = 0
        self._last_command = 0.0
        self._joints = self.advertise('joint_states')
        self._odometry = self.advertise('odom')
        self._truth = self.advertise('ground_truth/odom')
        compressed = partial(encode.compressed_image, jpeg_quality=_JPEG_QUALITY)
        self._images: dict[Any, Callable[..., Any]] = {
            self.advertise('camera/image_raw'): encode.image,
            self.advertise('camera/image_raw/compressed'): compressed,
        }
        self._info = self.advertise('camera/camera_info')
        self._transforms = TransformBroadcaster(self)
        camera = encode.camera_transform(self._mount, _OPTICAL_FRAME, tilt_rad)
        self._transforms.send_static(self._world.stamp_ns, [camera])
        self.listen('cmd_vel', self._on_velocity)
        listen_for_pan(self, self._mount, config.command.type, self._world.command_pan)
        self.create_timer(_STEP_S, self._tick, clock=steady_clock())

    def health(self) -> Health:
        """Degraded if the simulation lags behind real time."""
        image_count, self._image_count = self._image_count, 0
        values = {'lag_s': f'{self._lag_s:.2f}', 'images_per_s': image_count}
        late = self._lag_s > 1.0
        reason = 'too slow for the wall clock' if late else 'running'
        return Health(Level.DEGRADED if late else Level.OK, reason, values)

    @property
    def _lag_s(self) -> float:
        """Lag of the simulated time."""
        return time.monotonic() - self._began_s - self._steps * _STEP_S

    def _on_velocity(self, message: Any) -> None:
        linear_m_s, angular_rad_s = float(message.linear.x), float(message.angular.z)
        if not isfinite(linear_m_s) or not isfinite(angular_rad_s):
            raise LandmarkNavError('a speed is not a finite number')
        self._last_command = time.monotonic()
        self._world.command_velocity(linear_m_s, angular_rad_s)

    def _tick(self) -> None:
        """Catch up with real time in steps, then take an image if one is due."""
        if time.monotonic() - self._last_command > _COMMAND_TIMEOUT_S:
            self._world.command_velocity(0.0, 0.0)
        if self._lag_s > _MAX_LAG_S:
            self._began_s += self._lag_s
        self._follow_clock()
        for _ in range(int(self._lag_s / _STEP_S)):
            self._step()
        if self._world.stamp_ns >= self._image_due_ns:
            self._image_due_ns = self._world.stamp_ns + _IMAGE_PERIOD_NS
            self._take_image()

    def _follow_clock(self) -> None:
        """Adjust stamps to the system time after a change of the clock or a skipped lag."""
        stamp_ns = time.time_ns() - int(1e9 * self._lag_s)
        off_ns = stamp_ns - self._world.stamp_ns
        if abs(off_ns) > _MAX_OFF_NS:
            self._world.set_clock(stamp_ns)
            self._image_due_ns = stamp_ns
            self.get_logger().warning(f'stamps jump by {1e-9 * off_ns:+.1f} s to the system time')

    def _step(self) -> None:
        world, mount = self._world, self._mount
        world.advance(_STEP_S)
        self._steps += 1
        joints = world.joint_sample()
        self._joints.publish(encode.joint_state(ros_factory, joints, mount))
        self._transforms.send(joints.stamp_ns, encode.joint_transforms(mount, joints))
        if self._steps % _STEPS_PER_ODOMETRY == 0:
            odometry = partial(encode.odometry, ros_factory, child_frame_id=mount.base_frame)
            sample = world.odometry_sample()
            self._odometry.publish(odometry(sample))
            base = encode.planar_transform('odom', mount.base_frame, sample.pose_odom_base)
            self._transforms.send(sample.stamp_ns, [base])
            truth = odometry(world.truth_sample(), _EXACT, frame_id='map')
            self._truth.publish(truth)

    def _take_image(self) -> None:
        """Publish camera_info; render and publish an image if there are subscribers."""
        world, camera = self._world, self._world.camera
        stamp = world.stamp_ns + round(1e9 * world.mount.image_delay_s)
        self._info.publish(encode.camera_info(ros_factory, camera, stamp, _OPTICAL_FRAME))
        wanted = [item for item in self._images.items() if item[0].get_subscription_count()]
        if wanted:
            image = self._world.camera_frame().image
            self._image_count += 1
            for publisher, encoded in wanted:
                publisher.publish(encoded(ros_factory, image, stamp, _OPTICAL_FRAME))


def _build(
    config: Configuration, mount: PanTiltMount, camera_tilt_rad: float, start_ns: int
) -> RobotWorld:
    scene = generate_scene(config.seed, load_room(config.room_file) if config.room_file else None)
    places = choose_sweep_places(scene)
    if places is None:
        raise LandmarkNavError('the room has no place for a sweep: take another seed')
    return RobotWorld(
        scene,
        places.poses[0],
        config.seed,
        camera=load_camera(config.camera_file) if config.camera_file else DEFAULT_CAMERA,
        mount=mount,
        camera_tilt_rad=camera_tilt_rad,
        start_ns=start_ns,
    )


main = partial(run_node, RoomSimulatorNode)

if __name__ == '__main__':
    raise SystemExit(main())
