"""``map.png``: walls, landmarks with their covariances, and poses of the sweeps."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
import numpy as np
import numpy.typing as npt

from landmark_nav.evaluation.figures import style
from landmark_nav.geometry.walls import Paper
from landmark_nav.types import LandmarkMap

# Scale of the ellipses: those of millimetres would not be visible in a room.
_MAGNIFIED = 10.0
_NORMAL_M = 0.18
_MARGIN_M = 0.4
# Distance of a number from its wall, width of a digit of 7 points, and height of a number.
_WALL_IN, _DIGIT_IN, _ROW_IN = 0.16, 0.08, 0.105


def draw_map(landmarks: LandmarkMap, path: Path, papers: Iterable[Paper] = ()) -> None:
    """Draw a map."""
    figure = style.new_figure(9.0, 6.6)
    axes = figure.add_subplot()
    style.draw_walls(axes, landmarks.walls, _MARGIN_M)
    draw_landmarks(axes, landmarks)
    feet = landmarks.positions[:, :2]
    lines = list(np.stack([feet, feet + _NORMAL_M * landmarks.normals[:, :2]], 1))
    axes.add_collection(LineCollection(lines, colors=style.LANDMARK, linewidths=1.0, zorder=5))
    for foot, covariance in zip(feet, landmarks.covariances[:, :2, :2], strict=True):
        style.add_ellipse(axes, foot, covariance, style.LANDMARK, _MAGNIFIED)
    for place in landmarks.panorama_poses:
        style.add_ellipse(axes, place.pose, place.covariance[:2, :2], style.FUSED, _MAGNIFIED)
    style.draw_sweep_places(axes, [place.pose for place in landmarks.panorama_poses], 'sweep')
    axes.set_title(
        f'{len(landmarks.landmarks)} landmarks learned from '
        f'{len(landmarks.panorama_poses)} panoramas'
    )
    style.plain(axes)
    text = 'landmark, its normal, its number where there is room'
    handles = [
        style.key(style.LANDMARK, 'o', text, linestyle='-'),
        style.key(
            style.LANDMARK,
            'o',
            f'3 sigma, {_MAGNIFIED:.0f} times as large',
            markersize=13,
            alpha=0.35,
        ),
        style.key(style.FUSED, '^', 'sweep, arrow along base_link +x'),
    ]
    drawn = list(papers)
    style.draw_papers(axes, drawn)
    if drawn:
        handles.append(style.key('#888888', 's', 'paper, in its colour'))
    style.legend_beside(axes, 'below', (len(handles) + 1) // 2, handles)
    number_landmarks(figure, axes, landmarks)
    style.save(figure, path)


def draw_landmarks(axes: Axes, landmarks: LandmarkMap) -> None:
    """Draw landmarks as dots."""
    axes.plot(*landmarks.positions[:, :2].T, 'o', color=style.LANDMARK, markersize=4, zorder=6)


def number_landmarks(
    figure: Figure, axes: Axes, landmarks: LandmarkMap, shown: npt.ArrayLike = True
) -> None:
    """
    Write numbers outside the walls if they do not overlap, and widen the axes for them.

    Call it last, as it depends on the final layout of the figure. `shown` (n,) selects landmarks.
    """
    which = np.flatnonzero(np.broadcast_to(shown, len(landmarks.landmarks)))
    if not len(which):
        return
    scale = style.metres_per_inch(figure, axes)
    ids, normals = landmarks.ids[which], landmarks.normals[which, :2]
    places = landmarks.positions[which, :2] - scale * _WALL_IN * normals
    sizes = scale * np.stack([_DIGIT_IN * np.char.str_len(ids.astype(str)), 0 * ids + _ROW_IN], 1)
    free = style.free_labels(places - 0.5 * sizes, sizes)
    places, ids = places[free], ids[free]
    style.keep_in_view(axes, places, 0.15 * scale)
    for number, (x, y) in zip(ids, places, strict=True):
        text = axes.text(
            x, y, str(number), fontsize=7, ha='center', va='center', color='#333333', zorder=8
        )
        # The text is inside the axes; to check that in the layout is slow.
        text.set_in_layout(False)
