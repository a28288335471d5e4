"""``panorama_K.png``: candidates and elected landmarks drawn on the panorama."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
from matplotlib.artist import Artist
from matplotlib.backend_bases import RendererBase
import numpy as np

from landmark_nav.evaluation.figures import style
from landmark_nav.evaluation.figures.strips import mark
from landmark_nav.types import Candidate, Landmark, Panorama, Refusal

# Margins of the image: left, bottom, right, top, inches.
_MARGINS_IN = (0.7, 0.6, 0.2, 0.4)
# Width of a digit of a label and of its border, and height of the label.
_DIGIT_PX, _BORDER_PX, _LABEL_PX = 0.09 * style.DPI, 0.06 * style.DPI, 0.19 * style.DPI
# Distance of a label from the patch below it.
_ABOVE_PX = 2.0


def draw_panorama(
    panorama: Panorama,
    candidates: Sequence[Candidate],
    outcomes: Sequence[Landmark | Refusal],
    number: int,
    path: Path,
) -> None:
    """
    Draw a panorama with its candidates thin and its elected landmarks bold, with their ids.

    Ids that would overlap a previous one are omitted.
    """
    rows, columns = panorama.image.shape[:2]
    # The figure has the resolution of the panorama, so that nothing is resampled.
    left, bottom, right, top = _MARGINS_IN
    width, height = columns / style.DPI, rows / style.DPI
    size = (left + width + right, bottom + height + top)
    figure = style.new_figure(*size, arranged=False)
    axes = figure.add_axes((left / size[0], bottom / size[1], width / size[0], height / size[1]))
    figure.add_artist(_PanoramaArtist(panorama, left * style.DPI, bottom * style.DPI))
    axes.patch.set_visible(False)
    elected = sum(isinstance(outcome, Landmark) for outcome in outcomes)
    for candidate, outcome, label in zip(
        candidates, outcomes, _labels(candidates, outcomes), strict=True
    ):
        color = style.LANDMARK if isinstance(outcome, Landmark) else style.CANDIDATE
        # Patches across the seam are drawn at both ends.
        for column in (candidate.column - columns, candidate.column, candidate.column + columns):
            if -candidate.width_px < column < columns + candidate.width_px:
                mark(axes, (column, candidate.row), candidate, label, color)
    azimuths = np.arange(-165, 181, 15)
    axes.set_xticks(panorama.cylinder.column_of(np.radians(azimuths)), [f'{a}' for a in azimuths])
    tangents = np.arange(-8, 9, 2) / 10
    ticks = panorama.cylinder.row_of(tangents)
    inside = (ticks >= 0) & (ticks < rows)
    axes.set_yticks(ticks[inside], [f'{t:+.1f}' for t in tangents[inside]])
    axes.set_xlim(-0.5, columns - 0.5)
    axes.set_ylim(rows - 0.5, -0.5)
    axes.set_xlabel('azimuth from base_link +x [deg]')
    axes.set_ylabel('tangent of elevation')
    axes.set_title(
        f'Panorama {number}: {len(candidates)} candidates (thin), '
        f'{elected} of them elected (bold, with id where there is room)'
    )
    style.save(figure, path, tight=False)


class _PanoramaArtist(Artist):
    """The covered part of a panorama at its resolution; `figimage` would resample it slowly."""

    def __init__(self, panorama: Panorama, left_px: float, bottom_px: float) -> None:
        super().__init__()
        self.set_zorder(-1)
        self._corner = round(left_px), round(bottom_px)
        self._rgba = cv2.cvtColor(panorama.image, cv2.COLOR_BGR2RGBA)
        self._rgba[~panorama.mask] = 255

    def draw(self, renderer: RendererBase) -> None:
        """Draw the image; the renderer counts rows from the bottom."""
        context = renderer.new_gc()
        renderer.draw_image(context, *self._corner, np.flipud(self._rgba))


def _labels(candidates: Sequence[Candidate], outcomes: Sequence[Landmark | Refusal]) -> list[str]:
    """Ids of elected candidates that overlap no previous one; empty for all others."""
    elected = {k: str(one.id) for k, one in enumerate(outcomes) if isinstance(one, Landmark)}
    sizes, corners = np.empty((2, len(elected), 2))
    for row, (k, word) in enumerate(elected.items()):
        candidate, width = candidates[k], _BORDER_PX + _DIGIT_PX * len(word)
        top = candidate.row - 0.5 * candidate.height_px - _ABOVE_PX - _LABEL_PX
        sizes[row], corners[row] = (width, _LABEL_PX), (candidate.column - 0.5 * width, top)
    free = style.free_labels(corners, sizes)
    kept = {k: word for (k, word), is_free in zip(elected.items(), free, strict=True) if is_free}
    return [kept.get(k, '') for k in range(len(candidates))]
