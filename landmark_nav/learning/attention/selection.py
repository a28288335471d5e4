"""
Hierarchical winner-take-all: selection of rectangles of a saliency map.

Culhane and Tsotsos, An Attentional Prototype for Early Vision, ECCV 1992: units with rectangular
receptive fields of several sizes compete at the top; the beam of the winner is narrowed layer by
layer; the attended area is inhibited, and the competition is repeated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np

from landmark_nav.arrays import BoolArray, Float32Array, IndexArray
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.patches import is_upright_edge
from landmark_nav.learning.attention.maps import attention_maps, AttentionConfig
from landmark_nav.types import Candidate, FloatArray, ImageArray, Panorama, Refusal

# Distance between units in the layers of the pyramid, top first, px.
_PITCHES_PX = (4, 2, 1)
# Number of sectors of azimuth; `candidates_per_sector` limits each.
_SECTORS = 18
# Edges are accepted up to this number of patches in a sector.
_FEW = 3
# Inhibited area around an attended patch, in patch sizes.
_INHIBITION = 1.25
# Saliency of uncovered pixels: a unit that contains one loses against any other.
_FORBIDDEN = np.float32(-1e4)
# Exponent of the area in the response: among equal means the larger field wins.
_SIZE_EXPONENT = 0.25


def select(
    saliency: Float32Array, covered: BoolArray, gray: ImageArray, config: AttentionConfig
) -> tuple[tuple[Candidate, ...], tuple[tuple[Candidate, Refusal], ...]]:
    """
    Select rectangles until there are enough or the response is too low.

    Returned are those accepted, in the order of attention, at most `candidates_per_sector` in each
    sector of azimuth, and those refused.

    Parameters
    ----------
    saliency, covered, gray : ndarray, shape (height, width)
        Saliency, pixels that rectangles may contain, and image of a full turn: the last column
        borders on the first.
    """
    width = saliency.shape[1]
    taken = np.zeros(_SECTORS, dtype=int)
    units = _Units(saliency, covered, config)
    accepted: list[Candidate] = []
    refused: list[tuple[Candidate, Refusal]] = []
    first = units.strongest()[0]
    while len(accepted) < config.candidates:
        response, row, column = units.strongest()
        if response <= 0.0 or response < config.least_response * first:
            break
        winner = units.narrow(row, column)
        units.inhibit(winner)
        sector = _sector(winner, width)
        if taken[sector] >= config.candidates_per_sector:
            continue
        if (why := refusal(winner, gray, config)) is not None:
            refused.append((winner, why))
            continue
        accepted.append(winner)
        taken[sector] += 1
        if taken[sector] == config.candidates_per_sector:
            units.exclude(sector / _SECTORS, (sector + 1) / _SECTORS)
    return tuple(accepted), tuple(refused)


class _Units:
    """The competing units, and the saliency map without inhibited areas."""

    def __init__(
        self, saliency: Float32Array, covered: BoolArray, config: AttentionConfig
    ) -> None:
        sizes = config.sizes_px
        self._fields = [(w, h) for w in sizes for h in sizes]
        self._gains = [
            (w * h) ** (_SIZE_EXPONENT - 1.0) / sizes[-1] ** 0.5 for w, h in self._fields
        ]
        self._reach = sizes[-1] // 2 + 1
        self._border = self._reach + 2 * _PITCHES_PX[0]
        self._height, self._width = saliency.shape
        self._remaining = np.pad(
            np.where(covered, saliency, _FORBIDDEN),
            ((self._border, self._border), (0, 0)),
            constant_values=_FORBIDDEN,
        )
        self._rows: IndexArray = np.arange(0, self._height, _PITCHES_PX[0])
        self._columns: IndexArray = np.arange(0, self._width, _PITCHES_PX[0])
        self._open = np.ones(len(self._columns), dtype=bool)
        self._top = self._respond(self._rows, self._columns)[0]

    def strongest(self) -> tuple[float, int, int]:
        """Response and position (row, column) of the winner of the top layer."""
        at = int(np.argmax(self._top))
        row, column = np.unravel_index(at, self._top.shape)
        return float(self._top.flat[at]), int(self._rows[row]), int(self._columns[column])

    def narrow(self, row: int, column: int) -> Candidate:
        """Narrow the beam of a top unit to the rectangle with the largest response."""
        field, response = 0, 0.0
        for above, pitch in pairwise(_PITCHES_PX):
            offsets = np.arange(-above, above + 1, pitch)
            responses, fields = self._respond(row + offsets, column + offsets)
            i, j = np.unravel_index(int(np.argmax(responses)), responses.shape)
            row, column = row + int(offsets[i]), column + int(offsets[j])
            field, response = int(fields[i, j]), float(responses[i, j])
        width, height = self._fields[field]
        # The centre of pixels column - width // 2 and the width - 1 next ones.
        center = column - width // 2 + (width - 1) / 2.0
        return Candidate(
            column=float((center + 0.5) % self._width - 0.5),
            row=row - height // 2 + (height - 1) / 2.0,
            width_px=width,
            height_px=height,
            saliency=response,
        )

    def inhibit(self, attended: Candidate) -> None:
        """Inhibit the attended area and update the responses of the units that overlap it."""
        half_width = 0.5 * _INHIBITION * attended.width_px
        half_height = 0.5 * _INHIBITION * attended.height_px
        away = self._columns_away(np.arange(self._width), attended.column)
        columns = np.flatnonzero(np.abs(away) <= half_width)
        first = max(0, int(np.ceil(attended.row - half_height))) + self._border
        last = min(self._height - 1, int(attended.row + half_height)) + self._border
        area = np.ix_(np.arange(first, last + 1), columns)
        self._remaining[area] = np.minimum(self._remaining[area], 0.0)

        away = self._columns_away(self._columns, attended.column)
        saw_column = np.flatnonzero(np.abs(away) <= half_width + self._reach)
        saw_row = np.flatnonzero(np.abs(self._rows - attended.row) <= half_height + self._reach)
        columns = np.rint(attended.column + away[saw_column]).astype(np.intp)
        responses = self._respond(self._rows[saw_row], columns)[0]
        responses[:, ~self._open[saw_column]] = -np.inf
        self._top[np.ix_(saw_row, saw_column)] = responses

    def exclude(self, begin: float, end: float) -> None:
        """Exclude the units between two azimuths, relative to the turn, from winning."""
        share = (self._columns + 0.5) / self._width
        self._open &= (share < begin) | (share >= end)
        self._top[:, ~self._open] = -np.inf

    def _columns_away(self, columns: IndexArray, center: float) -> FloatArray:
        half = 0.5 * self._width
        return np.asarray((columns - center + half) % self._width - half)

    def _respond(self, rows: IndexArray, columns: IndexArray) -> tuple[FloatArray, IndexArray]:
        """Largest response over the sizes of units at rows x columns, and index of that size."""
        top, left = int(rows.min()) - self._reach, int(columns.min()) - self._reach
        across = np.arange(left, int(columns.max()) + self._reach + 1) % self._width
        down = slice(self._border + top, self._border + int(rows.max()) + self._reach + 1)
        table = cv2.integral(self._remaining[down].take(across, axis=1), sdepth=cv2.CV_64F)
        # Sums between the upper and the lower border of a field, up to each column of the table.
        heights = {h for _, height in self._fields for h in (height, height // 2)}
        above = {h: rows - top - h // 2 for h in heights}
        bands = {h: table[first + h] - table[first] for h, first in above.items()}
        best = np.full((len(rows), len(columns)), -np.inf)
        field = np.zeros(best.shape, dtype=np.intp)
        for k, ((width, height), gain) in enumerate(zip(self._fields, self._gains, strict=True)):
            whole = _sums(bands[height], columns - left, width)
            # The middle quarter counts as much, so that winners are centred on salient content.
            middle = _sums(bands[height // 2], columns - left, width // 2)
            response = gain * (0.5 * whole + 2.0 * middle)
            stronger = response > best
            best[stronger], field[stronger] = response[stronger], k
        return best, field


def _sums(band: FloatArray, columns: IndexArray, width: int) -> FloatArray:
    """Sums over fields of a width centred at columns."""
    before = columns - width // 2
    return np.asarray(band[:, before + width] - band[:, before])


# Smallest distance of another match, relative to the patch size; nearer ones are the patch itself.
_SAME_PLACE = 0.25
# Largest correlation with a neighbouring position (docs/decisions.md, attention).
_MAX_SIMILARITY = 0.75
# Least standard deviation of a patch, grey levels: a match needs 4.
_MIN_CONTRAST = 5.0


def refusal(candidate: Candidate, gray: ImageArray, config: AttentionConfig) -> Refusal | None:
    """Return why a patch of a grey panorama (height, width) is ambiguous; None if distinct."""
    around = config.neighborhood_rows_px, config.neighborhood_columns_px
    window, column, row = _neighborhood(candidate, gray, *around)
    patch = window[row : row + candidate.height_px, column : column + candidate.width_px]
    contrast = float(np.std(patch))
    if contrast < _MIN_CONTRAST:
        return Refusal('too little contrast', f'{contrast:.1f} grey levels')
    score = cv2.matchTemplate(window, np.ascontiguousarray(patch), cv2.TM_CCOEFF_NORMED)
    rows, columns = np.ogrid[: score.shape[0], : score.shape[1]]
    elsewhere = np.abs(columns - column) > _SAME_PLACE * candidate.width_px
    # An edge goes on above and below.
    if not candidate.edge:
        elsewhere = elsewhere | (np.abs(rows - row) > _SAME_PLACE * candidate.height_px)
    score = np.where(elsewhere & np.isfinite(score), score, -1.0)
    at = np.unravel_index(int(np.argmax(score)), score.shape)
    if score[at] > _MAX_SIMILARITY:
        return Refusal(
            'looks like its neighbourhood',
            f'correlation {score[at]:.2f} at {at[1] - column:+d} columns, {at[0] - row:+d} rows',
        )
    return None


def edges_among(
    refused: Sequence[tuple[Candidate, Refusal]],
    accepted: Sequence[Candidate],
    gray: ImageArray,
    config: AttentionConfig,
) -> tuple[list[Candidate], list[tuple[Candidate, Refusal]]]:
    """Upright edges among refused patches, in sectors of azimuth with few others; and the rest."""
    width = gray.shape[1]
    taken = np.bincount([_sector(c, width) for c in accepted], minlength=_SECTORS)
    edges, rest = [], []
    for candidate, why in refused:
        edge, sector = replace(candidate, edge=True), _sector(candidate, width)
        few = taken[sector] < _FEW and is_upright_edge(_neighborhood(candidate, gray, 0, 0)[0])
        if few and refusal(edge, gray, config) is None:
            edges.append(edge)
            taken[sector] += 1
        else:
            rest.append((candidate, why))
    return edges, rest


def _sector(candidate: Candidate, width: int) -> int:
    return int((candidate.column + 0.5) * _SECTORS / width) % _SECTORS


def _neighborhood(
    candidate: Candidate, gray: ImageArray, around: int, along: int
) -> tuple[ImageArray, int, int]:
    """Cut out the neighbourhood of a patch; return it and the patch's column and row in it."""
    height, width = gray.shape
    left = round(candidate.column - (candidate.width_px - 1) / 2.0)
    top = round(candidate.row - (candidate.height_px - 1) / 2.0)
    first = max(0, top - around)
    last = min(height, top + candidate.height_px + around)
    columns = np.arange(left - along, left + candidate.width_px + along) % width
    return gray[first:last].take(columns, axis=1), along, top - first


# A patch keeps this far from uncovered pixels, whose neighbours are blurred by interpolation.
_MARGIN_PX = 2


@dataclass(frozen=True, eq=False)
class Attention:
    """Candidates of a panorama, most salient first, then edges; `refused` ones are ambiguous."""

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
    gray = _fill_uncovered(panorama.grey.astype(np.uint8), panorama.mask)
    saliency = attention_maps(gray, config).saliency
    accepted, refused = select(saliency, _inside(panorama.mask), gray, config)
    edges, others = edges_among(refused, accepted, gray, config)
    candidates = (*accepted, *edges)
    first = max((c.saliency for c in candidates), default=1.0)
    return Attention(
        tuple(replace(c, saliency=c.saliency / first) for c in candidates),
        tuple((replace(c, saliency=c.saliency / first), why) for c, why in others),
    )


def _fill_uncovered(gray: ImageArray, mask: BoolArray) -> ImageArray:
    """Continue the image into uncovered areas, so that their borders are not edges."""
    if mask.all() or not mask.any():
        return gray
    labels = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )[1]
    value = np.zeros(int(labels.max()) + 1, dtype=np.uint8)
    value[labels[mask]] = gray[mask]
    return np.asarray(value[labels])


def _inside(mask: BoolArray) -> BoolArray:
    """Covered pixels surrounded by covered pixels, also across the seam."""
    columns = np.arange(-_MARGIN_PX, mask.shape[1] + _MARGIN_PX) % mask.shape[1]
    kernel = np.ones((2 * _MARGIN_PX + 1, 2 * _MARGIN_PX + 1), np.uint8)
    shrunk = cv2.erode(mask.take(columns, axis=1).astype(np.uint8), kernel)
    return np.asarray(shrunk[:, _MARGIN_PX:-_MARGIN_PX].astype(bool))
