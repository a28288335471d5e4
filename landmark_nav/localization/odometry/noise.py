"""
The noise model of wheel odometry.

White noise has the form of Borenstein and Feng (1996): variances grow with the way and the turn.
Systematic errors (of wheel diameters, their difference, the track) are three factors that the
filter estimates. Side slip is caused by turns and decays over some way. Wheels of iRobot Creates
slip by 2 to 5 mm per radian; a base with four fixed wheels turns about a centre that moves by up
to decimetres. On straight ways Creates keep their direction to 0.07 degrees over 5 m (motion
capture of MR.CLAM 6).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
import math
from typing import NamedTuple

import numpy as np

from landmark_nav.geometry.se2 import arc, sinc
from landmark_nav.parameters import Config, parameter
from landmark_nav.types import FloatArray

# Sigmas of the accelerations while the last twist is extrapolated.
_ACCELERATION_M_S2, _TURN_ACCELERATION_RAD_S2 = 0.5, 2.0
_OF_WAY = (
    'along_m_per_sqrt_m',
    'across_m_per_sqrt_m',
    'turn_rad_per_sqrt_m',
    'floor_m_per_sqrt_s',
    'floor_rad_per_sqrt_s',
)


class Motion(NamedTuple):
    """
    A planar motion in the body frame.

    `increment` (3,) is forward [m], left [m] and turn [rad] over `seconds`. For `blind_seconds`
    the odometry was missing or broken. `ahead_s4` is the growth of the fourth power of the
    extrapolated time [s^4] where the last twist is extrapolated. `jitter_m2` and `jitter_rad2` are
    variances by white noise of the two poses, `steps_m2` and `steps_rad2` by steps of the poses
    that the speeds contradict.
    """

    increment: FloatArray
    seconds: float
    blind_seconds: float = 0.0
    ahead_s4: float = 0.0
    jitter_m2: float = 0.0
    jitter_rad2: float = 0.0
    steps_m2: float = 0.0
    steps_rad2: float = 0.0


_sigma = partial(parameter, minimum=0.0, maximum=1.0)


@dataclass(frozen=True)
class OdometryNoiseConfig(Config):
    """Noise of wheel odometry."""

    along_m_per_sqrt_m: float = _sigma(0.004, 'Sigma along the way after one metre, m.')
    across_m_per_sqrt_m: float = _sigma(0.004, 'Sigma across the way after one metre, m.')
    turn_rad_per_sqrt_m: float = _sigma(0.008, 'Sigma of the heading after one metre, rad.')
    turn_rad_per_sqrt_rad: float = _sigma(
        0.015, 'Sigma of the heading after one radian of turn, rad.'
    )
    floor_m_per_sqrt_s: float = _sigma(
        0.0005, 'Sigma of the position after one second at rest, m.'
    )
    floor_rad_per_sqrt_s: float = _sigma(
        0.0003, 'Sigma of the heading after one second at rest, rad.'
    )
    blind_m_per_sqrt_s: float = parameter(
        0.5, 'Sigma of the position after one second without odometry, m.', minimum=0.0
    )
    blind_rad_per_sqrt_s: float = parameter(
        0.5, 'Sigma of the heading after one second without odometry, rad.', minimum=0.0
    )
    estimate_odometry_bias: bool = parameter(
        True, 'Estimate the scale, the drift per metre and the turn scale of the odometry.'
    )
    scale_sigma: float = _sigma(0.03, 'Sigma of the relative error of the way at the start.')
    drift_sigma_rad_per_m: float = _sigma(
        0.01, 'Sigma of the systematic turn per metre at the start.'
    )
    turn_scale_sigma: float = _sigma(0.03, 'Sigma of the relative error of turns at the start.')
    turn_loss_sigma_m_per_rad: float = _sigma(
        0.0,
        'Sigma of the way that is lost in turns, m per rad, which is estimated: a base that is '
        'commanded to drive and to turn may drive slower. 0 has it lose none.',
    )
    bias_change_per_sqrt_m: float = _sigma(
        0.05, 'Random walk of these three in one metre, relative to their sigmas at the start.'
    )
    slip_m_per_rad: float = _sigma(
        0.05,
        'Sigma of the side slip in turns, m to the left per rad; on a straight way there is none.',
    )
    slip_length_m: float = parameter(
        0.1, 'Way over which side slip changes, m.', minimum=0.001, maximum=1000.0
    )
    max_speed_m_s: float = parameter(
        3.0, 'Odometry that moves faster has jumped, m/s.', minimum=0.01, maximum=100.0
    )
    max_rate_rad_s: float = parameter(
        6.0, 'Odometry that turns faster has jumped, rad/s.', minimum=0.01, maximum=100.0
    )
    max_gap_s: float = parameter(
        1.0, 'A longer pause between samples counts as blind, s.', minimum=0.0, maximum=60.0
    )

    def scaled(self, way: float, turns: float, slip: float) -> OdometryNoiseConfig:
        """Return a copy with scaled sigmas of way, turns and side slip."""
        sigmas = {name: min(1.0, way * getattr(self, name)) for name in _OF_WAY}
        sigmas['turn_rad_per_sqrt_rad'] = min(1.0, turns * self.turn_rad_per_sqrt_rad)
        sigmas['slip_m_per_rad'] = min(1.0, slip * self.slip_m_per_rad)
        return replace(self, **sigmas)

    @cached_property
    def bias_sigmas(self) -> FloatArray:
        """Initial sigmas (3,) of scale, drift and turn scale; zero if they are not estimated."""
        sigmas = (self.scale_sigma, self.drift_sigma_rad_per_m, self.turn_scale_sigma)
        return np.array(sigmas) if self.estimate_odometry_bias else np.zeros(3)


def motion_variances(motion: Motion, config: OdometryNoiseConfig) -> FloatArray:
    """Variances (3,) of forward, left and turn of a motion; those of its parts add up."""
    sensed = np.sum(sensed_variances(motion, config), axis=0)
    return np.asarray(sensed + blind_variances(motion, config))


def sensed_variances(motion: Motion, config: OdometryNoiseConfig) -> FloatArray:
    """Variances (2, 3) of what the wheels reported: by way and time, and by turns."""
    forward, left, turn = motion.increment
    way = float(np.hypot(forward, left))
    rest = config.floor_m_per_sqrt_s**2 * motion.seconds
    rest_turn = config.floor_rad_per_sqrt_s**2 * motion.seconds
    along = config.along_m_per_sqrt_m**2 * way + rest
    across = config.across_m_per_sqrt_m**2 * way + rest
    turned = config.turn_rad_per_sqrt_m**2 * way + rest_turn
    by_turns = config.turn_rad_per_sqrt_rad**2 * abs(turn)
    return np.array([[along, across, turned], [0.0, 0.0, by_turns]])


def slip_variance(motion: Motion, config: OdometryNoiseConfig) -> float:
    """Variance of the side slip caused by a turn, m to the left per m ahead; at most 1."""
    forward, left, turn = motion.increment
    aside = (config.slip_m_per_rad * turn) ** 2
    return float(aside / max(forward**2 + left**2 + aside, 1e-300))


def left_variance(motion: Motion, config: OdometryNoiseConfig) -> float:
    """Variance of the motion to the left, m^2, over ways much longer than `slip_length_m`."""
    slip = 2.0 * config.slip_length_m * slip_variance(motion, config)
    return float(motion_variances(motion, config)[1] + slip * abs(motion.increment[0]))


def blind_variances(motion: Motion, config: OdometryNoiseConfig) -> FloatArray:
    """Variances (3,) of the time without odometry, of extrapolation, and of steps."""
    position = motion.blind_seconds * config.blind_m_per_sqrt_s**2 + motion.steps_m2
    heading = motion.blind_seconds * config.blind_rad_per_sqrt_s**2 + motion.steps_rad2
    along = 0.25 * motion.ahead_s4 * _ACCELERATION_M_S2**2
    turned = 0.25 * motion.ahead_s4 * _TURN_ACCELERATION_RAD_S2**2
    return np.array([position + along, position, heading + turned])


def jitter_variances(motion: Motion) -> FloatArray:
    """Variances (3,) by white noise of the poses at both ends; those of parts add up to more."""
    return np.array([motion.jitter_m2, motion.jitter_m2, motion.jitter_rad2])


def twist_motion(linear_m_s: float, angular_rad_s: float, seconds: float) -> FloatArray:
    """Increment (3,) of a constant twist: an arc."""
    return arc(linear_m_s * seconds, angular_rad_s * seconds)


def fraction_of_motion(increment: FloatArray, fraction: float) -> FloatArray:
    """
    First part (3,) of an increment (3,) at constant twist.

    The exponential of the fraction of the logarithm in SE(2): the chord turns by half the turn.
    """
    if fraction <= 0.0:
        return np.zeros(3)
    forward, left, turn = increment.tolist()
    ratio = fraction * sinc(fraction * turn / math.tau) / sinc(turn / math.tau)
    ahead, aside, back = ratio * forward, ratio * left, (fraction - 1.0) * turn / 2.0
    c, s = math.cos(back), math.sin(back)
    return np.array([c * ahead - s * aside, s * ahead + c * aside, fraction * turn])
