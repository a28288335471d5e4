"""
A robot that stands, or odometry that hangs: pictures tell them apart.

Odometry that hangs says that the robot stands, and so it says of one that is pushed or carried.
Where pictures contradict a stand, there are other states in which the robot turned on the spot or
went anywhere meanwhile; the next pictures tell which is true (`mixture`).
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

# From one picture to the next, logarithms of how likely it is: that the camera of a robot that
# stands is knocked; that the robot begins to turn or to move; that it goes on so, or stands again.
_KNOCKED, _BEGINS, _GOES_ON, _ENDS = np.log([0.01, 0.05, 0.25, 0.5]).tolist()
# So many numbers tell where the robot went meanwhile.
_LEAST = 3


def standing_or_hanging(
    state: FilterState,
    outcomes_of: Callable[[FilterState], list[Outcome]],
    config: OdometryNoiseConfig,
    single: bool = False,
) -> list[Outcome]:
    """
    Return all that a state may have come to by a measurement, if the odometry stands or hangs.

    Parameters
    ----------
    state : FilterState
        Before the measurement.
    outcomes_of : callable
        What a state comes to by it, the odometry being right.
    config : OdometryNoiseConfig
        What is not known of a motion without odometry.
    single : bool
        Whether the likeliest alone will be kept: then a turn that may have been the camera's stays
        open in one state.

    """
    if not state.still_s:
        return _outcomes(outcomes_of, state)
    blind = _blind(state, config)
    believed = widened(state, POSE, -blind) if state.hangs else state
    stood = _outcomes(outcomes_of, replace(believed, hangs=False))
    if not state.hangs and not any(_contradicts(one.update) for one in stood):
        return stood
    # Nothing has gone far yet after a short time: a speed is open, not a random walk.
    moved = min(state.still_s, 1.0) * blind
    turned, gone = (
        _fitting(_outcomes(outcomes_of, _hanging(believed, which, moved)))
        for which in (HEADING, POSE)
    )
    if state.hangs:
        # That it ends as a camera is knocked would be two accidents at once.
        ended = _fitting(stood)
        known = _with_prior(ended, _ENDS) + _with_prior([*turned, *gone], _GOES_ON)
        return known or _with_prior(_outcomes(outcomes_of, state), _KNOCKED)
    if single and turned and all(one.update.degrees for one in stood):
        return [one._replace(state=replace(one.state, hangs=True)) for one in stood]
    begun = [one for one in (*turned, *gone) if one.update.degrees >= _LEAST]
    return _with_prior(stood, _KNOCKED) + _with_prior(begun, _BEGINS)


def doubted_stand(state: FilterState, config: OdometryNoiseConfig) -> FilterState:
    """Return the state of a robot that may have gone anywhere while its odometry stood."""
    return state if state.hangs else _hanging(state, POSE, _blind(state, config))


def _blind(state: FilterState, config: OdometryNoiseConfig) -> FloatArray:
    """Variances (3,) that a hanging state has gained in the time of the stand."""
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
    """Whether a measurement did not fit, or only with a knock or a slip."""
    return update.refusal is not None or update.turned_rad != 0.0


def _with_prior(outcomes: list[Outcome], log: float) -> list[Outcome]:
    return [one._replace(log_prior=one.log_prior + log) for one in outcomes]
