"""
Depth from scale, for patches that both panoramas see in the same direction.

On the line through two panoramas bearings do not give depth, and the prior would move patches onto
their wall. Scale gives the depth to a centimetre. It does not change poses and walls: these are
known better than the errors that all scales share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from landmark_nav.learning.adjustment.problem import AdjustmentConfig
from landmark_nav.learning.adjustment.solution import Adjustment
from landmark_nav.learning.stereo.wall_patch import PatchMeasurement
from landmark_nav.types import FloatArray

# Patches with a depth sigma below this share of `uncertain_sigma_m` show the errors of scales, if
# there are at least this number.
_KNOWN = 0.25
_LEAST_KNOWN = 10
_MAD_TO_SIGMA = 1.4826
# Scales with a larger sigma than this share of `uncertain_sigma_m` are not used.
INFORMATIVE = 0.5


def depth_from_scale(
    adjustment: Adjustment,
    free: Adjustment,
    measurements: Sequence[Sequence[PatchMeasurement]],
    normals: FloatArray,
    config: AdjustmentConfig,
    uncertain_sigma_m: float,
) -> tuple[Adjustment, Adjustment]:
    """
    Update the depths of patches by scale where bearings leave them uncertain.

    For such a patch the prior of the wall is that of a single patch on an otherwise empty wall:
    its neighbours may have another distance from the wall. Both adjustments, with the walls and
    by bearings alone (`free`), are returned, updated.

    Parameters
    ----------
    measurements : sequence of sequences
        Measurements of each of n patches, the first in the panorama that proposed it.
    normals : ndarray, shape (n, 3)
        Normals of their walls.
    uncertain_sigma_m : float
        Sigma from which a depth is uncertain, m.
    """
    hanging = np.hypot(config.relief_sigma_m, config.hanging_sigma_m)
    loose = np.hypot(hanging, config.common_hanging_sigma_m)
    own, by_bearings = adjustment.own_covariance, free.own_covariance
    along = np.einsum('nij,nj->ni', by_bearings, normals)
    depth_variance = np.sum(along * normals, 1)
    uncertain = depth_variance > uncertain_sigma_m**2
    shift, size_variance = _shift_by_size(adjustment, measurements, normals, config)
    known = depth_variance < (_KNOWN * uncertain_sigma_m) ** 2
    known &= np.isfinite(size_variance)
    if known.sum() >= _LEAST_KNOWN:
        missed = np.abs(shift[known]) / np.sqrt(size_variance[known])
        size_variance = size_variance * max(1.0, _MAD_TO_SIGMA * float(np.median(missed))) ** 2

    is_informative = size_variance < (INFORMATIVE * uncertain_sigma_m) ** 2
    which = np.flatnonzero(uncertain & is_informative)
    n, by_size = normals[which], size_variance[which]
    # Along its ray it may have any distance from the wall that objects have.
    ray = along[which] / depth_variance[which, None]
    loosened = own[which] + loose**2 * ray[:, :, None] * ray[:, None]
    loading = adjustment.shared_loading[which]
    spread = np.einsum('ni,nij,nj->n', n, loosened, n) + by_size
    spread += np.sum(np.einsum('ni,nip->np', n, loading) ** 2, 1)
    gain = np.einsum('nij,nj->ni', loosened, n) / spread[:, None]
    kept = np.eye(3) - gain[:, :, None] * n[:, None]
    noise = by_size[:, None, None] * gain[:, :, None] * gain[:, None]

    positions, off_wall = adjustment.positions.copy(), adjustment.off_wall_m.copy()
    chi_square, own, by_bearings = adjustment.chi_square.copy(), own.copy(), by_bearings.copy()
    shared_loading = adjustment.shared_loading.copy()
    moved = gain * shift[which, None]
    positions[which] += moved
    off_wall[which] += np.sum(moved * n, 1)
    chi_square[which] += shift[which] ** 2 / spread
    own[which] = kept @ loosened @ kept.swapaxes(1, 2) + noise
    shared_loading[which] = kept @ loading
    total = (depth_variance[which] + by_size)[:, None, None]
    by_bearings[which] -= along[which, :, None] * along[which, None] / total
    adjustment = replace(
        adjustment,
        positions=positions,
        own_covariance=own,
        shared_loading=shared_loading,
        off_wall_m=off_wall,
        chi_square=chi_square,
    )
    return adjustment, replace(free, own_covariance=by_bearings)


def _shift_by_size(
    adjustment: Adjustment,
    measurements: Sequence[Sequence[PatchMeasurement]],
    normals: FloatArray,
    config: AdjustmentConfig,
) -> tuple[FloatArray, FloatArray]:
    """Shift of patches (n,) off their walls by scale, and its variance (n,)."""
    by_bearings, information = np.zeros((2, len(measurements)))
    for k, group in enumerate(measurements):
        reach = (adjustment.poses[:, :3] - adjustment.positions[k]) @ normals[k]
        source = reach[group[0].panorama]
        for measurement in group[1:]:
            there = reach[measurement.panorama]
            by_depth = 1.0 / there - 1.0 / source
            variance = measurement.sigma_log_nearer**2 + config.nearness_sigma**2
            missed = measurement.log_nearer - np.log(source / there)
            by_bearings[k] += by_depth * missed / variance
            information[k] += by_depth**2 / variance
    with np.errstate(divide='ignore', invalid='ignore'):
        return np.where(information > 0.0, by_bearings / information, 0.0), 1.0 / information
