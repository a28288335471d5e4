"""
How noisy the wheels are, learned while they roll.

Wheels and floors differ by more than a parameter file can say. Two variances, of the odometry's
white noise and of its side slip, are scaled by factors that the innovations speak for: maximum
likelihood by Fisher scoring, one step a picture (Mehra, On the Identification of Variances and
Adaptive Kalman Filtering, 1970, has the principle), with what of the state's covariance goes with
each factor carried through the filter. A third factor, on all the rest, is there so that bearings
or a map that are better than they claim are not taken for quiet wheels; it changes nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.types import FloatArray

__all__ = ['NoiseScales', 'learned_scales']

# White noise of the odometry, side slip, and all the rest: bearings, map.
COMPONENTS = 3
_REST = 2
# One picture may not change a variance by more than this, as a logarithm.
_MOST_AT_ONCE = 0.5


@dataclass(frozen=True, eq=False)
class NoiseScales:
    """
    Logarithms of the factors on the variances (COMPONENTS,), and what they are worth.

    `covariance` (COMPONENTS, COMPONENTS) is theirs; zero where nothing is learned.
    """

    log_scale: FloatArray
    covariance: FloatArray

    @classmethod
    def unknown(cls, config: OdometryNoiseConfig) -> NoiseScales:
        """Return what is known before anything was measured."""
        return cls(np.zeros(COMPONENTS), config.learning_sigma**2 * np.eye(COMPONENTS))

    @property
    def factors(self) -> FloatArray:
        """Factors on the variances, (COMPONENTS,)."""
        return np.exp(self.log_scale)

    def of(self, config: OdometryNoiseConfig) -> OdometryNoiseConfig:
        """Parameters as they turned out to be."""
        noise, slip, _ = np.sqrt(self.factors).tolist()
        return config.scaled(noise, slip)

    def moved(self, way_m: float, config: OdometryNoiseConfig) -> NoiseScales:
        """Forget a little on the way: an Ornstein-Uhlenbeck process about the parameters."""
        if config.learning_sigma == 0.0 or way_m == 0.0:
            return self
        kept = np.exp(-way_m / config.learning_way_m)
        fresh = config.learning_sigma**2 * np.eye(COMPONENTS)
        return NoiseScales(kept * self.log_scale, fresh + kept**2 * (self.covariance - fresh))


def learned_scales(
    scales: NoiseScales,
    innovation: FloatArray,
    covariance: FloatArray,
    jacobian: FloatArray,
    by_noise: FloatArray,
    config: OdometryNoiseConfig,
) -> NoiseScales:
    """
    Scales after one measurement.

    Parameters
    ----------
    scales : NoiseScales
        Before.
    innovation : ndarray, shape (m,)
        Measured minus predicted.
    covariance : ndarray, shape (m, m)
        What the filter says is its covariance.
    jacobian : ndarray, shape (m, n)
        What is measured, differentiated by the state.
    by_noise : ndarray, shape (2, n, n)
        What of the state's covariance comes from white noise and from side slip.
    config : OdometryNoiseConfig
        How far to learn.

    """
    if config.learning_sigma == 0.0:
        return scales
    known = jacobian @ by_noise @ jacobian.T
    rest = covariance - known.sum(axis=0)
    parts = np.concatenate([known, np.exp(scales.log_scale[_REST]) * rest[None]])
    precision = np.linalg.inv(parts.sum(axis=0))
    weighted = precision @ innovation
    passed = parts @ precision
    score = 0.5 * ((parts @ weighted) @ weighted - np.trace(passed, axis1=1, axis2=2))
    fisher = 0.5 * np.einsum('aij,bji->ab', passed, passed)
    uncertainty = np.linalg.inv(np.linalg.inv(scales.covariance) + fisher)
    step = np.clip(uncertainty @ score, -_MOST_AT_ONCE, _MOST_AT_ONCE)
    most = 2.0 * np.log(config.learning_range)
    return replace(
        scales,
        log_scale=np.clip(scales.log_scale + step, -most, most),
        covariance=uncertainty,
    )
