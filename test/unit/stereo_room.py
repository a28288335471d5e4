"""A room with textured walls, seen from two places."""

from __future__ import annotations

import numpy as np
from scenes import draw_panorama, rectangle_room, Scene
from wall_views import candidate_at, greys_of

from landmark_nav.learning.stereo import hypothesize, match_in, StereoConfig
from landmark_nav.learning.stereo.wall_patch import PatchMeasurement, WallPatch
from landmark_nav.types import FloatArray, Panorama, Refusal

ROOM = rectangle_room(6.0, 5.0)
CONFIG = StereoConfig()
CENTERS = (np.array([2.2, 2.0, 1.1]), np.array([3.6, 2.9, 1.1]))
HEADINGS = (0.4, -2.0)
EAST = 1


def views_of(scene: Scene, seed: int | None = 0) -> list[Panorama]:
    rng = None if seed is None else np.random.default_rng(seed)
    return [
        draw_panorama(scene, center, heading, rng=rng)
        for center, heading in zip(CENTERS, HEADINGS, strict=True)
    ]


def patch_at(panorama: Panorama, point: FloatArray) -> WallPatch | Refusal:
    return hypothesize(candidate_at(panorama, point, 32), 0, panorama, ROOM, CONFIG)


def match_at(
    panoramas: list[Panorama], point: FloatArray, config: StereoConfig = CONFIG
) -> tuple[WallPatch, PatchMeasurement | Refusal]:
    patch = patch_at(panoramas[0], point)
    assert isinstance(patch, WallPatch)
    return patch, match_in(patch, 1, panoramas, greys_of(panoramas), ROOM, config)


def direction_to(panorama: Panorama, point: FloatArray) -> FloatArray:
    """Azimuth in the base frame, and tangent, of a point."""
    d = point - panorama.center_map
    return np.array([np.arctan2(d[1], d[0]) - panorama.heading_rad, d[2] / np.hypot(d[0], d[1])])
