"""Attention to a panorama: features -> conspicuity -> saliency -> candidates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError
from landmark_nav.learning.attention.maps import attention_maps, AttentionConfig
from landmark_nav.learning.attention.selection import edges_among, refusal, select
from landmark_nav.types import Candidate, ImageArray, Panorama, Refusal

# A patch keeps this far from uncovered pixels, whose neighbours are blurred by interpolation.
_MARGIN_PX = 2


@dataclass(frozen=True, eq=False)
class Attention:
    """
    Result of attention to a panorama.

    Parameters
    ----------
    candidates : tuple of Candidate
        Most salient first, then edges.
    refused : tuple of (Candidate, Refusal)
        Attended patches that are ambiguous.
    """

    candidates: tuple[Candidate, ...]
    refused: tuple[tuple[Candidate, Refusal], ...]


def attend(panorama: Panorama, config: AttentionConfig) -> Attention:
    """
    Select candidates, and return why others were refused.

    Raises `LandmarkNavError`: the panorama is smaller than a patch.
    """
    height, width = panorama.mask.shape
    if min(height, width // 2) <= config.size_max_px:
        raise LandmarkNavError(
            f'panorama has {width} x {height} px, too small for patches of '
            f'{config.size_max_px} px: lower size_max_px or raise its resolution'
        )
    gray = _fill_uncovered(_to_gray(panorama.image), panorama.mask)
    saliency = attention_maps(gray, config).saliency
    examine = partial(refusal, gray=gray, config=config)
    accepted, refused = select(saliency, _inside(panorama.mask), config, examine)
    edges, others = edges_among(refused, accepted, gray, config)
    candidates = (*accepted, *edges)
    first = max((c.saliency for c in candidates), default=1.0)
    return Attention(
        tuple(replace(c, saliency=c.saliency / first) for c in candidates),
        tuple((replace(c, saliency=c.saliency / first), why) for c, why in others),
    )


def _to_gray(image: ImageArray) -> ImageArray:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


def _fill_uncovered(gray: ImageArray, mask: npt.NDArray[np.bool_]) -> ImageArray:
    """Continue the image into uncovered areas, so that their borders are not edges."""
    if mask.all() or not mask.any():
        return gray
    labels = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )[1]
    value = np.zeros(int(labels.max()) + 1, dtype=np.uint8)
    value[labels[mask]] = gray[mask]
    return np.asarray(value[labels])


def _inside(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Covered pixels surrounded by covered pixels, also across the seam."""
    columns = np.arange(-_MARGIN_PX, mask.shape[1] + _MARGIN_PX) % mask.shape[1]
    kernel = np.ones((2 * _MARGIN_PX + 1, 2 * _MARGIN_PX + 1), np.uint8)
    shrunk = cv2.erode(mask.take(columns, axis=1).astype(np.uint8), kernel)
    return np.asarray(shrunk[:, _MARGIN_PX:-_MARGIN_PX].astype(bool))
