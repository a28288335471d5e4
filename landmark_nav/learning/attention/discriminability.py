"""Refuse patches that a neighbouring place could be mistaken for."""

from __future__ import annotations

import cv2
import numpy as np

from landmark_nav.learning.attention.config import AttentionConfig
from landmark_nav.types import Candidate, ImageArray, Refusal

__all__ = ['refusal']

# A neighbour closer than this share of the patch is the patch itself, merely shifted.
_SAME_PLACE = 0.25
# Largest predicted noise of a match along the row, px.
_MOST_BEARING_SIGMA_PX = 0.05
# Largest correlation with another place near by (docs/decisions.md, attention).
_MOST_ALIKE = 0.75
# Noise of one frame, standard deviation in grey levels: about that of the simulated camera at
# middle brightness, sqrt(2^2 + 0.06 x 120) = 3.3.
_NOISE_GRAY = 3.0
# Standard deviation of the Gaussian before gradients are taken, px.
_SMOOTHING_PX = 1.0


def refusal(candidate: Candidate, gray: ImageArray, config: AttentionConfig) -> Refusal | None:
    """
    Say why a patch of a panorama could be mistaken, or None if it is distinct.

    Parameters
    ----------
    candidate : Candidate
    gray : ndarray of uint8, shape (height, width)
        Of a full turn: the last column borders on the first.
    config : AttentionConfig

    """
    window, column, row = _neighborhood(candidate, gray, config)
    patch = window[row : row + candidate.height_px, column : column + candidate.width_px]
    sigma_px = _bearing_sigma_px(patch)
    if sigma_px > _MOST_BEARING_SIGMA_PX:
        found = f'a match would vary by {sigma_px:.2f} px' if np.isfinite(sigma_px) else 'noise'
        return Refusal('too little contrast along the row', found)
    score = cv2.matchTemplate(window, np.ascontiguousarray(patch), cv2.TM_CCOEFF_NORMED)
    columns_away = np.abs(np.arange(score.shape[1]) - column)
    rows_away = np.abs(np.arange(score.shape[0]) - row)
    elsewhere = (columns_away > _SAME_PLACE * candidate.width_px) | (
        rows_away[:, None] > _SAME_PLACE * candidate.height_px
    )
    score = np.where(elsewhere & np.isfinite(score), score, -1.0)
    at = np.unravel_index(int(np.argmax(score)), score.shape)
    if score[at] > _MOST_ALIKE:
        return Refusal(
            'looks like a place near by',
            f'correlation {score[at]:.2f} at {at[1] - column:+d} columns, {at[0] - row:+d} rows',
        )
    return None


def _neighborhood(
    candidate: Candidate, gray: ImageArray, config: AttentionConfig
) -> tuple[ImageArray, int, int]:
    """Cut out what surrounds a patch; return it and where in it the patch begins."""
    height, width = gray.shape
    left = round(candidate.column - (candidate.width_px - 1) / 2.0)
    top = round(candidate.row - (candidate.height_px - 1) / 2.0)
    around, along = config.neighborhood_rows_px, config.neighborhood_columns_px
    first = max(0, top - around)
    last = min(height, top + candidate.height_px + around)
    columns = np.arange(left - along, left + candidate.width_px + along) % width
    return gray[first:last].take(columns, axis=1), along, top - first


def _bearing_sigma_px(patch: ImageArray) -> float:
    """
    Noise along the row of a least-squares match between two images of a patch, px.

    The Cramer-Rao bound sqrt(2) noise / |gradients|, with the shift along the column unknown
    too: a patch of one slanted edge fixes neither. The gradients are taken from a smoothed patch
    and cleared of what noise adds to them, since noise is not found again.
    """
    image = cv2.GaussianBlur(patch.astype(np.float32), (0, 0), _SMOOTHING_PX)
    dx = 0.5 * (image[1:-1, 2:] - image[1:-1, :-2])
    dy = 0.5 * (image[2:, 1:-1] - image[:-2, 1:-1])
    noise = dx.size * _NOISE_GRAY**2 / (8.0 * np.pi * _SMOOTHING_PX**4)
    xx, yy, xy = float(np.sum(dx * dx)), float(np.sum(dy * dy)), float(np.sum(dx * dy))
    information = xx - noise - (xy * xy / yy if yy > 0.0 else 0.0)
    if information <= 0.0:
        return float('inf')
    return float(np.sqrt(2.0 * _NOISE_GRAY**2 / information))
