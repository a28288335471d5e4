"""Where labels go, so that none lies on another or leaves the image."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
import numpy.typing as npt

from landmark_nav.types import FloatArray

__all__ = [
    'free_labels',
    'keep_in_view',
    'metres_per_inch',
    'places_of_numbers',
    'rows_of_labels',
]

# Inches that a digit of 7 points takes, the gap between two numbers and between the first and the
# wall, and a row of them.
_DIGIT_IN = 0.065
_GAP_IN = 0.04
_WALL_IN = 0.09
_ROW_IN = 0.105
# Rows farther from the wall no longer show which landmark a number belongs to.
_MOST_ROWS = 2


def rows_of_labels(centers: npt.ArrayLike, widths: npt.ArrayLike) -> npt.NDArray[np.intp]:
    """
    Row (n,) of each label: the first one where there is still room for it.

    Parameters
    ----------
    centers, widths : array_like, shape (n,)
        Of the labels along their row, in one unit.

    """
    middle, half = np.asarray(centers, float), 0.5 * np.asarray(widths, float)
    rows = np.zeros(len(middle), dtype=np.intp)
    ends: list[float] = []
    for k in np.argsort(middle - half):
        free = (row for row, end in enumerate(ends) if end <= middle[k] - half[k])
        rows[k] = next(free, len(ends))
        ends[rows[k] : rows[k] + 1] = [float(middle[k] + half[k])]
    return rows


def free_labels(corners: npt.ArrayLike, sizes: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """
    Which labels (n,) lie on none of those before that are kept.

    Parameters
    ----------
    corners, sizes : array_like, shape (n, 2)
        Least x and y of each label, its width and height, in one unit.

    """
    low = np.asarray(corners, float).reshape(-1, 2)
    high = low + np.asarray(sizes, float).reshape(-1, 2)
    kept = np.zeros(len(low), dtype=np.bool_)
    for k in range(len(low)):
        meets = np.all((low[k] < high[kept]) & (low[kept] < high[k]), axis=1)
        kept[k] = not meets.any()
    return kept


def places_of_numbers(
    positions: FloatArray, normals: FloatArray, numbers: npt.NDArray[np.int64], scale: float
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """
    Places (n, 2) of numbers of 7 points outside the walls, in rows; which (n,) have room there.

    Parameters
    ----------
    positions, normals : ndarray, shape (n, 2)
        What is numbered, on the walls, and where the room lies.
    numbers : ndarray, shape (n,)
        What is written.
    scale : float
        Metres of the room in an inch of the figure.

    """
    along = np.stack([-normals[:, 1], normals[:, 0]], -1)
    # Numbers are wider than high, whichever way the wall runs.
    written = np.array([_DIGIT_IN * len(str(number)) + _GAP_IN for number in numbers])
    size = scale * np.stack([written, np.full(len(numbers), _ROW_IN)], -1)
    width, depth = (np.sum(np.abs(way) * size, axis=1) for way in (along, normals))
    places, has_room = np.empty_like(positions), np.zeros(len(positions), dtype=np.bool_)
    for normal in np.unique(np.round(normals, 1), axis=0):
        wall = np.flatnonzero(np.all(np.round(normals, 1) == normal, axis=1))
        on_wall = np.sum(positions[wall] * along[wall], axis=1)
        rows = rows_of_labels(on_wall, width[wall])
        has_room[wall] = rows < _MOST_ROWS
        away = 0.5 + rows
        away = scale * _WALL_IN + away * depth[wall].max()
        places[wall] = positions[wall] - away[:, None] * normals[wall]
    return places, has_room


def metres_per_inch(figure: Figure, axes: Axes) -> float:
    """Scale at which a plan is going to be drawn in a figure."""
    figure.draw_without_rendering()
    return float(np.ptp(axes.get_xlim()) * figure.dpi / axes.get_window_extent().width)


def keep_in_view(axes: Axes, points: FloatArray, margin_m: float) -> None:
    """Widen the limits so far that all points (n, 2) lie `margin_m` inside."""
    low, high = points.min(axis=0) - margin_m, points.max(axis=0) + margin_m
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    axes.set_xlim(min(left, low[0]), max(right, high[0]))
    axes.set_ylim(min(bottom, low[1]), max(top, high[1]))
