"""Template matching by the peak of the normalized cross-correlation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array, FloatArray
from landmark_nav.matching.alignment import align, for_matching, Pair
from landmark_nav.types import Refusal, RefusalCode

# Smallest standard deviation of a template, grey levels.
_MIN_CONTRAST = 4.0
_NEIGHBOURS = np.ones((3, 3), np.uint8)


class Query(NamedTuple):
    """
    A template, and the image to search.

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
    """

    search: Float32Array
    template: Float32Array
    min_score: float = 0.7
    max_second_ratio: float = 0.9
    search_blur: Pair = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Match:
    """
    A template found in a search image.

    `xy` (2,) is the centre of the template in the search image, pixels (fractional); `covariance`
    (2, 2) its covariance; `score` the normalized cross-correlation there. `blur_px2` (2,) is the
    variance of the blur of the search image relative to the template, across and down; negative
    if the template is more blurred. It includes the blur by interpolation, f (1 - f) at a fraction
    f of a pixel.
    """

    xy: FloatArray
    covariance: FloatArray
    score: float
    blur_px2: FloatArray


def match_template(
    search: Float32Array,
    template: Float32Array,
    *,
    min_score: float = 0.7,
    max_second_ratio: float = 0.9,
) -> Match | Refusal:
    """Find one template: `match_templates` of one `Query`."""
    return match_templates([Query(search, template, min_score, max_second_ratio)])[0]


def match_templates(queries: Sequence[Query]) -> list[Match | Refusal]:
    """
    Find templates by normalized cross-correlation and align them to sub-pixel.

    Each step is done for all queries before the next, which is 1.5 times faster than query by
    query (caches).
    """
    searches = [for_matching(query.search) for query in queries]
    templates = [for_matching(query.template) for query in queries]
    scores = [
        np.asarray(cv2.matchTemplate(search, template, cv2.TM_CCOEFF_NORMED), dtype=np.float32)
        for search, template in zip(searches, templates, strict=True)
    ]
    outcome = [_peak(*each) for each in zip(queries, scores, strict=True)]
    peaks = [(k, peak) for k, peak in enumerate(outcome) if isinstance(peak, _Peak)]
    aligned = align(
        [searches[k] for k, _ in peaks],
        [templates[k] for k, _ in peaks],
        [_parabola_peak(scores[k], peak.column, peak.row) for k, peak in peaks],
        [queries[k].search_blur for k, _ in peaks],
    )
    matches: dict[int, Match] = {}
    for index, xy, covariance, score, blur_px2 in zip(*aligned, strict=True):
        k, peak = peaks[index]
        matches[k] = Match(xy, covariance, max(peak.score, float(score)), blur_px2)
    return [
        matches.get(k, Refusal('alignment failed')) if isinstance(peak, _Peak) else peak
        for k, peak in enumerate(outcome)
    ]


class _Peak(NamedTuple):
    column: int
    row: int
    score: float


def _peak(query: Query, scores: Float32Array) -> _Peak | Refusal:
    """The peak of the scores, if it is unambiguous."""
    contrast = float(cv2.meanStdDev(query.template)[1][0, 0])
    if contrast < _MIN_CONTRAST:
        return Refusal('blank template', f'contrast {contrast:.1f}')
    _, score, _, (column, row) = cv2.minMaxLoc(scores)
    if score < query.min_score:
        return Refusal(
            'low correlation',
            f'{score:.2f} < {query.min_score:.2f}',
            RefusalCode.LOW_CORRELATION,
        )
    if not (0 < column < scores.shape[1] - 1 and 0 < row < scores.shape[0] - 1):
        return Refusal('peak at the border of the search window')
    limit = query.max_second_ratio * score
    second = _second_peak(scores, column, row, query.template.shape, limit)
    if second > limit:
        return Refusal('ambiguous', f'second peak {second:.2f} of {score:.2f}')
    return _Peak(column, row, float(score))


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
