"""
The expected appearance of a landmark from the robot's pose: a virtual view.

A virtual view is rendered from the panoramas that saw the landmark: the ray of each pixel is
intersected with the plane of the landmark, and the panoramas give the intensity of that point
(plenoptic rendering, McMillan and Bishop, SIGGRAPH 1995, with the depth from the plane).
Panoramas from a similar direction and distance have the largest weights (Buehler et al., SIGGRAPH
2001).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
import math
from typing import NamedTuple

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array
from landmark_nav.geometry.patches import PatchView
from landmark_nav.matching.alignment import blur_to
from landmark_nav.types import FloatArray, Landmark

# Sigmas of a view's weight: in the angle, and in the log of the ratio of distances.
_ASIDE_RAD = 0.5
_FARTHER = math.log(2.0)
# Views with a smaller share of the weight are left out.
_LEAST_SHARE = 0.1


class Texture(NamedTuple):
    """An image of the landmark in wall coordinates, and its weight in the blend."""

    image: Float32Array
    share: float


class Drawing(NamedTuple):
    """
    Expected appearance of a landmark in a rectangle of the image, (height, width).

    `finer` is the resolution of the image relative to that of the textures, across and down, at
    least 1.
    """

    image: Float32Array
    finer: tuple[float, float]


def draw(
    landmarks: Sequence[Landmark],
    viewer: FloatArray,
    rays: Sequence[Float32Array],
    rays_to_patch: FloatArray,
) -> list[Drawing]:
    """
    Render the expected appearance of landmarks in rectangles of the image.

    Parameters
    ----------
    landmarks : sequence of Landmark
        n landmarks.
    viewer : ndarray, shape (3,)
        Position of the camera in map.
    rays : sequence of ndarray, shape (height, width, 2)
        Rays of the pixels of each rectangle: x/z and y/z in the optical frame.
    rays_to_patch : ndarray, shape (n, 3, 3)
        Homographies from rays (x, y, 1) to metres on each patch.
    """
    shown = [
        (k, *texture) for k, each in enumerate(landmarks) for texture in textures(each, viewer)
    ]
    to_texels = np.array([_to_texels(image, landmarks[k].width_m) for k, image, _ in shown])
    to_texels = to_texels @ rays_to_patch[[k for k, *_ in shown]]
    images = [np.zeros(each.shape[:2], np.float32) for each in rays]
    squares = np.zeros((len(images), 2))
    for (k, image, share), rays_to_texels in zip(shown, to_texels, strict=True):
        texels = np.asarray(cv2.perspectiveTransform(rays[k], rays_to_texels), dtype=np.float32)
        step = _texels_a_pixel(texels)
        part = cv2.remap(  # type: ignore[call-overload]
            blur_to(image, step), texels, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        cv2.scaleAdd(part, share, images[k], dst=images[k])
        squares[k] += [share * max(1.0 / each, 1.0) ** 2 for each in step]
    finer = np.sqrt(squares).tolist()
    return [Drawing(image, (x, y)) for image, (x, y) in zip(images, finer, strict=True)]


def _to_texels(image: Float32Array, width_m: float) -> list[list[float]]:
    """Homography (3, 3) from metres on a patch to columns and rows of its image."""
    rows, columns = image.shape
    scale = columns / width_m
    return [[scale, 0.0, (columns - 1) / 2], [0.0, scale, (rows - 1) / 2], [0.0, 0.0, 1.0]]


def _texels_a_pixel(texels: Float32Array) -> tuple[float, float]:
    """Texels per pixel, across and down, in the middle of a rectangle (height, width, 2)."""
    height, width = texels.shape[:2]
    # The order of texels is reversed if the camera is upside down.
    across = abs(float(texels[height // 2, -1, 0] - texels[height // 2, 0, 0])) / (width - 1)
    down = abs(float(texels[-1, width // 2, 1] - texels[0, width // 2, 1])) / (height - 1)
    return max(across, 1e-2), max(down, 1e-2)


def textures(landmark: Landmark, viewer: FloatArray) -> list[Texture]:
    """
    Images to blend, with weights that sum to one.

    Parameters
    ----------
    landmark : Landmark
        The landmark; without `views` its patch is the only image.
    viewer : ndarray, shape (3,)
        Position of the camera in map.
    """
    if not landmark.views:
        return [Texture(landmark.patch.astype(np.float32), 1.0)]
    angle, reach = _seen_from(landmark, viewer)
    views = _views(landmark)
    misfit = []
    for _, its_angle, its_reach in views:
        farther = max(math.log(its_reach / reach), 0.0)
        misfit.append(((its_angle - angle) / _ASIDE_RAD) ** 2 + (farther / _FARTHER) ** 2)
    weight = [math.exp(0.5 * (min(misfit) - m)) for m in misfit]
    # Of many equal views, none has the least share: the best one, of weight 1, is always kept.
    least = min(_LEAST_SHARE * sum(weight), 1.0)
    kept = [(k, w) for k, w in enumerate(weight) if w >= least]
    total = sum(w for _, w in kept)
    return [Texture(views[k][0], w / total) for k, w in kept]


@lru_cache(maxsize=4096)
def _views(landmark: Landmark) -> tuple[tuple[Float32Array, float, float], ...]:
    """Images of a landmark, each with the angle and the distance from which it was seen."""
    views = (PatchView(landmark.viewpoint, landmark.patch), *landmark.views)
    return tuple(
        (view.patch.astype(np.float32), *_seen_from(landmark, view.viewpoint)) for view in views
    )


def _seen_from(landmark: Landmark, viewpoint: FloatArray) -> tuple[float, float]:
    """Horizontal angle to the normal, and horizontal distance."""
    x, y = (viewpoint[:2] - landmark.position[:2]).tolist()
    nx, ny = landmark.normal[:2].tolist()
    return math.atan2(y * nx - x * ny, x * nx + y * ny), max(math.hypot(x, y), 1e-6)
