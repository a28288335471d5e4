"""
Stereo without walls: what does not hang on them is recognized by its own depth.

A patch that is not found on its wall is moved along its ray, from a little behind the wall towards
the camera, so that it looks the same, and searched from each depth to the next: together that is
the epipolar curve.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from landmark_nav.arrays import Float32Array
from landmark_nav.learning.stereo.config import StereoConfig
from landmark_nav.learning.stereo.wall_patch import own_measurement, PatchMeasurement, WallPatch
from landmark_nav.learning.stereo.wall_stereo import compare
from landmark_nav.types import FloatArray, Panorama, Refusal

__all__ = ['FreeMatch', 'explain', 'match_freely']

# From each depth to the next; half of that way is searched before it, half behind.
_STEP = 0.72
_NEAREST_M = 0.5
# Nothing is to be expected behind a wall, but the wall itself if it is given too near.
_FARTHEST = 1.0 / _STEP
_WIDEST_M = 2.0
# What is no farther off its wall than this may as well hang on it.
_OFF_WALL_M = 0.1
# So much is searched that chance finds something; it must be more alike than on the wall.
_MIN_SCORE = 0.88
_MARGIN = 0.03


@dataclass(frozen=True)
class FreeMatch:
    """A patch where it stands, in plan and off its wall, and where two panoramas show it."""

    patch: WallPatch
    measurements: list[PatchMeasurement]
    distance_m: float
    before_wall_m: float

    @property
    def refusal(self) -> Refusal:
        """Why it is no landmark."""
        side = 'before' if self.before_wall_m > 0.0 else 'behind'
        return Refusal(
            'not on a wall',
            f'{self.distance_m:.2f} m away, {abs(self.before_wall_m) * 100:.0f} cm {side} it',
        )


def match_freely(
    patch: WallPatch,
    other: int,
    panoramas: Sequence[Panorama],
    greys: Sequence[Float32Array],
    config: StereoConfig,
) -> FreeMatch | None:
    """
    Find a patch of one panorama in another, number `other`, at any depth.

    Returns
    -------
    FreeMatch or None
        The best one; None where there is none, where the wall is as good, and where too little
        parallax gives its depth.

    """
    here, there = panoramas[patch.source], panoramas[other]
    best: PatchMeasurement | None = None
    for moved in _moved(patch, here, there):
        step = 0.5 * (1.0 / _STEP - 1.0) * _normal_reach(moved, here)
        if _normal_reach(moved, there) < 2.0 * step:
            continue
        near = replace(
            config,
            min_score=max(config.min_score, _MIN_SCORE),
            before_wall_m=min(step, _WIDEST_M),
            behind_wall_m=min(1.3 * step, _WIDEST_M),
            # It is seldom parallel to what it is taken for.
            max_displaced_px=100.0,
        )
        found = compare(moved, other, panoramas, greys, near)
        if isinstance(found, PatchMeasurement) and (best is None or found.score > best.score):
            best = found
    if best is None:
        return None
    # The sine rule in plan (McMillan and Bishop, 1995).
    wall = patch.position[:2] - here.center_map[:2]
    base = there.center_map[:2] - here.center_map[:2]
    toward = float(np.arctan2(base[1], base[0]))
    azimuth = float(np.arctan2(wall[1], wall[0]))
    seen = best.azimuth_rad + there.heading_rad
    parallax = np.sin(seen - azimuth)
    if abs(parallax) < np.sin(0.5 * config.min_parallax_rad):
        return None
    distance = float(np.hypot(*base) * np.sin(seen - toward) / parallax)
    on_wall = compare(patch, other, panoramas, greys, replace(config, min_score=0.0))
    if isinstance(on_wall, PatchMeasurement) and on_wall.score > best.score - _MARGIN:
        return None
    reach = float(np.hypot(*wall))
    before = (1.0 - distance / reach) * _normal_reach(patch, here)
    off_wall = here.center_map + distance / reach * (patch.position - here.center_map)
    return FreeMatch(
        replace(patch, position=off_wall), [own_measurement(patch, here), best], distance, before
    )


def explain(
    patch: WallPatch,
    panoramas: Sequence[Panorama],
    greys: Sequence[Float32Array],
    config: StereoConfig,
) -> FreeMatch | None:
    """Say where off its wall a patch stands, if another panorama shows that."""
    matches = [
        match_freely(patch, other, panoramas, greys, config)
        for other in range(len(panoramas))
        if other != patch.source
    ]
    best = max(
        (m for m in matches if m is not None), key=lambda m: m.measurements[-1].score, default=None
    )
    if best is None or abs(best.before_wall_m) < _OFF_WALL_M or best.distance_m < 0.0:
        return None
    return best


def _moved(patch: WallPatch, here: Panorama, there: Panorama) -> Iterator[WallPatch]:
    """The patch at all depths, parallel to its wall and facing both cameras."""
    ray = patch.position - here.center_map
    reach = float(np.hypot(ray[0], ray[1]))
    share = _FARTHEST
    while share * reach > _NEAREST_M:
        position = here.center_map + share * ray
        between = 0.5 * (here.center_map + there.center_map) - position
        facing = np.append(between[:2] / max(float(np.hypot(*between[:2])), 1e-9), 0.0)
        for normal in (patch.normal, facing):
            cosine = float(-ray[:2] @ normal[:2]) / reach
            across = there.center_map - position
            if min(cosine, float(across[:2] @ normal[:2]) / float(np.hypot(*across[:2]))) < 0.3:
                continue
            columns = max(8, round(patch.candidate.width_px / cosine))
            yield replace(
                patch,
                position=position,
                normal=normal,
                shape=(patch.shape[0], columns),
                texel_m=patch.texel_m * share,
            )
        share *= _STEP


def _normal_reach(patch: WallPatch, panorama: Panorama) -> float:
    """How far before the plane of a patch a panorama was taken."""
    reach: FloatArray = (panorama.center_map - patch.position) @ patch.normal
    return float(reach)
