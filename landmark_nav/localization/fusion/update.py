"""Which measurements to believe, and the iterated update with those."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from landmark_nav.localization.fusion.noise import learned_scales, SIGHTING
from landmark_nav.localization.fusion.state import (
    bearing_model,
    correct,
    FilterState,
    MeasurementModel,
)
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.types import Detections, FloatArray, Refusal

__all__ = [
    'BearingFrame',
    'FusionUpdate',
    'bearing_frame',
    'expected_bearings',
    'update_bearings',
]

IndexArray = npt.NDArray[np.intp]

_MAX_ITERATIONS = 5
# A step this small bends bearings by a few microradians only.
_LINEAR_M = 2e-3
# So many pictures in a row repeat what a straight line leaves out: it is no noise.
_REPEATED = 10.0
# Matches of a picture that tell what correlation is to be expected in it.
_FEW = 4
# What of a template's variance a match may leave unexplained: times the median, and some more.
_UNLIKE_TIMES, _UNLIKE_ANYWAY = 6.0, 0.1
_NO_IDS = np.empty(0, dtype=np.int64)
_NO_INNOVATIONS = np.empty(0)
_ALL = slice(None)


@dataclass(frozen=True, eq=False)
class FusionUpdate:
    """
    What became of one measurement.

    Parameters
    ----------
    stamp_ns : int
        Its time.
    accepted_ids : ndarray of int, shape (m,)
        Landmarks whose bearings were used; empty for a pose.
    innovation_rad : ndarray, shape (m,)
        Their measured minus predicted bearings; for a pose its three differences.
    nis : float
        Normalized innovation squared of what was used.
    degrees : int
        Its degrees of freedom; 0 if nothing was used.
    rejected : dict of int to Refusal
        Why, by landmark id.
    refusal : Refusal or None
        Why the whole measurement was not used.
    turned_rad : float
        Angle by which all bearings were off, if that was more than could be expected; else 0.

    """

    stamp_ns: int
    accepted_ids: npt.NDArray[np.int64] = field(default_factory=lambda: _NO_IDS)
    innovation_rad: FloatArray = field(default_factory=lambda: _NO_INNOVATIONS)
    nis: float = 0.0
    degrees: int = 0
    rejected: dict[int, Refusal] = field(default_factory=dict)
    refusal: Refusal | None = None
    turned_rad: float = 0.0


@dataclass(frozen=True, eq=False)
class BearingFrame:
    """
    The bearings of one picture, ready for the filter.

    `columns` (m,) are places of the landmarks in the map, `variance` (m,) what each bearing claims
    of itself and `common_variance` what all of them share, `scores` (m,) their correlations,
    `unusable` what was sorted out before.
    """

    columns: IndexArray
    bearing_rad: FloatArray
    variance: FloatArray
    common_variance: float
    unusable: dict[int, Refusal]
    scores: FloatArray
    pan_rate: float = 0.0
    pan: float = 0.0


def bearing_frame(
    detections: Detections,
    columns: Mapping[int, int],
    common_sigma: float,
    scores_before: npt.ArrayLike = (),
) -> BearingFrame:
    """
    Sort out what no filter can use.

    Parameters
    ----------
    detections : Detections
        Of one picture.
    columns : mapping of int to int
        Landmark id to place in the map.
    common_sigma : float
        Error that all bearings of any picture share, radians.
    scores_before : array_like, shape (k,)
        Correlations in the pictures before: what is to be expected where few are found.

    """
    variance = detections.variance_rad2
    good = np.isfinite(detections.bearing_rad) & np.isfinite(variance) & (variance > 0.0)
    unlike = _unlike_the_others(detections.score, np.asarray(scores_before, dtype=np.float64))
    unusable: dict[int, Refusal] = {}
    chosen: dict[int, int] = {}
    for k, landmark in enumerate(detections.ids.tolist()):
        if landmark not in columns:
            unusable[landmark] = Refusal('not in the map')
        elif not good[k]:
            unusable[landmark] = Refusal('bearing or variance is not a number')
        elif landmark in chosen:
            unusable[landmark] = Refusal('given twice')
        elif unlike[k]:
            unusable[landmark] = Refusal(
                'less alike than the others', f'correlation {detections.score[k]:.2f}'
            )
        else:
            chosen[landmark] = k
    rows = list(chosen.values())
    return BearingFrame(
        np.array([columns[k] for k in chosen], dtype=np.intp),
        detections.bearing_rad[rows],
        variance[rows],
        common_sigma**2 + detections.pan_sigma_rad**2,
        unusable,
        detections.score[rows],
        detections.pan_rate_rad_s,
        detections.pan_rad,
    )


def _unlike_the_others(score: FloatArray, before: FloatArray) -> npt.NDArray[np.bool_]:
    """
    Which matches leave far more unexplained than the others of their picture, (n,).

    Light, blur and noise lower all correlations of a picture together. One far below the others
    shows something else, as a picture that was exchanged, and is off by the same amount again
    and again: its variance, which stands for noise, does not tell. Where a picture has few
    matches, those of the pictures `before` count as well; if it lies below them as a whole, that
    is the light.
    """
    others = score if len(score) >= _FEW else np.append(score, before)
    if len(others) < _FEW:
        return np.zeros(len(score), dtype=np.bool_)
    limit = _UNLIKE_TIMES * np.median(1.0 - others**2) + _UNLIKE_ANYWAY
    unlike = np.asarray(1.0 - score**2 > limit)
    return unlike & ~unlike.all()


def expected_bearings(
    prior: FilterState,
    frame: BearingFrame,
    lever: FloatArray,
    chosen: IndexArray | slice = _ALL,
    at: FilterState | None = None,
) -> MeasurementModel:
    """Bearings of a frame, all by default, as the prior expects them; linearised there or `at`."""
    at = at or prior
    model = bearing_model(
        prior,
        at,
        frame.columns[chosen],
        frame.bearing_rad[chosen],
        prior.scales.factors[SIGHTING] * frame.variance[chosen],
        frame.common_variance,
        lever,
        frame.pan_rate,
        frame.pan,
    )
    bend, spread = _left_out(model.jacobian[:, :2], at.covariance[:2, :2])
    return model._replace(innovation=model.innovation - bend, covariance=model.covariance + spread)


def _left_out(gradient: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """
    What a straight line leaves out of bearings (m,): its mean (m,) and its covariance (m, m).

    To second order, of positions that scatter with `covariance` (2, 2) about where the bearings
    are linearised (Garcia-Fernandez et al., Posterior Linearization Filter, 2015). Without it a
    pose that is known to decimetres becomes certain along the very arc that a few bearings leave
    open, as each picture is linearised elsewhere on it.
    """
    x, y = gradient.T
    xx, xy, yy = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    # The second derivative of a bearing is [[a, b], [b, -a]] with these, from its first one.
    second = np.stack([-2.0 * x * y, x * x - y * y], -1)
    across = 2.0 * xy * (xx - yy)
    squares = np.array(
        [[xx * xx + yy * yy - 2.0 * xy * xy, across], [across, 2.0 * (xy * xy + xx * yy)]]
    )
    mean = 0.5 * second @ np.array([xx - yy, 2.0 * xy])
    return mean, 0.5 * _REPEATED * second @ squares @ second.T


def update_bearings(
    prior: FilterState,
    frame: BearingFrame,
    ids: npt.NDArray[np.int64],
    lever: FloatArray,
    probability: float,
    odometry: OdometryNoiseConfig,
    least: int = 1,
    refine: bool = False,
    expected: MeasurementModel | None = None,
) -> tuple[FilterState, FusionUpdate]:
    """
    Use the bearings of a frame that agree with the prior and with each other.

    Parameters
    ----------
    prior : FilterState
        State at the frame's time.
    frame : BearingFrame
        What was seen.
    ids : ndarray of int, shape (n,)
        Of all landmarks of the map.
    lever : ndarray, shape (2,)
        Pan axis in the base frame, metres.
    probability : float
        Chi-square level of the gates.
    odometry : OdometryNoiseConfig
        How far noise may be learned.
    least : int
        Fewer agreeing bearings, or fewer than two thirds, are not used.
    refine : bool
        Improve the landmarks' places too.
    expected : MeasurementModel, optional
        What `expected_bearings` says of prior and frame, if it is known.

    """
    seen = ids[frame.columns]
    rejected = dict(frame.unusable)
    before = expected or expected_bearings(prior, frame, lever)
    chosen = _inside_gate(before, seen, probability, rejected)
    least = max(least, (2 * len(seen) + 2) // 3)
    while len(chosen) >= least:
        model_at = partial(expected_bearings, prior, frame, lever, chosen)
        first = before if len(chosen) == len(seen) else model_at()
        state, model = _iterated(prior, first, model_at, refine)
        inverse = np.linalg.inv(model.covariance)
        weighted = inverse @ model.innovation
        nis = float(model.innovation @ weighted)
        if nis <= float(chdtri(len(chosen), 1.0 - probability)):
            scales = learned_scales(
                prior.scales,
                model.innovation,
                model.covariance,
                model.jacobian @ prior.by_noise @ model.jacobian.T + model.by_noise,
                odometry,
            )
            return replace(state, scales=scales), FusionUpdate(
                prior.stamp_ns, seen[chosen], before.innovation[chosen], nis, len(chosen), rejected
            )
        # What the NIS would fall by without each: its square given all the others.
        worst = int(np.argmax(weighted**2 / np.diag(inverse)))
        rejected[int(seen[chosen[worst]])] = Refusal(
            'disagrees with the others', f'joint NIS {nis:.1f} of {len(chosen)} bearings'
        )
        chosen = np.delete(chosen, worst)
    refusal = Refusal(
        'bearings do not fit the expected pose',
        f'{len(chosen)} of {len(seen)} agree, '
        f'largest innovation {np.degrees(np.abs(before.innovation).max()):.2f} deg',
    )
    return prior, FusionUpdate(prior.stamp_ns, rejected=rejected, refusal=refusal)


def _inside_gate(
    model: MeasurementModel,
    seen: npt.NDArray[np.int64],
    probability: float,
    rejected: dict[int, Refusal],
) -> IndexArray:
    """Places of the bearings that each fit the prior; the others go to `rejected`."""
    sigmas = np.abs(model.innovation) / np.sqrt(np.diag(model.covariance))
    inside = sigmas**2 <= float(chdtri(1, 1.0 - probability))
    for k in np.flatnonzero(~inside):
        rejected[int(seen[k])] = Refusal(
            'outside its gate', f'{np.degrees(model.innovation[k]):.2f} deg, {sigmas[k]:.1f} sigma'
        )
    return np.flatnonzero(inside)


def _iterated(
    prior: FilterState,
    model: MeasurementModel,
    model_at: Callable[[FilterState], MeasurementModel],
    refine: bool,
) -> tuple[FilterState, MeasurementModel]:
    """Repeat the update, linearised about its own result, until that stays."""
    at, state = prior, correct(prior, model, refine)
    for _ in range(_MAX_ITERATIONS):
        if np.abs(state.mean[:2] - at.mean[:2]).max() < _LINEAR_M:
            break
        at = state
        model = model_at(at)
        state = correct(prior, model, refine)
    return state, model
