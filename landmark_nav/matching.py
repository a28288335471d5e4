"""
Where a template lies in an image: normalized cross-correlation, then sub-pixel alignment.

Both images must be of the same kind: the learner matches wall textures, the localizer pictures.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
import math

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array
from landmark_nav.types import FloatArray, Refusal

__all__ = [
    'Match',
    'blur_by',
    'blur_sigmas',
    'blur_to',
    'match_template',
    'sigmas_of',
]

Pair = tuple[float, float] | FloatArray

# Bilinear interpolation of raw pixels pulls the optimum towards whole pixels; this blur of both
# images takes that below 0.01 px (Gaussian sigma, pixels).
_BLUR_PX = 0.8
# Covariance that remains if noise did not matter: interpolation, and texture that isn't quite the
# same, pixels.
_FLOOR = np.diag([0.02**2, 0.02**2])
# Parts of a patch, each way, that may be out of place. Shift, gain and offset take of their
# freedom, and that few tell of a variance raises the mean of what is divided by it: two more.
_PARTS, _TAKEN = 4, 4 + 2
# By so much of itself the variance that parts tell exceeds that of white noise once in ten cases.
_BY_CHANCE = 0.5
_TINY = 1e-12
_ITERATIONS = 12
# Standard deviation of a template, grey levels.
_LEAST_CONTRAST = 4.0
_CONVERGED_PX = 2e-3
# Blur that a pixel stands for, as a share of its width (Gaussian sigma).
_BLUR_SHARE = 0.5
_LEAST_BLUR_PX = 0.3
_NEIGHBOURS = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, eq=False)
class Match:
    """
    A template found in a search image.

    `xy` (2,) is where the template's centre lies in the search image, pixels (fractional);
    `covariance` (2, 2) its covariance; `score` the normalized cross-correlation there.
    `blur_px2` (2,) is by how much more the search image is blurred than the template, across and
    down: variance of a Gaussian, negative if less. What interpolation blurs to compare them,
    f (1 - f) at a fraction f of a pixel, is part of it.
    """

    xy: FloatArray
    covariance: FloatArray
    score: float
    blur_px2: FloatArray


def match_template(
    search: Float32Array,
    template: Float32Array,
    *,
    min_score: float = 0.7,
    max_second_ratio: float = 0.9,
    search_blur: Pair = (0.0, 0.0),
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
        Least correlation that counts as found.
    max_second_ratio : float
        Greatest share of the peak that another place may reach.
    search_blur : tuple of float
        By how much the search image was blurred already, across and down: Gaussian sigmas in
        pixels. Its noise is correlated as far.

    Returns
    -------
    Match or Refusal

    Notes
    -----
    The alignment is Gauss-Newton over shift, gain and offset with the template's gradients, whose
    normal matrix N is the same in each step (Baker and Matthews, IJCV 56(3), 2004). White noise of
    variance s^2 in the search image passes the blur and the interpolation, together B, so the
    shift's covariance is ``s^2 N^-1 G B B^T G^T N^-1`` with G the gradients; the residuals, whose
    variance is s^2 times the sum of the squares of B's kernel, tell s^2.

    Where things stand out from each other (a picture's frame, a reflection), residuals next to
    each other pull alike. So each part of the patch says where it would rather be, and where they
    contradict each other by more than noise does, their spread is the covariance: the sandwich
    with clusters (White, Econometrica 48(4), 1980; Liang and Zeger, Biometrika 73(1), 1986).

    """
    contrast = float(cv2.meanStdDev(template)[1][0, 0])
    if contrast < _LEAST_CONTRAST:
        return Refusal('blank template', f'contrast {contrast:.1f}')
    search, template = _smooth(search), _smooth(template)
    scores = np.asarray(
        cv2.matchTemplate(search, template, cv2.TM_CCOEFF_NORMED), dtype=np.float32
    )
    _, score, _, (column, row) = cv2.minMaxLoc(scores)
    if score < min_score:
        return Refusal('low correlation', f'{score:.2f} < {min_score:.2f}')
    if not (0 < column < scores.shape[1] - 1 and 0 < row < scores.shape[0] - 1):
        return Refusal('peak at the border of the search window')
    second = _second_peak(scores, column, row, template.shape)
    if second > max_second_ratio * score:
        return Refusal('ambiguous', f'second peak {second:.2f} of {score:.2f}')
    aligned = _align(search, template, *_parabola_peak(scores, column, row), search_blur)
    if aligned is None:
        return Refusal('alignment failed')
    center, covariance, fine_score, blur_px2 = aligned
    return Match(center, covariance, max(float(score), fine_score), blur_px2)


def blur_to(image: Float32Array, step: Pair, own_step: Pair = (1.0, 1.0)) -> Float32Array:
    """
    Blur an image that resolves `own_step` pixels to one that resolves `step`, across and down.

    Where `step` is not the wider one nothing is to do; without it, sampling wider would alias.
    """
    return blur_by(image, blur_sigmas(step, own_step))


def blur_by(image: Float32Array, sigmas: Pair) -> Float32Array:
    """Blur an image by Gaussian sigmas across and down, pixels; where both are 0, not at all."""
    across, down = sigmas
    if max(across, down) == 0.0:
        return image
    blurred = cv2.GaussianBlur(image, (0, 0), sigmaX=max(across, 0.01), sigmaY=max(down, 0.01))
    return np.asarray(blurred, dtype=np.float32)


def blur_sigmas(step: Pair, own_step: Pair = (1.0, 1.0)) -> tuple[float, float]:
    """Sigmas of the blur of `blur_to`, pixels; zero where it would do next to nothing."""
    share = _BLUR_SHARE**2
    across = share * (float(step[0]) ** 2 - float(own_step[0]) ** 2)
    down = share * (float(step[1]) ** 2 - float(own_step[1]) ** 2)
    return sigmas_of(across, down)


def sigmas_of(across_px2: float, down_px2: float) -> tuple[float, float]:
    """Sigmas of a blur with these variances, if any; zero where it would do next to nothing."""
    across, down = max(across_px2, 0.0) ** 0.5, max(down_px2, 0.0) ** 0.5
    return (across, down) if max(across, down) >= _LEAST_BLUR_PX else (0.0, 0.0)


def _smooth(image: Float32Array) -> Float32Array:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), _BLUR_PX), dtype=np.float32)


def _second_peak(scores: Float32Array, column: int, row: int, shape: tuple[int, ...]) -> float:
    """Best score away from the peak by more than a fifth of the template."""
    away_x, away_y = max(3, shape[1] // 5), max(3, shape[0] // 5)
    rows, columns = scores.shape
    if max(column, columns - 2 - column) <= away_x and max(row, rows - 2 - row) <= away_y:
        return -1.0
    # A slope down from the main peak is no peak of its own.
    is_peak = scores >= cv2.dilate(scores, _NEIGHBOURS)
    is_peak[
        max(0, row - away_y) : row + away_y + 1, max(0, column - away_x) : column + away_x + 1
    ] = False
    inner = (slice(1, -1), slice(1, -1))
    return float(np.max(scores[inner], where=is_peak[inner], initial=-1.0))


def _parabola_peak(scores: Float32Array, column: int, row: int) -> tuple[float, float]:
    """Where parabolas through the peak of the scores and its neighbours are highest."""
    top = float(scores[row, column])
    left, right = float(scores[row, column - 1]), float(scores[row, column + 1])
    above, below = float(scores[row - 1, column]), float(scores[row + 1, column])
    bend_x, bend_y = left - 2.0 * top + right, above - 2.0 * top + below
    return (
        column + (0.5 * (left - right) / bend_x if bend_x < 0.0 else 0.0),
        row + (0.5 * (above - below) / bend_y if bend_y < 0.0 else 0.0),
    )


def _align(
    search: Float32Array, template: Float32Array, column: float, row: float, search_blur: Pair
) -> tuple[FloatArray, FloatArray, float, FloatArray] | None:
    """
    Centre (2,) of the template in the search image, its covariance, the correlation there.

    And by how much more the search image is blurred there, (2,) as `Match` has it.
    """
    height, width = template.shape[0] - 2, template.shape[1] - 2
    # Twice the gradients, the template itself, and its second differences: what blur adds to it.
    # What gain and offset explain is taken out of the gradients once and for all, so that each
    # step needs one product with the picture.
    all_rows = np.empty((5, height * width), np.float32)
    grad_x, grad_y, reference, bend_x, bend_y = all_rows.reshape(5, height, width)
    np.subtract(template[1:-1, 2:], template[1:-1, :-2], out=grad_x)
    np.subtract(template[2:, 1:-1], template[:-2, 1:-1], out=grad_y)
    reference[...] = template[1:-1, 1:-1]
    np.add(template[1:-1, 2:], template[1:-1, :-2], out=bend_x)
    np.add(template[2:, 1:-1], template[:-2, 1:-1], out=bend_y)
    all_rows[3:] -= 2.0 * all_rows[2]
    all_rows -= all_rows.sum(axis=1, keepdims=True) / all_rows.shape[1]
    normal = (all_rows @ all_rows.T).tolist()
    rows = all_rows[:3]
    (xx, xy, xr, _, _), (_, yy, yr, _, _), (_, _, power, _, _), _, _ = normal
    xx, xy, yy = (
        0.25 * (xx - xr * xr / power),
        0.25 * (xy - xr * yr / power),
        0.25 * (yy - yr * yr / power),
    )
    determinant = xx * yy - xy * xy
    if not determinant > 1e-6 * (xx + yy) ** 2:
        return None

    x0, y0 = column + 0.5 * (width + 1), row + 0.5 * (height + 1)
    x, y = x0, y0
    for _ in range(_ITERATIONS):
        seen = cv2.getRectSubPix(search, (width, height), (x, y))
        by_x, by_y, by_reference = (rows @ seen.ravel()).tolist()
        gain = by_reference / power
        if not gain > 0.0:
            return None
        # value(x) ~ gain * reference(x - d) + offset
        right = 0.5 * (by_x - xr * gain) / gain
        down = 0.5 * (by_y - yr * gain) / gain
        step_x = (xy * down - yy * right) / determinant
        step_y = (xy * right - xx * down) / determinant
        x, y = x + step_x, y + step_y
        if not (abs(x - x0) < 2.0 and abs(y - y0) < 2.0):
            return None
        if abs(step_x) + abs(step_y) < _CONVERGED_PX:
            break
    value = seen.ravel()
    value -= value.sum() / value.size
    total = float(value @ value)
    explained = (
        gain
        * gain
        * (power + xx * step_x * step_x + 2.0 * xy * step_x * step_y + yy * step_y * step_y)
    )
    variance = max(total - explained, 0.0) / max(value.size - 4, 1) / gain**2
    blur_px2 = _further_blur(normal, (all_rows @ value).tolist())
    rows[:2] -= np.array([[xr], [yr]], np.float32) / power * rows[2]
    passed = _noise_passed(rows[:2].reshape(2, height, width), (x, y), search_blur)
    inverse = np.array([[yy, -xy], [-xy, xx]]) / determinant
    covariance = 0.25 * variance * inverse @ passed @ inverse
    pulls = rows[:2] * (value / gain - rows[2])
    by_parts = _summed_squares(np.asarray(pulls, np.float32).reshape(2 * height, width))
    unlike = 0.25 * inverse @ by_parts @ inverse
    across, down = (
        math.sqrt(max(unlike[k, k] / max(covariance[k, k], _TINY) - _BY_CHANCE, 1.0))
        for k in range(2)
    )
    covariance *= [[across**2, across * down], [across * down, down**2]]
    covariance += _FLOOR
    return np.array([x, y]), covariance, gain * (power / max(total, 1e-12)) ** 0.5, blur_px2


def _summed_squares(pulls: Float32Array) -> FloatArray:
    """Sum (2, 2) over parts of a patch of the squares of what pulls (2 h, w) add up to there."""
    means = cv2.resize(pulls, (_PARTS, 2 * _PARTS), interpolation=cv2.INTER_AREA).reshape(2, -1)
    count = means.shape[1]
    in_each = 0.5 * pulls.size / count
    free = in_each**2 * count / (count - _TAKEN)
    return np.asarray(free * (means @ means.T), dtype=np.float64)


def _further_blur(normal: list[list[float]], seen: list[float]) -> FloatArray:
    """
    By how much more a picture is blurred than its template, (2,), to first order.

    A Gaussian of variance v adds v / 2 times the second derivative: of the products of `_align`'s
    rows, and those with the picture, what is left where gain and offset are taken out.
    """
    _, _, (_, _, power, rx, ry), (_, _, _, xx, xy), (_, _, _, _, yy) = normal
    _, _, reference, x, y = seen
    xx, xy, yy = xx - rx * rx / power, xy - rx * ry / power, yy - ry * ry / power
    x, y = x - rx * reference / power, y - ry * reference / power
    # A pattern that does not change one way says nothing of it.
    least = 1e-3 * (xx + yy)
    xx, yy = xx + least, yy + least
    half = 0.5 * reference / power * (xx * yy - xy * xy)
    return np.array([(yy * x - xy * y) / half, (xx * y - xy * x) / half])


def _noise_passed(gradients: Float32Array, center: Pair, search_blur: Pair) -> FloatArray:
    """``G B B^T G^T`` (2, 2) over the sum of the squares of B's kernel; gradients (2, h, w)."""
    height, width = gradients.shape[1:]
    x, y = center[0] - 0.5 * (width - 1), center[1] - 0.5 * (height - 1)
    across, across_power = _kernel(round(search_blur[0], 1), round(x % 1.0, 1))
    down, down_power = _kernel(round(search_blur[1], 1), round(y % 1.0, 1))
    reach = max(len(across), len(down)) // 2
    # One above the other, so that one call does both.
    framed = np.zeros((2, height + 2 * reach, width + 2 * reach), np.float32)
    framed[:, reach:-reach, reach:-reach] = gradients
    stacked = framed.reshape(-1, framed.shape[2])
    carried = cv2.sepFilter2D(stacked, cv2.CV_32F, across, down, borderType=cv2.BORDER_CONSTANT)
    flat = np.asarray(carried, dtype=np.float32).reshape(2, -1)
    return np.asarray((flat @ flat.T) / (across_power * down_power), dtype=np.float64)


@lru_cache(maxsize=1024)
def _kernel(blur_px: float, fraction: float) -> tuple[Float32Array, float]:
    """
    Blur, here and before, and interpolation at a fraction of a pixel, one after the other.

    With the kernel comes the sum of its squares. Asked for in tenths, most of them again.
    """
    sigma = math.hypot(_BLUR_PX, blur_px)
    reach = int(np.ceil(3.0 * sigma)) + 1
    gauss = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel = np.convolve(gauss / gauss.sum(), [0.0, 1.0 - fraction, fraction]).astype(np.float32)
    return kernel, float(kernel @ kernel)
