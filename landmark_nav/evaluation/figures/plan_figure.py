"""``plan.png``: expected localization error over the floor."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
import numpy as np

from landmark_nav.evaluation.figures import style
from landmark_nav.geometry.walls import Room
from landmark_nav.planning.planner import Plan
from landmark_nav.planning.prediction import Forecast

_MARGIN_M = 0.35


def draw_plan(plan: Plan, room: Room, path: Path) -> None:
    """Draw the map of expected accuracy with the proposed poses."""
    width, height = np.ptp(room.bounds, axis=0) + 2.0 * _MARGIN_M
    scale = 7.0 / max(width, height)
    figure = style.new_figure(scale * width + 1.5, scale * height + 1.5)
    axes = figure.add_subplot()
    _draw_accuracy(axes, plan.accuracy_map)
    style.draw_walls(axes, room.walls, _MARGIN_M)
    style.draw_papers(axes, room.papers)
    handles = [
        style.key(style.FUSED, '^', f'proposed: {_cost(plan.best)} in the mean over the floor')
    ]
    style.draw_sweep_places(axes, plan.best.poses_map_base, 'place')
    middle = plan.random[len(plan.random) // 2]
    handles.append(style.key('white', '', f'median of random places: {_cost(middle)}'))
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
    (x, column), (y, row) = (
        np.unique(np.round(values, 6), return_inverse=True) for values in forecast.floor_xy.T
    )
    error = np.full((len(y), len(x)), np.nan)
    sigma_mm = 1e3 * forecast.sigma_m
    error[row, column] = np.where(np.isfinite(sigma_mm), sigma_mm, np.nan)
    known = error[np.isfinite(error)]
    low, high = (float(np.quantile(known, q)) for q in (0.0, 0.98))
    axes.set_facecolor('#f4f4f4')
    heat = axes.pcolormesh(
        x, y, error, cmap='viridis_r', vmin=low, vmax=max(high, low + 0.1), zorder=1,
        shading='nearest',
    )  # fmt: skip
    figure = axes.figure
    bar = figure.colorbar(heat, ax=axes, shrink=0.75, extend='max', pad=0.02)
    bar.set_label('position error, root of the trace [mm]')
    bar.outline.set_visible(False)
    if min(error.shape) >= 2 and high > low:
        levels = np.quantile(known, [0.25, 0.5, 0.75, 0.95])
        lines = axes.contour(
            x, y, error, np.unique(np.round(levels, 2)), colors='white', linewidths=0.8, zorder=2
        )
        bar.add_lines(lines)


def _cost(forecast: Forecast) -> str:
    return f'{1e3 * forecast.cost_m:.2f} mm'
