"""
Template matching by the peak of the normalized cross-correlation, aligned to sub-pixels.

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

from dataclasses import dataclass, replace
from functools import lru_cache
import math

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array, FloatArray
from landmark_nav.types import Refusal, RefusalCode

# A value along the columns and one along the rows.
PerAxis = tuple[float, float] | FloatArray

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


def blur_to(image: Float32Array, step: PerAxis, own_step: PerAxis = (1.0, 1.0)) -> Float32Array:
    """
    Blur an image with a resolution of `own_step` pixels to one of `step`, across and down.

    This avoids aliasing when it is sampled by `step`. Nothing changes where `step` is smaller.
    """
    return blur_by(image, blur_sigmas(step, own_step))


def blur_by(image: Float32Array, sigmas: PerAxis) -> Float32Array:
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


def blur_sigmas(step: PerAxis, own_step: PerAxis = (1.0, 1.0)) -> tuple[float, float]:
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
_ITERATIONS = 12
_CONVERGED_PX = 2e-3
# Largest shift from the start, along each axis.
_MAX_SHIFT_PX = 2.0
_TINY = 1e-12
# Kernels over a pixel and its neighbours: the gradients, the pixel itself, and the second
# differences, which are the effect of a small blur.
_STENCILS = np.array(
    [
        [[0, 0, 0], [-0.5, 0, 0.5], [0, 0, 0]],
        [[0, -0.5, 0], [0, 0, 0], [0, 0.5, 0]],
        [[0, 0, 0], [0, 1, 0], [0, 0, 0]],
        [[0, 0, 0], [1, -2, 1], [0, 0, 0]],
        [[0, 1, 0], [0, -2, 0], [0, 1, 0]],
    ],
    dtype=np.float32,
).reshape(5, 9)


@dataclass(frozen=True, eq=False)
class Match:
    """
    A template found in a search image.

    `xy` (2,) is the centre of the template in the search image, pixels (fractional); `covariance`
    (2, 2) its covariance; `score` the normalized cross-correlation there. `blur_px2` (2,) is the
    variance of the blur of the search image relative to the template, across and down; negative
    if the template is more blurred. It includes the blur by interpolation, f (1 - f) at a fraction
    f of a pixel.
    """

    xy: FloatArray
    covariance: FloatArray
    score: float
    blur_px2: FloatArray


def align(
    search: Float32Array,
    template: Float32Array,
    start: tuple[float, float],
    search_blur: PerAxis,
    along_px: float = 0.0,
) -> Match | None:
    """
    Align a template with an image; None if it does not converge, or to a negative correlation.

    Parameters
    ----------
    search, template : ndarray
        Float32 images, blurred by `for_matching`.
    start : tuple of float
        Column and row of the template's upper left corner.
    search_blur : tuple of float
        Gaussian sigmas of the earlier blur of the search image, pixels.
    along_px : float
        Sigma along the edge if the template is an edge: it is aligned across the edge only.
    """
    size = template.shape[1] - 2, template.shape[0] - 2
    rows = _rows(template)
    # Small matrices are lists: calls of NumPy would take longer than all pixels.
    normal: list[list[float]] = (rows @ rows.T).tolist()
    power = max(normal[2][2], _TINY)
    xr, yr = normal[2][:2]
    # Regression of the gradients on the template.
    x_gain, y_gain = normal[0][2] / power, normal[1][2] / power
    xx, xy = normal[0][0] - x_gain * xr, normal[0][1] - x_gain * yr
    yy = normal[1][1] - y_gain * yr
    inverse, along = _inverse(xx, xy, yy), np.zeros((2, 2))
    if along_px:
        hessian = np.array([[xx, xy], [xy, yy]])
        weak, strong = np.linalg.eigh(hessian)[1].T
        inverse = np.outer(strong, strong) / max(float(strong @ hessian @ strong), _TINY)
        along = along_px**2 * np.outer(weak, weak)
    (xx, xy), (_, yy) = inverse.tolist()
    x0, y0 = start[0] + 0.5 * (size[0] + 1), start[1] + 0.5 * (size[1] + 1)
    x, y, aligning = x0, y0, rows[:3]
    for _ in range(_ITERATIONS):
        seen = np.asarray(cv2.getRectSubPix(search, size, (x, y)), dtype=np.float32).ravel()
        by_x, by_y, by_reference = (aligning @ seen).tolist()
        if not by_reference > 0.0:
            return None
        # value(x) ~ gain * reference(x - d) + offset
        gain = by_reference / power
        right, down = by_x / gain - xr, by_y / gain - yr
        step_x, step_y = -xx * right - xy * down, -xy * right - yy * down
        x, y = x + step_x, y + step_y
        if not (abs(x - x0) < _MAX_SHIFT_PX and abs(y - y0) < _MAX_SHIFT_PX):
            return None
        if abs(step_x) + abs(step_y) < _CONVERGED_PX:
            break
    seen -= seen.sum() / seen.size
    total = max(float(seen @ seen), _TINY)
    products = (rows @ seen).tolist()
    if not products[2] > 0.0:
        return None  # what correlated was the rounding of a uniform image
    # The last step explains a part of the residuals.
    explained = power - step_x * right - step_y * down
    variance = max(total / gain**2 - explained, 0.0) / max(seen.size - 4, 1)
    gradients = rows[:2] - np.array([[x_gain], [y_gain]], dtype=np.float32) * rows[2]
    contributions = gradients * (seen / np.float32(gain) - rows[2])
    fraction = (x - 0.5 * (size[0] - 1)) % 1.0, (y - 0.5 * (size[1] - 1)) % 1.0
    passed = _noise_passed(gradients, size, fraction, search_blur)
    inner = np.array([passed, _cluster_sum(contributions, size)], dtype=np.float64)
    # Sums of float32 are not symmetric enough: the receiver of detections would refuse them.
    inner = 0.5 * (inner + inner.swapaxes(1, 2))
    by_noise, by_parts = inverse @ inner @ inverse
    by_noise *= variance
    inflation = np.array(
        [
            math.sqrt(max(parts / max(noise, _TINY) - _CHANCE_EXCESS, 1.0))
            for parts, noise in zip(
                by_parts.diagonal().tolist(), by_noise.diagonal().tolist(), strict=True
            )
        ]
    )
    return Match(
        np.array([x, y]),
        by_noise * inflation[:, None] * inflation + _FLOOR_PX2 + along,
        products[2] / math.sqrt(power * total),
        _relative_blur(normal, products),
    )


def _rows(template: Float32Array) -> Float32Array:
    """
    Products of `_STENCILS` with the inner pixels of a template, without their means, (5, pixels).

    Without the means, the offset drops out, and each step is one product with the image.
    """
    height, width = template.shape[0] - 2, template.shape[1] - 2
    # `as_strided` would take longer than the product.
    shifted = np.ndarray((3, 3, height, width), np.float32, template, strides=2 * template.strides)
    rows = _STENCILS @ shifted.reshape(9, -1)
    rows -= rows.sum(axis=1, keepdims=True) / rows.shape[1]
    return np.asarray(rows, dtype=np.float32)


def _inverse(xx: float, xy: float, yy: float) -> FloatArray:
    """Inverse of a symmetric matrix (2, 2); NaN where it is near singular."""
    determinant = xx * yy - xy * xy
    scale = 1.0 / determinant if determinant > 1e-6 * (xx + yy) ** 2 else math.nan
    return np.array([[yy * scale, -xy * scale], [-xy * scale, xx * scale]])


def _noise_passed(
    gradients: Float32Array,
    size: tuple[int, int],
    fraction: tuple[float, float],
    search_blur: PerAxis,
) -> Float32Array:
    """``G B B^T G^T`` (2, 2) over the sum of the squares of B's kernel; gradients (2, pixels)."""
    width, height = size
    across = _noise_correlation(search_blur[0], fraction[0], width)
    down = _noise_correlation(search_blur[1], fraction[1], height)
    noise_passed = down @ gradients.reshape(2, height, width) @ across
    return np.asarray(gradients @ noise_passed.reshape(2, -1).T)


def _noise_correlation(blur_px: float, fraction: float, count: int) -> Float32Array:
    """Correlation (count, count) of the noise of pixels in a row after blur and interpolation."""
    # Rounded, and sizes to powers of two, so that most of them are in the cache.
    size = 1 << (count - 1).bit_length()
    return _correlations(round(blur_px, 1), round(fraction, 1), size)[:count, :count]


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


def _cluster_sum(contributions: Float32Array, size: tuple[int, int]) -> Float32Array:
    """Sum (2, 2) over the parts of a patch of the outer products of their sums of (2, pixels)."""
    width, height = size
    stacked = contributions.reshape(2 * height, width)
    means = cv2.resize(stacked, (_PARTS, 2 * _PARTS), interpolation=cv2.INTER_AREA).reshape(2, -1)
    count = means.shape[1]
    in_each = width * height / count
    free = in_each**2 * count / (count - _USED_FREEDOM)
    return np.asarray(free * (means @ means.T))


def _relative_blur(normal: list[list[float]], image_products: list[float]) -> FloatArray:
    """
    Variance (2,) of the blur of an image relative to its template, to first order.

    A Gaussian of variance v adds v / 2 times the second derivative. The coefficients follow by
    regression from the products of `_rows` with each other (5, 5) and with the image (5,).
    """
    power, reference, across, down = normal[2][2], *image_products[2:]
    x_share, y_share = normal[3][2] / power, normal[4][2] / power
    xx, xy = normal[3][3] - x_share * normal[2][3], normal[3][4] - x_share * normal[2][4]
    yy = normal[4][4] - y_share * normal[2][4]
    # Regularised: a texture that is constant along one axis does not determine its blur.
    least = 1e-3 * (xx + yy)
    seen = np.array([across - x_share * reference, down - y_share * reference])
    blur = _inverse(xx + least, xy, yy + least) @ seen
    return np.asarray(2.0 * power / reference * blur)


# Smallest standard deviation of a template, grey levels.
_MIN_CONTRAST = 4.0
_NEIGHBOURS = np.ones((3, 3), np.uint8)


def match_template(
    search: Float32Array,
    template: Float32Array,
    *,
    min_score: float = 0.7,
    max_second_ratio: float = 0.9,
    search_blur: PerAxis = (0.0, 0.0),
    edge: bool = False,
) -> Match | Refusal:
    """
    Find a template by normalized cross-correlation and align it to sub-pixel.

    Parameters
    ----------
    search : ndarray, shape (H, W)
        Float32 image, larger than the template by at least 4 pixels each way.
    template : ndarray, shape (h, w)
        Float32 image.
    min_score : float
        Smallest correlation that counts as found.
    max_second_ratio : float
        Largest score of another peak, relative to the best.
    search_blur : tuple of float
        Gaussian sigmas of the earlier blur of the search image, across and down, pixels; its noise
        is correlated accordingly.
    edge : bool
        Whether the template is an upright edge: any row of the search image may be the right one.
    """
    contrast = float(cv2.meanStdDev(template)[1][0, 0])
    if contrast < _MIN_CONTRAST:
        return Refusal('blank template', f'contrast {contrast:.1f}')
    search, template = for_matching(search), for_matching(template)
    found = cv2.matchTemplate(search, template, cv2.TM_CCOEFF_NORMED)
    scores = np.asarray(found, dtype=np.float32)
    first, along_px = np.zeros(scores.shape[1]), 0.0
    if edge:
        # Any row may be the right one: the best of each column counts.
        first, along_px = scores.argmax(axis=0) - 1.0, scores.shape[0] / math.sqrt(12.0)
        scores = np.pad(scores.max(axis=0)[None], ((1, 1), (0, 0)), constant_values=-1.0)
    _, score, _, (column, row) = cv2.minMaxLoc(scores)
    if score < min_score:
        return Refusal(
            'low correlation', f'{score:.2f} < {min_score:.2f}', RefusalCode.LOW_CORRELATION
        )
    if not (0 < column < scores.shape[1] - 1 and 0 < row < scores.shape[0] - 1):
        return Refusal('peak at the border of the search window')
    limit = max_second_ratio * score
    second = _second_peak(scores, column, row, template.shape, limit)
    if second > limit:
        return Refusal('ambiguous', f'second peak {second:.2f} of {score:.2f}')
    across, down = _parabola_peak(scores, column, row)
    start = across, down + float(first[column])
    match = align(search, template, start, search_blur, along_px)
    if match is None:
        return Refusal('alignment failed')
    return match if match.score >= score else replace(match, score=score)


def _second_peak(
    scores: Float32Array, column: int, row: int, shape: tuple[int, ...], limit: float
) -> float:
    """Best peak above `limit`, more than a fifth of the template away from the best; else -1."""
    away_x, away_y = max(3, shape[1] // 5), max(3, shape[0] // 5)
    away = scores.copy()
    away[
        max(0, row - away_y) : row + away_y + 1, max(0, column - away_x) : column + away_x + 1
    ] = -1.0
    if cv2.minMaxLoc(away)[1] <= limit:
        return -1.0
    # Only local maxima count, not the slope of the main peak.
    is_peak = scores >= cv2.dilate(scores, _NEIGHBOURS)
    inner = (slice(1, -1), slice(1, -1))
    return float(np.max(away[inner], where=is_peak[inner], initial=-1.0))


def _parabola_peak(scores: Float32Array, column: int, row: int) -> tuple[float, float]:
    """Sub-pixel maximum of parabolas through the peak of the scores and its neighbours."""
    top = float(scores[row, column])
    left, right = float(scores[row, column - 1]), float(scores[row, column + 1])
    above, below = float(scores[row - 1, column]), float(scores[row + 1, column])
    bend_x, bend_y = left - 2.0 * top + right, above - 2.0 * top + below
    return (
        column + (0.5 * (left - right) / bend_x if bend_x < 0.0 else 0.0),
        row + (0.5 * (above - below) / bend_y if bend_y < 0.0 else 0.0),
    )
