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

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array
from landmark_nav.geometry.patches import PatchView
from landmark_nav.matching import blur_to
from landmark_nav.types import FloatArray, ImageArray, Landmark

__all__ = ['APPEARANCES', 'Texture', 'draw', 'textures']

APPEARANCES = ('patch', 'virtual_view')

# A view from so far aside, or from so many times as far, counts exp(-1/2) of one from here.
_ASIDE_RAD = 0.5
_FARTHER = math.log(2.0)
# Less is not worth its time.
_LEAST_SHARE = 0.1


class Texture(NamedTuple):
    """A picture of the landmark in wall coordinates, and its share in how it should look."""

    image: ImageArray
    share: float


def draw(
    landmark: Landmark,
    viewer: FloatArray,
    rays: Float32Array,
    ray_to_patch: FloatArray,
    appearance: str,
) -> tuple[Float32Array, tuple[float, float]]:
    """
    Draw a landmark as it should look in a rectangle of the picture.

    Parameters
    ----------
    landmark : Landmark
        What to draw.
    viewer : ndarray, shape (3,)
        Where the camera is, in map.
    rays : ndarray, shape (height, width, 2)
        Of the pixels, x/z and y/z in the optical frame.
    ray_to_patch : ndarray, shape (3, 3)
        Rays (x, y, 1) to metres on the patch.
    appearance : str
        One of `APPEARANCES`.

    Returns
    -------
    template : ndarray of float32, shape (height, width)
    finer : tuple of float
        How many times finer than what was drawn from the picture is, across and down; at least 1.

    """
    height, width = rays.shape[:2]
    right, below = cv2.split(cv2.perspectiveTransform(rays, ray_to_patch))
    # Metres a pixel, across and down; they run backwards where the camera is upside down.
    across = abs(float(right[height // 2, -1] - right[height // 2, 0])) / (width - 1)
    down = abs(float(below[-1, width // 2] - below[0, width // 2])) / (height - 1)
    template = np.zeros((height, width), np.float32)
    finer_across = finer_down = 0.0
    for image, share in textures(landmark, viewer, appearance):
        rows, columns = image.shape
        scale = columns / landmark.width_m
        step_x, step_y = max(scale * across, 1e-2), max(scale * down, 1e-2)
        part = cv2.remap(
            blur_to(image.astype(np.float32), (step_x, step_y)),
            scale * right + (columns - 1) / 2,
            scale * below + (rows - 1) / 2,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        template += share * part
        finer_across += share * max(1.0 / step_x, 1.0) ** 2
        finer_down += share * max(1.0 / step_y, 1.0) ** 2
    return template, (math.sqrt(finer_across), math.sqrt(finer_down))


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
    if appearance == 'patch' or not landmark.views:
        return [Texture(landmark.patch, 1.0)]
    views = (PatchView(landmark.viewpoint, landmark.patch), *landmark.views)
    angle, reach = _seen_from(landmark, viewer)
    misfit = []
    for view in views:
        its_angle, its_reach = _seen_from(landmark, view.viewpoint)
        farther = max(math.log(its_reach / reach), 0.0)
        misfit.append(((its_angle - angle) / _ASIDE_RAD) ** 2 + (farther / _FARTHER) ** 2)
    weight = [math.exp(0.5 * (min(misfit) - m)) for m in misfit]
    least = _LEAST_SHARE * sum(weight)
    total = sum(w for w in weight if w >= least)
    return [Texture(v.patch, w / total) for v, w in zip(views, weight, strict=True) if w >= least]


def _seen_from(landmark: Landmark, viewpoint: FloatArray) -> tuple[float, float]:
    """Angle from the normal and distance, in plan."""
    x, y = (viewpoint[:2] - landmark.position[:2]).tolist()
    nx, ny = landmark.normal[:2].tolist()
    return math.atan2(y * nx - x * ny, x * nx + y * ny), max(math.hypot(x, y), 1e-6)
