"""``map.png``: the walls, the landmarks and how sure they are, where they were learned from."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
import numpy as np

from landmark_nav.evaluation.figures.style import (
    add_ellipse,
    draw_papers,
    draw_walls,
    FUSED,
    LANDMARK,
    legend_beside,
    new_figure,
    plain,
    save,
)
from landmark_nav.geometry.walls import Paper
from landmark_nav.types import FloatArray, LandmarkMap, PoseEstimate

__all__ = ['draw_landmarks', 'draw_map', 'places_of_numbers']

# Ellipses of millimetres would not be seen in a room: they are drawn this many times as large.
_MAGNIFIED = 10.0
_NORMAL_M = 0.18

# Room that a number takes, and rows of them outside a wall.
_NUMBER_M = np.array([0.17, 0.10])
_NUMBER_ROWS = 5
_MARGIN_M = 0.7


def draw_map(landmarks: LandmarkMap, path: Path, papers: Iterable[Paper] = ()) -> None:
    """
    Draw a map.

    Parameters
    ----------
    landmarks : LandmarkMap
        What was learned.
    path : Path
        PNG to write.
    papers : iterable of Paper
        The reference area, if it is to be seen.

    """
    figure = new_figure(9.0, 6.6)
    axes = figure.add_subplot()
    draw_walls(axes, landmarks.walls, _MARGIN_M)
    draw_papers(axes, papers)
    draw_landmarks(axes, landmarks, detailed=True)
    for number, place in enumerate(landmarks.panorama_poses, 1):
        _draw_place(axes, place, number)
    axes.set_title(
        f'{len(landmarks.landmarks)} landmarks learned from '
        f'{len(landmarks.panorama_poses)} panoramas'
    )
    plain(axes)
    handles = [
        Line2D([], [], color=LANDMARK, marker='o', label='landmark, its normal and number'),
        Line2D(
            [],
            [],
            color=LANDMARK,
            marker='o',
            markersize=13,
            alpha=0.35,
            linestyle='',
            label=f'3 sigma, {_MAGNIFIED:.0f} times as large',
        ),
        Line2D([], [], color=FUSED, marker='^', linestyle='', label='place of a sweep'),
    ]
    legend_beside(axes, 'below', 3, handles)
    save(figure, path)


def draw_landmarks(axes: Axes, landmarks: LandmarkMap, *, detailed: bool) -> None:
    """Landmarks as dots; with `detailed` also ellipses, normals and numbers."""
    if not landmarks.landmarks:
        return
    positions, normals = landmarks.positions[:, :2], landmarks.normals[:, :2]
    axes.plot(*positions.T, 'o', color=LANDMARK, markersize=4, zorder=6)
    if not detailed:
        return
    tips = positions + _NORMAL_M * normals
    lines = list(np.stack([positions, tips], 1))
    axes.add_collection(LineCollection(lines, colors=LANDMARK, linewidths=1.0, zorder=5))
    for landmark, place in zip(
        landmarks.landmarks, places_of_numbers(positions, normals), strict=True
    ):
        add_ellipse(
            axes, landmark.position, landmark.covariance[:2, :2], 3.0, LANDMARK, _MAGNIFIED
        )
        number = axes.text(
            place[0],
            place[1],
            str(landmark.id),
            fontsize=7,
            ha='center',
            va='center',
            color='#333333',
            zorder=7,
        )
        # It lies inside the axes; to find that out for each takes long.
        number.set_in_layout(False)


def places_of_numbers(positions: FloatArray, normals: FloatArray) -> FloatArray:
    """Places (n, 2) outside the walls, each in the first row where there is still room."""
    along = np.stack([-normals[:, 1], normals[:, 0]], -1)
    # Numbers are wider than high, whichever way the wall runs.
    width = np.abs(along) @ _NUMBER_M
    depth = np.abs(normals) @ _NUMBER_M
    ends: dict[tuple[float, ...], list[float]] = {}
    places = np.empty_like(positions)
    on_wall = np.sum(positions * along, axis=1)
    for k in np.argsort(on_wall):
        rows = ends.setdefault(tuple(np.round(normals[k], 1)), [-np.inf] * _NUMBER_ROWS)
        free = [row for row, end in enumerate(rows) if on_wall[k] - end >= width[k]]
        row = free[0] if free else int(np.argmin(rows))
        rows[row] = float(on_wall[k])
        places[k] = positions[k] - (0.06 + (row + 0.6) * depth[k]) * normals[k]
    return places


def _draw_place(axes: Axes, place: PoseEstimate, number: int) -> None:
    """Draw a sweep's place: where, where the base looked, how sure."""
    x, y, heading = place.pose
    add_ellipse(axes, place.pose, place.covariance[:2, :2], 3.0, FUSED, _MAGNIFIED)
    axes.plot(x, y, '^', color=FUSED, markersize=8, zorder=6)
    axes.annotate(
        '',
        (x + 0.45 * np.cos(heading), y + 0.45 * np.sin(heading)),
        (x, y),
        arrowprops={'arrowstyle': '->', 'color': FUSED},
        zorder=6,
    )
    axes.annotate(
        f'sweep {number}', (x, y), (0, 8), textcoords='offset points', ha='center', color=FUSED
    )
