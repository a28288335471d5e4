"""Where a driving robot looks: at what hangs on the walls, one thing after the other."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.se2 import transform_points
from landmark_nav.simulation.places import item_points, view_quality
from landmark_nav.simulation.scene import Scene
from landmark_nav.types import FloatArray

# The camera stays this far inside its limits, so that it can follow while the base turns.
_RESERVE_RAD = 0.4

_STEEPEST_DEG = 58.0

# What is nearer fills the image: not much else is seen, and nothing as it was learned.
_NEAR_M = 1.9

# Seen worse than that, a thing is given up for a better one.
_LOST_QUALITY = 0.2

# What lies within this angle of a thing is seen together with it.
_TOGETHER_RAD = 0.35

# The next thing to look at is rather at least this far aside.
_ELSEWHERE_RAD = 0.6


class PanControl:
    """
    Holds the camera on one thing for a while, then chooses another.

    Parameters
    ----------
    scene : Scene
        What there is to see.
    pan_limit_rad : float
        How far it turns to both sides.
    rng : numpy.random.Generator
        Which thing is next, and for how long.
    preferred : ndarray of bool, shape (n,), optional
        Which of the scene's items it looks at if any of them is in sight: those it knows.
    """

    def __init__(
        self,
        scene: Scene,
        mount: PanTiltMount,
        pan_limit_rad: float,
        rng: np.random.Generator,
        preferred: npt.NDArray[np.bool_] | None = None,
    ) -> None:
        """Look ahead until the pose of the robot is given."""
        self._scene = scene
        self._mount = mount
        self._limit_rad = pan_limit_rad
        self._rng = rng
        self._points, self._walls = item_points(scene)
        known = np.ones(len(self._points), np.bool_) if preferred is None else preferred
        self._liking = np.where(known, 1.0, 0.1)
        self._chosen = -1
        self._until_s = 0.0

    def pan(self, time_s: float, pose_map_base: FloatArray) -> float:
        """Pan that looks at the thing of the moment from a pose (3,); 0 if there is none."""
        axis = transform_points(pose_map_base, self._mount.axis_xyz[:2])
        offset = self._points[:, :2] - axis
        azimuth = np.arctan2(offset[:, 1], offset[:, 0]) - pose_map_base[2]
        pan = self._mount.pan_toward_rad(azimuth)
        usable = np.abs(pan) < self._limit_rad - _RESERVE_RAD
        quality = np.where(usable, self._quality(axis), 0.0)
        if self._chosen < 0 or self._lost(quality) or time_s >= self._until_s:
            self._choose(time_s, pan, quality)
        return float(pan[self._chosen]) if self._chosen >= 0 else 0.0

    def _lost(self, quality: FloatArray) -> bool:
        """Whether what it looks at is hidden, or badly seen while something else is not."""
        now = float(quality[self._chosen])
        return now == 0.0 or now < _LOST_QUALITY <= float(quality.max())

    def _quality(self, axis_xy: FloatArray) -> FloatArray:
        seen = view_quality(self._scene, axis_xy, self._points, self._walls, _STEEPEST_DEG)[0]
        near = np.linalg.norm(self._points[:, :2] - axis_xy, axis=1) < _NEAR_M
        return np.asarray(np.where(near, 0.1 * seen, seen))

    def _choose(self, time_s: float, pan: npt.NDArray[np.float64], quality: FloatArray) -> None:
        """Rather a thing with others around it that are seen well too."""
        together = np.abs(wrap_rad(pan[:, None] - pan)) < _TOGETHER_RAD
        weight = np.where(quality > 0.0, together @ (quality * self._liking), 0.0) ** 2
        if self._chosen >= 0:
            # Look elsewhere, if there is anything.
            weight = weight * np.where(
                np.abs(wrap_rad(pan - pan[self._chosen])) < _ELSEWHERE_RAD, 0.02, 1.0
            )
            weight[self._chosen] = 0.0
        self._until_s = time_s + float(self._rng.uniform(1.8, 3.2))
        if weight.sum() <= 0.0:
            return
        self._chosen = int(self._rng.choice(len(weight), p=weight / weight.sum()))
