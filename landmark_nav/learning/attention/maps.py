"""
Saliency of a grey panorama: feature maps -> conspicuity maps -> weighted mean.

Feature maps are float32 in [0, 1]: edges, corners, and local symmetry about points. All use Canny
edge pixels only, so that noise on a bare wall is no feature, and have half the resolution of the
panorama, which is fine enough for patches of about 30 px.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import Float32Array
from landmark_nav.errors import LandmarkNavError
from landmark_nav.parameters import Config, parameter
from landmark_nav.types import ImageArray

FEATURES = ('edges', 'corners', 'symmetry')


@dataclass(frozen=True)
class AttentionConfig(Config):
    """
    Weights of features, sizes of patches, and which patches are refused.

    The weight of a feature is proportional to the number of patches, proposed by it alone, that
    are found again beyond chance in the simulated rooms for tuning (docs/decisions.md).
    """

    weight_edges: float = 0.25
    weight_corners: float = 0.2
    # Weight of symmetry about a point.
    weight_symmetry: float = 0.25
    # Widths and heights of patches.
    size_min_px: int = 28
    size_max_px: int = 32
    size_step_px: int = 2
    candidates: int = parameter(120, 'patches per panorama at most', minimum=1, maximum=10000)
    # Smallest response, relative to the first.
    least_response: float = 0.1
    # Largest number of patches in a sector of azimuth.
    candidates_per_sector: int = 12
    # Neighbourhood, to either side and up and down, in which no similar patch may be.
    neighborhood_columns_px: int = 60
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
    Gradients (height, width) on Canny edge pixels, zero elsewhere; grey levels per px.

    `strong` is the magnitude of a strong edge of this image; 1 where there is no edge.
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
    lets a map with one peak pass and suppresses one with many equal peaks. Sigmas are in pixels of
    the feature map (height, width); `side` columns at either end are repetitions and do not count
    in statistics. Itti, Koch and Niebur, A Model of Saliency-Based Visual Attention, PAMI 20(11),
    1998.
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
    """Maps of a grey panorama (height, width), whose last column borders on the first."""
    weights = {name: weight for name, weight in config.weights.items() if weight > 0.0}
    height, width = panorama_gray.shape
    # Even sizes, so that half resolution is exact; the surround reaches three sigma.
    side = 2 * int(np.ceil(1.5 * SURROUND_SIGMA_PX)) + 2 * 16
    columns = np.arange(-side, width + side + width % 2) % width
    padded = panorama_gray.take(columns, axis=1)
    padded = cv2.copyMakeBorder(padded, 0, height % 2, 0, 0, cv2.BORDER_REPLICATE)
    gradients = edge_gradients(padded, _EDGE_LOW, _EDGE_HIGH, side)
    features = {
        'edges': halve(_unit(gradients.magnitude / np.float32(gradients.strong))),
        'corners': halve(corner_map(gradients)),
        'symmetry': point_symmetry_map(gradients),
    }
    features = {name: features[name] for name in weights}
    sigmas = CENTER_SIGMA_PX / 2.0, SURROUND_SIGMA_PX / 2.0
    conspicuities = {name: conspicuity_map(m, *sigmas, side // 2) for name, m in features.items()}
    total = sum(weights.values())
    fused = sum(np.float32(weights[name] / total) * m for name, m in conspicuities.items())
    fused = np.asarray(fused, dtype=np.float32)
    full = cv2.resize(fused, padded.shape[::-1], interpolation=cv2.INTER_LINEAR)
    saliency = np.asarray(full[:height, side : side + width], np.float32, order='C')
    return AttentionMaps(features, conspicuities, saliency, side // 2)
