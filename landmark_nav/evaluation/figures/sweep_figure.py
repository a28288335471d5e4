"""Counterpart of Figure 3 of Livatino and Madsen: panoramas from frames of a turning camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
import numpy as np

from landmark_nav.evaluation.figures.strips import caption
from landmark_nav.evaluation.figures.style import FUSED, new_figure, plain, save
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.geometry.walls import Paper, Room
from landmark_nav.types import FloatArray, Panorama, Sweep

_WIDTH_IN = 24.0
_NAMES = 'LR'
# Height of a line of 12 points with its border; height of two lines, pixels of a panorama.
_LINE_PT, _NAMES_PX = 20.0, 75.0


def draw_sweeps(
    sweeps: Sequence[Sweep], panoramas: Sequence[Panorama], room: Room, path: Path
) -> str:
    """Draw panoramas with papers and the number of frames of each column; return the caption."""
    shape = panoramas[0].image.shape
    height = len(sweeps) * (_WIDTH_IN * shape[0] / shape[1] + 1.3) + 1.0
    figure = new_figure(_WIDTH_IN, height)
    ratios = [_WIDTH_IN * shape[0] / shape[1], 0.6] * len(sweeps)
    rows = figure.subplots(2 * len(sweeps), 1, height_ratios=ratios)
    counts = [_frames_of_columns(s, p) for s, p in zip(sweeps, panoramas, strict=True)]
    for k, panorama in enumerate(panoramas):
        name = _NAMES[k] if len(panoramas) <= 2 else f'{k + 1}'
        _draw_panorama_part(rows[2 * k], panorama, room, f'{name}: {_place(panorama)}')
        _draw_counts(rows[2 * k + 1], panorama, counts[k])
    text = _text(sweeps, panoramas, counts, room.papers)
    caption(figure, text, 14.0)
    save(figure, path)
    return text


def _draw_panorama_part(axes: Axes, panorama: Panorama, room: Room, title: str) -> None:
    axes.imshow(np.where(panorama.mask[..., None], panorama.image[..., ::-1], 255), aspect='auto')
    axes.set_title(title, fontsize=15)
    axes.set_xticks([])
    axes.set_yticks([])
    _name_papers(axes, panorama, room)
    axes.set_xlim(-0.5, panorama.mask.shape[1] - 0.5)


def _name_papers(axes: Axes, panorama: Panorama, room: Room) -> None:
    """Label each paper above it, or below if there is no room, at alternating distances."""
    height = panorama.mask.shape[0]
    seen = []
    for paper in room.papers:
        away = np.asarray(paper.center) - panorama.center_map
        distance = float(np.hypot(away[0], away[1]))
        azimuth = np.arctan2(away[1], away[0]) - panorama.heading_rad
        row = float(panorama.cylinder.row_of(away[2] / distance))
        half = 0.5 * paper.height * panorama.cylinder.fy / distance
        if half < row < height - half:
            seen.append((float(panorama.cylinder.column_of(azimuth)), row, half, paper.color))
    for k, (column, row, half, color) in enumerate(sorted(seen)):
        way = -1.0 if row - half > _NAMES_PX else 1.0
        offset = (0.0, -way * _LINE_PT * (1.2 + k % 2))
        axes.annotate(
            f'{color} paper', (column, row + way * (half + 3.0)), offset,
            textcoords='offset points', ha='center', va='center', fontsize=12,
            arrowprops={'arrowstyle': '->'},
            bbox={'boxstyle': 'round,pad=0.15', 'facecolor': 'white', 'linewidth': 0.0},
        )  # fmt: skip


def _draw_counts(axes: Axes, panorama: Panorama, counts: FloatArray) -> None:
    axes.fill_between(np.arange(len(counts)), counts, step='mid', color=FUSED, alpha=0.35)
    axes.set_ylim(0, counts.max() + 1)
    axes.set_ylabel('frames')
    azimuths = np.arange(-165, 181, 15)
    axes.set_xticks(panorama.cylinder.column_of(np.radians(azimuths)), [f'{a}°' for a in azimuths])
    axes.set_xlim(-0.5, len(counts) - 0.5)
    plain(axes)


def _frames_of_columns(sweep: Sweep, panorama: Panorama) -> FloatArray:
    """Number of frames that show each column (width,) at the horizon."""
    azimuth = panorama.cylinder.azimuth_rad(np.arange(panorama.cylinder.width))
    counts = np.zeros(panorama.cylinder.width)
    for frame in sweep.frames:
        left, right = _sides(frame.camera)
        away = wrap_rad(azimuth - frame.pan_rad)
        counts += (away <= left) & (away >= right)
    return counts


def _sides(camera: CameraModel) -> tuple[float, float]:
    """Angles of the left and right borders from the optical axis, counter-clockwise."""
    rims = np.array([[0.0, camera.cy], [camera.width - 1.0, camera.cy]])
    rays = camera.unproject(rims)
    left, right = -np.arctan2(rays[:, 0], rays[:, 2])
    return float(left), float(right)


def _place(panorama: Panorama) -> str:
    x, y, _ = panorama.center_map
    sigma = np.sqrt(np.diag(panorama.covariance))
    return (
        f'pan axis at ({x:.3f}, {y:.3f}) m, heading {np.degrees(panorama.heading_rad):.2f}°; '
        f'standard deviations {1e3 * sigma[0]:.1f} mm, {1e3 * sigma[1]:.1f} mm, '
        f'{np.degrees(sigma[3]):.3f}°'
    )


def _text(
    sweeps: Sequence[Sweep],
    panoramas: Sequence[Panorama],
    counts: Sequence[FloatArray],
    papers: Sequence[Paper],
) -> str:
    poses = 'What they share gives their poses to each other.'
    if papers:
        poses = 'The papers of the reference area give the position of the camera.'
    frame = sweeps[0].frames[0]
    pans = np.sort([f.pan_rad for f in sweeps[0].frames])
    step = float(np.median(np.diff(pans)))
    left, right = _sides(frame.camera)
    cylinder = panoramas[0].cylinder
    return (
        f'Figure 3. Panoramas of the room, each a cylinder of {cylinder.width} x '
        f'{cylinder.height} px synthesized from {len(sweeps[0].frames)} frames of '
        f'{frame.camera.width} x {frame.camera.height} px, one each {np.degrees(step):.2f}°. Two '
        f'neighbouring frames overlap by {1.0 - step / (left - right):.0%}; a column is shown by '
        f'{np.median(counts[0]):.0f} frames in the median, by {counts[0].max():.0f} at most; the '
        f'median of those that look straightest at it is kept. {poses}'
    )
