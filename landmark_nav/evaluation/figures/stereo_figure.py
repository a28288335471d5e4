"""
Counterpart of Figure 5 of Livatino and Madsen: location of a landmark from two panoramas.

Left, one landmark: its patch in one panorama, and the epipolar curve with the match in the other.
Right, both rays in plan, and the sigma of a landmark by two rays alone, all over the room.
"""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
import numpy as np

from landmark_nav.evaluation.figures import style
from landmark_nav.evaluation.figures.style import caption, mark, show, Strip
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.pipeline import LearningResult
from landmark_nav.types import Candidate, FloatArray, Landmark, Panorama

# Width of a strip, as a share of the turn.
_SHARE = 0.16
_NAMES = 'LR'
_MARGIN_M = 0.3
_CELL_M = 0.02
# Usual sigma of a match, columns.
_MATCH_PX = 0.1
_LEVELS_MM = (2.0, 3.0, 5.0, 10.0, 20.0, 50.0)


def draw_reconstruction(result: LearningResult, room: Room, path: Path) -> str:
    """
    Draw the reconstruction of a landmark and its sigma over the room; return the caption.

    Of more than two panoramas the first two are drawn.
    """
    source, candidate, landmark = _example(result)
    views = result.panoramas[source], result.panoramas[1 - source]
    figure = style.new_figure(16.0, 6.6)
    left, right = np.ravel(np.asarray(figure.subfigures(1, 2, width_ratios=[1.0, 1.6])))
    above, below = left.subplots(2, 1)
    width = round(_SHARE * views[0].mask.shape[1])
    turn = views[0].mask.shape[1]
    strip = Strip.around(views[0], candidate.column, candidate.row, width)
    title = f'patch of landmark {landmark.id} in panorama {_NAMES[source]}'
    show(above, strip.cut(views[0].image), title)
    place = strip.place(candidate, turn)
    assert place is not None, 'the strip is centred on it'
    mark(above, place, candidate, str(landmark.id))
    _draw_epipolar(below, views, candidate, landmark, width, _NAMES[1 - source])
    low = _draw_uncertainty(right.subplots(), result, room, landmark)
    parallax = np.degrees(_angle(result.panoramas[:2], landmark.position[:2]))
    sigma = 1e3 * np.sqrt(np.trace(landmark.covariance[:2, :2]))
    baseline = np.hypot(*(views[0].center_map - views[1].center_map)[:2])
    text = (
        f'Figure 5. Left: landmark {landmark.id} is searched along the epipolar curve of the '
        f'other panorama; the two rays meet at the angle a = {parallax:.0f}°, and together with '
        f'the wall leave {sigma:.1f} mm (root of the trace). Right: what two rays alone, without '
        f'the wall, would leave all over the room: lines of equal standard deviation for a match '
        f'to {_MATCH_PX:g} px and the panoramas as they are known, {baseline:.2f} m apart. Best '
        f'are the areas R and S beside the baseline (down to {low:.1f} mm), useless is what lies '
        'on it.'
    )
    caption(figure, text)
    style.save(figure, path)
    return text


def ray_sigma_m(panoramas: tuple[Panorama, Panorama], xy: FloatArray) -> FloatArray:
    """
    Root of the trace of the covariance of points (n, 2) located by azimuths of two panoramas.

    ``Sigma = [(r1 s1)^2 u2 u2^T + (r2 s2)^2 u1 u1^T] / sin^2 a``, where s includes the errors of
    the pose of the panorama; the errors of the two panoramas are regarded as independent.
    """
    square = np.zeros(len(xy))
    for panorama in panoramas:
        away = xy - panorama.center_map[:2]
        reach = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-3)
        across = np.stack([-away[:, 1], away[:, 0]], -1) / reach[:, None]
        lever = np.concatenate([across, reach[:, None]], axis=1)
        square += np.einsum('ni,ij,nj->n', lever, panorama.axis.covariance, lever)
        square += (reach * _MATCH_PX / panorama.cylinder.fx) ** 2
    sine = np.sin(_angle(panoramas, xy))
    return np.asarray(np.sqrt(square) / np.maximum(np.abs(sine), 1e-6))


def _angle(panoramas: tuple[Panorama, ...], xy: FloatArray) -> FloatArray:
    first, second = (xy - panorama.center_map[:2] for panorama in panoramas)
    azimuths = (np.arctan2(way[..., 1], way[..., 0]) for way in (first, second))
    return np.asarray(np.abs(wrap_rad(next(azimuths) - next(azimuths))))


def _example(result: LearningResult) -> tuple[int, Candidate, Landmark]:
    """Return the landmark of the first two panoramas with the best parallax, and its candidate."""
    best: tuple[float, int, Candidate, Landmark] | None = None
    for source, (candidates, outcomes) in enumerate(
        zip(result.candidates[:2], result.outcomes[:2], strict=True)
    ):
        for candidate, outcome in zip(candidates, outcomes, strict=True):
            if isinstance(outcome, Landmark):
                sine = float(np.sin(_angle(result.panoramas[:2], outcome.position[:2])))
                merit = min(sine, 0.7) + 0.5 * candidate.saliency
                if best is None or merit > best[0]:
                    best = merit, source, candidate, outcome
    assert best is not None, 'learning refuses panoramas without a landmark'
    return best[1:]


def _draw_epipolar(
    axes: Axes, views: tuple[Panorama, Panorama], candidate: Candidate, landmark: Landmark,
    width: int, name: str,
) -> None:  # fmt: skip
    """Draw the other panorama with the curve of all distances, and the match."""
    here, there = views
    azimuth = float(here.cylinder.azimuth_rad(candidate.column)) + here.heading_rad
    ray = np.array([np.cos(azimuth), np.sin(azimuth), here.cylinder.tangent(candidate.row)])
    reach = float(np.hypot(*(landmark.position - here.center_map)[:2]))
    distance = np.geomspace(0.3 * reach, 5.0 * reach, 400)
    match = _pixel(there, landmark.position[None])[0]
    curve = _pixel(there, here.center_map + distance[:, None] * ray)
    strip = Strip.around(there, match[0], match[1], width)
    show(axes, strip.cut(there.image), f'epipolar curve and match in panorama {name}')
    turn = there.mask.shape[1]
    at = (curve - [strip.start, strip.top]) % [turn, 1e9]
    inside = (at[:, 0] < strip.width) & (at[:, 1] < strip.bottom - strip.top)
    axes.plot(*np.where(inside[:, None], at, np.nan).T, color=style.CANDIDATE, linewidth=1.5)
    scale = reach / float(np.hypot(*(landmark.position - there.center_map)[:2]))
    size = (round(candidate.width_px * scale), round(candidate.height_px * scale))
    found = Candidate(float(match[0]), float(match[1]), *size, 1.0)
    place = strip.place(found, turn)
    if place is not None:
        mark(axes, place, found, str(landmark.id))


def _pixel(panorama: Panorama, points: FloatArray) -> FloatArray:
    away = points - panorama.center_map
    turned = away[:, :2] @ se2.rotation(panorama.heading_rad)
    return panorama.cylinder.project(np.concatenate([turned, away[:, 2:]], axis=1))


def _draw_uncertainty(axes: Axes, result: LearningResult, room: Room, landmark: Landmark) -> float:
    """Draw a heat map of sigmas, and the rays to a landmark; return the least sigma, mm."""
    pair = result.panoramas[0], result.panoramas[1]
    low, high = room.bounds
    x, y = (np.arange(a, b + _CELL_M, _CELL_M) for a, b in zip(low, high, strict=True))
    cells = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    sigma = 1e3 * ray_sigma_m(pair, cells)
    inside = room.contains(cells)
    for panorama in pair:
        inside &= room.visible(panorama.center_map[:2], cells)
    sigma[~inside] = np.nan
    grid = sigma.reshape(len(y), len(x))
    norm = LogNorm(1.0, 100.0)
    heat = axes.pcolormesh(x, y, grid, cmap='viridis_r', norm=norm, shading='nearest', zorder=1)
    lines = axes.contour(x, y, grid, _LEVELS_MM, colors='white', linewidths=1.0, zorder=2)
    style.draw_walls(axes, room.walls, _MARGIN_M)
    bar = axes.figure.colorbar(heat, ax=axes, shrink=0.7, extend='both')
    bar.add_lines(lines)
    ticks = (1.0, *_LEVELS_MM, 100.0)
    bar.set_ticks(ticks, labels=[f'{mm:g}' for mm in ticks])
    bar.minorticks_off()
    bar.set_label('standard deviation of a landmark from two rays [mm]')
    centers = np.array([p.center_map[:2] for p in pair])
    axes.plot(*centers.T, '--', color='white', zorder=3)
    rays = np.stack([centers[0], landmark.position[:2], centers[1]])
    axes.plot(*rays.T, color=style.CANDIDATE, linewidth=1.5, zorder=3)
    style.draw_sweep_places(axes, centers)
    along = centers[1] - centers[0]
    side = (cells - centers[0]) @ np.array([-along[1], along[0]])
    for letter, half in (('R', side > 0.0), ('S', side < 0.0)):
        good = half & np.isfinite(sigma)
        if good.any():
            best = good & (sigma <= 1.3 * np.nanmin(sigma[good]))
            axes.annotate(
                f'area {letter}', cells[best].mean(axis=0), ha='center', va='center', fontsize=16,
                weight='bold', path_effects=style.HALO, zorder=6,
            )  # fmt: skip
    axes.plot(*result.map.positions[:, :2].T, '.', color=style.LANDMARK, markersize=7, zorder=4)
    axes.set_title('areas R and S have the least uncertainty; dots: landmarks learned')
    return float(np.nanmin(sigma))
