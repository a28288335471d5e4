"""Counterpart of Figure 6 of Livatino and Madsen: observation areas of landmarks."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.patches import Patch
import numpy as np

from landmark_nav.evaluation.figures import style
from landmark_nav.evaluation.figures.strips import caption, show
from landmark_nav.geometry.patches import observed_well
from landmark_nav.geometry.walls import Room
from landmark_nav.localization.triplet import TripletConfig
from landmark_nav.types import Landmark, LandmarkMap

_COUNT = 3
# Bounds of the robot by default.
_BOUNDS = TripletConfig()
_CELL_M = 0.04
# Margin of the plans for the names of walls, as a share of the longer side.
_MARGIN = 0.07
_LEVELS = (0.5, 1.5)


def typical_landmarks(landmarks: LandmarkMap) -> list[Landmark]:
    """Return the strongest landmark of each wall, three at most, the strongest first."""
    ranked = sorted(landmarks.landmarks, key=lambda k: -k.saliency)
    chosen: list[Landmark] = []
    for landmark in [*ranked, *ranked]:
        walls = {k.wall_id for k in chosen}
        fresh = landmark.wall_id not in walls or len(walls) == len({k.wall_id for k in ranked})
        if len(chosen) < _COUNT and landmark not in chosen and fresh:
            chosen.append(landmark)
    return chosen


def draw_observation_areas(landmarks: LandmarkMap, room: Room, path: Path) -> str:
    """Draw observation areas of three landmarks and poses of sweeps; return the caption."""
    chosen = typical_landmarks(landmarks)
    width, height = np.ptp(room.bounds, axis=0) + 2.0 * _margin_m(room)
    # The figure is higher than the plans: otherwise the layout has no room for labels below them.
    figure = style.new_figure(15.0, 2.0 * (5.9 * height / width + 1.1) + 1.2)
    top, body = np.ravel(np.asarray(figure.subfigures(2, 1, height_ratios=[0.04, 1.0])))
    grid = np.asarray(body.subplots(2, 4, width_ratios=[5.0, 1.0, 5.0, 1.0]))
    panels, patches = grid[:, ::2].ravel(), grid[:, 1::2].ravel()
    for axes, beside, landmark in zip(panels, patches, chosen, strict=False):
        _draw_area(axes, landmark, room)
        show(beside, landmark.patch)
        beside.set_anchor('NW')
    for axes in (*panels[len(chosen) : -1], *patches[len(chosen) :]):
        axes.set_axis_off()
    _draw_places(panels[-1], landmarks, room)
    handles = [
        Patch(color=style.FIX, alpha=0.45, label='observation area as predicted'),
        style.key(style.FUSED, '^', 'where it was learned'),
    ]
    top.legend(handles=handles, loc='center', ncols=len(handles), frameon=False)
    text = (
        f'Figure 6. Observation areas of {len(chosen)} landmarks: there neither width nor height '
        f'of the patch is seen with less than {_BOUNDS.min_sampling:g} or more than '
        f'{_BOUNDS.max_sampling:g} times the resolution of the view that it was learned from. '
        'Bottom right: the places of the sweeps, and how many landmarks each wall has.'
    )
    caption(figure, text)
    style.save(figure, path)
    return text


def _margin_m(room: Room) -> float:
    return _MARGIN * float(np.ptp(room.bounds, axis=0).max())


def _draw_area(axes: Axes, landmark: Landmark, room: Room) -> None:
    """Draw one landmark and its observation area."""
    x, y = (np.arange(a, b + _CELL_M, _CELL_M) for a, b in zip(*room.bounds, strict=True))
    cells = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    seen = observed_well(
        landmark.position[None],
        landmark.normal[None],
        landmark.viewpoint[None],
        cells,
        _BOUNDS.min_sampling,
        _BOUNDS.max_sampling,
    )[:, 0]
    seen &= room.contains(cells) & room.visible(cells, landmark.position[:2])
    area = seen.reshape(len(y), len(x)).astype(float)
    axes.contourf(x, y, area, _LEVELS, colors=style.FIX, alpha=0.45, zorder=1)
    style.draw_walls(axes, room.walls, _margin_m(room))
    axes.set_anchor('NE')
    axes.plot(*landmark.position[:2], 's', color=style.LANDMARK, markersize=8, zorder=6)
    axes.plot(*landmark.viewpoint[:2], '^', color=style.FUSED, markersize=10, zorder=6)
    wall = f'wall {landmark.wall_id}' if landmark.wall_id else 'no wall'
    axes.set_title(f'landmark {landmark.id} on {wall}', fontsize=11)


def _draw_places(axes: Axes, landmarks: LandmarkMap, room: Room) -> None:
    style.draw_walls(axes, room.walls, _margin_m(room))
    axes.set_anchor('NE')
    style.draw_papers(axes, room.papers)
    axes.plot(*landmarks.positions[:, :2].T, '.', color=style.LANDMARK, markersize=6, zorder=4)
    style.draw_sweep_places(axes, [place.pose[:2] for place in landmarks.panorama_poses])
    counts = Counter(k.wall_id for k in landmarks.landmarks)
    for wall, normal in zip(room.walls, room.normals, strict=True):
        x, y = 0.5 * np.add(wall.start, wall.end)
        # Along the wall, outside of it, and not upside down.
        turn = np.degrees(np.arctan2(-normal[0], normal[1]))
        axes.annotate(
            f'{wall.id}: {counts[wall.id]}', (x, y), tuple(-12.0 * normal[:2]),
            textcoords='offset points', ha='center', va='center', fontsize=12,
            rotation=(turn + 89.9) % 180.0 - 89.9,
        )  # fmt: skip
    axes.set_title(f'{len(landmarks.landmarks)} landmarks', fontsize=11)
