"""A camera that was bumped, or a robot turned on the spot: all bearings are off by one angle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from landmark_nav.localization.fusion.bearings import BearingFrame
from landmark_nav.localization.fusion.measurement import expected_bearings, MeasurementModel
from landmark_nav.localization.fusion.state import (
    BORESIGHT,
    DELAY,
    FilterState,
    HEADING,
    looking_again,
)
from landmark_nav.localization.fusion.update import FusionUpdate, update_bearings
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.types import FloatArray

__all__ = ['LATE_S', 'update_turning']

# An angle that all bearings share is a surprise beyond this many standard deviations.
_SURPRISE = 5.0
# So many bearings tell a common angle from a wrong place.
_LEAST = 3
# What has a variance that is this share of what a surprise brings is doubted already.
_DOUBTED = 0.25
# Stamps of joints may be late by so much; they are suspected where that explains so much of an
# angle, and then have this sigma.
_REACH_S, _LATE_SHARE, LATE_S = 0.3, 0.5, 0.15


def update_turning(
    prior: FilterState,
    frame: BearingFrame,
    lever: FloatArray,
    probability: float,
    odometry: OdometryNoiseConfig,
    least: int,
) -> tuple[FilterState, FusionUpdate]:
    """
    Use the bearings of a frame as `update_bearings` does, or as those of a camera that turned.

    If they agree with each other but not with the prior's direction, either the camera turned
    against the base, or the base against the odometry, or the wheels slipped: at these few places
    that looks alike. So heading and boresight become uncertain by that angle, `turn_sigma_rad`
    at most, and the position by what shows it from here; so does the lateness of the joints'
    stamps, if the camera turns so fast that it may be that. Other bearings, other rates, and the
    direction in which the robot drives on, tell them apart. An angle that is only too large for
    the gates of single bearings is laid to the odometry.
    """
    prior = looking_again(prior, frame.config.repeat_length_m)
    expected = expected_bearings(prior, frame, lever)
    state, update = update_bearings(prior, frame, lever, probability, odometry, least, expected)
    turn_sigma = frame.config.turn_sigma_rad
    if turn_sigma == 0.0 or len(frame.columns) < _LEAST:
        return state, update
    angle, sigma = _common_turn(expected)
    surprising = abs(angle) > _SURPRISE * sigma
    if update.refusal is None and not surprising:
        return state, update
    covariance = prior.covariance.copy()
    variance = min(angle**2, turn_sigma**2)
    covariance[HEADING, HEADING] += variance
    if surprising:
        # Wheels may go on slipping, but a camera is knocked once.
        if covariance[BORESIGHT, BORESIGHT] < _DOUBTED * turn_sigma**2:
            covariance[BORESIGHT, BORESIGHT] += variance
        away = prior.landmarks[frame.columns] - prior.mean[:2]
        covariance[[0, 1], [0, 1]] += variance * np.mean(np.sum(away**2, axis=1))
        swings = frame.swing_rad(_REACH_S) > _LATE_SHARE * abs(angle)
        if swings and covariance[DELAY, DELAY] < _DOUBTED * LATE_S**2:
            covariance[DELAY, DELAY] += LATE_S**2
    loose = replace(prior, covariance=covariance)
    loose_state, loose_update = update_bearings(
        loose, frame, lever, probability, odometry, max(least, _LEAST)
    )
    if loose_update.refusal is not None or loose_update.degrees < update.degrees:
        return state, update
    if not surprising:
        return loose_state, loose_update
    angle = float(np.median(loose_update.innovation_rad))
    if update.refusal is None and abs(angle) <= _SURPRISE * sigma:
        # It was one that is far off, and not the others with it.
        return state, update
    return loose_state, replace(loose_update, turned_rad=angle)


def _common_turn(model: MeasurementModel) -> tuple[float, float]:
    """Angle by which all bearings are off together, and its standard deviation; radians."""
    weight = np.linalg.solve(model.covariance, np.ones(len(model.innovation)))
    information = weight.sum()
    return float(weight @ model.innovation / information), float(1.0 / np.sqrt(information))
