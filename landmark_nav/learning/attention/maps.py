"""
Saliency of a grey panorama: feature maps -> conspicuity maps -> weighted mean.

Feature maps are float32 in [0, 1]: intensity, edges, vertical edges, corners, and local symmetry
about points and about vertical lines. All but intensity and line symmetry use Canny edge pixels
only, so that noise on a bare wall is no feature. Symmetry is computed at half resolution, which is
fine enough for patches of about 30 px.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import Float32Array
from landmark_nav.errors import LandmarkNavError
from landmark_nav.parameters import Config, parameter
from landmark_nav.types import ImageArray

FEATURES = (
    'intensity',
    'edges',
    'vertical_edges',
    'corners',
    'symmetry',
    'radial_symmetry',
    'line_symmetry',
)


@dataclass(frozen=True)
class AttentionConfig(Config):
    """
    Weights of features, sizes of patches, and which patches are refused.

    The weight of a feature is proportional to the number of patches, proposed by it alone, that
    are found again beyond chance in the simulated rooms for tuning (docs/decisions.md).
    """

    # Weight of bright areas.
    weight_intensity: float = 0.0
    # Weight of Canny edges.
    weight_edges: float = 0.25
    # Weight of vertical edges, which determine bearings.
    weight_vertical_edges: float = 0.0
    # Weight of corners.
    weight_corners: float = 0.2
    # Weight of symmetry about a point.
    weight_symmetry: float = 0.25
    # Weight of symmetry about a point that edges vote for.
    weight_radial_symmetry: float = 0.2
    # Weight of symmetry about vertical lines.
    weight_line_symmetry: float = 0.1
    # Smallest width and height of a patch, px.
    size_min_px: int = 28
    # Largest width and height of a patch, px.
    size_max_px: int = 32
    # Step between sizes, px.
    size_step_px: int = 2
    candidates: int = parameter(120, 'patches per panorama at most', minimum=1, maximum=10000)
    # Smallest response, relative to the first.
    least_response: float = 0.1
    # Largest number of patches in a sector of azimuth.
    candidates_per_sector: int = 12
    # Neighbourhood to either side in which no similar patch may be, px.
    neighborhood_columns_px: int = 60
    # Neighbourhood up and down in which no similar patch may be, px.
    neighborhood_rows_px: int = 16

    @property
    def weights(self) -> dict[str, float]:
        """Weight of each of `FEATURES`."""
        return {name: float(getattr(self, f'weight_{name}')) for name in FEATURES}

    def alone(self, feature: str) -> AttentionConfig:
        """
        Return the configuration in which only one of `FEATURES` has a weight.

        Raises `LandmarkNavError`: unknown feature.
        """
        if feature not in FEATURES:
            raise LandmarkNavError(
                f'attention knows no feature {feature!r}: take one of {", ".join(FEATURES)}'
            )
        weights: dict[str, Any] = {f'weight_{name}': float(name == feature) for name in FEATURES}
        return replace(self, **weights)

    @property
    def sizes_px(self) -> tuple[int, ...]:
        """Possible widths and heights, ascending."""
        return tuple(range(self.size_min_px, self.size_max_px + 1, self.size_step_px))


# Scales of the ring that collects edges around a point, px of the full image; the weight is
# largest at a radius of sqrt(2) sigma.
_RING_SIGMAS_PX = (4.0, 8.0, 16.0)
# Mean edge strength of an almost empty ring, relative to strong edges everywhere.
_EMPTY = 0.02
# Radii of the circles that edges vote for, px of the full image.
_RADII_PX = (4, 8, 16)
# Number of votes of full symmetry, and exponent of radial strictness (Loy and Zelinsky); it
# excludes straight edges.
_FULL_VOTES = 9.9
_STRICTNESS = 2
# Half the width and height of the window in which two sides of a vertical line are compared, px of
# the full image.
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
    # A few stray edges in an almost empty ring are no symmetry.
    certainty = total / (total + np.float32(_EMPTY))
    total = np.maximum(total, np.float32(1e-6))
    symmetry = np.maximum(circular, 0.0) * np.maximum(total - linear, 0.0) / (total * total)
    return np.asarray(symmetry * certainty, dtype=np.float32)


def radial_symmetry_map(gradients: EdgeGradients) -> Float32Array:
    """
    Symmetry about a point at half resolution: edges vote for centres of circles.

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

    Row means are subtracted first, since horizontal edges are symmetric about any vertical line.

    Parameters
    ----------
    intensity : ndarray of float32, shape (height, width)
        Full resolution.
    contrast : float
        Contrast that counts as weak, in the units of `intensity`.
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
    """Mean over 2 x 2 pixels; height and width must be even."""
    size = (image.shape[1] // 2, image.shape[0] // 2)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


# Response of the Sobel kernel to a unit gradient.
_SOBEL_GAIN = 8.0
# Gaussian window over which the gradients of a corner are averaged, px.
_CORNER_SIGMA_PX = 2.5
# Percentile of the magnitude of edge pixels that counts as a strong edge.
_STRONG_EDGE_PERCENT = 90.0


@dataclass(frozen=True, eq=False)
class EdgeGradients:
    """
    Gradients on Canny edge pixels, zero elsewhere; grey levels per px.

    Parameters
    ----------
    dx, dy, magnitude : ndarray of float32, shape (height, width)
        Slopes to the right and downwards and their norm.
    strong : float
        Magnitude of a strong edge of this image; 1 where there is no edge.
    """

    dx: Float32Array
    dy: Float32Array
    magnitude: Float32Array
    strong: float


def edge_gradients(gray: ImageArray, low: float, high: float, side: int = 0) -> EdgeGradients:
    """
    Gradients on the Canny edges of a grey image (height, width).

    `low` and `high` are the thresholds of the hysteresis in grey levels per px; `side` columns at
    either end are repetitions and do not count in statistics. Canny, A Computational Approach to
    Edge Detection, PAMI 8(6), 1986.
    """
    smooth = cv2.GaussianBlur(gray, (0, 0), 1.0)
    sobel_x = cv2.Sobel(smooth, cv2.CV_16S, 1, 0)
    sobel_y = cv2.Sobel(smooth, cv2.CV_16S, 0, 1)
    edge = cv2.Canny(
        sobel_x, sobel_y, low * _SOBEL_GAIN, high * _SOBEL_GAIN, L2gradient=True
    ).astype(bool)
    dx = np.where(edge, sobel_x, 0).astype(np.float32) / np.float32(_SOBEL_GAIN)
    dy = np.where(edge, sobel_y, 0).astype(np.float32) / np.float32(_SOBEL_GAIN)
    # Not cv2.magnitude: its last bit depends on the alignment of the arrays in memory.
    magnitude = np.sqrt(dx * dx + dy * dy)
    turn = slice(side, edge.shape[1] - side)
    found = magnitude[:, turn][edge[:, turn]]
    strong = float(np.percentile(found, _STRONG_EDGE_PERCENT)) if found.size else 1.0
    return EdgeGradients(dx, dy, magnitude, strong)


def intensity_map(gray: ImageArray) -> Float32Array:
    """Brightness."""
    return np.asarray(gray.astype(np.float32) / np.float32(255.0))


def edge_map(gradients: EdgeGradients) -> Float32Array:
    """Contrast of edges in any direction."""
    return _unit(gradients.magnitude / np.float32(gradients.strong))


def vertical_edge_map(gradients: EdgeGradients) -> Float32Array:
    """
    Contrast of edges within 45 degrees of the vertical: |g| max(0, cos 2 angle).

    They determine bearings: shifted along the row, they do not match.
    """
    dx, dy, magnitude = gradients.dx, gradients.dy, gradients.magnitude
    slope = (dx * dx - dy * dy) / np.maximum(magnitude, np.float32(1e-3))
    return _unit(slope / np.float32(gradients.strong))


def corner_map(gradients: EdgeGradients) -> Float32Array:
    """
    Corners by the covariance of the gradients on edge pixels: root of its smaller eigenvalue.

    Zero along straight lines, even several parallel ones. Foerstner and Guelch, A Fast Operator
    for Detection and Precise Location of Distinct Points, 1987.
    """
    dx, dy = gradients.dx, gradients.dy
    xx, yy, xy = (
        cv2.GaussianBlur(product, (0, 0), _CORNER_SIGMA_PX)
        for product in (dx * dx, dy * dy, dx * dy)
    )
    smaller = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    # An ideal corner has one edge pixel of either direction per px in the window.
    full = gradients.strong / np.sqrt(2.0 * np.sqrt(2.0 * np.pi) * _CORNER_SIGMA_PX)
    return _unit(np.sqrt(np.maximum(smaller, 0.0)) / np.float32(full))


def _unit(values: npt.NDArray[np.floating]) -> Float32Array:
    return np.asarray(np.clip(values, 0.0, 1.0), dtype=np.float32)


# Smallest peak of a map; below, it holds only rounding errors.
_MIN_PEAK = 1e-3


def conspicuity_map(
    feature: Float32Array, center_sigma: float, surround_sigma: float, side: int = 0
) -> Float32Array:
    """
    Conspicuity: contrast of a feature with its surround, in [0, 1].

    Difference of Gaussians, rectified, then N(m) = m (1 - mean of the local maxima)^2, which
    lets a map with one peak pass and suppresses one with many equal peaks. Itti, Koch and
    Niebur, A Model of Saliency-Based Visual Attention, PAMI 20(11), 1998.

    Parameters
    ----------
    feature : ndarray of float32, shape (height, width)
    center_sigma, surround_sigma : float
        Gaussian sigmas, pixels of `feature`.
    side : int
        Number of repeated columns at either end, which do not count in statistics.
    """
    turn = slice(side, feature.shape[1] - side)
    center = cv2.GaussianBlur(feature, (0, 0), center_sigma)
    surround = cv2.GaussianBlur(feature, (0, 0), surround_sigma)
    stands_out = np.maximum(center - surround, 0.0)
    peak = float(stands_out[:, turn].max())
    if peak < _MIN_PEAK:
        return np.zeros_like(feature)
    stands_out /= np.float32(peak)
    reach = 2 * int(np.ceil(surround_sigma)) + 1
    highest = cv2.dilate(stands_out, np.ones((reach, reach), np.uint8))
    is_peak = (stands_out == highest) & (stands_out > 0.0)
    maxima = stands_out[:, turn][is_peak[:, turn]]
    others = float(maxima[maxima < 1.0].mean()) if np.any(maxima < 1.0) else 0.0
    return np.asarray(stands_out * np.float32((1.0 - others) ** 2), dtype=np.float32)


def fuse(conspicuities: Mapping[str, Float32Array], weights: Mapping[str, float]) -> Float32Array:
    """Weighted mean of conspicuity maps of the same shape."""
    total = sum(weights[name] for name in conspicuities)
    fused = sum(np.float32(weights[name] / total) * m for name, m in conspicuities.items())
    return np.asarray(fused, dtype=np.float32)


# Sigmas of the difference of Gaussians, px of the panorama.
CENTER_SIGMA_PX, SURROUND_SIGMA_PX = 4.0, 16.0
# Thresholds of the hysteresis of Canny edges, grey levels per px: chosen by hand.
_EDGE_LOW, _EDGE_HIGH = 4.0, 10.0


@dataclass(frozen=True, eq=False)
class AttentionMaps:
    """
    All maps of attention, float32 in [0, 1].

    `features` and `conspicuities` are by name, for weights above 0, at half resolution and with
    `side` repeated columns at either end; `saliency` has the size of the panorama.
    """

    features: dict[str, Float32Array]
    conspicuities: dict[str, Float32Array]
    saliency: Float32Array
    side: int


def attention_maps(panorama_gray: ImageArray, config: AttentionConfig) -> AttentionMaps:
    """
    Compute feature, conspicuity and saliency maps of a grey panorama.

    Parameters
    ----------
    panorama_gray : ndarray of uint8, shape (height, width)
        Full turn: the last column borders on the first.
    """
    weights = {name: weight for name, weight in config.weights.items() if weight > 0.0}
    height, width = panorama_gray.shape
    # Even sizes, so that half resolution is exact; the surround reaches three sigma.
    side = 2 * int(np.ceil(1.5 * SURROUND_SIGMA_PX)) + 2 * 16
    columns = np.arange(-side, width + side + width % 2) % width
    padded = panorama_gray.take(columns, axis=1)
    padded = cv2.copyMakeBorder(padded, 0, height % 2, 0, 0, cv2.BORDER_REPLICATE)
    features = _feature_maps(padded, list(weights), side)
    sigmas = CENTER_SIGMA_PX / 2.0, SURROUND_SIGMA_PX / 2.0
    conspicuities = {name: conspicuity_map(m, *sigmas, side // 2) for name, m in features.items()}
    fused = fuse(conspicuities, weights)
    full = cv2.resize(fused, padded.shape[::-1], interpolation=cv2.INTER_LINEAR)
    saliency = np.asarray(full[:height, side : side + width], np.float32, order='C')
    return AttentionMaps(features, conspicuities, saliency, side // 2)


def _feature_maps(gray: ImageArray, names: list[str], side: int) -> dict[str, Float32Array]:
    """Feature maps at half resolution."""
    gradients = edge_gradients(gray, _EDGE_LOW, _EDGE_HIGH, side)
    intensity = intensity_map(gray)
    compute: dict[str, Callable[[], Float32Array]] = {
        'intensity': lambda: halve(intensity),
        'edges': lambda: halve(edge_map(gradients)),
        'vertical_edges': lambda: halve(vertical_edge_map(gradients)),
        'corners': lambda: halve(corner_map(gradients)),
        'symmetry': lambda: point_symmetry_map(gradients),
        'radial_symmetry': lambda: radial_symmetry_map(gradients),
        'line_symmetry': lambda: line_symmetry_map(intensity, _EDGE_HIGH / 255.0),
    }
    return {name: compute[name]() for name in names}
