"""What `landmark-nav figures` draws where no bag is given: sweeps in a simulated room."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.figures.area_figure import AreaTest
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.se2 import bearings
from landmark_nav.geometry.walls import Room
from landmark_nav.localization.detection import (
    detect_landmarks,
    DetectionConfig,
)
from landmark_nav.simulation.furnishing import another_day, generate_scene
from landmark_nav.simulation.places import choose_sweep_places
from landmark_nav.simulation.renderer import Renderer
from landmark_nav.simulation.scene import Scene
from landmark_nav.simulation.world import DEFAULT_CAMERA, RobotWorld
from landmark_nav.types import (
    CameraFrame,
    FloatArray,
    Landmark,
    LandmarkMap,
    PoseEstimate,
    Sweep,
)

_FRAMES = 72
_GRID_M = 0.45
_CLEARANCE_M = 0.25
_RIGHT_PX = 1.0
# Of what a robot knows of its pose while it looks.
_PRIOR = np.diag([0.03, 0.03, np.radians(0.5)]) ** 2
# Narrow images, which hold a patch and its surroundings, are drawn sooner.
_NARROW_PX = 160


@dataclass(frozen=True, eq=False)
class FiguresWorld:
    """
    A furnished room and where sweeps are taken in it.

    Parameters
    ----------
    poses : ndarray, shape (2, 3)
        Of the base at the two sweeps.
    """

    scene: Scene
    mount: PanTiltMount
    poses: FloatArray

    @classmethod
    def furnish(cls, seed: int, mount: PanTiltMount, room: Room | None = None) -> FiguresWorld:
        """
        Furnish a room, `room` if it is given.

        Raises `LandmarkNavError`: no two places there see all papers.
        """
        scene = generate_scene(seed, room)
        places = choose_sweep_places(scene)
        if places is None:
            raise LandmarkNavError('the room has no two places that see all papers')
        return cls(scene, mount, places.poses)

    def sweep(self, number: int) -> Sweep:
        """Turn the camera once around at a place."""
        world = RobotWorld(self.scene, self.poses[number], self.scene.seed, mount=self.mount)
        frames = []
        for pan in -np.pi + 2.0 * np.pi * np.arange(_FRAMES) / _FRAMES:
            frames.append(world.frame_at(self.poses[number], float(pan)))
        return Sweep(frames[0].stamp_ns, tuple(frames))

    def look_for(self, landmark: Landmark, seed: int) -> AreaTest:
        """Look for a landmark from all over the floor on another day."""
        rng = np.random.default_rng([seed, 70])
        later = another_day(self.scene, rng)
        camera = replace(
            DEFAULT_CAMERA, width=_NARROW_PX, cx=DEFAULT_CAMERA.cx - (512 - _NARROW_PX) / 2
        )
        renderer = Renderer(later, camera)
        xy = _floor(later)
        xy = xy[later.sees(xy, landmark.position[:2], self.mount.axis_xyz[2])]
        found = [self._found(place, landmark, renderer, camera, rng) for place in xy]
        return AreaTest(landmark.id, xy, np.array(found))

    def _found(
        self,
        place: FloatArray,
        landmark: Landmark,
        renderer: Renderer,
        camera: CameraModel,
        rng: np.random.Generator,
    ) -> bool:
        """Whether it is found within a pixel of the truth when the camera looks its way."""
        pose = np.append(place, rng.uniform(-np.pi, np.pi))
        pan = float(bearings(pose, landmark.position[:2]))
        rotation, center = self.mount.camera_pose_map(pose, pan)
        noise = rng.normal(0.0, 2.0, (camera.height, camera.width, 1))
        image = np.clip(renderer.render(rotation, center) + noise, 0, 255).astype(np.uint8)
        result = detect_landmarks(
            CameraFrame(0, image, camera, pan),
            PoseEstimate(0, pose, _PRIOR),
            LandmarkMap((landmark,)),
            self.mount,
            DetectionConfig(),
            np.array([0]),
        )
        if not len(result.detections):
            return False
        expected = camera.project((landmark.position - center) @ rotation)
        return bool(np.abs(result.detections.uv_px[0, 0] - expected[0]) < _RIGHT_PX)


def _floor(scene: Scene) -> FloatArray:
    """Grid of free places (n, 2)."""
    low, high = scene.room.bounds[0] + _CLEARANCE_M, scene.room.bounds[1] - _CLEARANCE_M
    x, y = (np.arange(a, b, _GRID_M) for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    grid = grid[scene.room.contains(grid)]
    return np.asarray(grid[scene.distance_to_obstacles(grid) > _CLEARANCE_M])
