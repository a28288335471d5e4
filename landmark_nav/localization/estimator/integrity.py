"""
Integrity: whether the pose is right, and a bound of its error.

One likelihood ratio compares the landmarks found in an image with those expected if the pose is
right, and with those found by chance if it is wrong. It is summed over the images (a sequential
test: Wald, Sequential Analysis, 1947), and bounded, so that it can change quickly.

The protection level bounds the error with a probability of 99 %: by the covariance, and by the
poses without each one of the landmarks, as one of them may be wrong (solution separation: Blanch
et al., Baseline Advanced RAIM User Algorithm, 2015).
"""

from __future__ import annotations

from dataclasses import replace
from enum import Enum
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, ndtri

from landmark_nav.localization.estimator.state import Update
from landmark_nav.types import FloatArray, PoseEstimate

# Rates: of false detections with a right pose; of landmarks in view that are found with a right
# pose, and by chance with a wrong one.
_WRONG, _FOUND, _BY_CHANCE = 0.1, 0.8, 0.15
# Half width of the window in which chance matches are uniform: in sigmas, and at least this angle.
_WINDOW_SIGMAS, _LEAST_WINDOW = 3.0, 0.02
# Log likelihood ratio of a landmark that is not found: right pose against wrong pose.
MISSED = float(np.log((1.0 - _FOUND) / (1.0 - _BY_CHANCE)))


def squared_norms(residual: FloatArray, covariance: FloatArray) -> FloatArray:
    """Squared Mahalanobis norms (m,) of residuals (m, d) with covariances (m, d, d)."""
    weighted = np.linalg.solve(covariance, residual[..., None])[..., 0]
    return np.asarray(np.einsum('mi,mi->m', residual, weighted))


def found_log_ratios(residual: FloatArray, covariance: FloatArray) -> FloatArray:
    """
    Log likelihood ratio (m,) of each landmark that is found: right pose against wrong pose.

    `residual` (m, d) is measured minus expected, `covariance` (m, d, d) that of each.
    """
    area = np.prod(2.0 * _windows(covariance), axis=1)
    density = np.exp(-0.5 * np.minimum(squared_norms(residual, covariance), 1e3))
    density /= np.sqrt(np.linalg.det(2.0 * np.pi * covariance))
    return np.asarray(
        np.log((1.0 - _WRONG) * density * area + _WRONG) + np.log(_FOUND / _BY_CHANCE)
    )


def chance_log_evidence(residual: FloatArray, covariance: FloatArray) -> float:
    """
    Log evidence of an image whose landmarks were all found by chance, in the widest window of all.

    As in `Update.log_evidence`, the powers of 2 pi of normal densities are left out.
    """
    half = np.maximum(_windows(covariance), np.abs(residual)).max(axis=0)
    each = np.log(_WRONG) - np.sum(np.log(2.0 * half)) + 0.5 * len(half) * np.log(2.0 * np.pi)
    return float(len(residual) * each)


def _windows(covariance: FloatArray) -> FloatArray:
    """Half sizes (m, d) of the windows for covariances (m, d, d)."""
    sigmas = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return np.maximum(_WINDOW_SIGMAS * sigmas, _LEAST_WINDOW)


# Greatest contributions of one detection and of all misses of an image, which share causes, nats.
_MOST, _MOST_MISSED = 2.0, 2.0
# Bounds of the sum and of the contribution of one image; the sum below which a pose is lost, and
# the contribution of one image below which it is degraded, nats.
_BOUND, _AT_ONCE, _LOST, _AGAINST = 8.0, 4.0, -4.0, -2.0
# Without an image or a detection for this time a pose is degraded, s.
_BLIND_S = 1.0
# Sigmas above which a pose is lost, and a heading degraded.
_LOST_M, _LOST_RAD, _DEGRADED_RAD = 1.0, 0.5, 0.02
_RISK = 0.01
# Probability that a given landmark of an image is wrong for long.
_LANDMARK_RISK = 0.05
# Factor on sigmas for errors that the noise models leave out.
_MODEL = 1.1
_POSITION = _MODEL * float(np.sqrt(chdtri(2, _RISK)))
_HEADING = _MODEL * float(-ndtri(0.5 * _RISK))
_POSITION_WITHOUT = _MODEL * float(np.sqrt(chdtri(2, _RISK / _LANDMARK_RISK)))
_HEADING_WITHOUT = _MODEL * float(-ndtri(0.5 * _RISK / _LANDMARK_RISK))


class Status(Enum):
    """State of a pose."""

    OK = 'OK'
    DEGRADED = 'degraded'
    LOST = 'lost'


class ProtectionLevel(NamedTuple):
    """Bounds on the errors of position [m] and heading [rad] that hold with 99 %."""

    position_m: float
    heading_rad: float

    def scaled(self, estimate: PoseEstimate) -> PoseEstimate:
        """
        Return the pose with a covariance of which one sigma is this level.

        The root of the largest eigenvalue of x and y is the level of the position, the root of
        the variance of the heading its own.
        """
        position, heading = _sigmas(estimate.covariance)
        by = np.array([self.position_m, self.position_m, self.heading_rad])
        by /= np.maximum([position, position, heading], 1e-9)
        return replace(estimate, covariance=estimate.covariance * np.outer(by, by))

    @classmethod
    def unscaled(cls, scaled: PoseEstimate) -> ProtectionLevel:
        """Return the level by which a pose was `scaled`."""
        return cls(*map(float, _sigmas(scaled.covariance)))


def protection_level(estimate: PoseEstimate, update: Update | None = None) -> ProtectionLevel:
    """Return the protection level of a pose, with the last update if there was one."""
    position, heading = _sigmas(estimate.covariance)
    away, aside = _POSITION * float(position), _HEADING * float(heading)
    if update is not None and len(update.columns):
        wide, turned = _sigmas(estimate.covariance + update.without)
        off = np.linalg.norm(update.separation[:, :2], axis=1)
        away = max(away, float((off + _POSITION_WITHOUT * wide).max()))
        off = np.abs(update.separation[:, 2])
        aside = max(aside, float((off + _HEADING_WITHOUT * turned).max()))
    return ProtectionLevel(away, aside)


def is_unknown(covariance: FloatArray) -> bool:
    """Whether a pose with this covariance (3, 3) is unknown, so that it is lost."""
    position, heading = _sigmas(covariance)
    return bool(position > _LOST_M or heading > _LOST_RAD)


def _sigmas(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Largest sigma of the position, and that of the heading, of covariances (..., 3, 3)."""
    xx, xy, yy = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    largest = 0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)
    return np.sqrt(np.maximum(largest, 0.0)), np.sqrt(np.maximum(covariance[..., 2, 2], 0.0))


class Integrity:
    """Sums the likelihood ratios of images: bounded log odds that the pose is right."""

    def __init__(self) -> None:
        self.log_ratio, self._newest = 0.0, 0.0
        # Stamps of the newest image, and of the newest that showed a landmark.
        self._seen_ns: int | None = None
        self._found_ns: int | None = None
        self._stepped = False

    @property
    def contradicted(self) -> bool:
        """Whether images do not show what should be seen from the pose."""
        return self.log_ratio < _LOST

    def add(self, stamp_ns: int, update: Update | None, missed: int = 0) -> None:
        """Add an image: its update, and the number of landmarks that were not found."""
        found = 0 if update is None else len(update.columns)
        if self._found_ns is None:
            self._found_ns = stamp_ns
        self._seen_ns = max(self._seen_ns or 0, stamp_ns)
        if not found and not missed:
            return  # nothing was expected: the last evidence stands
        gained = max(-_MOST_MISSED, missed * MISSED)
        if update is not None and found:
            self._found_ns = max(self._found_ns, stamp_ns)
            self._stepped |= update.stepped
            gained += float(np.minimum(update.log_ratios, _MOST).sum())
        self._newest = float(np.clip(gained, -_AT_ONCE, _AT_ONCE))
        self.log_ratio = float(np.clip(self.log_ratio + self._newest, -_BOUND, _BOUND))

    def inflated_if_lost(self, estimate: PoseEstimate, lost: bool = False) -> PoseEstimate:
        """Return a pose for publication: the covariance of a lost one is inflated."""
        if not (self.contradicted or lost):
            return estimate
        unknown = np.diag(np.square([_LOST_M, _LOST_M, _LOST_RAD]))
        return replace(estimate, covariance=estimate.covariance + unknown)

    def status(self, estimate: PoseEstimate) -> tuple[Status, str]:
        """State of a pose, and the reason if it is not OK."""
        position, heading = (float(sigma) for sigma in _sigmas(estimate.covariance))
        since_ns = estimate.stamp_ns if self._found_ns is None else self._found_ns
        blind_s = 1e-9 * (estimate.stamp_ns - since_ns)
        unseen_s = 1e-9 * (estimate.stamp_ns - (self._seen_ns or since_ns))
        if not np.isfinite(estimate.pose).all() or not np.isfinite(position + heading):
            return Status.LOST, 'the estimate is not a number'
        if self.contradicted:
            return Status.LOST, 'images do not show what should be seen from here'
        if is_unknown(estimate.covariance):
            return Status.LOST, f'sigma {position:.2f} m, {np.degrees(heading):.0f} deg'
        if unseen_s > _BLIND_S:
            return Status.DEGRADED, f'no detections for {unseen_s:.1f} s: camera or node stopped'
        if self.log_ratio < 0.0 or self._newest <= _AGAINST:
            return Status.DEGRADED, 'images show little of what should be seen from here'
        if blind_s > _BLIND_S:
            return Status.DEGRADED, f'no landmark found for {blind_s:.1f} s'
        if heading > _DEGRADED_RAD:
            why = 'camera or base was turned' if self._stepped else 'pan zero is not known yet'
            return Status.DEGRADED, f'heading sigma {np.degrees(heading):.1f} deg: {why}'
        self._stepped = False
        return Status.OK, ''
