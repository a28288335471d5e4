"""Plans: ``map.png``, ``plan.png``, and Figures 6 and 8 of Livatino and Madsen."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch
import numpy as np
import numpy.typing as npt

from landmark_nav.evaluation.figures import style
from landmark_nav.evaluation.figures.style import caption, mark, show, Strip, widest
from landmark_nav.geometry.patches import observed_well
from landmark_nav.geometry.walls import Marker, Paper, Room
from landmark_nav.learning.pipeline import LearningResult
from landmark_nav.localization.triplet.visibility import TripletConfig
from landmark_nav.planning.planner import Plan
from landmark_nav.planning.prediction import Forecast
from landmark_nav.types import Landmark, LandmarkMap

# Scale of the ellipses: those of millimetres would not be visible in a room.
_MAGNIFIED = 10.0
_NORMAL_M = 0.18
_MARGIN_M = 0.4
# Distance of a number from its wall, width of a digit of 7 points, and height of a number.
_WALL_IN, _DIGIT_IN, _ROW_IN = 0.16, 0.08, 0.105


def draw_map(landmarks: LandmarkMap, path: Path, papers: Iterable[Paper | Marker] = ()) -> None:
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
    sweeps = len(landmarks.panorama_poses)
    axes.set_title(f'{len(landmarks.landmarks)} landmarks learned from {sweeps} panoramas')
    style.plain(axes)
    text = 'landmark, its normal, its number where there is room'
    large = f'3 sigma, {_MAGNIFIED:.0f} times as large'
    handles = [
        style.key(style.LANDMARK, 'o', text, linestyle='-'),
        style.key(style.LANDMARK, 'o', large, markersize=13, alpha=0.35),
        style.key(style.FUSED, '^', 'sweep, arrow along base_link +x'),
    ]
    drawn = list(papers)
    style.draw_papers(axes, drawn)
    if any(isinstance(paper, Paper) for paper in drawn):
        handles.append(style.key('#888888', 's', 'paper, in its colour'))
    elif drawn:
        handles.append(style.key('black', 's', 'marker'))
    style.legend_beside(axes, 'below', (len(handles) + 1) // 2, handles)
    number_landmarks(figure, axes, landmarks, _MAGNIFIED)
    style.save(figure, path)


def draw_landmarks(axes: Axes, landmarks: LandmarkMap) -> None:
    """Draw landmarks as dots."""
    axes.plot(*landmarks.positions[:, :2].T, 'o', color=style.LANDMARK, markersize=4, zorder=6)


def number_landmarks(
    figure: Figure, axes: Axes, landmarks: LandmarkMap, enlarged: float,
    shown: npt.ArrayLike = True,
) -> None:  # fmt: skip
    """
    Write numbers behind the landmarks, where they meet no line, ellipse or other number.

    Call it last, as it depends on the final layout of the figure. Ellipses are `enlarged`;
    `shown` (n,) selects landmarks.
    """
    which = np.flatnonzero(np.broadcast_to(shown, len(landmarks.landmarks)))
    if not len(which):
        return
    feet, normals = landmarks.positions[which, :2], landmarks.normals[which, :2]
    figure.draw_without_rendering()
    # Metres per inch in the final layout.
    scale = float(np.ptp(axes.get_xlim()) * figure.dpi / axes.get_window_extent().width)
    style.keep_in_view(axes, feet, 3.0 * _WALL_IN * scale)
    ids, covariances = landmarks.ids[which], landmarks.covariances[which, :2, :2]
    variances = np.einsum('ni,nij,nj->n', normals, covariances, normals)
    behind = 3.0 * enlarged * np.sqrt(variances) + scale * _WALL_IN
    places = feet - behind[:, None] * normals
    sizes = scale * np.stack([_DIGIT_IN * np.char.str_len(ids.astype(str)), 0 * ids + _ROW_IN], 1)
    around = 3.0 * enlarged * np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    tips = feet + _NORMAL_M * normals
    taken = [np.minimum(feet - around, tips)]
    taken_sizes = [np.maximum(feet + around, tips) - taken[0]]
    for wall in landmarks.walls:
        count = 2 + round(2.0 * wall.length / (_ROW_IN * scale))
        taken.append(np.linspace(wall.start, wall.end, count))
        taken_sizes.append(np.zeros((count, 2)))
    low, high = np.transpose([axes.get_xlim(), axes.get_ylim()])
    inside = np.all((places - 0.5 * sizes > low) & (places + 0.5 * sizes < high), axis=1)
    places, ids, sizes = places[inside], ids[inside], sizes[inside]
    obstacles = np.concatenate(taken), np.concatenate(taken_sizes)
    free = style.free_labels(places - 0.5 * sizes, sizes, *obstacles)
    places, ids = places[free], ids[free]
    look: dict[str, Any] = {'fontsize': 7, 'ha': 'center', 'va': 'center', 'zorder': 8}
    for number, (x, y) in zip(ids, places, strict=True):
        # The text is inside the axes; to check that in the layout is slow.
        axes.text(x, y, str(number), color='#333333', **look).set_in_layout(False)


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
    place, normal, viewpoint = landmark.position, landmark.normal, landmark.viewpoint
    bounds = _BOUNDS.min_sampling, _BOUNDS.max_sampling
    seen = observed_well(place[None], normal[None], viewpoint[None], cells, *bounds)[:, 0]
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
    style.draw_papers(axes, room.anchors)
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


_SHARE = 0.25
_ENLARGED = 30.0


def draw_learned(result: LearningResult, room: Room, path: Path) -> str:
    """Draw two parts of the first panorama with selected patches, and their locations."""
    first, second = _strips(result)
    figure = style.new_figure(17.0, 7.2)
    left, right = np.ravel(np.asarray(figure.subfigures(1, 2, width_ratios=[1.0, 1.25])))
    drawn: set[int] = set()
    for axes, strip in zip(left.subplots(2, 1), (first, second), strict=True):
        drawn |= _draw_strip(axes, result, strip)
    axes = right.subplots()
    shown = np.array([landmark.id in drawn for landmark in result.map.landmarks])
    _draw_plan(axes, result, room, shown)
    candidates = sum(len(group) for group in result.candidates)
    counts = f'{len(result.map.landmarks)} landmarks out of {candidates} candidates'
    sigma = np.sqrt(np.trace(result.map.covariances[:, :2, :2], axis1=1, axis2=2))
    text = (
        f'Figure 8. Left: patches that attention selects by all features together in two parts of '
        f'panorama L; thin those that were not elected ({counts} of {len(result.panoramas)} '
        f'panoramas). Right: the places of the {shown.sum()} elected ones, small those from '
        f'elsewhere; 3 sigma {_ENLARGED:.0f} times as large. Their standard deviations (root of '
        f'the trace) are {1e3 * np.median(sigma[shown]):.1f} mm in the median.'
    )
    caption(figure, text)
    number_landmarks(figure, axes, result.map, _ENLARGED, shown)
    style.save(figure, path)
    return text


def _strips(result: LearningResult) -> tuple[Strip, Strip]:
    """Return the part with most landmarks, and the best part apart from it."""
    panorama = result.panoramas[0]
    turn = panorama.mask.shape[1]
    pairs = zip(result.candidates[0], result.outcomes[0], strict=True)
    elected = [candidate for candidate, outcome in pairs if isinstance(outcome, Landmark)]
    width = round(_SHARE * turn)
    first = widest(panorama, elected, width, max(turn // 72, 1))
    rest = [candidate for candidate in elected if first.place(candidate, turn) is None]
    away = [c for c in rest if (c.column - first.start) % turn > first.width + width / 4]
    return first, widest(panorama, away or rest or elected, width, max(turn // 72, 1))


def _draw_strip(axes: Axes, result: LearningResult, strip: Strip) -> set[int]:
    """Draw a part of the first panorama; return the ids of the landmarks in it."""
    panorama = result.panoramas[0]
    show(axes, strip.cut(panorama.image))
    ids = set()
    for candidate, outcome in zip(result.candidates[0], result.outcomes[0], strict=True):
        place = strip.place(candidate, panorama.mask.shape[1])
        if place is None:
            continue
        if isinstance(outcome, Landmark):
            ids.add(outcome.id)
            mark(axes, place, candidate, str(outcome.id))
        else:
            mark(axes, place, candidate, '', style.CANDIDATE)
    return ids


def _draw_plan(
    axes: Axes, result: LearningResult, room: Room, shown: npt.NDArray[np.bool_]
) -> None:
    style.draw_walls(axes, room.walls, _MARGIN_M)
    style.draw_papers(axes, room.anchors)
    landmarks = result.map
    axes.plot(*landmarks.positions[~shown, :2].T, '.', color=style.LANDMARK, alpha=0.35, zorder=4)
    style.draw_sweep_places(axes, [panorama.center_map[:2] for panorama in result.panoramas])
    eye = result.panoramas[0].center_map[:2]
    for k in np.flatnonzero(shown):
        landmark = landmarks.landmarks[k]
        point = landmark.position[:2]
        ray = np.stack([eye, point], -1)
        axes.plot(*ray, color=style.FUSED, alpha=0.12, linewidth=0.8, zorder=1)
        style.add_ellipse(axes, point, landmark.covariance[:2, :2], style.LANDMARK, _ENLARGED)
    axes.plot(*landmarks.positions[shown, :2].T, 'o', color=style.LANDMARK, markersize=5, zorder=6)


_PLAN_MARGIN_M = 0.35


def draw_plan(plan: Plan, room: Room, path: Path) -> None:
    """Draw the map of expected accuracy with the proposed poses."""
    width, height = np.ptp(room.bounds, axis=0) + 2.0 * _PLAN_MARGIN_M
    scale = 7.0 / max(width, height)
    figure = style.new_figure(scale * width + 1.5, scale * height + 1.5)
    axes = figure.add_subplot()
    _draw_accuracy(axes, plan.accuracy_map)
    style.draw_walls(axes, room.walls, _PLAN_MARGIN_M)
    style.draw_papers(axes, room.anchors)
    style.draw_sweep_places(axes, plan.best.poses_map_base, 'place')
    middle = plan.random[len(plan.random) // 2]
    text = f'proposed: {1e3 * plan.best.cost_m:.2f} mm in the mean over the floor'
    handles = [style.key(style.FUSED, '^', text)]
    text = f'median of random places: {1e3 * middle.cost_m:.2f} mm'
    handles.append(style.key('white', '', text))
    axes.set_title(
        f'Expected localization error, {len(plan.best.poses_map_base)} panoramas, '
        f'{plan.best.landmarks.sum():.0f} landmarks',
        pad=15 * len(handles) + 12,  # above the legend
    )
    for side in ('top', 'right', 'left', 'bottom'):
        axes.spines[side].set_visible(False)
    style.legend_beside(axes, 'above', 1, handles)
    style.save(figure, path)


def _draw_accuracy(axes: Axes, forecast: Forecast) -> None:
    """Draw a heat map in millimetres with lines of equal error; unknown cells are blank."""
    at = np.round(forecast.floor_xy.T, 6)
    (x, column), (y, row) = (np.unique(values, return_inverse=True) for values in at)
    error = np.full((len(y), len(x)), np.nan)
    sigma_mm = 1e3 * forecast.sigma_m
    error[row, column] = np.where(np.isfinite(sigma_mm), sigma_mm, np.nan)
    known = error[np.isfinite(error)]
    low, high = (float(np.quantile(known, q)) for q in (0.0, 0.98))
    axes.set_facecolor('#f4f4f4')
    look: dict[str, Any] = {'cmap': 'viridis_r', 'vmin': low, 'vmax': max(high, low + 0.1)}
    heat = axes.pcolormesh(x, y, error, zorder=1, shading='nearest', **look)
    figure = axes.figure
    bar = figure.colorbar(heat, ax=axes, shrink=0.75, extend='max', pad=0.02)
    bar.set_label('position error, root of the trace [mm]')
    bar.outline.set_visible(False)
    if min(error.shape) >= 2 and high > low:
        levels = np.unique(np.round(np.quantile(known, [0.25, 0.5, 0.75, 0.95]), 2))
        look = {'colors': 'white', 'linewidths': 0.8, 'zorder': 2}
        bar.add_lines(axes.contour(x, y, error, levels, **look))
