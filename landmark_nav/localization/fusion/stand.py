"""
A robot that stands, or odometry that hangs: images distinguish them.

Odometry also says that the robot stands if its driver hangs, or if the robot is pushed or carried.
Where images contradict a stand, hypotheses are added in which the robot turned on the spot or
moved anywhere meanwhile; the next images tell which is true (`mixture`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from landmark_nav.localization.fusion.mixture import Outcome
from landmark_nav.localization.fusion.state import FilterState, HEADING, measured, POSE, widened
from landmark_nav.localization.fusion.update import FusionUpdate
from landmark_nav.localization.odometry.noise import blind_variances, Motion, OdometryNoiseConfig
from landmark_nav.types import FloatArray

__all__ = ['doubted_stand', 'standing_or_hanging']

# Logarithms of transition probabilities from one image to the next: the camera of a standing
# robot is displaced; the robot begins to turn or move; it continues to; it stands again.
_KNOCKED, _BEGINS, _GOES_ON, _ENDS = np.log([0.01, 0.05, 0.25, 0.5]).tolist()
# A measurement of so many numbers tells the whole pose, and so where the robot went meanwhile.
_LEAST = 3


def standing_or_hanging(
    state: FilterState,
    outcomes_of: Callable[[FilterState], list[Outcome]],
    config: OdometryNoiseConfig,
) -> list[Outcome]:
    """
    Return the outcomes of a measurement, with the odometry believed and, if it stands, not.

    Parameters
    ----------
    state : FilterState
        Before the measurement.
    outcomes_of : callable
        From a state to the outcomes of the measurement if its odometry is right.
    config : OdometryNoiseConfig
        Has the variances of a motion without odometry.

    """
    if not state.still_s:
        return _outcomes(outcomes_of, state)
    blind = _blind(state, config)
    believed = widened(state, POSE, -blind) if state.hangs else state
    stood = _outcomes(outcomes_of, replace(believed, hangs=False))
    if not state.hangs and not any(_contradicts(one.update) for one in stood):
        return stood
    # At first this is an unknown speed, not a random walk: variance goes with the time squared.
    moved = min(state.still_s, 1.0) * blind
    turned, gone = (
        _fitting(_outcomes(outcomes_of, _hanging(believed, which, moved)))
        for which in (HEADING, POSE)
    )
    if state.hangs:
        # That the motion ends and the camera is displaced would be two accidents at once.
        ended = _fitting(stood)
        known = _with_prior(ended, _ENDS) + _with_prior([*turned, *gone], _GOES_ON)
        return known or _with_prior(_outcomes(outcomes_of, state), _KNOCKED)
    begun = [one for one in (*turned, *gone) if one.update.degrees >= _LEAST]
    return _with_prior(stood, _KNOCKED) + _with_prior(begun, _BEGINS)


def doubted_stand(state: FilterState, config: OdometryNoiseConfig) -> FilterState:
    """Return the state of a robot that may have gone anywhere while its odometry stood."""
    return state if state.hangs else _hanging(state, POSE, _blind(state, config))


def _blind(state: FilterState, config: OdometryNoiseConfig) -> FloatArray:
    """Variances (3,) of a motion without odometry in the time of the stand."""
    return blind_variances(Motion(np.zeros(3), state.still_s, state.still_s), config)


def _hanging(state: FilterState, which: int | list[int], variances: FloatArray) -> FilterState:
    return replace(widened(state, which, variances[which]), hangs=True)


def _outcomes(
    outcomes_of: Callable[[FilterState], list[Outcome]], state: FilterState
) -> list[Outcome]:
    return [one._replace(state=measured(one.state)) for one in outcomes_of(state)]


def _fitting(outcomes: list[Outcome]) -> list[Outcome]:
    return [one for one in outcomes if not _contradicts(one.update)]


def _contradicts(update: FusionUpdate) -> bool:
    """Whether a measurement did not fit, or only if the camera was displaced or wheels slipped."""
    return update.refusal is not None or update.turned_rad != 0.0


def _with_prior(outcomes: list[Outcome], log: float) -> list[Outcome]:
    return [one._replace(log_prior=one.log_prior + log) for one in outcomes]
