"""The simulated robot in its room: commands, sensors and time steps."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.simulation.differential_drive import DifferentialDrive, DriveConfig
from landmark_nav.simulation.pan_tilt_unit import PanTiltConfig, PanTiltUnit
from landmark_nav.simulation.people import Person
from landmark_nav.simulation.renderer import CameraEffects, CameraEffectsConfig, Renderer
from landmark_nav.simulation.scene import Scene
from landmark_nav.types import CameraFrame, FloatArray, JointSample, OdometrySample

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
