"""A camera that was bumped, or a robot turned on the spot: all bearings are off by one angle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from landmark_nav.localization.fusion.bearings import BearingFrame
from landmark_nav.localization.fusion.measurement import expected_bearings, MeasurementModel
from landmark_nav.localization.fusion.mixture import Mixture, Outcome, weighed
from landmark_nav.localization.fusion.stand import standing_or_hanging
from landmark_nav.localization.fusion.state import (
    BORESIGHT,
    DELAY,
    FilterState,
    HEADING,
    looking_again,
    widened,
)
from landmark_nav.localization.fusion.update import FusionUpdate, update_bearings
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.types import FloatArray

__all__ = ['KNOCKED', 'LATE_S', 'update_turning']

# An angle that all bearings share is a surprise beyond this many standard deviations.
_SURPRISE = 5.0
# So many bearings tell a common angle from a wrong place.
_LEAST = 3
# What has a sigma that is this share of what a surprise brings is doubted already.
_DOUBTED = 0.5
# Wheels slip more often than cameras are knocked: sigma of that angle beside that of the heading.
KNOCKED = 0.7
# Stamps of joints may be late by so much; they are suspected where that explains so much of an
# angle, and then have this sigma. So likely is that, and that they are not.
_REACH_S, _LATE_SHARE, LATE_S = 0.3, 0.5, 0.15
_LATE, _IN_TIME = np.log([1.0 / 3.0, 2.0 / 3.0]).tolist()


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

    If they agree with each other but not with the prior's direction, either the base turned
    against the odometry, or the camera against the base: in this picture that looks alike. So the
    heading becomes uncertain by that angle, `turn_sigma_rad` at most, the boresight by a part of
    it, and the position by what shows it from here; other bearings, and the direction in which
    the robot drives on, tell them apart. If the camera turns so fast that it may be that, there is
    another state, in which the joints' stamps are late as well: other rates tell which is true. A
    delay that is open anyway, or landmarks that are refined, take no second state. An angle that
    is only too large for the gates of single bearings is laid to the odometry.

    Parameters are those of `update_bearings`, but for the prior: all that may have happened.
    """
    single = frame.config.landmarks == 'refine'

    def updated(state: FilterState, enough: int, model: MeasurementModel | None = None) -> Outcome:
        return Outcome(*update_bearings(state, frame, lever, probability, odometry, enough, model))

    def outcomes(state: FilterState) -> list[Outcome]:
        stands = state.stands and not single
        state = looking_again(state, frame.config.repeat_length_m)
        expected = expected_bearings(state, frame, lever)
        as_before = updated(state, least, expected)
        turn_sigma = frame.config.turn_sigma_rad
        if turn_sigma == 0.0 or len(frame.columns) < _LEAST:
            return [as_before]
        angle, sigma = _common_turn(expected)
        surprising = abs(angle) > _SURPRISE * sigma
        if as_before.update.refusal is None and not surprising:
            return [as_before]
        turned = _turned(state, frame, min(abs(angle), turn_sigma), surprising, stands)
        loose = [(0.0, turned)]
        swings = frame.swing_rad(_REACH_S) > _LATE_SHARE * abs(angle)
        if surprising and swings and state.late.sigma_s < _DOUBTED * LATE_S:
            late = widened(state if stands else turned, DELAY, LATE_S**2)
            known = state.late.is_known and frame.config.landmarks == 'consider'
            # A delay that is known stays, most likely; one that is open would be told by a slip.
            loose = [(_IN_TIME, turned), (_LATE, late)] if known else [(0.0, late)]
        found = [
            updated(other, max(least, _LEAST))._replace(log_prior=log) for log, other in loose
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
            # Else it was one that is far off, and not the others with it.
            told = [one for one in told if abs(one.update.turned_rad) > _SURPRISE * sigma]
        return told or [as_before]

    return weighed(
        prior,
        lambda state: standing_or_hanging(state, outcomes, odometry, single),
        single,
    )


def _turned(
    state: FilterState, frame: BearingFrame, turn_rad: float, surprising: bool, stands: bool
) -> FilterState:
    """
    Doubt heading, boresight and position by an angle; the heading alone if no surprise.

    Of a robot that stands nothing slips: only its camera may have been knocked.
    """
    loose = state if stands and surprising else widened(state, HEADING, turn_rad**2)
    if not surprising:
        return loose
    away = state.landmarks[frame.columns] - state.mean[:2]
    if not stands:
        loose = widened(loose, [0, 1], turn_rad**2 * np.mean(np.sum(away**2, axis=1)))
    # Wheels may go on slipping, but a camera is knocked once.
    knock_rad, most_rad = KNOCKED * turn_rad, KNOCKED * frame.config.turn_sigma_rad
    if state.covariance[BORESIGHT, BORESIGHT] < (_DOUBTED * most_rad) ** 2:
        loose = widened(loose, BORESIGHT, knock_rad**2)
    return loose


def _explains(update: FusionUpdate, before: FusionUpdate) -> bool:
    """Whether a doubt makes no fewer bearings fit than there were without it."""
    return update.refusal is None and update.degrees >= before.degrees


def _common_turn(model: MeasurementModel) -> tuple[float, float]:
    """Angle by which all bearings are off together, and its standard deviation; radians."""
    weight = np.linalg.solve(model.covariance, np.ones(len(model.innovation)))
    information = weight.sum()
    return float(weight @ model.innovation / information), float(1.0 / np.sqrt(information))
