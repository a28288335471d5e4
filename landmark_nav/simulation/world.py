"""The simulated robot among people: commands, sensors and time steps."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.simulation.differential_drive import DifferentialDrive, DriveConfig
from landmark_nav.simulation.pan_tilt_unit import PanTiltConfig, PanTiltUnit
from landmark_nav.simulation.renderer import CameraEffects, CameraEffectsConfig, Renderer
from landmark_nav.simulation.scene import Scene
from landmark_nav.simulation.solids import Solid
from landmark_nav.simulation.surfaces import Surface
from landmark_nav.simulation.textures import fractal_noise, random_color, to_uint8
from landmark_nav.types import CameraFrame, FloatArray, ImageArray, JointSample, OdometrySample

_HEIGHT_M = 1.75
_WIDTH_M = 0.62
_CLEARANCE_M = 0.35

# Smallest distance of people from the robot.
_SHY_M = 0.9


class Person:
    """A person who walks between random positions with pauses."""

    def __init__(self, scene: Scene, robot_xy: FloatArray, rng: np.random.Generator) -> None:
        """Draw the figure and choose a start far from the robot."""
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
        surface = Surface(
            np.array([*left_end, _HEIGHT_M]),
            np.append(right, 0.0),
            np.array([0.0, 0.0, -1.0]),
            _WIDTH_M,
            _HEIGHT_M,
            self._albedo,
            lit=False,
        )
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
    A simulated robot with a turning camera.

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
        people: int = 0,
        start_ns: int = 0,
        renderer: Renderer | None = None,
    ) -> None:
        """Build the room; takes seconds for its textures."""
        wheels, noise, walking = np.random.default_rng([seed, 20]).spawn(3)
        self.scene = scene
        self.camera = camera
        self.mount = mount
        self._start_ns = start_ns
        self._steps = 0
        self._owed_s = 0.0
        self.unit = PanTiltUnit(PanTiltConfig())
        self._drive = DifferentialDrive(DriveConfig(), pose_map_base, self._free, wheels)
        self._people = [
            Person(scene, self.true_pose[:2], child) for child in walking.spawn(people)
        ]
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
        linear, angular = (float(value) for value in drive.measured_twist)
        return OdometrySample(self.stamp_ns, drive.pose_odom_base.copy(), linear, angular)

    def truth_sample(self) -> OdometrySample:
        """True pose in map, and speeds, for ``ground_truth/odom``."""
        linear, angular = (float(value) for value in self._drive.twist)
        return OdometrySample(self.stamp_ns, self.true_pose, linear, angular)

    def camera_frame(self) -> CameraFrame:
        """Capture an image now."""
        pan, tilt = self.unit.angles_rad
        turn, center = self.mount.camera_pose_map(self.true_pose, float(pan), float(tilt))
        people = [person.solid(center[:2]) for person in self._people]
        image = self.renderer.render(turn, center, people)
        sample = self.joint_sample()
        return CameraFrame(
            sample.stamp_ns,
            self._effects.apply(image),
            self.camera,
            sample.pan_rad,
            sample.tilt_rad,
        )

    def _free(self, position_xy: FloatArray) -> bool:
        """Whether a position is in the room, with enough distance from walls and furniture."""
        inside = bool(self.scene.room.contains(position_xy))
        clearance = float(self.scene.distance_to_obstacles(position_xy))
        return inside and clearance >= _ROBOT_RADIUS_M
