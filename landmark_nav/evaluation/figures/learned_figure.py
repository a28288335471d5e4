"""Counterpart of Figure 8 of Livatino and Madsen: patches by all features, and their locations."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
import numpy as np
import numpy.typing as npt

from landmark_nav.evaluation.figures.map_figure import number_landmarks
from landmark_nav.evaluation.figures.strips import caption, mark, show, Strip, widest
from landmark_nav.evaluation.figures.style import (
    add_ellipse,
    CANDIDATE,
    draw_papers,
    draw_sweep_places,
    draw_walls,
    FUSED,
    LANDMARK,
    new_figure,
    ODOMETRY,
    save,
)
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.pipeline import LearningResult
from landmark_nav.types import FloatArray, Landmark

_SHARE = 0.25
_MARGIN_M = 0.4
_MAGNIFIED = 30.0


def draw_learned(
    result: LearningResult, room: Room, path: Path, truth: FloatArray | None = None
) -> str:
    """
    Draw two parts of a panorama with selected patches, and their locations; return the caption.

    Parameters
    ----------
    result : LearningResult
        Result of learning, of which the first panorama is shown.
    truth : ndarray, shape (n, 2), optional
        True locations by `true_places`.
    """
    first, second = _strips(result)
    figure = new_figure(17.0, 7.2)
    left, right = np.ravel(np.asarray(figure.subfigures(1, 2, width_ratios=[1.0, 1.25])))
    drawn: set[int] = set()
    for axes, strip in zip(left.subplots(2, 1), (first, second), strict=True):
        drawn |= _draw_strip(axes, result, strip)
    axes = right.subplots()
    shown = np.array([landmark.id in drawn for landmark in result.map.landmarks])
    _draw_plan(axes, result, room, shown, truth)
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
    if truth is not None:
        error = 1e3 * np.hypot(*(result.map.positions[:, :2] - truth).T)
        text += (
            f' Along their walls they lie {np.median(error[shown]):.1f} mm in the median, '
            f'{error[shown].max():.1f} mm at most, from the true rays, all landmarks '
            f'{np.median(error):.1f} mm and {np.quantile(error, 0.95):.1f} mm at 95 %.'
        )
    caption(figure, text)
    number_landmarks(figure, axes, result.map, shown)
    save(figure, path)
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
            mark(axes, place, candidate, '', CANDIDATE)
    return ids


def _draw_plan(
    axes: Axes, result: LearningResult, room: Room, shown: npt.NDArray[np.bool_],
    truth: FloatArray | None,
) -> None:  # fmt: skip
    draw_walls(axes, room.walls, _MARGIN_M)
    draw_papers(axes, room.papers)
    landmarks = result.map
    axes.plot(*landmarks.positions[~shown, :2].T, '.', color=LANDMARK, alpha=0.35, zorder=4)
    draw_sweep_places(axes, [panorama.center_map[:2] for panorama in result.panoramas])
    eye = result.panoramas[0].center_map[:2]
    for k in np.flatnonzero(shown):
        landmark = landmarks.landmarks[k]
        point = landmark.position[:2]
        axes.plot(*np.stack([eye, point], -1), color=FUSED, alpha=0.12, linewidth=0.8, zorder=1)
        add_ellipse(axes, point, landmark.covariance[:2, :2], LANDMARK, _MAGNIFIED)
    axes.plot(*landmarks.positions[shown, :2].T, 'o', color=LANDMARK, markersize=5, zorder=6)
    if truth is not None:
        axes.plot(
            *truth[shown].T,
            'x',
            color=ODOMETRY,
            markersize=5,
            zorder=7,
            label='on the true ray',
        )
        axes.legend(loc='upper left', frameon=False, bbox_to_anchor=(0.0, 1.06))
