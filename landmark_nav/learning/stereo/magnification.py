"""
Magnification between two views of a patch: depth from scale.

If two panoramas and a patch lie on one line, there is no parallax; but on the way to a patch its
image grows the faster the nearer it is. Resampled on the assumed plane, views of a parallel plane
in front of it differ by one factor in both directions.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array
from landmark_nav.learning.stereo.wall_patch import texels_per_pixel, wall_texture, WallPatch
from landmark_nav.matching import blur_to
from landmark_nav.types import FloatArray, Panorama

# Sigma of the Gaussian blur against noise, pixels; blur of a pixel itself, relative to its size.
_BLUR_PX = 0.8
_BLUR_SHARE = 0.5
_ITERATIONS = 6
_CONVERGED = 1e-4
# With larger values it is not the same patch, or the pattern is not usable.
_MOST = 0.25
_LARGEST_SIGMA = 0.02
_LEAST_PIVOT = 1e-5
# Border of a view that the blur affects, pixels.
MARGIN = 4
_INNER = (slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))


def log_nearer(
    patch: WallPatch, point: FloatArray, panoramas: tuple[Panorama, Panorama]
) -> tuple[float, float]:
    """
    Log ratio of the distances of two panoramas from the true plane of a patch.

    Parameters
    ----------
    patch : WallPatch
        The patch in the first of `panoramas`.
    point : ndarray, shape (3,)
        Its match in the other, on the plane of the patch.
    panoramas : tuple
        Both panoramas.

    Returns
    -------
    tuple of float
        Logarithm of the distance of the first panorama over that of the second, and its sigma,
        which is infinite if the ratio is not observable.
    """
    shape = (patch.shape[0] + 2 * MARGIN, patch.shape[1] + 2 * MARGIN)
    views = [
        wall_texture(replace(patch, position=place, shape=shape), panorama)
        for panorama, place in zip(panoramas, (patch.position, point), strict=True)
    ]
    if views[0] is None or views[1] is None:
        return 0.0, np.inf
    own, seen = (texels_per_pixel(patch, panorama) for panorama in panoramas)
    own_view, seen_view = blur_to(views[0], seen, own), blur_to(views[1], own, seen)
    coarser = float(max(own.max(), seen.max()))
    if own.max() > seen.max():
        larger, sigma = log_magnification(own_view, seen_view, coarser) or (0.0, np.inf)
    else:
        smaller, sigma = log_magnification(seen_view, own_view, coarser) or (0.0, np.inf)
        larger = -smaller
    reach, reach_there = (patch.reach_m(panorama) for panorama in panoramas)
    return larger + float(np.log(reach / reach_there)), sigma


def log_magnification(
    template: Float32Array, found: Float32Array, pixel: float
) -> tuple[float, float] | None:
    """
    Log of the magnification of `found` relative to `template`, and its sigma.

    Shift, gain, offset and blur are estimated too: a slightly more blurred view would look larger,
    as its outlines are wider. Gradients are those of the template alone: with a view's own
    gradients its noise would look like blur.

    Parameters
    ----------
    template, found : ndarray, shape (h, w)
        Both views, aligned and about equally sharp; the template should be the coarser one. The
        outermost `MARGIN` pixels are used for filtering only.
    pixel : float
        Texels per pixel of the coarser view: the correlation length of its noise.

    Returns
    -------
    tuple of float, or None
        None if the pattern does not show the magnification.
    """
    height, width = template.shape
    right, down = (
        np.arange(n, dtype=np.float32) - np.float32(0.5 * (n - 1)) for n in (width, height)
    )
    reference = np.asarray(cv2.GaussianBlur(template, (0, 0), _BLUR_PX), np.float32)
    blurred = cv2.GaussianBlur(found, (0, 0), _BLUR_PX) - reference.mean()
    reference -= reference.mean()
    rows = _rows(reference, right, down)
    normal = np.asarray(rows @ rows.T, np.float64)
    size = np.sqrt(np.diag(normal))
    if size.min() <= 0.0:
        return None
    scaled = normal / np.outer(size, size)
    if np.linalg.eigvalsh(scaled)[0] < _LEAST_PIVOT:
        return None
    inverse = np.linalg.inv(scaled) / np.outer(size, size)
    grown, center = 0.0, 0.5 * np.array([width - 1, height - 1])
    for _ in range(_ITERATIONS):
        larger = float(np.exp(grown))
        # cv2.remap is too coarse: it has 32 steps per pixel.
        seen = (
            _cubic(height, center[1] + larger * down)
            @ blurred
            @ _cubic(width, center[0] + larger * right).T
        )
        values = seen[_INNER].ravel()
        solution = inverse @ (rows @ values)
        gain = float(solution[3])
        if gain <= 0.0:
            return None
        step = solution[:3] / gain
        grown, center = grown - float(step[0]), center - step[1:]
        if not abs(grown) < _MOST:
            return None
        if abs(step[0]) < _CONVERGED:
            break
    left = values - solution @ rows
    variance = float(left @ left) / max(values.size - len(rows), 1)
    influence = np.zeros((height, width))
    influence[_INNER] = (inverse[0] @ rows).reshape(seen[_INNER].shape)
    # White noise of the image is filtered by the blur, and so are the residuals.
    passed = float(np.hypot(_BLUR_PX, _BLUR_SHARE * pixel))
    carried = cv2.GaussianBlur(influence, (0, 0), passed, borderType=cv2.BORDER_CONSTANT)
    sigma = float(np.sqrt(4.0 * np.pi * variance * np.sum(carried**2))) * passed / gain
    return (grown, sigma) if sigma < _LARGEST_SIGMA else None


def _rows(view: Float32Array, right: Float32Array, down: Float32Array) -> Float32Array:
    """Derivatives (7, n) of a view (h, w) by size, shift (2), gain, offset and blur (2)."""
    by_y, by_x = np.gradient(view)
    grown = right * by_x + down[:, None] * by_y
    bend_x, bend_y = np.gradient(by_x, axis=1), np.gradient(by_y, axis=0)
    rows = np.stack([grown, by_x, by_y, view, np.ones_like(view), bend_x, bend_y])
    inner = rows[:, MARGIN:-MARGIN, MARGIN:-MARGIN]
    return np.asarray(inner.reshape(len(rows), -1), np.float32)


def _cubic(count: int, places: Float32Array) -> Float32Array:
    """Weights (n, count) of `count` samples at places (n,) between them (Keys, 1981)."""
    away = np.abs(places[:, None] - np.arange(count))
    near = (1.5 * away - 2.5) * away**2 + 1.0
    far = ((2.5 - 0.5 * away) * away - 4.0) * away + 2.0
    return np.asarray(np.where(away < 1.0, near, np.where(away < 2.0, far, 0.0)), np.float32)
