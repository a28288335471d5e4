"""A camera that was bumped, or a robot turned on the spot: all bearings are off by one angle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from landmark_nav.localization.fusion.bearings import BearingFrame
from landmark_nav.localization.fusion.late_joints import (
    in_doubt,
    late_joints,
    perhaps_late,
    REACH_S,
)
from landmark_nav.localization.fusion.measurement import expected_bearings, MeasurementModel
from landmark_nav.localization.fusion.mixture import Mixture, Outcome, weighed
from landmark_nav.localization.fusion.stand import standing_or_hanging
from landmark_nav.localization.fusion.state import (
    BORESIGHT,
    FilterState,
    HEADING,
    looking_again,
    widened,
)
from landmark_nav.localization.fusion.update import FusionUpdate, update_bearings
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.types import FloatArray

__all__ = ['KNOCKED', 'update_turning']

# An angle that all bearings share is a surprise beyond this many standard deviations, or beyond
# fewer where it is as large as that of a knock: taken for an error of the odometry, a knock would
# stay in the heading for good.
_SURPRISE, _SURPRISE_OF_KNOCK, _KNOCK_RAD = 5.0, 3.0, 0.02
# It takes so many bearings to tell a common angle from a wrong position.
_LEAST = 3
# A sigma that is at least this share of the one to be added is wide enough as it is.
_DOUBTED = 0.5
# Cameras are displaced less often than wheels slip: sigma of the boresight relative to that of the
# heading.
KNOCKED = 0.7
# Joint states are suspected to be late where the pan turned by so large a share of the angle in
# the time by which they may be.
_LATE_SHARE = 0.5


def update_turning(
    prior: Mixture,
    frame: BearingFrame,
    lever: FloatArray,
    probability: float,
    odometry: OdometryNoiseConfig,
    least: int,
) -> tuple[Mixture, FusionUpdate]:
    """
    Use the bearings of a frame as `update_bearings` does, or as those of a camera that turned.

    If all bearings are off by one angle, either the base turned against the odometry or the camera
    against the base; one image cannot tell which. So the angle, `turn_sigma_rad` at most, is
    added to the sigma of the heading, a part of it to that of the boresight, and to the position
    what it amounts to at the range of the landmarks. Later bearings, and the direction in which
    the robot drives on, distinguish them.

    If the pan turns fast enough, late joint states may be the reason. A second hypothesis then
    opens their delay, and images at other rates tell which is true; where the delay is open
    anyway, it stays so.

    An angle too small to be a surprise, but too large for the gates, widens the heading alone.

    Parameters are those of `update_bearings`, with a mixture as the prior.
    """

    def updated(state: FilterState, enough: int, model: MeasurementModel | None = None) -> Outcome:
        return Outcome(*update_bearings(state, frame, lever, probability, odometry, enough, model))

    def outcomes(state: FilterState) -> list[Outcome]:
        state = looking_again(
            state, frame.config.repeat_length_m, frame.config.correlation_length_m
        )
        expected = expected_bearings(state, frame, lever)
        as_before = updated(state, least, expected)
        turn_sigma = frame.config.turn_sigma_rad
        if turn_sigma == 0.0 or len(frame.columns) < _LEAST:
            return [as_before]
        angle, sigma = _common_turn(expected)
        limit = sigma * (_SURPRISE if abs(angle) < _KNOCK_RAD else _SURPRISE_OF_KNOCK)
        surprising = abs(angle) > limit
        if as_before.update.refusal is None and not surprising:
            return [as_before]
        turned = _turned(state, frame, min(abs(angle), turn_sigma), surprising)
        loose = Mixture((turned,))
        swings = frame.pan_range_rad(REACH_S) > _LATE_SHARE * abs(angle)
        if surprising and swings and not in_doubt(state):
            loose = late_joints(state if state.stands else turned)
            # A known delay most likely stays as it is; an open one might take a slip for a delay.
            if state.late.is_known:
                loose = perhaps_late(turned, loose)
        found = [
            updated(other, max(least, _LEAST))._replace(
                model=None, log_prior=float(np.log(weight))
            )
            for other, weight in zip(loose.states, loose.weights, strict=True)
        ]
        believed = [one for one in found if _explains(one.update, as_before.update)]
        if not surprising:
            return believed or [as_before]
        told = [
            one._replace(
                update=replace(one.update, turned_rad=float(np.median(one.update.innovation_rad)))
            )
            for one in believed
        ]
        if as_before.update.refusal is None:
            # A smaller median: one bearing far off made the angle, not all of them together.
            told = [one for one in told if abs(one.update.turned_rad) > limit]
        return told or [as_before]

    return weighed(
        prior,
        lambda state: standing_or_hanging(state, outcomes, odometry),
        frame.config.landmarks,
    )


def _turned(
    state: FilterState, frame: BearingFrame, turn_rad: float, surprising: bool
) -> FilterState:
    """
    Widen heading, boresight and position by an angle; the heading alone if it is no surprise.

    While the robot stands its wheels cannot slip: only the camera may have been displaced.
    """
    loose = state if state.stands and surprising else widened(state, HEADING, turn_rad**2)
    if not surprising:
        return loose
    away = state.map_errors.places(frame.columns) - state.mean[:2]
    if not state.stands:
        loose = widened(loose, [0, 1], turn_rad**2 * np.mean(np.sum(away**2, axis=1)))
    # Wheels may continue to slip, but a camera is displaced once.
    knock_rad, most_rad = KNOCKED * turn_rad, KNOCKED * frame.config.turn_sigma_rad
    if state.covariance[BORESIGHT, BORESIGHT] < (_DOUBTED * most_rad) ** 2:
        loose = widened(loose, BORESIGHT, knock_rad**2)
    return loose


def _explains(update: FusionUpdate, before: FusionUpdate) -> bool:
    """Whether at least as many bearings fit as without the doubt."""
    return update.refusal is None and update.degrees >= before.degrees


def _common_turn(model: MeasurementModel) -> tuple[float, float]:
    """Angle by which all bearings are off together, and its standard deviation; radians."""
    weight = np.linalg.solve(model.covariance, np.ones(len(model.innovation)))
    information = weight.sum()
    return float(weight @ model.innovation / information), float(1.0 / np.sqrt(information))
