"""Template matching by the peak of the normalized cross-correlation."""

from __future__ import annotations

from dataclasses import replace
import math

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array
from landmark_nav.matching.alignment import align, for_matching, Match, Pair
from landmark_nav.types import Refusal, RefusalCode

# Smallest standard deviation of a template, grey levels.
_MIN_CONTRAST = 4.0
_NEIGHBOURS = np.ones((3, 3), np.uint8)


def match_template(
    search: Float32Array,
    template: Float32Array,
    *,
    min_score: float = 0.7,
    max_second_ratio: float = 0.9,
    search_blur: Pair = (0.0, 0.0),
    edge: bool = False,
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
        Smallest correlation that counts as found.
    max_second_ratio : float
        Largest score of another peak, relative to the best.
    search_blur : tuple of float
        Gaussian sigmas of the earlier blur of the search image, across and down, pixels; its noise
        is correlated accordingly.
    edge : bool
        Whether the template is an upright edge: any row of the search image may be the right one.
    """
    contrast = float(cv2.meanStdDev(template)[1][0, 0])
    if contrast < _MIN_CONTRAST:
        return Refusal('blank template', f'contrast {contrast:.1f}')
    search, template = for_matching(search), for_matching(template)
    found = cv2.matchTemplate(search, template, cv2.TM_CCOEFF_NORMED)
    scores = np.asarray(found, dtype=np.float32)
    first, along_px = np.zeros(scores.shape[1]), 0.0
    if edge:
        # Any row may be the right one: the best of each column counts.
        first, along_px = scores.argmax(axis=0) - 1.0, scores.shape[0] / math.sqrt(12.0)
        scores = np.pad(scores.max(axis=0)[None], ((1, 1), (0, 0)), constant_values=-1.0)
    _, score, _, (column, row) = cv2.minMaxLoc(scores)
    if score < min_score:
        return Refusal(
            'low correlation', f'{score:.2f} < {min_score:.2f}', RefusalCode.LOW_CORRELATION
        )
    if not (0 < column < scores.shape[1] - 1 and 0 < row < scores.shape[0] - 1):
        return Refusal('peak at the border of the search window')
    limit = max_second_ratio * score
    second = _second_peak(scores, column, row, template.shape, limit)
    if second > limit:
        return Refusal('ambiguous', f'second peak {second:.2f} of {score:.2f}')
    across, down = _parabola_peak(scores, column, row)
    start = across, down + float(first[column])
    match = align(search, template, start, search_blur, along_px)
    if match is None:
        return Refusal('alignment failed')
    return match if match.score >= score else replace(match, score=score)


def _second_peak(
    scores: Float32Array, column: int, row: int, shape: tuple[int, ...], limit: float
) -> float:
    """Best peak above `limit`, more than a fifth of the template away from the best; else -1."""
    away_x, away_y = max(3, shape[1] // 5), max(3, shape[0] // 5)
    away = scores.copy()
    away[
        max(0, row - away_y) : row + away_y + 1, max(0, column - away_x) : column + away_x + 1
    ] = -1.0
    if cv2.minMaxLoc(away)[1] <= limit:
        return -1.0
    # Only local maxima count, not the slope of the main peak.
    is_peak = scores >= cv2.dilate(scores, _NEIGHBOURS)
    inner = (slice(1, -1), slice(1, -1))
    return float(np.max(away[inner], where=is_peak[inner], initial=-1.0))


def _parabola_peak(scores: Float32Array, column: int, row: int) -> tuple[float, float]:
    """Sub-pixel maximum of parabolas through the peak of the scores and its neighbours."""
    top = float(scores[row, column])
    left, right = float(scores[row, column - 1]), float(scores[row, column + 1])
    above, below = float(scores[row - 1, column]), float(scores[row + 1, column])
    bend_x, bend_y = left - 2.0 * top + right, above - 2.0 * top + below
    return (
        column + (0.5 * (left - right) / bend_x if bend_x < 0.0 else 0.0),
        row + (0.5 * (above - below) / bend_y if bend_y < 0.0 else 0.0),
    )
