"""
How noisy wheels and detections are, learned while the robot drives.

Wheels, floors and cameras differ by more than a parameter file can say. Factors on four variances
are estimated from the innovations: on the odometry's white noise, by the way and by turns, on its
side slip and on each detection. It is maximum likelihood by Fisher scoring, one step an image (as
Mehra, On the Identification of Variances and Adaptive Kalman Filtering, 1970, has it);
the filter carries along which part of the state's covariance comes from each noise.

A fifth factor, on all the rest, keeps a map that is better than it claims from being taken for
quiet wheels or sharp detections. It is not applied to anything: innovations do not show an error
that landmarks share, and show that of a single landmark again and again. The error that all
detections of an image share is not learned either, as it looks like a turn of the wheels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.types import FloatArray

__all__ = ['LEARNED', 'SIGHTING', 'SLIP', 'TURNS', 'WAY', 'NoiseScales', 'learned_scales']

# White noise of the odometry, as `sensed_variances` has it, its side slip, each detection.
LEARNED = 4
WAY, TURNS, SLIP, SIGHTING = range(LEARNED)
# All other uncertainty: that of the map and of the start.
_REST = LEARNED
_COMPONENTS = LEARNED + 1
# Way over which the noise may change, and the largest factor on a sigma that is learned.
_LEARNING_WAY_M, _LEARNING_RANGE = 50.0, 5.0
# The same wheels make the noise of the way and of turns: a wheel that slips more does so in both.
_ALIKE = np.eye(_COMPONENTS)
_ALIKE[WAY, TURNS] = _ALIKE[TURNS, WAY] = 0.5
# One image may not change a variance by more than this, as a logarithm.
_MOST_AT_ONCE = 0.5


@dataclass(frozen=True, eq=False)
class NoiseScales:
    """
    Logarithms of the factors on the variances (c,), and their covariance (c, c).

    Both are zero where nothing is learned.
    """

    log_scale: FloatArray
    covariance: FloatArray

    @classmethod
    def unknown(cls, config: OdometryNoiseConfig) -> NoiseScales:
        """Return factors of one, as uncertain as the configuration has it."""
        return cls(np.zeros(_COMPONENTS), config.learning_sigma**2 * _ALIKE)

    @property
    def factors(self) -> FloatArray:
        """Factors on the variances that are learned, (LEARNED,)."""
        return np.exp(self.log_scale[:LEARNED])

    def of(self, config: OdometryNoiseConfig) -> OdometryNoiseConfig:
        """Return odometry parameters scaled by the learned factors."""
        return config.scaled(*np.sqrt(self.factors[:SIGHTING]).tolist())

    @property
    def detection_sigma_factor(self) -> float:
        """Factor on what detections claim as their sigmas."""
        return float(np.sqrt(self.factors[SIGHTING]))

    def moved(self, way_m: float, config: OdometryNoiseConfig) -> NoiseScales:
        """Forget a little on the way: an Ornstein-Uhlenbeck process about the parameters."""
        if config.learning_sigma == 0.0 or way_m == 0.0:
            return self
        kept = np.exp(-way_m / _LEARNING_WAY_M)
        fresh = config.learning_sigma**2 * _ALIKE
        return NoiseScales(kept * self.log_scale, fresh + kept**2 * (self.covariance - fresh))


def learned_scales(
    scales: NoiseScales,
    innovation: FloatArray,
    covariance: FloatArray,
    by_noise: FloatArray,
    config: OdometryNoiseConfig,
) -> NoiseScales:
    """
    Return the scales after one measurement.

    Parameters
    ----------
    scales : NoiseScales
        Before.
    innovation : ndarray, shape (m,)
        Measured minus predicted.
    covariance : ndarray, shape (m, m)
        Its covariance according to the filter.
    by_noise : ndarray, shape (LEARNED, m, m)
        Part of it that comes from each learned noise.
    config : OdometryNoiseConfig
        Its `learning_sigma` is the prior of the logarithms; 0 leaves the scales as they are.

    """
    if config.learning_sigma == 0.0:
        return scales
    rest = covariance - by_noise.sum(axis=0)
    parts = np.concatenate([by_noise, np.exp(scales.log_scale[_REST]) * rest[None]])
    precision = np.linalg.inv(parts.sum(axis=0))
    weighted = precision @ innovation
    passed = parts @ precision
    score = 0.5 * ((parts @ weighted) @ weighted - np.trace(passed, axis1=1, axis2=2))
    fisher = 0.5 * np.einsum('aij,bji->ab', passed, passed)
    uncertainty = np.linalg.inv(np.linalg.inv(scales.covariance) + fisher)
    step = np.clip(uncertainty @ score, -_MOST_AT_ONCE, _MOST_AT_ONCE)
    most = 2.0 * np.log(_LEARNING_RANGE)
    return replace(
        scales,
        log_scale=np.clip(scales.log_scale + step, -most, most),
        covariance=uncertainty,
    )
