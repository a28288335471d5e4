"""
Joint states that may be late: the hypotheses of how late they are.

Where the pan speeds up or slows down, bearings are no linear function of the delay. If they were
taken as linear over all delays that are possible, images of one swing would seem to tell it. So
an unknown delay is a mixture of parts, each short enough.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from landmark_nav.geometry.se2 import compose, compose_jacobians
from landmark_nav.localization.fusion.mixture import Mixture, MOST
from landmark_nav.localization.fusion.start import Found
from landmark_nav.localization.fusion.state import (
    DELAY,
    FilterState,
    HEADING,
    POSE,
    STATES,
    with_late_joints,
)
from landmark_nav.localization.joint_delay import DELAY_BOUND_S
from landmark_nav.types import FloatArray

__all__ = ['REACH_S', 'found_in_swing', 'in_doubt', 'late_joints', 'perhaps_late', 'seen_in_swing']

# Joint states may be late by so much.
REACH_S = 0.3
# Sigma of an unknown delay, and of each of the parts about these delays, which reach as far as the
# pan is known.
_LATE_S, _PART_S = 0.15, 0.06
_PARTS_S = np.array([0.0, 0.1, -0.1, 0.2, -0.2])
_WEIGHTS = np.exp(-0.5 * _PARTS_S**2 / (_LATE_S**2 - _PART_S**2))
_WEIGHTS /= _WEIGHTS.sum()
# Prior probability that joint states which may be late are.
_LATE = 1.0 / 3.0
# A sigma that is at least this share of a part's is in doubt already.
_DOUBTED = 0.5


def in_doubt(state: FilterState) -> bool:
    """Whether the delay of the joints is open."""
    return state.late.sigma_s >= _DOUBTED * _PART_S


def late_joints(state: FilterState) -> Mixture:
    """Return hypotheses of a delay of the joint stamps of which nothing is known."""
    parts = (with_late_joints(state, _PART_S, delay_s) for delay_s in _PARTS_S.tolist())
    return Mixture(tuple(parts), _WEIGHTS)


def perhaps_late(in_time: FilterState, late: Mixture) -> Mixture:
    """Return the hypothesis that the delay is as it was known, and those that it is not."""
    weights = np.concatenate([[1.0 - _LATE], _LATE * late.weights])
    return Mixture((in_time, *late.states), weights)


def seen_in_swing(mixture: Mixture) -> Mixture:
    """Return the mixture with joint states that may be late, unless they are in doubt already."""
    if any(in_doubt(state) for state in mixture.states):
        return mixture
    parts = [perhaps_late(state, late_joints(state)) for state in mixture.states]
    weights = np.outer(mixture.weights, parts[0].weights).reshape(-1)
    states = [state for part in parts for state in part.states]
    kept = np.argsort(-weights, kind='stable')[:MOST]
    return Mixture(tuple(states[k] for k in kept), weights[kept] / weights[kept].sum())


def found_in_swing(
    state: FilterState, found: Found, lever: FloatArray, whole: bool = False
) -> Mixture:
    """
    Return hypotheses of a pose that was found in an image whose joint states may be late.

    A pan that is off turns the pose that is found about the pan axis. So each delay has its own
    heading; `whole`, the heading is wide.

    Parameters
    ----------
    state : FilterState
        With the pose that was found.
    found : Found
        How the pan turned meanwhile.
    lever : ndarray, shape (2,)
        Pan axis in the base frame, metres.
    whole : bool
        Whether no more than one hypothesis can be kept.

    """
    to_axis = np.array([*lever, 0.0])
    axis = compose(state.mean[POSE], to_axis)
    by_heading = compose_jacobians(axis, -to_axis)[0][:, HEADING]
    if whole:
        wide = state.covariance.copy()
        wide[:3, :3] += found.pan_range_rad(DELAY_BOUND_S) ** 2 * np.outer(by_heading, by_heading)
        return Mixture((with_late_joints(replace(state, covariance=wide), _LATE_S),))
    in_time = with_late_joints(state, 0.0) if in_doubt(state) else state

    def turned(part: FilterState) -> FilterState:
        lag, mean, by_delay = found.lag(part.late), part.mean.copy(), np.eye(STATES)
        mean[POSE] = compose(axis - np.array([0.0, 0.0, lag.shift_rad]), -to_axis)
        by_delay[POSE, DELAY] = -lag.rate_rad_s * by_heading
        covariance = by_delay @ part.covariance @ by_delay.T
        covariance[:3, :3] += lag.bend_rad**2 * np.outer(by_heading, by_heading)
        return replace(
            part,
            mean=mean,
            covariance=covariance,
            cross=by_delay @ part.cross,
            by_noise=by_delay @ part.by_noise @ by_delay.T,
        )

    return perhaps_late(in_time, late_joints(in_time)).each(turned)
