"""What `landmark-nav bench` works on: a simulated room, what is learned there, and an image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.learning.pipeline import learn_from_panoramas, LearningConfig, LearningResult
from landmark_nav.learning.sweep_pipeline import panorama_from_sweep, PanoramaStages
from landmark_nav.localization.triplet import TripletConfig, visible_landmarks
from landmark_nav.simulation.furnishing import generate_scene
from landmark_nav.simulation.places import choose_sweep_places
from landmark_nav.simulation.renderer import Renderer
from landmark_nav.types import (
    CameraFrame,
    FloatArray,
    Panorama,
    PoseEstimate,
    Sweep,
)

CAMERA = CameraModel(
    512, 512, 573.0, 573.0, 255.5, 255.5, 'plumb_bob', (-0.12, 0.03, 0.0005, -0.0003, 0.0)
)
MOUNT = PanTiltMount(axis_xyz=(0.08, 0.0, 1.1))
STEP_RAD = np.radians(5.0)


@dataclass(frozen=True)
class Comparison:
    """
    A stage and its reference; both do `count` pieces of work in a call.

    A stage that does not take the same time in each call is called `calls` times, each timed.
    """

    stage: str
    ours: Callable[[], object]
    reference_name: str
    reference: Callable[[], object]
    count: int = 1
    calls: int = 1


class World:
    """A simulated room, its two sweeps, what is learned there, and one image of a drive."""

    def __init__(self, seed: int) -> None:
        self.scene = generate_scene(seed)
        self.renderer = Renderer(self.scene, CAMERA)
        places = choose_sweep_places(self.scene)
        if places is None:
            raise LandmarkNavError(f'the room of seed {seed} has no two places: take another')
        self.poses = places.poses

    def frame(self, pose: FloatArray, pan_rad: float) -> CameraFrame:
        """Take an image."""
        rotation, center = MOUNT.camera_pose_map(pose, pan_rad)
        return CameraFrame(0, self.renderer.render(rotation, center), CAMERA, pan_rad)

    @cached_property
    def sweeps(self) -> tuple[Sweep, ...]:
        """One turn at each place, whose pose is known."""
        pans = STEP_RAD * np.arange(72)
        return tuple(
            Sweep(0, tuple(self.frame(pose, pan) for pan in pans), _estimate(pose, 1e-3))
            for pose in self.poses
        )

    @cached_property
    def panoramas(self) -> tuple[Panorama, ...]:
        """Of the sweeps."""
        room = self.scene.room
        return tuple(panorama_from_sweep(s, room, MOUNT, PanoramaStages()) for s in self.sweeps)

    @cached_property
    def greys(self) -> list[npt.NDArray[np.float32]]:
        """The panoramas in grey."""
        images = [cv2.cvtColor(p.image, cv2.COLOR_BGR2GRAY) for p in self.panoramas]
        return [image.astype(np.float32) for image in images]

    @cached_property
    def learned(self) -> LearningResult:
        """Map."""
        return learn_from_panoramas(self.panoramas, self.scene.room, LearningConfig())

    @cached_property
    def prior(self) -> PoseEstimate:
        """Expected pose between the two places."""
        middle = np.array([*self.poses[:, :2].mean(axis=0), 0.3])
        return _estimate(middle, 0.03)

    @cached_property
    def view(self) -> CameraFrame:
        """The image, from there, that shows most landmarks."""
        pans = 4.0 * STEP_RAD * np.arange(18)
        best = max(pans, key=lambda pan: len(self.expected(float(pan))))
        return self.frame(self.prior.pose, float(best))

    def expected(self, pan_rad: float) -> npt.NDArray[np.int_]:
        """Indices of the landmarks in view."""
        return visible_landmarks(
            self.prior, self.learned.map, CAMERA, MOUNT, pan_rad, 0.0, TripletConfig()
        )

    @cached_property
    def bearings(self) -> FloatArray:
        """True bearings of all landmarks at the pan axis."""
        axis = MOUNT.axis_pose_map(self.prior.pose)
        return se2.bearings(axis, self.learned.map.positions[:, :2])


def _estimate(pose: FloatArray, sigma_m: float) -> PoseEstimate:
    return PoseEstimate(0, pose, np.diag([sigma_m**2, sigma_m**2, (0.5 * sigma_m) ** 2]))
