"""People who walk through the room: flat figures that face the camera."""

from __future__ import annotations

import cv2
import numpy as np

from landmark_nav.simulation.scene import Scene
from landmark_nav.simulation.solids import Solid
from landmark_nav.simulation.surfaces import Surface
from landmark_nav.simulation.textures import fractal_noise, random_color, to_uint8
from landmark_nav.types import FloatArray, ImageArray

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
