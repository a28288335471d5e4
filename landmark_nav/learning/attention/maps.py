"""From a grey panorama to its saliency: features -> conspicuity -> weighted mean."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array
from landmark_nav.learning.attention.config import AttentionConfig
from landmark_nav.learning.attention.conspicuity import conspicuity_map, fuse
from landmark_nav.learning.attention.features import (
    corner_map,
    edge_gradients,
    edge_map,
    intensity_map,
    vertical_edge_map,
)
from landmark_nav.learning.attention.symmetry import (
    halve,
    line_symmetry_map,
    point_symmetry_map,
    radial_symmetry_map,
)
from landmark_nav.types import ImageArray

__all__ = ['CENTER_SIGMA_PX', 'SURROUND_SIGMA_PX', 'AttentionMaps', 'attention_maps']

# Difference of Gaussians between what is at a place and around it, px of the panorama.
CENTER_SIGMA_PX, SURROUND_SIGMA_PX = 4.0, 16.0
# Gradients at which an edge goes on and starts, grey levels per px: chosen by hand.
_EDGE_LOW, _EDGE_HIGH = 4.0, 10.0


@dataclass(frozen=True, eq=False)
class AttentionMaps:
    """
    Every step to saliency, float32 in [0, 1].

    `features` and `conspicuities` by name, for weights above 0, at half resolution and with
    `side` columns of the turn repeated on either side; `saliency` is as large as the panorama.
    """

    features: dict[str, Float32Array]
    conspicuities: dict[str, Float32Array]
    saliency: Float32Array
    side: int


def attention_maps(panorama_gray: ImageArray, config: AttentionConfig) -> AttentionMaps:
    """
    Compute what attracts attention in a grey panorama.

    Parameters
    ----------
    panorama_gray : ndarray of uint8, shape (height, width)
        Of a full turn: the last column borders on the first.
    config : AttentionConfig

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
    """Feature maps at half resolution, what they share computed once."""
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
