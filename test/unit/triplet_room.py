"""A room of 6.6 m x 4.4 m with landmarks on all its walls, to choose triplets in."""

from __future__ import annotations

from typing import Any

from bare_landmarks import bare_landmark
import numpy as np

from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.walls import Wall
from landmark_nav.localization.triplet import rank_triplets, TripletConfig
from landmark_nav.types import Landmark, LandmarkMap, PoseEstimate, Refusal, Triplet

WIDTH, DEPTH = 6.6, 4.4
CAMERA = CameraModel(512, 512, 573.0, 573.0, 255.5, 255.5, 'plumb_bob', (-0.1, 0.02))
MOUNT = PanTiltMount(axis_xyz=(0.08, 0.0, 1.1))
CONFIG = TripletConfig()
PRIOR = PoseEstimate(42, np.array([3.0, 2.0, 0.3]), np.diag([0.01, 0.01, 0.005]) ** 2)
ROOM = tuple(
    Wall(name, start, end, 2.6)
    for name, start, end in (
        ('south', (0.0, 0.0), (WIDTH, 0.0)),
        ('east', (WIDTH, 0.0), (WIDTH, DEPTH)),
        ('north', (WIDTH, DEPTH), (0.0, DEPTH)),
        ('west', (0.0, DEPTH), (0.0, 0.0)),
    )
)


def select_triplet(*given: Any, **options: Any) -> Triplet | Refusal:
    return rank_triplets(*given, **options).chosen


def landmark(k: int, xy: tuple[float, float], normal: tuple[float, float], z: float) -> Landmark:
    return bare_landmark(
        100 + k,
        np.array([*xy, z]),
        np.diag([0.006, 0.006, 0.01]) ** 2,
        shared_loading=np.vstack([0.004 * np.eye(2), np.zeros((1, 2))]),
        normal=np.array([*normal, 0.0]),
        width_m=0.25,
        viewpoint=np.array([WIDTH / 2.0, DEPTH / 2.0, 1.1]),
    )


def random_map(n: int, seed: int = 0) -> LandmarkMap:
    """Landmarks all around a room of 6.6 m x 4.4 m."""
    rng = np.random.default_rng(seed)
    made = []
    for k in range(n):
        wall = ROOM[rng.integers(4)]
        share = rng.uniform(0.05, 0.95)
        xy = (1.0 - share) * np.array(wall.start) + share * np.array(wall.end)
        normal = (float(wall.normal[0]), float(wall.normal[1]))
        made.append(landmark(k, (float(xy[0]), float(xy[1])), normal, rng.uniform(0.8, 1.5)))
    return LandmarkMap(tuple(made), walls=ROOM)


def chosen(found: Triplet | Refusal) -> Triplet:
    assert isinstance(found, Triplet), str(found)
    return found
