"""The simulated robot among people: commands, sensors, recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.se2 import arc, compose
from landmark_nav.messages import encode
from landmark_nav.messages.factory import MessageFactory
from landmark_nav.parameters import Config
from landmark_nav.simulation.drive_path import PathFollower
from landmark_nav.simulation.pan_tilt_unit import PanControl, PanTiltConfig, PanTiltUnit
from landmark_nav.simulation.renderer import CameraEffects, CameraEffectsConfig, Renderer
from landmark_nav.simulation.scene import Scene
from landmark_nav.simulation.solids import Solid
from landmark_nav.simulation.surfaces import Surface
from landmark_nav.simulation.textures import fractal_noise, random_color, to_uint8
from landmark_nav.types import CameraFrame, FloatArray, ImageArray, JointSample, OdometrySample


@dataclass(frozen=True)
class DriveConfig(Config):
    """Limits of the base, and errors of its odometry."""

    max_speed_m_s: float = 0.8
    max_turn_rad_s: float = 1.8
    max_acceleration_m_s2: float = 1.0
    max_turn_acceleration_rad_s2: float = 4.0
    track_m: float = 0.36
    # Relative errors of each wheel radius and of the track, drawn once.
    scale_sigma: float = 0.002
    track_sigma: float = 0.008
    # Slip of each wheel over 1 m, a random walk.
    slip_sigma_m: float = 0.0015
    # Distance of a wheel for one encoder count.
    encoder_step_m: float = 0.00002


class DifferentialDrive:
    """Base with two driven wheels; it stops before positions that are not `free`."""

    def __init__(
        self,
        config: DriveConfig,
        pose_map_base: npt.ArrayLike,
        free: Callable[[FloatArray], bool],
        rng: np.random.Generator,
    ) -> None:
        self._config = config
        self._free = free
        self._rng = rng
        self._scale = 1.0 + config.scale_sigma * rng.standard_normal(2)
        self._track_m = config.track_m * (1.0 + config.track_sigma * rng.standard_normal())
        self._command = np.zeros(2)
        self._counted_m = np.zeros(2)
        self._rolled_m = np.zeros(2)
        self.place(pose_map_base)

    def place(self, pose_map_base: npt.ArrayLike) -> None:
        """Put the base at a pose (3,); odometry restarts from zero."""
        self.pose_map_base: FloatArray = np.array(pose_map_base, dtype=np.float64)
        self.pose_odom_base: FloatArray = np.zeros(3)
        self.twist: FloatArray = np.zeros(2)
        self.measured_twist: FloatArray = np.zeros(2)

    def command(self, linear_m_s: float, angular_rad_s: float) -> None:
        """Set the speed and turning rate to reach, clipped to the limits."""
        limit = np.array([self._config.max_speed_m_s, self._config.max_turn_rad_s])
        self._command = np.clip([linear_m_s, angular_rad_s], -limit, limit)

    def step(self, dt_s: float) -> None:
        """Advance the time."""
        config = self._config
        most = dt_s * np.array([config.max_acceleration_m_s2, config.max_turn_acceleration_rad_s2])
        self.twist = self.twist + np.clip(self._command - self.twist, -most, most)
        moved = compose(self.pose_map_base, arc(*self.twist * dt_s))
        if self.twist[0] != 0.0 and not self._free(moved[:2]):
            self.twist = np.array([0.0, self.twist[1]])
            moved = compose(self.pose_map_base, arc(*self.twist * dt_s))
        self.pose_map_base = moved
        self._measure(dt_s)

    def _measure(self, dt_s: float) -> None:
        """Update odometry by the encoder counts of the wheels."""
        config = self._config
        forward, turn = self.twist * dt_s
        rolled = forward + turn * config.track_m * np.array([-0.5, 0.5])
        slip = config.slip_sigma_m * np.sqrt(np.abs(rolled)) * self._rng.standard_normal(2)
        self._rolled_m = self._rolled_m + rolled * self._scale + slip
        counted = self._rolled_m
        if config.encoder_step_m > 0.0:
            counted = np.floor(counted / config.encoder_step_m) * config.encoder_step_m
        left, right = counted - self._counted_m
        self._counted_m = counted
        step = np.array([0.5 * (left + right), (right - left) / self._track_m])
        self.pose_odom_base = compose(self.pose_odom_base, arc(*step))
        self.measured_twist = step / dt_s


_HEIGHT_M = 1.75
_WIDTH_M = 0.62
_CLEARANCE_M = 0.35
# Smallest distance of people from the robot.
_SHY_M = 0.9


class Person:
    """A person who walks between random positions with pauses."""

    def __init__(self, scene: Scene, robot_xy: FloatArray, rng: np.random.Generator) -> None:
        self._scene = scene
        self._rng = rng
        self._albedo = _draw_figure(rng)
        self._speed_m_s = float(rng.uniform(0.6, 1.2))
        starts = [self._free_place() for _ in range(8)]
        self._position = max(starts, key=lambda place: float(np.linalg.norm(place - robot_xy)))
        self._goal = self._free_place()
        self._rest_s = 0.0

    def step(self, dt_s: float, robot_xy: FloatArray) -> None:
        """Walk on; choose another goal if furniture or the robot is in the way."""
        self._rest_s -= dt_s
        if self._rest_s > 0.0:
            return
        way = self._goal - self._position
        distance = float(np.linalg.norm(way))
        if distance < 0.1:
            self._goal, self._rest_s = self._free_place(), float(self._rng.uniform(0.0, 3.0))
            return
        ahead = self._position + way / distance * min(self._speed_m_s * dt_s, distance)
        near = np.linalg.norm(ahead - robot_xy)
        blocked = self._scene.distance_to_obstacles(ahead) < 0.5 * _CLEARANCE_M
        if blocked or (near < _SHY_M and near < np.linalg.norm(self._position - robot_xy)):
            self._goal, self._rest_s = self._free_place(), 0.3
            return
        self._position = ahead

    def solid(self, viewer_xy: FloatArray) -> Solid:
        """Flat figure that faces `viewer_xy`."""
        view = self._position - viewer_xy
        view = view / max(float(np.linalg.norm(view)), 1e-6)
        right = np.array([view[1], -view[0]])
        left_end = self._position - 0.5 * _WIDTH_M * right
        corner, across = np.array([*left_end, _HEIGHT_M]), np.append(right, 0.0)
        size = _WIDTH_M, _HEIGHT_M
        surface = Surface(corner, across, np.array([0, 0, -1.0]), *size, self._albedo, lit=False)
        return Solid(np.array([left_end + _WIDTH_M * right, left_end]), (surface,))

    def _free_place(self) -> FloatArray:
        places = self._rng.uniform(*self._scene.room.bounds, (200, 2))
        free = self._scene.room.contains(places)
        free &= self._scene.distance_to_obstacles(places) > _CLEARANCE_M
        return np.asarray(places[np.argmax(free)])


def _draw_figure(rng: np.random.Generator) -> ImageArray:
    """Standing figure with opacity, (rows, columns, 4)."""
    rows, columns = 700, 248
    image = np.zeros((rows, columns, 3), np.uint8)
    alpha = np.zeros((rows, columns), np.uint8)
    skin = tuple((np.array([120.0, 160.0, 215.0]) * rng.uniform(0.45, 1.1)).tolist())
    shirt = random_color(rng, (0.1, 0.7), (0.2, 0.9))
    trousers = random_color(rng, (0.1, 0.5), (0.1, 0.5))
    hair = tuple((np.array([20.0, 35.0, 60.0]) * rng.uniform(0.3, 3.0)).tolist())
    middle = columns // 2

    def limb(a: tuple[int, int], b: tuple[int, int], width: int, color: tuple[float, ...]) -> None:
        cv2.line(image, a, b, color, width, cv2.LINE_AA)
        cv2.line(alpha, a, b, 255, width, cv2.LINE_AA)

    for side in (-1, 1):
        limb((middle + 28 * side, 370), (middle + 36 * side, 660), 46, trousers)
        limb((middle + 36 * side, 672), (middle + 50 * side, 680), 34, (30.0, 30.0, 35.0))
        limb((middle + 62 * side, 160), (middle + 88 * side, 350), 34, shirt)
        limb((middle + 88 * side, 355), (middle + 90 * side, 375), 28, skin)
    torso = np.array([[-70, 140], [70, 140], [58, 390], [-58, 390]])
    torso[:, 0] += middle
    for layer, color in ((image, shirt), (alpha, 255)):
        cv2.fillConvexPoly(layer, torso.astype(np.int32), color, cv2.LINE_AA)
    limb((middle, 110), (middle, 140), 36, skin)
    for layer, color in ((image, hair), (alpha, 255)):
        cv2.ellipse(layer, (middle, 62), (42, 56), 0, 0, 360, color, -1, cv2.LINE_AA)
    cv2.ellipse(image, (middle, 76), (36, 44), 0, 0, 360, skin, -1, cv2.LINE_AA)
    folds = 1.0 + 0.12 * fractal_noise(rng, (rows, columns), (90, 60), 4)
    shaded = to_uint8(image.astype(np.float32) * folds[..., None])
    return np.dstack([shaded, alpha])


# Rate of the physics, independent of the steps of `advance`.
_RATE_HZ = 60
_SECOND_NS = 1_000_000_000
DEFAULT_CAMERA = CameraModel(
    512, 512, 555.0, 555.0, 256.7, 254.1, 'plumb_bob', (-0.19, 0.06, 0.0005, -0.0003, 0.0)
)
DEFAULT_MOUNT = PanTiltMount((0.08, 0.0, 1.1))


# The base keeps this far from walls and furniture.
_ROBOT_RADIUS_M = 0.22


class RobotWorld:
    """
    A simulated robot with a turning camera, which may be tilted against its joint.

    `seed` is that of the noise of wheels and sensor, and of what people do. A renderer of another
    world with the same scene and camera lends its textures.
    """

    def __init__(
        self,
        scene: Scene,
        pose_map_base: npt.ArrayLike,
        seed: int,
        *,
        camera: CameraModel = DEFAULT_CAMERA,
        mount: PanTiltMount = DEFAULT_MOUNT,
        camera_tilt_rad: float = 0.0,
        people: int = 0,
        start_ns: int = 0,
        renderer: Renderer | None = None,
    ) -> None:
        """Build the room; takes seconds for its textures."""
        wheels, noise, walking = np.random.default_rng([seed, 20]).spawn(3)
        self.scene = scene
        self.camera = camera
        self.mount = mount
        self._camera_tilt_rad = camera_tilt_rad
        self._start_ns = start_ns
        self._steps = 0
        self._owed_s = 0.0
        self.unit = PanTiltUnit(PanTiltConfig())
        self._drive = DifferentialDrive(DriveConfig(), pose_map_base, self._free, wheels)
        people_rngs = walking.spawn(people)
        self._people = [Person(scene, self.true_pose[:2], each) for each in people_rngs]
        self.renderer = renderer or Renderer(scene, camera)
        self._effects = CameraEffects(camera, CameraEffectsConfig(), noise)

    @property
    def stamp_ns(self) -> int:
        """Time of the current state."""
        return self._start_ns + self._steps * _SECOND_NS // _RATE_HZ

    @property
    def true_pose(self) -> FloatArray:
        """Pose of the base in map, (3,)."""
        return np.array(self._drive.pose_map_base)

    def set_clock(self, stamp_ns: int) -> None:
        """Set the time of the current state."""
        self._start_ns += stamp_ns - self.stamp_ns

    def advance(self, dt_s: float) -> None:
        """Advance the time in whole steps of 1/60 s; the remainder is added to the next call."""
        self._owed_s += dt_s
        dt = 1.0 / _RATE_HZ
        # A tolerance of 1 ns for rounding errors of sums.
        while self._owed_s >= dt - 1e-9:
            self._owed_s -= dt
            self._steps += 1
            self._drive.step(dt)
            self.unit.step(dt)
            for person in self._people:
                person.step(dt, self._drive.pose_map_base[:2])

    def command_pan(self, pan_rad: float, tilt_rad: float = 0.0) -> None:
        """Turn the camera to pan and tilt."""
        self.unit.command(pan_rad, tilt_rad)

    def command_velocity(self, linear_m_s: float, angular_rad_s: float) -> None:
        """Set the velocity until the next command."""
        self._drive.command(linear_m_s, angular_rad_s)

    def place(
        self, pose_map_base: npt.ArrayLike, pan_rad: float = 0.0, tilt_rad: float = 0.0
    ) -> None:
        """Put the robot at a pose (3,) with the camera at rest; odometry restarts from zero."""
        self._drive.place(pose_map_base)
        self.unit.jump(pan_rad, tilt_rad)

    def frame_at(self, pose_map_base: npt.ArrayLike, pan_rad: float) -> CameraFrame:
        """Put the robot at a pose (3,) and capture an image there."""
        self.place(pose_map_base, pan_rad)
        self.advance(1.0 / _RATE_HZ)
        return self.camera_frame()

    def joint_sample(self) -> JointSample:
        """Pan and tilt measured by the encoders now."""
        pan, tilt = self.unit.measured_rad
        return JointSample(self.stamp_ns, float(pan), float(tilt))

    def odometry_sample(self) -> OdometrySample:
        """Odometry now."""
        drive = self._drive
        pose, twist = drive.pose_odom_base.copy(), drive.measured_twist.tolist()
        return OdometrySample(self.stamp_ns, pose, *twist)

    def truth_sample(self) -> OdometrySample:
        """True pose in map, and speeds, for ``ground_truth/odom``."""
        return OdometrySample(self.stamp_ns, self.true_pose, *self._drive.twist.tolist())

    def camera_frame(self) -> CameraFrame:
        """Capture an image now."""
        pan, tilt = self.unit.angles_rad
        view_rad = float(tilt) + self._camera_tilt_rad
        turn, center = self.mount.camera_pose_map(self.true_pose, float(pan), view_rad)
        people = [person.solid(center[:2]) for person in self._people]
        image = self.renderer.render(turn, center, people)
        sample, image = self.joint_sample(), self._effects.apply(image)
        stamp_ns = sample.stamp_ns + round(1e9 * self.mount.image_delay_s)
        return CameraFrame(stamp_ns, image, self.camera, sample.pan_rad, sample.tilt_rad)

    def _free(self, position_xy: FloatArray) -> bool:
        """Whether a position is in the room, with enough distance from walls and furniture."""
        far = self.scene.distance_to_obstacles(position_xy) >= _ROBOT_RADIUS_M
        return bool(self.scene.room.contains(position_xy) and far)


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
    world: RobotWorld, factory: MessageFactory, *, frames: int = 72
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
        yield from _image_messages(frame, factory, 'sweep', 'sweep/image/compressed')
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
    seconds: float,
    speed_m_s: float = 0.35,
    camera_rate_hz: float = 5.0,
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
            yield from _image_messages(frame, factory, 'camera', 'camera/image_raw/compressed')
        yield _joints(world, factory)
        odometry = encode.odometry(factory, world.odometry_sample(), _ODOMETRY_COVARIANCE)
        yield Recorded('odom', odometry, world.stamp_ns)
        yield _truth(world, factory)
        world.advance(1.0 / STATE_RATE_HZ)


def _image_messages(
    frame: CameraFrame, factory: MessageFactory, camera: str, topic: str
) -> Sequence[Recorded]:
    stamp = frame.stamp_ns
    image = encode.compressed_image(factory, frame.image, stamp, _FRAME)
    info = encode.camera_info(factory, frame.camera, stamp, _FRAME)
    return [Recorded(topic, image, stamp), Recorded(f'{camera}/camera_info', info, stamp)]


def _joints(world: RobotWorld, factory: MessageFactory) -> Recorded:
    sample = world.joint_sample()
    message = encode.joint_state(factory, sample, world.mount)
    return Recorded('joint_states', message, sample.stamp_ns)


def _truth(world: RobotWorld, factory: MessageFactory) -> Recorded:
    message = encode.odometry(factory, world.truth_sample(), _EXACT, frame_id='map')
    return Recorded('ground_truth/odom', message, world.stamp_ns)
