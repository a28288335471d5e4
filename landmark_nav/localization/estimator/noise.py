"""
Noise of wheels, floor and detections, estimated while the robot drives.

Wheels, floors and cameras differ more than a parameter file can describe. The filter propagates
the part of its covariance by each noise; the innovations give a factor on each: maximum likelihood
by Fisher scoring, one step per image (Mehra, Approaches to Adaptive Filtering, IEEE Trans.
Automatic Control 17(5), 1972).

A last factor, on all other uncertainty, prevents that a map which is better than its covariance is
taken for low noise of the wheels. It is not applied: innovations do not show errors that all
landmarks share.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from landmark_nav.types import FloatArray

# White noise of the odometry by way and time, and by turns; its side slip; tilt of the floor; the
# detections; and all other uncertainty.
WAY, TURNS, SLIP_NOISE, FLOOR, DETECTION, _REST = range(6)
NOISES = _REST
# Prior correlation: the same wheels cause the noise of way and turns.
_ALIKE = np.eye(_REST + 1)
_ALIKE[WAY, TURNS] = _ALIKE[TURNS, WAY] = 0.5
# Correlation length of the factors, m.
_LEARNING_WAY_M = 50.0
# Largest factor on a sigma, and largest change of a log variance by one image.
_LARGEST, _MOST_AT_ONCE = 5.0, 0.5


@dataclass(frozen=True, eq=False)
class NoiseScales:
    """Logarithms (c,) of the factors on the variances, and their covariance (c, c)."""

    log_scale: FloatArray
    covariance: FloatArray
    prior_sigma: float

    @classmethod
    def unknown(cls, sigma: float) -> NoiseScales:
        """Return factors of one with this sigma of their logarithms; 0 keeps them at one."""
        return cls(np.zeros(_REST + 1), sigma**2 * _ALIKE, sigma)

    @property
    def factors(self) -> FloatArray:
        """Factors on the variances, (NOISES,)."""
        return np.exp(self.log_scale[:NOISES])

    def moved(self, way_m: float) -> NoiseScales:
        """Predict over a way: an Ornstein-Uhlenbeck process about factors of one."""
        if not (self.prior_sigma and way_m):
            return self
        kept = np.exp(-way_m / _LEARNING_WAY_M)
        fresh = self.prior_sigma**2 * _ALIKE
        spread = fresh + kept**2 * (self.covariance - fresh)
        return NoiseScales(kept * self.log_scale, spread, self.prior_sigma)


def learned(
    scales: NoiseScales, innovation: FloatArray, covariance: FloatArray, by_noise: FloatArray
) -> NoiseScales:
    """
    Return the scales after one measurement.

    Parameters
    ----------
    innovation : ndarray, shape (m,)
        Measured minus predicted.
    covariance : ndarray, shape (m, m)
        Covariance of the innovation by the filter.
    by_noise : ndarray, shape (NOISES, m, m)
        Part of that covariance by each noise.
    """
    if not scales.prior_sigma:
        return scales
    of_noises = by_noise.sum(axis=0)
    rest = np.exp(scales.log_scale[_REST]) * (covariance - of_noises)
    precision = np.linalg.inv(of_noises + rest)
    passed = np.concatenate([by_noise, rest[None]]) @ precision
    # The score is 1/2 (w' V w - trace(V S^-1)) with w = S^-1 r.
    weighted = precision @ innovation
    score = 0.5 * ((passed @ innovation) @ weighted - np.trace(passed, axis1=1, axis2=2))
    flat = passed.reshape(_REST + 1, -1)
    fisher = 0.5 * flat @ passed.swapaxes(1, 2).reshape(_REST + 1, -1).T
    spread = np.linalg.inv(np.linalg.inv(scales.covariance) + fisher)
    step = np.clip(spread @ score, -_MOST_AT_ONCE, _MOST_AT_ONCE)
    most = 2.0 * np.log(_LARGEST)
    return NoiseScales(np.clip(scales.log_scale + step, -most, most), spread, scales.prior_sigma)
