"""Common parts of all figures: colours, plans of the room, parts of panoramas, saving."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from textwrap import fill
from typing import Any

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Rectangle
from matplotlib.patheffects import withStroke
import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.walls import Marker, Paper, Wall
from landmark_nav.storage.atomic_io import write_atomically
from landmark_nav.types import Candidate, FloatArray, Panorama

# Colours for all kinds of colour vision (Okabe and Ito, Color Universal Design, 2008).
TRUTH = '#222222'
FUSED = '#0072b2'
ODOMETRY = '#d55e00'
FIX = '#56b4e9'
LANDMARK = '#009e73'
CANDIDATE = '#e69f00'
SMOOTHED = '#cc79a7'
WALL = '#555555'
GRID = '#dddddd'
# Border of text over a drawing.
HALO = (withStroke(linewidth=3.0, foreground='white'),)

DPI = 130


def new_figure(width_in: float, height_in: float) -> Figure:
    """Create an empty figure without a window or global state."""
    figure = Figure(figsize=(width_in, height_in), dpi=DPI, layout='constrained')
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: Path) -> None:
    """
    Write a PNG.

    It contains no date and no version, so that the same figure gives the same file. A tight box
    is required for axes of equal scale, which do not fill their layout; it draws everything twice.
    """
    drawn = BytesIO()
    # Higher levels halve the size, but take many times as long.
    fast: dict[str, Any] = {'metadata': {'Software': None}, 'pil_kwargs': {'compress_level': 1}}
    figure.savefig(drawn, bbox_inches='tight', pad_inches=0.12, **fast)
    write_atomically(path, drawn.getvalue())


def plain(axes: Axes) -> None:
    """Set a light grid, and no frame at the top and right."""
    axes.grid(color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ('top', 'right'):
        axes.spines[side].set_visible(False)


def legend_beside(
    axes: Axes, where: str, columns: int, handles: Sequence[Artist] | None = None
) -> None:
    """Add a legend above or below the axes, where it covers no data."""
    chosen = axes.get_legend_handles_labels()[0] if handles is None else handles
    side, at = ('lower', 1.0) if where == 'above' else ('upper', -0.1)
    place: dict[str, Any] = {'loc': f'{side} center', 'bbox_to_anchor': (0.5, at)}
    axes.legend(handles=chosen, ncols=columns, frameon=False, **place)


def key(color: str, marker: str, label: str, **more: Any) -> Line2D:
    """Entry of a legend: a marker, without a line unless `linestyle` gives one."""
    look = {'color': color, 'marker': marker, 'linestyle': '', **more}
    return Line2D([], [], **look, label=label)


def draw_walls(axes: Axes, walls: Iterable[Wall], margin_m: float) -> None:
    """Draw a plan of the walls with equal axes in metres and a margin of `margin_m`."""
    drawn = list(walls)
    for wall in drawn:
        axes.plot(*zip(wall.start, wall.end, strict=True), color=WALL, linewidth=2.5, zorder=2)
    axes.set_aspect('equal')
    axes.set_xlabel('x in map [m]')
    axes.set_ylabel('y in map [m]')
    if drawn:
        corners = np.array([wall.start for wall in drawn])
        (left, bottom), (right, top) = corners.min(0) - margin_m, corners.max(0) + margin_m
        axes.set_xlim(left, right)
        axes.set_ylim(bottom, top)


def draw_papers(axes: Axes, papers: Iterable[Paper | Marker]) -> None:
    """Draw reference papers and markers as squares of their colour."""
    for paper in papers:
        blue, green, red = (part / 255.0 for part in paper.bgr)
        axes.plot(*paper.center[:2], 's', color=(red, green, blue), markersize=7, zorder=5)


def draw_sweep_places(axes: Axes, poses: Iterable[FloatArray], name: str = '') -> None:
    """
    Draw the poses (2,) or (3,) of sweeps, with an arrow along the heading, if it is given.

    They are called L and R if there are two, as in stereo, else by number; with a `name`, always.
    """
    places = [np.asarray(pose) for pose in poses]
    numbers = [f'{name} {number}'.strip() for number in range(1, len(places) + 1)]
    for label, place in zip(numbers if name or len(places) > 2 else 'LR', places, strict=False):
        x, y = place[:2]
        axes.plot(x, y, '^', color=FUSED, markersize=9, markeredgecolor='white', zorder=7)
        ahead = np.array([np.cos(place[2]), np.sin(place[2])]) if len(place) > 2 else np.zeros(2)
        if ahead.any():
            arrow = {'arrowstyle': '->', 'color': FUSED, 'path_effects': HALO}
            axes.annotate('', 0.45 * ahead + [x, y], (x, y), arrowprops=arrow, zorder=6)
        # Behind the arrow, and ending there.
        offset = tuple(-14.0 * ahead) if ahead.any() else (12, 8)
        side = ('left', 'center', 'right')[1 + round(ahead[0])]
        axes.annotate(
            label, (x, y), offset, textcoords='offset points', ha=side, va='center',
            color=FUSED, path_effects=HALO, weight='bold', zorder=8,
        )  # fmt: skip


def add_ellipse(
    axes: Axes, center: FloatArray, covariance: FloatArray, color: str, scale: float
) -> None:
    """
    Draw the ellipse of three sigmas of a planar covariance (2, 2).

    `scale` enlarges it, so that centimetres are visible in a room.
    """
    variances, axes_2d = np.linalg.eigh(covariance)
    width, height = 6.0 * scale * np.sqrt(np.maximum(variances[::-1], 0.0))
    angle = np.degrees(np.arctan2(axes_2d[1, 1], axes_2d[0, 1]))
    look = {'angle': angle, 'color': color, 'alpha': 0.35, 'linewidth': 0.8, 'zorder': 4}
    ellipse = Ellipse((center[0], center[1]), width, height, **look)
    ellipse.set_in_layout(False)
    axes.add_patch(ellipse)


def free_labels(
    corners: npt.ArrayLike, sizes: npt.ArrayLike,
    taken: npt.ArrayLike = (), taken_sizes: npt.ArrayLike = (),
) -> npt.NDArray[np.bool_]:  # fmt: skip
    """
    Mask (n,) of labels that overlap none of the previously kept ones, and nothing `taken`.

    `corners` and `sizes` (n, 2) are least x and y, and width and height, in one unit; those of
    what is taken (m, 2) likewise.
    """
    taken_low = np.reshape(taken, (-1, 2))
    low = np.concatenate([taken_low, np.reshape(corners, (-1, 2))])
    high = low + np.concatenate([np.reshape(one, (-1, 2)) for one in (taken_sizes, sizes)])
    kept = np.arange(len(low)) < len(taken_low)
    for k in range(len(taken_low), len(low)):
        meets = np.all((low[k] < high[kept]) & (low[kept] < high[k]), axis=1)
        kept[k] = not meets.any()
    return kept[len(taken_low) :]


def keep_in_view(axes: Axes, points: FloatArray, margin_m: float) -> None:
    """Widen the limits so that all points (n, 2) are at least `margin_m` inside."""
    low, high = points.min(axis=0) - margin_m, points.max(axis=0) + margin_m
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    axes.set_xlim(min(left, low[0]), max(right, high[0]))
    axes.set_ylim(min(bottom, low[1]), max(top, high[1]))


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
