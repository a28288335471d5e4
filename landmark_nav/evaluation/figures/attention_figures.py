"""
Counterparts of Figures 4, 7 and 8 (left) of Livatino and Madsen: attention.

Figure 4 shows the stages from image to candidates, Figure 7 each feature alone, Figure 8 all.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array
from landmark_nav.evaluation.figures import style
from landmark_nav.evaluation.figures.style import caption, mark, show, Strip, widest
from landmark_nav.learning.attention import (
    attend,
    attention_maps,
    AttentionConfig,
    AttentionMaps,
    FEATURES,
)
from landmark_nav.learning.attention.maps import CENTER_SIGMA_PX, SURROUND_SIGMA_PX
from landmark_nav.types import Candidate, Panorama, Refusal

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
        title = (
            f'{_title(name)}\n{len(attended.refused)} of {len(everything)} attended are refused'
        )
        show(above, strip.cut(maps.saliency), title)
        show(view, strip.cut(panorama.image))
        for number, (candidate, place) in enumerate(chosen, 1):
            color, line = (
                (style.ODOMETRY, '--') if id(candidate) in refused else (style.LANDMARK, '-')
            )
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
