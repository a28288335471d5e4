"""Panoramas: ``panorama_K.png``, and the counterpart of Figure 3 of Livatino and Madsen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
import numpy as np

from landmark_nav.evaluation.figures import style
from landmark_nav.evaluation.figures.style import caption, new_figure, save
from landmark_nav.geometry.walls import Paper, Room
from landmark_nav.image_codec import encode_image
from landmark_nav.storage.atomic_io import write_atomically
from landmark_nav.types import Candidate, Landmark, Panorama, Refusal, Sweep

_FONT, _SIZE = cv2.FONT_HERSHEY_SIMPLEX, 0.45
# Height of an id, and its distance from the patch below it.
_ID_PX, _ABOVE_PX = 14, 3


def draw_panorama(
    panorama: Panorama,
    candidates: Sequence[Candidate],
    outcomes: Sequence[Landmark | Refusal],
    path: Path,
) -> None:
    """
    Draw a panorama with its candidates thin and its elected landmarks bold, with their ids.

    Ids that would overlap a previous one are omitted.
    """
    image = np.where(panorama.mask[..., None], panorama.image, np.uint8(255))
    turn = image.shape[1]
    thin, bold = (
        tuple(round(255 * part) for part in to_rgb(color)[::-1])
        for color in (style.CANDIDATE, style.LANDMARK)
    )
    elected: list[tuple[str, float, float]] = []
    for candidate, outcome in zip(candidates, outcomes, strict=True):
        color, width = thin, 1
        size = np.array([candidate.width_px, candidate.height_px])
        top_left = np.array([candidate.column, candidate.row]) - 0.5 * size
        if isinstance(outcome, Landmark):
            color, width = bold, 2
            elected.append((str(outcome.id), *top_left))
        # Patches across the seam are drawn at both ends.
        for shift in (-turn, 0, turn):
            first, last = np.rint(np.add([top_left, top_left + size], (shift, 0))).astype(int)
            cv2.rectangle(image, first.tolist(), last.tolist(), color, width)
    widths = [cv2.getTextSize(word, _FONT, _SIZE, 1)[0][0] for word, *_ in elected]
    above = [(left, top - _ABOVE_PX - _ID_PX) for _, left, top in elected]
    free = style.free_labels(above, [(width, _ID_PX) for width in widths])
    for (word, left, top), width, is_free in zip(elected, widths, free, strict=True):
        if is_free:
            x, y = round(left), round(top) - _ABOVE_PX
            cv2.rectangle(image, (x, y - _ID_PX), (x + width, y), bold, cv2.FILLED)
            cv2.putText(image, word, (x, y - 2), _FONT, _SIZE, (255, 255, 255), 1, cv2.LINE_AA)
    write_atomically(path, encode_image(image, '.png').tobytes())


_WIDTH_IN = 24.0
_NAMES = 'LR'
# Height of a line of 12 points with its border; height of two lines, pixels of a panorama.
_LINE_PT, _NAMES_PX = 20.0, 75.0


def draw_sweeps(
    sweeps: Sequence[Sweep], panoramas: Sequence[Panorama], room: Room, path: Path
) -> str:
    """Draw panoramas with papers; return the caption."""
    rows, columns = panoramas[0].image.shape[:2]
    figure = new_figure(_WIDTH_IN, len(panoramas) * (_WIDTH_IN * rows / columns + 0.6) + 0.8)
    for k, axes in enumerate(np.ravel(figure.subplots(len(panoramas), 1))):
        name = _NAMES[k] if len(panoramas) <= 2 else f'{k + 1}'
        _draw_panorama_part(axes, panoramas[k], room, f'{name}: {_place(panoramas[k])}')
    text = _text(sweeps[0], panoramas[0], room.papers)
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


def _place(panorama: Panorama) -> str:
    x, y, _ = panorama.center_map
    sigma = np.sqrt(np.diag(panorama.covariance))
    return (
        f'pan axis at ({x:.3f}, {y:.3f}) m, heading {np.degrees(panorama.heading_rad):.2f}°; '
        f'standard deviations {1e3 * sigma[0]:.1f} mm, {1e3 * sigma[1]:.1f} mm, '
        f'{np.degrees(sigma[3]):.3f}°'
    )


def _text(sweep: Sweep, panorama: Panorama, papers: Sequence[Paper]) -> str:
    poses = 'What they share gives their poses to each other.'
    if papers:
        poses = 'The papers of the reference area give the position of the camera.'
    camera, cylinder = sweep.frames[0].camera, panorama.cylinder
    step = float(np.median(np.diff(np.sort([frame.pan_rad for frame in sweep.frames]))))
    return (
        f'Figure 3. Panoramas of the room, each a cylinder of {cylinder.width} x '
        f'{cylinder.height} px synthesized from {len(sweep.frames)} frames of {camera.width} x '
        f'{camera.height} px, one each {np.degrees(step):.2f}°. Two neighbouring frames overlap '
        f'by {1.0 - step / (2.0 * camera.half_fov_rad):.0%}; of those that look straightest at a '
        f'column the median is kept. {poses}'
    )
