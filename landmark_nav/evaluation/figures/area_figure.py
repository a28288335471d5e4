"""Counterpart of Figure 6 of Livatino and Madsen: observation areas of landmarks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.patches import Patch
import numpy as np
import numpy.typing as npt

from landmark_nav.evaluation.figures.strips import caption, show
from landmark_nav.evaluation.figures.style import (
    draw_papers,
    draw_sweep_places,
    draw_walls,
    FIX,
    framed,
    FUSED,
    key,
    LANDMARK,
    new_figure,
    ODOMETRY,
    save,
)
from landmark_nav.geometry.patches import observed_well
from landmark_nav.geometry.walls import Room
from landmark_nav.localization.triplet import TripletConfig
from landmark_nav.types import FloatArray, Landmark, LandmarkMap

_COUNT = 3
# Bounds of the robot by default.
_BOUNDS = TripletConfig()
_CELL_M = 0.04
# Margin of the plans for the names of walls, as a share of the longer side.
_MARGIN = 0.07
_LEVELS = (0.5, 1.5)


@dataclass(frozen=True, eq=False)
class AreaTest:
    """Whether a landmark was correctly `found` (c,) from positions `xy` (c, 2) of a robot."""

    landmark: int
    xy: FloatArray
    found: npt.NDArray[np.bool_]


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


def draw_observation_areas(
    landmarks: LandmarkMap, room: Room, path: Path, tests: Sequence[AreaTest] = ()
) -> str:
    """
    Draw observation areas of three landmarks and the poses of the sweeps; return the caption.

    Parameters
    ----------
    tests : sequence of AreaTest
        Tests of the areas, if there are any.
    """
    chosen = typical_landmarks(landmarks)
    tried = {test.landmark: test for test in tests}
    width, height = np.ptp(room.bounds, axis=0) + 2.0 * _margin_m(room)
    # The figure is higher than the plans: otherwise the layout has no room for labels below them.
    figure = new_figure(15.0, 2.0 * (5.9 * height / width + 1.1) + 1.2)
    top, body = np.ravel(np.asarray(figure.subfigures(2, 1, height_ratios=[0.04, 1.0])))
    grid = np.asarray(body.subplots(2, 4, width_ratios=[5.0, 1.0, 5.0, 1.0]))
    panels, patches = grid[:, ::2].ravel(), grid[:, 1::2].ravel()
    agree: list[tuple[int, int]] = []
    for axes, beside, landmark in zip(panels, patches, chosen, strict=False):
        agree.append(_draw_area(axes, landmark, room, tried.get(landmark.id)))
        _draw_patch(beside, landmark)
    for axes in (*panels[len(chosen) : -1], *patches[len(chosen) :]):
        axes.set_axis_off()
    _draw_places(panels[-1], landmarks, room)
    handles = [
        Patch(color=FIX, alpha=0.45, label='observation area as predicted'),
        key(FUSED, '^', 'where it was learned'),
    ]
    if tests:
        handles += [key(LANDMARK, 'o', 'found from here'), key(ODOMETRY, 'x', 'not found')]
    top.legend(handles=handles, loc='center', ncols=len(handles), frameon=False)
    text = (
        f'Figure 6. Observation areas of {len(chosen)} landmarks: there neither width nor height '
        f'of the patch is seen with less than {_BOUNDS.min_sampling:g} or more than '
        f'{_BOUNDS.max_sampling:g} times the resolution of the view that it was learned from.'
    )
    if tests:
        same, total = np.sum(agree, axis=0)
        text += (
            f' Looked for from {total} places on another day (a lamp dimmed, a piece of furniture '
            f'moved), the area predicts for {same / total:.0%} of them whether a patch is found.'
        )
    text += ' Bottom right: the places of the sweeps, and how many landmarks each wall has.'
    caption(figure, text)
    save(figure, path)
    return text


def _margin_m(room: Room) -> float:
    return _MARGIN * float(np.ptp(room.bounds, axis=0).max())


def _draw_area(
    axes: Axes, landmark: Landmark, room: Room, test: AreaTest | None
) -> tuple[int, int]:
    """Draw one landmark; return the numbers of tests that agree with the area, and of all."""
    x, y = (np.arange(a, b + _CELL_M, _CELL_M) for a, b in zip(*room.bounds, strict=True))
    cells = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    area = _predicted(landmark, room, cells).reshape(len(y), len(x)).astype(float)
    axes.contourf(x, y, area, _LEVELS, colors=FIX, alpha=0.45, zorder=1)
    draw_walls(axes, room.walls, _margin_m(room))
    axes.set_anchor('NE')
    axes.plot(*landmark.position[:2], 's', color=LANDMARK, markersize=8, zorder=6)
    axes.plot(*landmark.viewpoint[:2], '^', color=FUSED, markersize=10, zorder=6)
    wall = f'wall {landmark.wall_id}' if landmark.wall_id else 'no wall'
    title = f'landmark {landmark.id} on {wall}'
    agree = (0, 0)
    if test is not None:
        axes.plot(*test.xy[test.found].T, 'o', color=LANDMARK, markersize=4, zorder=4)
        axes.plot(*test.xy[~test.found].T, 'x', color=ODOMETRY, markersize=4, zorder=3)
        predicted = _predicted(landmark, room, test.xy)
        agree = int(np.sum(predicted == test.found)), len(predicted)
        inside, outside = test.found[predicted], test.found[~predicted]
        title += f'\nfound from {inside.sum()} of {len(inside)} places inside, '
        title += f'{outside.sum()} of {len(outside)} outside'
    axes.set_title(title, fontsize=11)
    return agree


def _predicted(landmark: Landmark, room: Room, xy: FloatArray) -> npt.NDArray[np.bool_]:
    seen = observed_well(
        landmark.position[None],
        landmark.normal[None],
        landmark.viewpoint[None],
        xy,
        _BOUNDS.min_sampling,
        _BOUNDS.max_sampling,
    )[:, 0]
    return np.asarray(seen & room.contains(xy) & room.visible(xy, landmark.position[:2]))


def _draw_patch(axes: Axes, landmark: Landmark) -> None:
    """Draw the patch of a landmark."""
    show(axes, landmark.patch)
    axes.set_anchor('NW')
    framed(axes, LANDMARK)


def _draw_places(axes: Axes, landmarks: LandmarkMap, room: Room) -> None:
    draw_walls(axes, room.walls, _margin_m(room))
    axes.set_anchor('NE')
    draw_papers(axes, room.papers)
    axes.plot(*landmarks.positions[:, :2].T, '.', color=LANDMARK, markersize=6, zorder=4)
    draw_sweep_places(axes, [place.pose[:2] for place in landmarks.panorama_poses])
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
