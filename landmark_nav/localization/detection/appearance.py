"""
How a landmark should look from where the robot is: its patch, or a virtual view.

A virtual view is drawn pixel by pixel out of the panoramas that saw the landmark: a pixel's ray
meets the landmark's plane, and the panoramas show what is there (plenoptic rendering, McMillan
and Bishop, SIGGRAPH 1995, where the plane tells the depth). Those that saw it from nearly the
same side and from as near count most, after Buehler et al., SIGGRAPH 2001.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from landmark_nav.geometry.patches import PatchView
from landmark_nav.types import FloatArray, ImageArray, Landmark

__all__ = ['APPEARANCES', 'Texture', 'textures']

APPEARANCES = ('patch', 'virtual_view')

# A view from so far aside, or from so many times as far, counts exp(-1/2) of one from here.
_ASIDE_RAD = 0.5
_FARTHER = math.log(2.0)
# Less is not worth its time.
_LEAST_SHARE = 0.1
_LEAST_COSINE = 0.2


class Texture(NamedTuple):
    """
    A picture of the landmark, and its share in how it should look.

    `own_step` are the texels, across and down, that a pixel of its panorama covered.
    """

    image: ImageArray
    share: float = 1.0
    own_step: tuple[float, float] = (1.0, 1.0)


def textures(landmark: Landmark, viewer: FloatArray, appearance: str) -> list[Texture]:
    """
    Pictures to blend, with shares that sum to one.

    Parameters
    ----------
    landmark : Landmark
        One without `views` looks as its patch does.
    viewer : ndarray, shape (3,)
        Where the camera is, in map.
    appearance : str
        One of `APPEARANCES`.

    """
    if appearance == 'patch':
        return [Texture(landmark.patch)]
    views = (PatchView(landmark.viewpoint, landmark.patch), *landmark.views)
    angle, reach, _ = _seen_from(landmark, viewer)
    places = [_seen_from(landmark, view.viewpoint) for view in views]
    misfit = [
        ((a - angle) / _ASIDE_RAD) ** 2 + (max(math.log(r / reach), 0.0) / _FARTHER) ** 2
        for a, r, _ in places
    ]
    best = min(misfit)
    weight = [math.exp(0.5 * (best - m)) for m in misfit]
    least = _LEAST_SHARE * sum(weight)
    total = sum(w for w in weight if w >= least)
    return [
        Texture(view.patch, w / total, (1.0 / cosine, 1.0))
        for view, w, (_, _, cosine) in zip(views, weight, places, strict=True)
        if w >= least
    ]


def _seen_from(landmark: Landmark, viewpoint: FloatArray) -> tuple[float, float, float]:
    """Angle from the normal, distance and cosine of the angle, in plan."""
    x, y = (viewpoint[:2] - landmark.position[:2]).tolist()
    nx, ny = landmark.normal[:2].tolist()
    ahead, aside = x * nx + y * ny, y * nx - x * ny
    reach = max(math.hypot(ahead, aside), 1e-6)
    return math.atan2(aside, ahead), reach, max(ahead / reach, _LEAST_COSINE)
