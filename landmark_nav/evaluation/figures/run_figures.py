"""``trajectory.png`` and ``errors.png``: a run compared with the ground truth."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
import numpy as np

from landmark_nav.evaluation.figures import style
from landmark_nav.evaluation.figures.map_figure import draw_landmarks
from landmark_nav.evaluation.replay import Replay
from landmark_nav.evaluation.run_report import errors_by_axis, path_of, Smoothed
from landmark_nav.types import FloatArray, LandmarkMap


def draw_trajectory(
    run: Replay, landmark_map: LandmarkMap, path: Path, smoothed: Smoothed | None = None
) -> None:
    """Draw true, dead reckoned, fused and other trajectories in the plan of the room."""
    figure = style.new_figure(9.0, 6.6)
    axes = figure.add_subplot()
    style.draw_walls(axes, landmark_map.walls, 0.3)
    draw_landmarks(axes, landmark_map)
    fixes = run.fixes
    axes.plot(*fixes[:, :2].T, '.', color=style.FIX, markersize=4, label='triangulated', zorder=3)
    lines = [(run.odometry.poses[:, :2].T, style.ODOMETRY, 1.5, 'odometry alone')]
    if len(run.truth):
        lines.append((run.truth.poses[:, :2].T, style.TRUTH, 3.0, 'truth'))
    lines.append((path_of(run, run.stamps_ns, run.fused), style.FUSED, 1.4, 'fused'))
    if smoothed is not None:
        line = path_of(run, smoothed.stamps_ns, smoothed.poses)
        lines.append((line, style.SMOOTHED, 1.0, 'smoothed'))
    for line, color, width, label in lines:
        axes.plot(*line, color=color, linewidth=width, label=label, zorder=4)
    axes.plot(*run.start.pose[:2], 'o', color=style.TRUTH, markersize=7, label='start', zorder=6)
    axes.plot([], [], 'o', color=style.LANDMARK, markersize=4, label='landmark')
    style.keep_in_view(axes, np.concatenate([run.odometry.poses[:, :2], run.fused[:, :2]]), 0.2)
    way = run.odometry.at(run.stamps_ns)[:, :2]
    way_m = float(np.nansum(np.hypot(*np.diff(way, axis=0).T)))
    axes.set_title(f'A drive of {way_m:.1f} m in {1e-9 * np.ptp(run.stamps_ns):.0f} s')
    style.plain(axes)
    style.legend_beside(axes, 'below', 7)
    style.save(figure, path)


def draw_errors(run: Replay, path: Path) -> None:
    """
    Draw the errors ahead, to the left and in heading, with +-3 sigma by the covariance.

    Fixes beyond the axes are counted. A strip below shows which images gave a fix and when the
    state was lost.
    """
    figure = style.new_figure(10.0, 7.6)
    rows = figure.subplots(4, 1, sharex=True, height_ratios=[3.0, 3.0, 3.0, 1.0])
    seconds = 1e-9 * (run.stamps_ns - run.begin_ns).astype(np.float64)
    by_axis = errors_by_axis(run, run.errors.triangulation)
    for axes, one in zip(rows[:3], by_axis, strict=True):
        look = {'color': style.FUSED, 'alpha': 0.18, 'linewidth': 0, 'label': '±3 sigma'}
        axes.fill_between(seconds, -one.band, one.band, **look)
        axes.plot(seconds, one.fixes, '.', color=style.FIX, markersize=3, label='triangulated')
        axes.plot(seconds, one.fused, color=style.FUSED, linewidth=1.3, label='fused')
        axes.axhline(0.0, color=style.TRUTH, linewidth=0.6)
        axes.set_ylim(-one.limit, one.limit)
        beyond = int(np.sum(np.abs(one.fixes) > one.limit))
        if beyond:
            place = {'xycoords': 'axes fraction', 'ha': 'right', 'va': 'bottom', 'fontsize': 8}
            axes.annotate(f'{beyond} triangulated beyond', (0.995, 1.0), **place)
        axes.set_ylabel(one.label)
        style.plain(axes)
    _strip(rows[3], run, seconds)
    rows[3].set_xlabel('time [s]')
    figure.suptitle(
        'Errors of base_link in map: estimated position, seen from the true one'
        if len(run.truth)
        else 'No ground_truth/odom in the bag: no errors, only what the fusion claims'
    )
    style.legend_beside(rows[0], 'above', 3)
    style.save(figure, path)


def _strip(axes: Axes, run: Replay, seconds: FloatArray) -> None:
    """Draw for each image whether it gave a fix, whether fusion used it, whether it was lost."""
    fixed = np.isfinite(run.fixes[:, 0])
    used = np.array([update.used > 0 for update in run.updates])
    names = []
    for height, (name, where, color) in enumerate((
        ('lost', run.lost, style.ODOMETRY),
        ('used by fusion', used, style.FUSED),
        ('triangulated', fixed, style.FIX),
    )):  # fmt: skip
        axes.plot(seconds[where], np.full(int(where.sum()), height), '|', color=color, ms=9)
        names.append(f'{name} {int(where.sum())}')
    axes.set_yticks(range(3), names)
    axes.set_ylim(-0.6, 2.6)
    style.plain(axes)
