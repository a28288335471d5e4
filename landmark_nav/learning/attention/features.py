"""
Feature maps: intensity, edges, vertical edges and corners, each float32 in [0, 1].

All but intensity live on Canny edge pixels only, so that noise on a bare wall has no features.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import Float32Array
from landmark_nav.types import ImageArray

__all__ = [
    'EdgeGradients',
    'corner_map',
    'edge_gradients',
    'edge_map',
    'intensity_map',
    'vertical_edge_map',
]


# A Sobel kernel adds up eight times the slope.
_SOBEL_GAIN = 8.0
# Over how far the gradients of a corner are collected, px.
_CORNER_SIGMA_PX = 2.5
# The share of edge pixels that is as strong as an edge needs to be to count fully.
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
    either end are there twice, and count once. Canny, A Computational Approach to Edge
    Detection, PAMI 8(6), 1986.
    """
    smooth = cv2.GaussianBlur(gray, (0, 0), 1.0)
    sobel_x = cv2.Sobel(smooth, cv2.CV_16S, 1, 0)
    sobel_y = cv2.Sobel(smooth, cv2.CV_16S, 0, 1)
    edge = cv2.Canny(
        sobel_x, sobel_y, low * _SOBEL_GAIN, high * _SOBEL_GAIN, L2gradient=True
    ).astype(bool)
    dx = np.where(edge, sobel_x, 0).astype(np.float32) / np.float32(_SOBEL_GAIN)
    dy = np.where(edge, sobel_y, 0).astype(np.float32) / np.float32(_SOBEL_GAIN)
    # Not cv2.magnitude: its last bit depends on where the arrays lie in memory.
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

    They are what fixes a bearing: shifted along the row, they no longer match.
    """
    dx, dy, magnitude = gradients.dx, gradients.dy, gradients.magnitude
    slope = (dx * dx - dy * dy) / np.maximum(magnitude, np.float32(1e-3))
    return _unit(slope / np.float32(gradients.strong))


def corner_map(gradients: EdgeGradients) -> Float32Array:
    """
    Corners by the covariance of the gradients on edge pixels: root of its smaller eigenvalue.

    Zero along straight lines, also several parallel ones. Foerstner and Guelch, A Fast Operator
    for Detection and Precise Location of Distinct Points, 1987.
    """
    dx, dy = gradients.dx, gradients.dy
    xx, yy, xy = (
        cv2.GaussianBlur(product, (0, 0), _CORNER_SIGMA_PX)
        for product in (dx * dx, dy * dy, dx * dy)
    )
    smaller = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    # An ideal corner has an edge pixel of either direction per px inside the window.
    full = gradients.strong / np.sqrt(2.0 * np.sqrt(2.0 * np.pi) * _CORNER_SIGMA_PX)
    return _unit(np.sqrt(np.maximum(smaller, 0.0)) / np.float32(full))


def _unit(values: npt.NDArray[np.floating]) -> Float32Array:
    return np.asarray(np.clip(values, 0.0, 1.0), dtype=np.float32)
