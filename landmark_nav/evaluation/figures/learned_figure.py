"""Counterpart of Figure 8 of Livatino and Madsen: patches by all features, and their locations."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
import numpy as np
import numpy.typing as npt

from landmark_nav.evaluation.figures import style
from landmark_nav.evaluation.figures.map_figure import number_landmarks
from landmark_nav.evaluation.figures.strips import caption, mark, show, Strip, widest
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.pipeline import LearningResult
from landmark_nav.types import Landmark

_SHARE = 0.25
_MARGIN_M = 0.4
_MAGNIFIED = 30.0


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
        f'elsewhere; 3 sigma {_MAGNIFIED:.0f} times as large. Their standard deviations (root of '
        f'the trace) are {1e3 * np.median(sigma[shown]):.1f} mm in the median.'
    )
    caption(figure, text)
    number_landmarks(figure, axes, result.map, shown)
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
    style.draw_papers(axes, room.papers)
    landmarks = result.map
    axes.plot(*landmarks.positions[~shown, :2].T, '.', color=style.LANDMARK, alpha=0.35, zorder=4)
    style.draw_sweep_places(axes, [panorama.center_map[:2] for panorama in result.panoramas])
    eye = result.panoramas[0].center_map[:2]
    for k in np.flatnonzero(shown):
        landmark = landmarks.landmarks[k]
        point = landmark.position[:2]
        axes.plot(
            *np.stack([eye, point], -1), color=style.FUSED, alpha=0.12, linewidth=0.8, zorder=1
        )
        style.add_ellipse(axes, point, landmark.covariance[:2, :2], style.LANDMARK, _MAGNIFIED)
    axes.plot(*landmarks.positions[shown, :2].T, 'o', color=style.LANDMARK, markersize=5, zorder=6)
