"""Parts of panoramas in figures: strips across the seam, marked patches and captions."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from textwrap import fill

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
import numpy as np
import numpy.typing as npt

from landmark_nav.evaluation.figures.style import LANDMARK
from landmark_nav.types import Candidate, Panorama

# Width of a letter of a caption, inches per point of its size; height of a strip over its width.
_LETTER_IN = 0.0072
_HEIGHT = 0.45


@dataclass(frozen=True)
class Strip:
    """`width` columns of a panorama from `start`, wrapped at the seam, rows `top` to `bottom`."""

    start: int
    width: int
    top: int
    bottom: int

    @classmethod
    def around(cls, panorama: Panorama, column: float, row: float, width: int) -> Strip:
        """Return the strip centred at a column and, if the panorama is high enough, at a row."""
        height, turn = panorama.mask.shape
        rows = round(min(_HEIGHT * width, height))
        top = int(np.clip(round(row - rows / 2), 0, height - rows))
        return cls(round(column - width / 2), min(width, turn), top, top + rows)

    def cut(self, image: npt.NDArray[np.generic], scale: float = 1.0) -> npt.NDArray[np.generic]:
        """Cut the strip out of the panorama, or of a map that is `scale` times as large."""
        first, count = round(scale * self.start), round(scale * self.width)
        rows = slice(round(scale * self.top), round(scale * self.bottom))
        columns = np.arange(first, first + count) % image.shape[1]
        return np.asarray(image[rows].take(columns, axis=1))

    def place(self, candidate: Candidate, turn: int) -> tuple[float, float] | None:
        """Column and row of a patch in the strip; None if it is not completely inside."""
        column = (candidate.column - self.start) % turn
        row = candidate.row - self.top
        across, down = candidate.width_px / 2, candidate.height_px / 2
        inside = across <= column <= self.width - across
        inside &= down <= row <= self.bottom - self.top - down
        return (float(column), float(row)) if inside else None


def widest(panorama: Panorama, candidates: Iterable[Candidate], width: int, apart: int) -> Strip:
    """
    Find the strip that shows the first candidate, and as many of the others as possible.

    `width` and `apart`, of the strip and between the tried ones, are in columns.
    """
    turn = panorama.mask.shape[1]
    chosen = list(candidates)
    row = float(np.median([c.row for c in chosen])) if chosen else panorama.mask.shape[0] / 2
    strips = [Strip.around(panorama, column, row, width) for column in range(0, turn, apart)]

    def shown(strip: Strip) -> tuple[bool, int]:
        seen = [strip.place(c, turn) is not None for c in chosen]
        return any(seen[:1]), sum(seen)

    return max(strips, key=shown)


def show(axes: Axes, image: npt.NDArray[np.generic], title: str = '') -> None:
    """Draw an image without ticks: BGR, grey levels 0 to 255, or a map from 0 to its maximum."""
    if image.ndim == 3:
        axes.imshow(image[..., ::-1])
    elif image.dtype == np.uint8:
        axes.imshow(image, cmap='gray', vmin=0, vmax=255)
    else:
        axes.imshow(image, cmap='magma', vmin=0.0, vmax=max(float(image.max()), 1e-6))
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
    if title:
        axes.set_title(title, fontsize=10)


def mark(
    axes: Axes, place: tuple[float, float], candidate: Candidate, label: str = '',
    color: str = LANDMARK, style: str = '-',
) -> None:  # fmt: skip
    """Draw the outline of a patch centred at `place` of the axes, with a label above it."""
    corner = (place[0] - candidate.width_px / 2, place[1] - candidate.height_px / 2)
    axes.add_patch(
        Rectangle(
            corner, candidate.width_px, candidate.height_px,
            fill=False, edgecolor=color, linewidth=1.8 if label or color == LANDMARK else 0.9,
            linestyle=style,
        )
    )  # fmt: skip
    if label:
        axes.text(
            place[0], corner[1] - 2.0, label, ha='center', va='bottom', fontsize=8, color='white',
            fontweight='bold', clip_on=True,
            bbox={'boxstyle': 'round,pad=0.12', 'facecolor': color, 'linewidth': 0.0},
        )  # fmt: skip


def caption(figure: Figure, text: str, size: float = 10.0) -> None:
    """Write a caption below the figure, wrapped to its width."""
    letters = int(figure.get_size_inches()[0] / (_LETTER_IN * size))
    figure.supxlabel(fill(text, letters), x=0.01, ha='left', fontsize=size)
