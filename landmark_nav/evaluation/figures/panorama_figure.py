"""Panoramas and attention: ``panorama_K.png``, Figures 3, 4 and 7 of Livatino and Madsen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
import numpy as np

from landmark_nav.arrays import Float32Array
from landmark_nav.evaluation.figures import style
from landmark_nav.evaluation.figures.style import (
    caption,
    mark,
    new_figure,
    save,
    show,
    Strip,
    widest,
)
from landmark_nav.geometry.walls import Marker, Paper, Room
from landmark_nav.image_codec import encode_image
from landmark_nav.learning.attention.maps import (
    attention_maps,
    AttentionConfig,
    AttentionMaps,
    CENTER_SIGMA_PX,
    FEATURES,
    SURROUND_SIGMA_PX,
)
from landmark_nav.learning.attention.selection import attend
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
    text = _text(sweeps[0], panoramas[0], room.anchors)
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
    for paper in room.anchors:
        away = np.asarray(paper.center) - panorama.center_map
        distance = float(np.hypot(away[0], away[1]))
        azimuth = np.arctan2(away[1], away[0]) - panorama.heading_rad
        row = float(panorama.cylinder.row_of(away[2] / distance))
        half = 0.5 * paper.height * panorama.cylinder.fy / distance
        if half < row < height - half:
            seen.append((float(panorama.cylinder.column_of(azimuth)), row, half, paper.name))
    for k, (column, row, half, name) in enumerate(sorted(seen)):
        way = -1.0 if row - half > _NAMES_PX else 1.0
        offset = (0.0, -way * _LINE_PT * (1.2 + k % 2))
        at = (column, row + way * (half + 3.0))
        box = {'boxstyle': 'round,pad=0.15', 'facecolor': 'white', 'linewidth': 0.0}
        axes.annotate(
            name, at, offset, textcoords='offset points', ha='center', va='center',
            fontsize=12, arrowprops={'arrowstyle': '->'}, bbox=box,
        )  # fmt: skip


def _place(panorama: Panorama) -> str:
    x, y, _ = panorama.center_map
    sigma = np.sqrt(np.diag(panorama.covariance))
    return (
        f'pan axis at ({x:.3f}, {y:.3f}) m, heading {np.degrees(panorama.heading_rad):.2f}°; '
        f'standard deviations {1e3 * sigma[0]:.1f} mm, {1e3 * sigma[1]:.1f} mm, '
        f'{np.degrees(sigma[3]):.3f}°'
    )


def _text(sweep: Sweep, panorama: Panorama, papers: Sequence[Paper | Marker]) -> str:
    poses = 'What they share gives their poses to each other.'
    if papers:
        kind = 'papers' if isinstance(papers[0], Paper) else 'markers'
        poses = f'The {kind} of the reference area give the position of the camera.'
    camera, cylinder = sweep.frames[0].camera, panorama.cylinder
    step = float(np.median(np.diff(np.sort([frame.pan_rad for frame in sweep.frames]))))
    return (
        f'Figure 3. Panoramas of the room, each a cylinder of {cylinder.width} x '
        f'{cylinder.height} px synthesized from {len(sweep.frames)} frames of {camera.width} x '
        f'{camera.height} px, one each {np.degrees(step):.2f}°. Two neighbouring frames overlap '
        f'by {1.0 - step / (2.0 * camera.half_fov_rad):.0%}; of those that look straightest at a '
        f'column the median is kept. {poses}'
    )


# Shown part of a panorama, as a share of the turn, and number of shown patches.
_SHARE = 0.25
_PATCHES = 6
_COLUMNS = 4


def draw_attention(panorama: Panorama, config: AttentionConfig, path: Path) -> str:
    """Draw the maps from a part of a panorama to its candidates; return the caption."""
    attended = attend(panorama, config)
    strip = _strip(panorama, attended.candidates[:30])
    maps = attention_maps(_grey(panorama), config)
    found = _inside(strip, panorama, attended.candidates)
    names = list(maps.features)
    figure = style.new_figure(2.6 * max(len(names), 4), 9.6)
    rows = figure.subfigures(3, 1, height_ratios=[2.5, 3.2, 3.1])
    view, middle, fused = np.ravel(np.asarray(rows))
    show(view.subplots(), strip.cut(panorama.image), 'panorama (part)')
    grid = middle.subplots(2, len(names), squeeze=False)
    for k, name in enumerate(names):
        show(grid[0, k], _part(maps, maps.features[name], strip), f'{_title(name)}')
        weight = config.weights[name] / sum(config.weights.values())
        show(grid[1, k], _part(maps, maps.conspicuities[name], strip), f'weight {weight:.2f}')
    grid[0, 0].set_ylabel('feature maps', fontsize=11)
    grid[1, 0].set_ylabel('conspicuity maps\n(difference of\nGaussians)', fontsize=11)
    left, right = fused.subplots(1, 2)
    show(left, strip.cut(maps.saliency), 'saliency map: weighted mean of the conspicuity maps')
    show(right, strip.cut(panorama.image), 'hierarchical selection: candidates, strongest first')
    for number, (candidate, place) in enumerate(found, 1):
        label = str(number) if number <= _PATCHES else ''
        mark(right, place, candidate, label, style.LANDMARK if label else style.CANDIDATE)
        mark(left, place, candidate, '', 'white')
    text = (
        f'Figure 4. Extraction of candidate landmarks: maps of {", ".join(map(_title, names))}; '
        'the difference of Gaussians between what is at a place and around it (sigma '
        f'{CENTER_SIGMA_PX:g} and {SURROUND_SIGMA_PX:g} px); their weighted mean, '
        'from which a winner-take-all selects over positions and sizes of '
        f'{config.size_min_px} to {config.size_max_px} px. {len(attended.candidates)} candidates '
        f'in this panorama, {len(found)} in this part; {_refusals(attended.refused)}.'
    )
    caption(figure, text)
    style.save(figure, path)
    return text


def draw_features_alone(
    panorama: Panorama, config: AttentionConfig, path: Path, names: Sequence[str] = FEATURES
) -> str:
    """Draw conspicuity and selected patches of each feature alone; return the caption."""
    grey = _grey(panorama)
    strip = _strip(panorama, attend(panorama, config).candidates[:30])
    columns = min(len(names), _COLUMNS)
    rows = -(-len(names) // columns)
    figure = style.new_figure(max(4.6 * columns, 9.0), (4.3 if columns > 1 else 8.0) * rows + 0.7)
    panels = np.ravel(np.asarray(figure.subfigures(rows, columns, squeeze=False)))
    for name, panel in zip(names, panels, strict=False):
        alone = config.alone(name)
        attended = attend(panorama, alone)
        maps = attention_maps(grey, alone)
        refused = {id(candidate) for candidate, _ in attended.refused}
        everything = [*attended.candidates, *(candidate for candidate, _ in attended.refused)]
        everything.sort(key=lambda candidate: -candidate.saliency)
        chosen = _inside(strip, panorama, everything)[:_PATCHES]
        above, view = panel.subplots(2, 1)
        refusals = f'{len(attended.refused)} of {len(everything)} attended are refused'
        title = f'{_title(name)}\n{refusals}'
        show(above, strip.cut(maps.saliency), title)
        show(view, strip.cut(panorama.image))
        for number, (candidate, place) in enumerate(chosen, 1):
            wrong = id(candidate) in refused
            color, line = (style.ODOMETRY, '--') if wrong else (style.LANDMARK, '-')
            mark(view, place, candidate, str(number), color, line)
    text = (
        'Figure 7. What attention selects by one feature at a time. Above, conspicuity maps; '
        f'below, the {_PATCHES} strongest patches of this part of the panorama. Broken orange: '
        'refused, since a neighbouring place could be mistaken for them; the counts are of the '
        'whole panorama.'
    )
    caption(figure, text)
    style.save(figure, path)
    return text


def _strip(panorama: Panorama, candidates: Sequence[Candidate]) -> Strip:
    turn = panorama.mask.shape[1]
    return widest(panorama, candidates, round(_SHARE * turn), max(turn // 72, 1))


def _inside(
    strip: Strip, panorama: Panorama, candidates: Sequence[Candidate]
) -> list[tuple[Candidate, tuple[float, float]]]:
    """Return the candidates in the strip and their positions in it."""
    turn = panorama.mask.shape[1]
    placed = ((candidate, strip.place(candidate, turn)) for candidate in candidates)
    return [(candidate, place) for candidate, place in placed if place is not None]


def _grey(panorama: Panorama) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.asarray(cv2.cvtColor(panorama.image, cv2.COLOR_BGR2GRAY), np.uint8)


def _part(maps: AttentionMaps, image: Float32Array, strip: Strip) -> Float32Array:
    """Cut a strip out of a map of half resolution, without its padding columns."""
    turn = image[:, maps.side : image.shape[1] - maps.side]
    return np.asarray(strip.cut(turn, 0.5), np.float32)


def _title(name: str) -> str:
    return name.replace('_', ' ')


def _refusals(refused: Sequence[tuple[Candidate, Refusal]]) -> str:
    reasons = [why.reason for _, why in refused]
    counts = ', '.join(f'{reasons.count(r)} for "{r}"' for r in sorted(set(reasons)))
    return f'{len(reasons)} others were refused ({counts})' if reasons else 'none was refused'
