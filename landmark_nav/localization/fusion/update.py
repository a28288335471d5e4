"""Which measurements to believe, and the iterated update with those."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from landmark_nav.arrays import IndexArray
from landmark_nav.localization.fusion.bearings import BearingFrame
from landmark_nav.localization.fusion.measurement import (
    correct,
    expected_bearings,
    MeasurementModel,
)
from landmark_nav.localization.fusion.noise import learned_scales
from landmark_nav.localization.fusion.state import DELAY, FilterState
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.types import FloatArray, Refusal

__all__ = ['FusionUpdate', 'log_density', 'update_bearings']

_MAX_ITERATIONS = 5
# Steps below these need no further iteration: bearings are linear to a few microradians, and the
# rate of the pan stays the same.
_LINEAR_M = 2e-3
_LINEAR_S = 5e-3
# Logarithm of the density of a mistaken bearing, 1 / rad: one bearing in fifty is mistaken, and
# then lies anywhere within some degrees.
_LOG_STRAY = float(np.log(0.2))
# Degrees of freedom of the t distribution of bearing errors. With fewer bearings than `_FEW` none
# can be told to be off; factors on the variance up to `_WORTH_WHILE` change little.
_TAIL_DEGREES, _FEW, _WORTH_WHILE = 4.0, 3, 1.6
_NO_IDS = np.empty(0, dtype=np.int64)
_NO_INNOVATIONS = np.empty(0)


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
    contradicts : bool
        Whether it was not used because it does not fit the expected pose.
    turned_rad : float
        Angle by which all bearings were off, if that was a surprise; else 0.
    log_likelihood : float
        Logarithm of the density of the measurement, given the prior: in 1 / rad for each bearing,
        in 1 / (m^2 rad) for a pose.

    """

    stamp_ns: int
    accepted_ids: npt.NDArray[np.int64] = field(default_factory=lambda: _NO_IDS)
    innovation_rad: FloatArray = field(default_factory=lambda: _NO_INNOVATIONS)
    nis: float = 0.0
    degrees: int = 0
    rejected: dict[int, Refusal] = field(default_factory=dict)
    refusal: Refusal | None = None
    contradicts: bool = False
    turned_rad: float = 0.0
    log_likelihood: float = 0.0


def update_bearings(
    prior: FilterState,
    frame: BearingFrame,
    lever: FloatArray,
    probability: float,
    odometry: OdometryNoiseConfig,
    least: int,
    expected: MeasurementModel | None = None,
) -> tuple[FilterState, FusionUpdate, MeasurementModel | None]:
    """
    Use the bearings of a frame that agree with the prior and with each other.

    Parameters
    ----------
    prior : FilterState
        State at the frame's time.
    frame : BearingFrame
        What was seen.
    lever : ndarray, shape (2,)
        Pan axis in the base frame, metres.
    probability : float
        Chi-square level of the gates.
    odometry : OdometryNoiseConfig
        Says whether the noise is learned.
    least : int
        Fewer agreeing bearings than this, or than two thirds of them, are not used.
    expected : MeasurementModel, optional
        Result of `expected_bearings` for this prior and frame, if it was computed before.

    Returns
    -------
    FilterState, FusionUpdate, MeasurementModel or None
        State after it, what became of it, and the model of the bearings that were used.

    """
    seen = frame.ids
    rejected = dict(frame.unusable)
    before = expected or expected_bearings(prior, frame, lever)
    chosen = _inside_gate(before, seen, probability, rejected)
    least = max(least, (2 * len(seen) + 2) // 3)
    while len(chosen) >= least:
        model_at = partial(expected_bearings, prior, frame, lever, chosen)
        first = before if len(chosen) == len(seen) else model_at()
        state, model = _iterated(prior, first, model_at)
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
            strays = len(seen) - len(chosen)
            tails, used = _tails(weighted, inverse), model
            if len(chosen) >= _FEW and tails.max() > _WORTH_WHILE:
                tailed = frame.tailed(chosen, tails)
                used = expected_bearings(prior, tailed, lever, chosen, state)
                state = correct(prior, used)
            update = FusionUpdate(
                prior.stamp_ns,
                seen[chosen],
                before.innovation[chosen],
                nis,
                len(chosen),
                rejected,
                log_likelihood=strays * _LOG_STRAY + log_density(nis, model.covariance),
            )
            return replace(state, scales=scales), update, used
        # How much the NIS would fall without each bearing.
        worst = int(np.argmax(weighted**2 / np.diag(inverse)))
        rejected[int(seen[chosen[worst]])] = Refusal(
            'disagrees with the others', f'joint NIS {nis:.1f} of {len(chosen)} bearings'
        )
        chosen = np.delete(chosen, worst)
    contradicts = len(chosen) < len(seen)
    refusal = Refusal('too few bearings', f'{len(seen)} agree, it takes {least}')
    if contradicts:
        refusal = Refusal(
            'bearings do not fit the expected pose',
            f'{len(chosen)} of {len(seen)} agree, '
            f'largest innovation {np.degrees(np.abs(before.innovation).max()):.2f} deg',
        )
    unused = FusionUpdate(
        prior.stamp_ns,
        rejected=rejected,
        refusal=refusal,
        contradicts=contradicts,
        log_likelihood=len(seen) * _LOG_STRAY,
    )
    return prior, unused, None


def _tails(weighted: FloatArray, inverse: npt.NDArray[Any]) -> FloatArray:
    """
    Factors (m,) on the variances of bearings whose errors have heavy tails.

    They follow from how far each bearing is off from what all the others predict, for errors of
    Student's t distribution (Lange, Little and Taylor, Robust Statistical Modeling Using the t
    Distribution, 1989).
    """
    squares = weighted**2 / np.diag(inverse)
    return np.maximum((_TAIL_DEGREES + squares) / (_TAIL_DEGREES + 1.0), 1.0)


def log_density(nis: float, covariance: FloatArray) -> float:
    """Logarithm of a Gaussian density, by the NIS and the covariance (m, m)."""
    scaled = 2.0 * np.pi * covariance
    return -0.5 * (nis + float(np.linalg.slogdet(scaled)[1]))


def _inside_gate(
    model: MeasurementModel,
    seen: npt.NDArray[np.int64],
    probability: float,
    rejected: dict[int, Refusal],
) -> IndexArray:
    """Indices of the bearings inside their own gates; the others go to `rejected`."""
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
) -> tuple[FilterState, MeasurementModel]:
    """Repeat the update, linearised about its own result, until it converges."""
    at, state = prior, correct(prior, model)
    for _ in range(_MAX_ITERATIONS):
        moved = np.abs(state.mean - at.mean)
        if moved[:2].max() < _LINEAR_M and moved[DELAY] < _LINEAR_S:
            break
        at = state
        model = model_at(at)
        state = correct(prior, model)
    return state, model
