"""
Where a template lies in an image: normalized cross-correlation, then sub-pixel alignment.

Both images must be of the same kind: the learner matches wall textures, the localizer pictures.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.types import FloatArray, Refusal

__all__ = ['Match', 'blur_to', 'match_template']

Float32Image = npt.NDArray[np.float32]

# Bilinear interpolation of raw pixels pulls the optimum towards whole pixels; this blur of both
# images takes that below 0.01 px (Gaussian sigma, pixels).
_BLUR_PX = 0.8
# Neighbouring pixels share noise after the blur and the interpolation, so that the residuals
# count for fewer than they are (measured by Monte Carlo).
_CORRELATION_AREA = 5.0
# What remains if noise did not matter: interpolation, and texture that isn't quite the same.
_FLOOR_PX = 0.02
_ITERATIONS = 12
_CONVERGED_PX = 2e-3


@dataclass(frozen=True, eq=False)
class Match:
    """
    A template found in a search image.

    `xy` (2,) is where the template's centre lies in the search image, pixels (fractional);
    `covariance` (2, 2) its covariance; `score` the normalized cross-correlation there and
    `second` that of the best other place.
    """

    xy: FloatArray
    covariance: FloatArray
    score: float
    second: float


def match_template(
    search: Float32Image,
    template: Float32Image,
    *,
    min_score: float = 0.7,
    max_second_ratio: float = 0.9,
    min_contrast: float = 4.0,
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
    min_contrast : float
        Least standard deviation of the template, grey levels.

    Returns
    -------
    Match or Refusal

    Notes
    -----
    The alignment is Gauss-Newton over shift, gain and offset with the template's gradients, whose
    normal matrix is the same in each step (Baker and Matthews, IJCV 56(3), 2004) and gives the
    covariance.

    """
    if float(np.std(template)) < min_contrast:
        return Refusal('blank template', f'contrast {np.std(template):.1f}')
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
    aligned = _align(search, template, column, row)
    if aligned is None:
        return Refusal('alignment failed')
    shift, covariance, fine_score = aligned
    center = np.array([(template.shape[1] - 1) / 2.0, (template.shape[0] - 1) / 2.0])
    return Match(center + shift, covariance, max(float(score), fine_score), second)


def blur_to(
    image: Float32Image, step: FloatArray, own_step: FloatArray | float = 1.0
) -> Float32Image:
    """
    Blur an image that resolves `own_step` (2,) pixels to one that resolves `step`, across, down.

    Where `step` is not the wider one nothing is to do; without it, sampling wider would alias.
    """
    sigma = 0.5 * np.sqrt(np.maximum(np.square(step) - np.square(own_step), 0.0))
    if sigma.max() < 0.3:
        return image
    x, y = np.maximum(sigma, 0.01)
    blurred = cv2.GaussianBlur(image, (0, 0), sigmaX=float(x), sigmaY=float(y))
    return np.asarray(blurred, dtype=np.float32)


def _smooth(image: Float32Image) -> Float32Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), _BLUR_PX), dtype=np.float32)


def _second_peak(scores: Float32Image, column: int, row: int, shape: tuple[int, ...]) -> float:
    """Best score away from the peak by more than a fifth of the template."""
    away_x, away_y = max(3, shape[1] // 5), max(3, shape[0] // 5)
    rest = scores.copy()
    rows = slice(max(0, row - away_y), row + away_y + 1)
    rest[rows, max(0, column - away_x) : column + away_x + 1] = -1.0
    # A slope down from the main peak is no peak of its own.
    inner = rest[1:-1, 1:-1]
    if inner.size == 0:
        return -1.0
    is_peak = inner >= cv2.dilate(scores, np.ones((3, 3), np.uint8))[1:-1, 1:-1]
    return float(np.max(inner, where=is_peak, initial=-1.0))


def _align(
    search: Float32Image, template: Float32Image, column: int, row: int
) -> tuple[FloatArray, FloatArray, float] | None:
    """Shift (2,) of the template's corner, its covariance, and the correlation there."""
    height, width = template.shape
    inner = (slice(1, -1), slice(1, -1))
    reference = template[inner].ravel()
    reference = reference - reference.mean()
    power = float(reference @ reference)
    # What gain and offset explain is taken out of the gradients once and for all, so that each
    # step needs no more than two products with the picture.
    gradient = np.stack(_gradients(template))
    gradient -= gradient.mean(1, keepdims=True)
    gradient -= np.outer(gradient @ reference / power, reference)
    normal = (gradient @ gradient.T).astype(np.float64)
    if np.linalg.det(normal) < 1e-6 * np.trace(normal) ** 2:
        return None
    inverse = np.linalg.inv(normal)

    corner = np.array([column, row], dtype=np.float64)
    center = np.array([(width - 1) / 2.0, (height - 1) / 2.0])
    shift, step, gain = np.zeros(2), np.zeros(2), 1.0
    for _ in range(_ITERATIONS):
        x, y = corner + center + shift
        seen = cv2.getRectSubPix(search, (width, height), (float(x), float(y)))
        value = np.asarray(seen, dtype=np.float32)[inner].ravel()
        gain = float(reference @ value) / power
        if gain <= 0.0:
            return None
        # value(x) ~ gain * reference(x - d) + offset
        step = -inverse @ (gradient @ value).astype(np.float64) / gain
        shift += step
        if not np.hypot(*shift) < 2.0:
            return None
        if np.hypot(*step) < _CONVERGED_PX:
            break
    value = value - value.mean()
    left = value - gain * reference + gain * (step @ gradient)
    variance = float(left @ left) / max(len(left) - 4, 1) * _CORRELATION_AREA / gain**2
    covariance = variance * inverse + np.eye(2) * _FLOOR_PX**2
    score = gain * np.sqrt(power / max(float(value @ value), 1e-12))
    return corner + shift, covariance, float(score)


def _gradients(image: Float32Image) -> tuple[Float32Image, Float32Image]:
    """Central differences inside the border, flattened."""
    grad_x = 0.5 * (image[1:-1, 2:] - image[1:-1, :-2])
    grad_y = 0.5 * (image[2:, 1:-1] - image[:-2, 1:-1])
    return grad_x.ravel(), grad_y.ravel()
