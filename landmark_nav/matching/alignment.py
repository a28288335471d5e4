"""
Templates aligned with images to sub-pixel.

Gauss-Newton over shift, gain and offset with the template's gradients, whose normal matrix is the
same in each step (Baker and Matthews, IJCV 56(3), 2004).

How far off templates may be that were aligned with images.

White noise of variance s^2 in the search image passes the blur and the interpolation, together B,
so the shift's covariance is ``s^2 N^-1 G B B^T G^T N^-1`` with G the gradients and N their normal
matrix; the residuals, whose variance is s^2 times the sum of the squares of B's kernel, give s^2.

Where things stand out from each other (an image's frame, a reflection), residuals next to each
other pull alike. So each part of the patch says where it would rather be, and where they
contradict each other by more than noise does, their spread is the covariance: the sandwich with
clusters (White, Econometrica 48(4), 1980; Liang and Zeger, Biometrika 73(1), 1986).
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

# Bilinear interpolation of raw pixels pulls the optimum towards whole pixels; this blur of both
# images takes that below 0.01 px (Gaussian sigma, pixels).
MATCHED_PX = 0.8
# Blur that a pixel stands for, as a share of its width (Gaussian sigma).
_SHARE = 0.5
_LEAST_PX = 0.3


def for_matching(image: Float32Array) -> Float32Array:
    """Blur an image by what alignment to sub-pixel takes."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), MATCHED_PX), dtype=np.float32)


def blur_to(image: Float32Array, step: Pair, own_step: Pair = (1.0, 1.0)) -> Float32Array:
    """
    Blur an image that resolves `own_step` pixels to one that resolves `step`, across and down.

    Where `step` is not the wider one nothing is to do; without it, sampling wider would alias.
    """
    return blur_by(image, blur_sigmas(step, own_step))


def blur_by(image: Float32Array, sigmas: Pair) -> Float32Array:
    """
    Blur an image by Gaussian sigmas across and down, pixels; where both are 0, not at all.

    As distance and lens do it: they mix light, of which a camera's values are about the root
    (sRGB: the power 0.45). Values mixed by themselves would move outlines to their bright side.
    """
    across, down = sigmas
    if max(across, down) == 0.0:
        return image
    light = image * image
    blurred = cv2.GaussianBlur(light, (0, 0), sigmaX=max(across, 0.01), sigmaY=max(down, 0.01))
    return np.asarray(np.sqrt(blurred), dtype=np.float32)


def blur_sigmas(step: Pair, own_step: Pair = (1.0, 1.0)) -> tuple[float, float]:
    """Sigmas of the blur of `blur_to`, pixels; zero where it would do next to nothing."""
    share = _SHARE**2
    across = share * (float(step[0]) ** 2 - float(own_step[0]) ** 2)
    down = share * (float(step[1]) ** 2 - float(own_step[1]) ** 2)
    return sigmas_of(across, down)


def sigmas_of(across_px2: float, down_px2: float) -> tuple[float, float]:
    """Sigmas of a blur with these variances, if any; zero where it would do next to nothing."""
    across, down = max(across_px2, 0.0) ** 0.5, max(down_px2, 0.0) ** 0.5
    return (across, down) if max(across, down) >= _LEAST_PX else (0.0, 0.0)


# Covariance that remains if noise did not matter: interpolation, and texture that isn't quite the
# same, pixels.
_FLOOR = np.diag([0.02**2, 0.02**2])
# Parts of a patch, each way, that may be out of place. Shift, gain and offset take of their
# freedom, and that few contribute to a variance raises the mean of what is divided by it: two
# more.
_PARTS, _TAKEN = 4, 4 + 2
# By this share the variance estimated from parts exceeds that of white noise once in ten cases.
_BY_CHANCE = 0.5


class Fits(NamedTuple):
    """
    What gives the accuracy of n aligned templates.

    `sizes` are width and height; `rows` (5, pixels) each, of which the first two are twice the
    gradients and the third the template; `seen` (pixels,) each what the image shows, without its
    mean; `xy` (n, 2) the centres; `gain` (n,); `left` (n,) the sum of the squares of what gain
    and shift don't explain; `by_gain` (n, 2) what gain explains of the gradients; `inverse`
    (n, 2, 2) of the normal matrices; `blurs` those of the search images, before.
    """

    sizes: list[tuple[int, int]]
    rows: list[Float32Array]
    seen: list[Float32Array]
    xy: FloatArray
    gain: FloatArray
    left: FloatArray
    by_gain: FloatArray
    inverse: FloatArray
    blurs: list[Pair]


def covariances(fits: Fits) -> FloatArray:
    """Covariances (n, 2, 2) of the centres."""
    n = len(fits.rows)
    away = np.zeros((n, 2, 3), np.float32)
    away[:, :, :2], away[:, :, 2] = np.eye(2), -fits.by_gain
    gradients = [each @ rows[:3] for each, rows in zip(away, fits.rows, strict=True)]
    corners = fits.xy - 0.5 * (np.array(fits.sizes) - 1)
    fractions = np.round(corners % 1.0, 1).tolist()
    passed = np.array(
        [
            _noise_passed(*each)
            for each in zip(gradients, fits.sizes, fractions, fits.blurs, strict=True)
        ]
    )
    pulls = [
        gradient * (seen / gain - rows[2])
        for gradient, seen, gain, rows in zip(
            gradients, fits.seen, fits.gain.astype(np.float32), fits.rows, strict=True
        )
    ]
    by_parts = np.array([_summed_squares(*each) for each in zip(pulls, fits.sizes, strict=True)])
    freedom = np.array([max(seen.size - 4, 1) for seen in fits.seen])
    variance = fits.left / freedom / fits.gain**2
    # The gradients are twice what they are called.
    covariance = 0.25 * variance[:, None, None] * (fits.inverse @ passed @ fits.inverse)
    unlike = 0.25 * (fits.inverse @ by_parts @ fits.inverse)
    noise = np.maximum(np.diagonal(covariance, axis1=1, axis2=2), _TINY)
    further = np.diagonal(unlike, axis1=1, axis2=2) / noise - _BY_CHANCE
    wider = np.sqrt(np.maximum(further, 1.0))
    return np.asarray(covariance * wider[:, :, None] * wider[:, None] + _FLOOR)


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
    passed = down @ gradients.reshape(2, height, width) @ across
    return np.asarray(gradients @ passed.reshape(2, -1).T, dtype=np.float64)


def _noise_correlation(blur_px: float, fraction: float, count: int) -> Float32Array:
    """Correlation (count, count) of the noise of so many pixels in a row, as a match sees it."""
    # In sizes of powers of two, and tenths: most of them are asked for again.
    return _correlations(blur_px, fraction, 1 << (count - 1).bit_length())[:count, :count]


@lru_cache(maxsize=256)
def _correlations(blur_px: float, fraction: float, count: int) -> Float32Array:
    # Blur, here and before, and interpolation at a fraction of a pixel, one after the other.
    sigma = math.hypot(MATCHED_PX, blur_px)
    reach = int(np.ceil(3.0 * sigma)) + 1
    gauss = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel = np.convolve(gauss, [1.0 - fraction, fraction])
    shared = np.zeros(count + len(kernel))
    shared[: len(kernel)] = np.correlate(kernel, kernel, 'full')[len(kernel) - 1 :]
    place = np.arange(count)
    apart = np.abs(place[:, None] - place)
    return np.asarray(shared[apart] / shared[0], dtype=np.float32)


def _summed_squares(pulls: Float32Array, size: tuple[int, int]) -> FloatArray:
    """Sum (2, 2) over parts of a patch of the squares of what pulls (2, pixels) come to there."""
    width, height = size
    stacked = pulls.reshape(2 * height, width)
    means = cv2.resize(stacked, (_PARTS, 2 * _PARTS), interpolation=cv2.INTER_AREA).reshape(2, -1)
    count = means.shape[1]
    in_each = width * height / count
    free = in_each**2 * count / (count - _TAKEN)
    return np.asarray(free * (means @ means.T), dtype=np.float64)


_ITERATIONS = 12
_CONVERGED_PX = 2e-3
_FARTHEST_PX = 2.0
_TINY = 1e-12
# Of a pixel and its neighbours: twice the gradients, the pixel itself, and the second differences:
# what blur adds to it.
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
    Where the centres of m templates lie in their images, `xy` (m, 2).

    `place` (m,) holds which of those given they are: the others don't align. `covariance`
    (m, 2, 2) is that of `xy`; `score` (m,) is the normalized cross-correlation there; `blur_px2`
    (m, 2) by how much more the image is blurred than the template.
    """

    place: list[int]
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
        With the blur of `for_matching`.
    starts : sequence of tuple of float
        Column and row of each template's upper left corner.
    search_blurs : sequence of tuple of float
        By what each search image was blurred before, Gaussian sigmas.
    """
    n = len(templates)
    sizes = [(template.shape[1] - 2, template.shape[0] - 2) for template in templates]
    rows = [_rows(template) for template in templates]
    normal = np.array([each @ each.T for each in rows], dtype=np.float64).reshape(n, 5, 5)
    with np.errstate(divide='ignore', invalid='ignore'):
        # What gain explains of the gradients, which are half of the first two rows.
        by_gain = normal[:, :2, 2] / normal[:, 2, 2, None]
        hessian = 0.25 * (normal[:, :2, :2] - by_gain[:, :, None] * normal[:, None, 2, :2])
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
    normal, hessian, inverse, by_gain = (a[good] for a in (normal, hessian, inverse, by_gain))
    total = np.array([float(each @ each) for each in seen])
    power = normal[:, 2, 2]
    further = ((step[:, None] @ hessian)[:, 0] * step).sum(axis=-1)
    fits = Fits(
        [sizes[k] for k in good],
        rows,
        seen,
        xy,
        gain,
        np.maximum(total - gain**2 * (power + further), 0.0),
        by_gain,
        inverse,
        [search_blurs[k] for k in good],
    )
    by_seen = np.array([its_rows @ each for its_rows, each in zip(rows, seen, strict=True)])
    return Alignment(
        good,
        xy,
        covariances(fits),
        gain * np.sqrt(power / np.maximum(total, _TINY)),
        _further_blur(normal, by_seen.astype(np.float64)),
    )


def _rows(template: Float32Array) -> Float32Array:
    """
    What pixels of a template, but for the outermost, are multiplied by, (5, pixels).

    What offset explains is taken out once and for all, so that each step needs one product with
    the image.
    """
    height, width = template.shape[0] - 2, template.shape[1] - 2
    shifted = as_strided(template, (3, 3, height, width), 2 * template.strides)
    rows = _STENCILS @ shifted.reshape(9, -1)
    rows -= rows.sum(axis=1, keepdims=True) / rows.shape[1]
    return np.asarray(rows, dtype=np.float32)


def _inverse(matrix: FloatArray) -> FloatArray:
    """Inverse of symmetric matrices (n, 2, 2); NaN where they leave a direction undetermined."""
    xx, xy, yy = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]
    determinant = xx * yy - xy * xy
    determinant[~(determinant > 1e-6 * (xx + yy) ** 2)] = np.nan
    adjugate = np.array([[yy, -xy], [-xy, xx]]).transpose(2, 0, 1)
    return np.asarray(adjugate / determinant[:, None, None])


class _Shift(NamedTuple):
    """Centre of a template, the last step there, and what the image showed of it before that."""

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
    Shift a template until it fits best.

    `terms` (7,) are the products of the template with its gradients and itself, and the inverse
    of the Hessian.
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
        if not (abs(x - x0) < _FARTHEST_PX and abs(y - y0) < _FARTHEST_PX):
            return None
        if abs(step_x) + abs(step_y) < _CONVERGED_PX:
            break
    return _Shift((x, y), (step_x, step_y), gain, seen)


def _without_mean(values: Float32Array) -> Float32Array:
    return np.asarray(values - values.sum() / values.size, dtype=np.float32)


def _further_blur(normal: FloatArray, by_seen: FloatArray) -> FloatArray:
    """
    By how much more images are blurred than their templates, (n, 2), to first order.

    A Gaussian of variance v adds v / 2 times the second derivative: of the products (n, 5, 5) of
    `_rows`, and those with the image (n, 5), what is left where gain and offset are taken out.
    """
    power, reference = normal[:, 2, 2], by_seen[:, 2]
    by_gain = normal[:, 3:, 2] / power[:, None]
    bends = normal[:, 3:, 3:] - by_gain[:, :, None] * normal[:, None, 2, 3:]
    seen = by_seen[:, 3:] - by_gain * reference[:, None]
    # A pattern that does not change one way says nothing of it.
    bends += 1e-3 * (bends[:, 0, 0] + bends[:, 1, 1])[:, None, None] * np.eye(2)
    added = (_inverse(bends) @ seen[..., None])[..., 0]
    return np.asarray(2.0 * (power / reference)[:, None] * added)
