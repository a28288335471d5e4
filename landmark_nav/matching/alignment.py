"""
Sub-pixel alignment of templates with images, and its covariance.

Alignment: Gauss-Newton over shift, gain and offset with the gradients of the template, so that the
normal matrix is constant (Baker and Matthews, IJCV 56(3), 2004).

Covariance by noise: white noise of variance s^2 in the search image passes blur and interpolation
(together B). The covariance of the shift is ``s^2 N^-1 G B B^T G^T N^-1`` with the gradients G and
their normal matrix N. The variance of the residuals, s^2 times the sum of the squared kernel of B,
gives s^2.

Covariance by structure: where parts of the patch move differently (a frame that stands out, a
reflection), neighbouring residuals are correlated. If the parts of a patch disagree by more than
noise explains, the covariance is the sandwich estimate with these parts as clusters (White,
Econometrica 48(4), 1980; Liang and Zeger, Biometrika 73(1), 1986).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import as_strided

from landmark_nav.arrays import Float32Array, FloatArray

Pair = tuple[float, float] | FloatArray

# Blur of both images before alignment (Gaussian sigma, pixels). Bilinear interpolation of raw
# pixels biases the shift towards whole pixels; with this blur the bias is below 0.01 px.
MATCHED_PX = 0.8
# Gaussian sigma of the blur that sampling by a pixel stands for, relative to the pixel width.
_PIXEL_SIGMA = 0.5
# Smaller blurs are negligible and left out, pixels.
_MIN_SIGMA_PX = 0.3


def for_matching(image: Float32Array) -> Float32Array:
    """Blur an image as sub-pixel alignment needs it."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), MATCHED_PX), dtype=np.float32)


def blur_to(image: Float32Array, step: Pair, own_step: Pair = (1.0, 1.0)) -> Float32Array:
    """
    Blur an image with a resolution of `own_step` pixels to one of `step`, across and down.

    This avoids aliasing when it is sampled by `step`. Nothing changes where `step` is smaller.
    """
    return blur_by(image, blur_sigmas(step, own_step))


def blur_by(image: Float32Array, sigmas: Pair) -> Float32Array:
    """
    Blur an image by Gaussian sigmas across and down, pixels; not at all if both are 0.

    The blur is applied to light intensity, as by a lens. Grey levels are about its square root
    (sRGB: the power 0.45); a blur of grey levels would move edges to their bright side.
    """
    across, down = sigmas
    if max(across, down) == 0.0:
        return image
    light = image * image
    blurred = cv2.GaussianBlur(light, (0, 0), sigmaX=max(across, 0.01), sigmaY=max(down, 0.01))
    return np.asarray(np.sqrt(blurred), dtype=np.float32)


def blur_sigmas(step: Pair, own_step: Pair = (1.0, 1.0)) -> tuple[float, float]:
    """Sigmas of the blur of `blur_to`, pixels; both zero if they are negligible."""
    share = _PIXEL_SIGMA**2
    across = share * (float(step[0]) ** 2 - float(own_step[0]) ** 2)
    down = share * (float(step[1]) ** 2 - float(own_step[1]) ** 2)
    return sigmas_of(across, down)


def sigmas_of(across_px2: float, down_px2: float) -> tuple[float, float]:
    """Sigmas of a blur with these variances; both zero if they are negligible or negative."""
    across, down = max(across_px2, 0.0) ** 0.5, max(down_px2, 0.0) ** 0.5
    return (across, down) if max(across, down) >= _MIN_SIGMA_PX else (0.0, 0.0)


# Covariance by interpolation and by small differences of texture, without noise, pixels squared.
_FLOOR_PX2 = np.diag([0.02**2, 0.02**2])
# Number of parts of a patch along each axis, and degrees of freedom subtracted from their number:
# 4 for shift, gain and offset; 2 because the mean of the inverse of an estimated variance exceeds
# the inverse of the mean.
_PARTS, _USED_FREEDOM = 4, 4 + 2
# Relative excess over the variance by white noise that chance causes in one of ten cases.
_CHANCE_EXCESS = 0.5


class _Fits(NamedTuple):
    """
    Results of n alignments, from which their covariances follow.

    `sizes` are width and height; `rows` (5, pixels) those of `_rows`; `seen` (pixels,) the aligned
    part of the image without its mean; `xy` (n, 2) the centres; `gain` (n,); `squared_residuals`
    (n,) their sums; `gradient_gain` (n, 2) the regression coefficients of the gradients on the
    template; `inverse` (n, 2, 2) the inverse normal matrices; `blurs` the earlier blurs of the
    search images.
    """

    sizes: list[tuple[int, int]]
    rows: list[Float32Array]
    seen: list[Float32Array]
    xy: FloatArray
    gain: FloatArray
    squared_residuals: FloatArray
    gradient_gain: FloatArray
    inverse: FloatArray
    blurs: list[Pair]


def covariances(fits: _Fits) -> FloatArray:
    """Covariances (n, 2, 2) of the centres."""
    n = len(fits.rows)
    without_gain = np.zeros((n, 2, 3), np.float32)
    without_gain[:, :, :2], without_gain[:, :, 2] = np.eye(2), -fits.gradient_gain
    gradients = [each @ rows[:3] for each, rows in zip(without_gain, fits.rows, strict=True)]
    corners = fits.xy - 0.5 * (np.array(fits.sizes) - 1)
    fractions = np.round(corners % 1.0, 1).tolist()
    noise_passed = np.array(
        [
            _noise_passed(*each)
            for each in zip(gradients, fits.sizes, fractions, fits.blurs, strict=True)
        ]
    )
    contributions = [
        gradient * (seen / gain - rows[2])
        for gradient, seen, gain, rows in zip(
            gradients, fits.seen, fits.gain.astype(np.float32), fits.rows, strict=True
        )
    ]
    cluster_sums = np.array(
        [_cluster_sum(*each) for each in zip(contributions, fits.sizes, strict=True)]
    )
    freedom = np.array([max(seen.size - 4, 1) for seen in fits.seen])
    variance = fits.squared_residuals / freedom / fits.gain**2
    # The rows hold twice the gradients.
    covariance = 0.25 * variance[:, None, None] * (fits.inverse @ noise_passed @ fits.inverse)
    cluster_covariance = 0.25 * (fits.inverse @ cluster_sums @ fits.inverse)
    noise = np.maximum(np.diagonal(covariance, axis1=1, axis2=2), _TINY)
    excess = np.diagonal(cluster_covariance, axis1=1, axis2=2) / noise - _CHANCE_EXCESS
    inflation = np.sqrt(np.maximum(excess, 1.0))
    return np.asarray(covariance * inflation[:, :, None] * inflation[:, None] + _FLOOR_PX2)


def _noise_passed(
    gradients: Float32Array,
    size: tuple[int, int],
    fraction: tuple[float, float],
    search_blur: Pair,
) -> FloatArray:
    """``G B B^T G^T`` (2, 2) over the sum of the squares of B's kernel; gradients (2, pixels)."""
    width, height = size
    across = _noise_correlation(round(search_blur[0], 1), fraction[0], width)
    down = _noise_correlation(round(search_blur[1], 1), fraction[1], height)
    noise_passed = down @ gradients.reshape(2, height, width) @ across
    return np.asarray(gradients @ noise_passed.reshape(2, -1).T, dtype=np.float64)


def _noise_correlation(blur_px: float, fraction: float, count: int) -> Float32Array:
    """Correlation (count, count) of the noise of pixels in a row after blur and interpolation."""
    # Sizes are rounded to powers of two, so that most of them are in the cache.
    return _correlations(blur_px, fraction, 1 << (count - 1).bit_length())[:count, :count]


@lru_cache(maxsize=256)
def _correlations(blur_px: float, fraction: float, count: int) -> Float32Array:
    # Kernel of all blurs, convolved with that of interpolation at a fraction of a pixel.
    sigma = math.hypot(MATCHED_PX, blur_px)
    reach = int(np.ceil(3.0 * sigma)) + 1
    gauss = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel = np.convolve(gauss, [1.0 - fraction, fraction])
    shared = np.zeros(count + len(kernel))
    shared[: len(kernel)] = np.correlate(kernel, kernel, 'full')[len(kernel) - 1 :]
    indices = np.arange(count)
    apart = np.abs(indices[:, None] - indices)
    return np.asarray(shared[apart] / shared[0], dtype=np.float32)


def _cluster_sum(contributions: Float32Array, size: tuple[int, int]) -> FloatArray:
    """Sum (2, 2) over the parts of a patch of the outer products of their sums of (2, pixels)."""
    width, height = size
    stacked = contributions.reshape(2 * height, width)
    means = cv2.resize(stacked, (_PARTS, 2 * _PARTS), interpolation=cv2.INTER_AREA).reshape(2, -1)
    count = means.shape[1]
    in_each = width * height / count
    free = in_each**2 * count / (count - _USED_FREEDOM)
    return np.asarray(free * (means @ means.T), dtype=np.float64)


_ITERATIONS = 12
_CONVERGED_PX = 2e-3
# Largest shift from the start, along each axis.
_MAX_SHIFT_PX = 2.0
_TINY = 1e-12
# Kernels over a pixel and its neighbours: twice the gradients, the pixel itself, and the second
# differences, which are the effect of a small blur.
_STENCILS = np.array(
    [
        [[0, 0, 0], [-1, 0, 1], [0, 0, 0]],
        [[0, -1, 0], [0, 0, 0], [0, 1, 0]],
        [[0, 0, 0], [0, 1, 0], [0, 0, 0]],
        [[0, 0, 0], [1, -2, 1], [0, 0, 0]],
        [[0, 1, 0], [0, -2, 0], [0, 1, 0]],
    ],
    dtype=np.float32,
).reshape(5, 9)


class Alignment(NamedTuple):
    """
    Centres of m templates in their images, `xy` (m, 2).

    `indices` (m,) are the indices of the aligned templates: alignment of the others failed.
    `covariance` (m, 2, 2) is that of `xy`; `score` (m,) is the normalized cross-correlation there;
    `blur_px2` (m, 2) is the variance of the blur of the image relative to the template.
    """

    indices: list[int]
    xy: FloatArray
    covariance: FloatArray
    score: FloatArray
    blur_px2: FloatArray


def align(
    searches: Sequence[Float32Array],
    templates: Sequence[Float32Array],
    starts: Sequence[tuple[float, float]],
    search_blurs: Sequence[Pair],
) -> Alignment:
    """
    Align n templates with their images.

    Parameters
    ----------
    searches, templates : sequence of ndarray
        Float32 images, blurred by `for_matching`.
    starts : sequence of tuple of float
        Column and row of each template's upper left corner.
    search_blurs : sequence of tuple of float
        Gaussian sigmas of the earlier blur of each search image, pixels.
    """
    n = len(templates)
    sizes = [(template.shape[1] - 2, template.shape[0] - 2) for template in templates]
    rows = [_rows(template) for template in templates]
    normal = np.array([each @ each.T for each in rows], dtype=np.float64).reshape(n, 5, 5)
    with np.errstate(divide='ignore', invalid='ignore'):
        # Regression of the gradients (half of the first two rows) on the template.
        gradient_gain = normal[:, :2, 2] / normal[:, 2, 2, None]
        hessian = 0.25 * (normal[:, :2, :2] - gradient_gain[:, :, None] * normal[:, None, 2, :2])
        inverse = _inverse(hessian)
    terms = np.concatenate([normal[:, 2, :3], inverse.reshape(n, 4)], axis=1).tolist()
    shifted = [_shifted(*each) for each in zip(searches, sizes, rows, starts, terms, strict=True)]
    good = [k for k, shift in enumerate(shifted) if shift is not None]
    if not good:
        return Alignment([], np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0), np.empty((0, 2)))

    shifts = [shift for shift in shifted if shift is not None]
    xy, step = np.array([shift.xy for shift in shifts]), np.array([shift.step for shift in shifts])
    gain = np.array([shift.gain for shift in shifts])
    seen = [_without_mean(shift.seen) for shift in shifts]
    rows = [rows[k] for k in good]
    normal, hessian, inverse, gradient_gain = (
        a[good] for a in (normal, hessian, inverse, gradient_gain)
    )
    total = np.array([float(each @ each) for each in seen])
    power = normal[:, 2, 2]
    step_power = ((step[:, None] @ hessian)[:, 0] * step).sum(axis=-1)
    fits = _Fits(
        [sizes[k] for k in good],
        rows,
        seen,
        xy,
        gain,
        np.maximum(total - gain**2 * (power + step_power), 0.0),
        gradient_gain,
        inverse,
        [search_blurs[k] for k in good],
    )
    image_products = np.array([its_rows @ each for its_rows, each in zip(rows, seen, strict=True)])
    return Alignment(
        good,
        xy,
        covariances(fits),
        gain * np.sqrt(power / np.maximum(total, _TINY)),
        _relative_blur(normal, image_products.astype(np.float64)),
    )


def _rows(template: Float32Array) -> Float32Array:
    """
    Products of `_STENCILS` with the inner pixels of a template, without their means, (5, pixels).

    Without the means, the offset drops out, and each step is one product with the image.
    """
    height, width = template.shape[0] - 2, template.shape[1] - 2
    shifted = as_strided(template, (3, 3, height, width), 2 * template.strides)
    rows = _STENCILS @ shifted.reshape(9, -1)
    rows -= rows.sum(axis=1, keepdims=True) / rows.shape[1]
    return np.asarray(rows, dtype=np.float32)


def _inverse(matrix: FloatArray) -> FloatArray:
    """Inverse of symmetric matrices (n, 2, 2); NaN where they are near singular."""
    xx, xy, yy = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]
    determinant = xx * yy - xy * xy
    determinant[~(determinant > 1e-6 * (xx + yy) ** 2)] = np.nan
    adjugate = np.array([[yy, -xy], [-xy, xx]]).transpose(2, 0, 1)
    return np.asarray(adjugate / determinant[:, None, None])


class _Shift(NamedTuple):
    """Centre of a template, the last step, and the image at the position before that step."""

    xy: tuple[float, float]
    step: tuple[float, float]
    gain: float
    seen: Float32Array


def _shifted(
    search: Float32Array,
    size: tuple[int, int],
    rows: Float32Array,
    start: tuple[float, float],
    terms: Sequence[float],
) -> _Shift | None:
    """
    Align one template; None if it does not converge nearby or the correlation is negative.

    `terms` (7,) are the products of the template with its doubled gradients and itself, and the
    inverse of the Hessian.
    """
    xr, yr, power, xx, xy, _, yy = terms
    x0, y0 = start[0] + 0.5 * (size[0] + 1), start[1] + 0.5 * (size[1] + 1)
    x, y = x0, y0
    for _ in range(_ITERATIONS):
        seen = np.asarray(cv2.getRectSubPix(search, size, (x, y)), dtype=np.float32).ravel()
        by_x, by_y, by_reference = (rows[:3] @ seen).tolist()
        if not by_reference > 0.0:
            return None
        # value(x) ~ gain * reference(x - d) + offset
        gain = by_reference / power
        right, down = 0.5 * (by_x / gain - xr), 0.5 * (by_y / gain - yr)
        step_x, step_y = -xx * right - xy * down, -xy * right - yy * down
        x, y = x + step_x, y + step_y
        if not (abs(x - x0) < _MAX_SHIFT_PX and abs(y - y0) < _MAX_SHIFT_PX):
            return None
        if abs(step_x) + abs(step_y) < _CONVERGED_PX:
            break
    return _Shift((x, y), (step_x, step_y), gain, seen)


def _without_mean(values: Float32Array) -> Float32Array:
    return np.asarray(values - values.sum() / values.size, dtype=np.float32)


def _relative_blur(normal: FloatArray, image_products: FloatArray) -> FloatArray:
    """
    Variance (n, 2) of the blur of images relative to their templates, to first order.

    A Gaussian of variance v adds v / 2 times the second derivative. The coefficients follow by
    regression from the products of `_rows` with each other (n, 5, 5) and with the image (n, 5).
    """
    power, reference = normal[:, 2, 2], image_products[:, 2]
    projection = normal[:, 3:, 2] / power[:, None]
    curvature = normal[:, 3:, 3:] - projection[:, :, None] * normal[:, None, 2, 3:]
    seen = image_products[:, 3:] - projection * reference[:, None]
    # Regularised: a texture that is constant along one axis does not determine its blur.
    curvature += 1e-3 * (curvature[:, 0, 0] + curvature[:, 1, 1])[:, None, None] * np.eye(2)
    coefficients = (_inverse(curvature) @ seen[..., None])[..., 0]
    return np.asarray(2.0 * (power / reference)[:, None] * coefficients)
