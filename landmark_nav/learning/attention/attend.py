"""Attention to a panorama: features -> conspicuity -> saliency -> candidates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError
from landmark_nav.learning.attention.config import AttentionConfig, FEATURES
from landmark_nav.learning.attention.conspicuity import conspicuity_map, fuse
from landmark_nav.learning.attention.discriminability import refusal
from landmark_nav.learning.attention.features import (
    corner_map,
    edge_gradients,
    edge_map,
    FloatMap,
    intensity_map,
    vertical_edge_map,
)
from landmark_nav.learning.attention.selection import select
from landmark_nav.learning.attention.symmetry import halve, line_symmetry_map, point_symmetry_map
from landmark_nav.types import Candidate, ImageArray, Panorama, Refusal

__all__ = ['Attention', 'attend', 'saliency_map', 'select_candidates']

# A patch keeps this far from uncovered pixels, whose neighbours are blurred by interpolation.
_MARGIN_PX = 2


@dataclass(frozen=True, eq=False)
class Attention:
    """
    What attention found in a panorama.

    Parameters
    ----------
    candidates : tuple of Candidate
        Strongest first.
    refused : tuple of (Candidate, Refusal)
        Attended as well, but a neighbouring place could be mistaken for them.

    """

    candidates: tuple[Candidate, ...]
    refused: tuple[tuple[Candidate, Refusal], ...]


def select_candidates(panorama: Panorama, config: AttentionConfig) -> tuple[Candidate, ...]:
    """Patches of a panorama that are worth being reconstructed, strongest first."""
    return attend(panorama, config).candidates


def attend(panorama: Panorama, config: AttentionConfig) -> Attention:
    """
    Select candidates and say why others were refused.

    Raises
    ------
    LandmarkNavError
        The panorama is smaller than a patch.

    """
    height, width = panorama.mask.shape
    if min(height, width // 2) <= config.size_max_px:
        raise LandmarkNavError(
            f'panorama has {width} x {height} px, too small for patches of '
            f'{config.size_max_px} px: lower size_max_px or raise its resolution'
        )
    gray = _fill_uncovered(_to_gray(panorama.image), panorama.mask)
    saliency = saliency_map(gray, config)
    examine = partial(refusal, gray=gray, config=config)
    accepted, refused = select(saliency, _inside(panorama.mask), config, examine)
    first = max((c.saliency for c in accepted), default=1.0)
    return Attention(
        tuple(replace(c, saliency=c.saliency / first) for c in accepted),
        tuple((replace(c, saliency=c.saliency / first), why) for c, why in refused),
    )


def saliency_map(
    panorama_gray: ImageArray, config: AttentionConfig, feature: str | None = None
) -> FloatMap:
    """
    Saliency of a grey panorama, or the conspicuity of one feature alone.

    Parameters
    ----------
    panorama_gray : ndarray of uint8, shape (height, width)
        Of a full turn: the last column borders on the first.
    config : AttentionConfig
    feature : str, optional
        One of `FEATURES`; all of them with their weights if not given.

    Returns
    -------
    ndarray of float32, shape (height, width)
        In [0, 1].

    Raises
    ------
    LandmarkNavError
        Unknown feature.

    """
    if feature is not None and feature not in FEATURES:
        raise LandmarkNavError(
            f'attention knows no feature {feature!r}: take one of {", ".join(FEATURES)}'
        )
    weights = config.weights if feature is None else {feature: 1.0}
    height, width = panorama_gray.shape
    # Even sizes, so that half resolution is exact; the surround reaches three sigma.
    side = 2 * int(np.ceil(1.5 * config.surround_sigma_px)) + 2 * 16
    columns = np.arange(-side, width + side + width % 2) % width
    padded = panorama_gray.take(columns, axis=1)
    padded = cv2.copyMakeBorder(padded, 0, height % 2, 0, 0, cv2.BORDER_REPLICATE)
    maps = _feature_maps(padded, config, [name for name in weights if weights[name] > 0.0])
    sigmas = config.center_sigma_px / 2.0, config.surround_sigma_px / 2.0
    fused = fuse({name: conspicuity_map(m, *sigmas) for name, m in maps.items()}, weights)
    full = cv2.resize(fused, padded.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(full[:height, side : side + width])


def _feature_maps(
    gray: ImageArray, config: AttentionConfig, names: list[str]
) -> dict[str, FloatMap]:
    """Feature maps at half resolution, what they share computed once."""
    gradients = edge_gradients(gray, config.edge_low, config.edge_high)
    intensity = intensity_map(gray)
    compute: dict[str, Callable[[], FloatMap]] = {
        'intensity': lambda: halve(intensity),
        'edges': lambda: halve(edge_map(gradients)),
        'vertical_edges': lambda: halve(vertical_edge_map(gradients)),
        'corners': lambda: halve(corner_map(gradients)),
        'symmetry': lambda: point_symmetry_map(gradients),
        'line_symmetry': lambda: line_symmetry_map(intensity, config.edge_high / 255.0),
    }
    return {name: compute[name]() for name in names}


def _to_gray(image: ImageArray) -> ImageArray:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


def _fill_uncovered(gray: ImageArray, mask: npt.NDArray[np.bool_]) -> ImageArray:
    """Continue the picture into uncovered areas, whose rims would be edges otherwise."""
    if mask.all() or not mask.any():
        return gray
    labels = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )[1]
    value = np.zeros(int(labels.max()) + 1, dtype=np.uint8)
    value[labels[mask]] = gray[mask]
    return np.asarray(value[labels])


def _inside(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Covered pixels with covered pixels around, round the seam too."""
    columns = np.arange(-_MARGIN_PX, mask.shape[1] + _MARGIN_PX) % mask.shape[1]
    kernel = np.ones((2 * _MARGIN_PX + 1, 2 * _MARGIN_PX + 1), np.uint8)
    shrunk = cv2.erode(mask.take(columns, axis=1).astype(np.uint8), kernel)
    return np.asarray(shrunk[:, _MARGIN_PX:-_MARGIN_PX].astype(bool))
