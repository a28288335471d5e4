"""
Local symmetry about a point and about vertical lines, float32 in [0, 1].

Both work at half resolution: symmetry of a patch of some 30 px shows nothing below 2 px.
"""

from __future__ import annotations

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array
from landmark_nav.learning.attention.features import EdgeGradients

__all__ = ['halve', 'line_symmetry_map', 'point_symmetry_map', 'radial_symmetry_map']

# Scales of the ring that collects edges about a point, in px of the full image; it weighs most
# at sqrt(2) times as much.
_RING_SIGMAS_PX = (4.0, 8.0, 16.0)
# Mean edge strength, as a share of a strong edge everywhere, below which a ring is empty.
_EMPTY = 0.02
# Radii of the circles that edges vote for, in px of the full image.
_RADII_PX = (4, 8, 16)
# Votes that make a point fully symmetric, and how strictly they must come from all sides: Loy and
# Zelinsky's values, and strict enough to leave straight edges out.
_FULL_VOTES = 9.9
_STRICTNESS = 2
# Half the width and height over which two sides of a vertical line are compared, full px.
_HALF_WIDTH_PX = 16
_HALF_HEIGHT_PX = 16


def point_symmetry_map(gradients: EdgeGradients) -> Float32Array:
    """
    Symmetry about a point at half resolution: edges that lie on circles around it.

    With the gradient in double-angle representation z, ``c = Re(w e^(-2i phi) * z) / w * |z|``
    is 1 for concentric patterns, dark or bright, and ``l = |w * z| / w * |z|`` is 1 for straight
    parallel lines; the map is c (1 - l), the largest over the sizes of w. Without the second
    factor, any horizontal edge would be symmetric about points beside it. The weight
    ``w = r^2 exp(-r^2 / 2 s^2)`` makes all filters separable, and a circle seen at 50 degrees
    keeps c above 0.7. Bigun and Granlund, Optimal Orientation Detection of Linear Symmetry,
    ICCV 1987; Bigun, Recognition of Local Symmetries in Gray Value Images by Harmonic
    Functions, ICPR 1988.
    """
    dx, dy, magnitude = gradients.dx, gradients.dy, gradients.magnitude
    norm = np.float32(gradients.strong) * np.maximum(magnitude, np.float32(1e-3))
    real = halve((dx * dx - dy * dy) / norm)
    imaginary = halve(2.0 * dx * dy / norm)
    strength = halve(magnitude / np.float32(gradients.strong))
    best = np.zeros_like(strength)
    for sigma_px in _RING_SIGMAS_PX:
        np.maximum(best, _ring_symmetry(real, imaginary, strength, sigma_px / 2.0), out=best)
    return best


def _ring_symmetry(
    real: Float32Array, imaginary: Float32Array, strength: Float32Array, sigma: float
) -> Float32Array:
    reach = int(np.ceil(3.5 * sigma))
    x = np.arange(-reach, reach + 1, dtype=np.float32)
    bell = np.exp(-0.5 * (x / sigma) ** 2)
    bell /= bell.sum()
    first, second = x / sigma * bell, (x / sigma) ** 2 * bell

    def ring(image: Float32Array, sign: float) -> Float32Array:
        """Weight w (sign 1) or w cos 2 phi (sign -1), normalised to the sum of w."""
        wide = cv2.sepFilter2D(image, -1, second, bell)
        high = cv2.sepFilter2D(image, -1, bell, second)
        return np.asarray(0.5 * (wide + sign * high))

    total = ring(strength, 1.0)
    circular = ring(real, -1.0) + cv2.sepFilter2D(imaginary, -1, first, first)
    linear = np.sqrt(ring(real, 1.0) ** 2 + ring(imaginary, 1.0) ** 2)
    # Divided by what a full ring would hold, so that a few stray edges are no symmetry.
    certainty = total / (total + np.float32(_EMPTY))
    total = np.maximum(total, np.float32(1e-6))
    symmetry = np.maximum(circular, 0.0) * np.maximum(total - linear, 0.0) / (total * total)
    return np.asarray(symmetry * certainty, dtype=np.float32)


def radial_symmetry_map(gradients: EdgeGradients) -> Float32Array:
    """
    Symmetry about a point at half resolution: edges vote for what they lie on a circle around.

    Each edge pixel votes for the points that lie one radius up and one down its gradient, with
    opposite signs: bright and dark centres collect votes of one sign, from all sides; points
    beside a straight edge get one vote each. The largest over the radii. Loy and Zelinsky, Fast
    Radial Symmetry for Detecting Points of Interest, PAMI 25(8), 2003, the fast form of Reisfeld,
    Wolfson and Yeshurun, Context-Free Attentional Operators, IJCV 14, 1995.
    """
    height, width = (side // 2 for side in gradients.magnitude.shape)
    row, column = np.nonzero(gradients.magnitude)
    magnitude = gradients.magnitude[row, column]
    up_x = gradients.dx[row, column] / magnitude
    up_y = gradients.dy[row, column] / magnitude
    strength = np.minimum(magnitude / np.float32(gradients.strong), np.float32(1.0))
    best = np.zeros((height, width), np.float32)
    for radius in _RADII_PX:
        votes, weight = np.zeros(height * width), np.zeros(height * width)
        for sign in (1, -1):
            at_row = (row + np.rint(sign * radius * up_y).astype(np.intp)) // 2
            at_column = (column + np.rint(sign * radius * up_x).astype(np.intp)) // 2
            inside = (at_row >= 0) & (at_row < height) & (at_column >= 0) & (at_column < width)
            at = at_row[inside] * width + at_column[inside]
            votes += sign * np.bincount(at, minlength=len(votes))
            weight += sign * np.bincount(at, strength[inside], minlength=len(weight))
        share = np.minimum(np.abs(votes) / _FULL_VOTES, 1.0) ** _STRICTNESS
        share *= np.minimum(np.abs(weight) / _FULL_VOTES, 1.0)
        ring = share.reshape(height, width).astype(np.float32)
        # A quarter of the radius, at half resolution.
        np.maximum(best, cv2.GaussianBlur(ring, (0, 0), radius / 8.0), out=best)
    return best


def line_symmetry_map(intensity: Float32Array, contrast: float) -> Float32Array:
    """
    Symmetry about vertical lines at half resolution: correlation of both sides, one mirrored.

    Row means are taken away first, since horizontal edges are symmetric about any vertical line.

    Parameters
    ----------
    intensity : ndarray of float32, shape (height, width)
        Full resolution.
    contrast : float
        Contrast below which there is nothing to compare, in the units of `intensity`.

    """
    half = halve(intensity)
    reach, rise = _HALF_WIDTH_PX // 2, _HALF_HEIGHT_PX // 2
    detail = half - cv2.blur(half, (2 * reach + 1, 1))
    width = detail.shape[1]
    padded = cv2.copyMakeBorder(detail, 0, 0, reach, reach, cv2.BORDER_REFLECT)
    product = np.zeros_like(detail)
    energy = np.zeros_like(detail)
    for offset in range(1, reach + 1):
        left = padded[:, reach - offset : reach - offset + width]
        right = padded[:, reach + offset : reach + offset + width]
        product += left * right
        energy += left * left + right * right
    window = (1, 2 * rise + 1)
    product, energy = cv2.blur(product, window), cv2.blur(energy, window)
    floor = np.float32(2 * reach * contrast**2)
    return np.asarray(np.clip(2.0 * product / (energy + floor), 0.0, 1.0), dtype=np.float32)


def halve(image: Float32Array) -> Float32Array:
    """Mean over 2 x 2 pixels; height and width are even."""
    size = (image.shape[1] // 2, image.shape[0] // 2)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
