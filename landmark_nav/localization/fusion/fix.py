"""Triangulated poses of the base in the filter."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from landmark_nav.arrays import IndexArray
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.fusion.measurement import bearing_model, correct, MeasurementModel
from landmark_nav.localization.fusion.mixture import Mixture, Outcome, weighed
from landmark_nav.localization.fusion.noise import LEARNED
from landmark_nav.localization.fusion.stand import standing_or_hanging
from landmark_nav.localization.fusion.state import BORESIGHT, FilterState, HEADING, widened
from landmark_nav.localization.fusion.update import FusionUpdate, log_density
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.types import FloatArray, PoseEstimate, Refusal

__all__ = ['update_pose']

# Logarithm of the density of a mistaken pose, 1 / (m^2 rad): one pose in fifty is mistaken, and
# then lies anywhere in a square metre and some degrees.
_LOG_STRAY = float(np.log(0.1))


def update_pose(
    prior: Mixture,
    measured: PoseEstimate,
    columns: IndexArray,
    lever: FloatArray,
    probability: float,
    turn_sigma: float,
    odometry: OdometryNoiseConfig,
) -> tuple[Mixture, FusionUpdate]:
    """
    Use a triangulated pose, if it agrees with the prior.

    Where only its heading does not agree, the camera was turned against the base or the base
    against the odometry: that angle is added to the sigmas of both, or to that of the boresight
    alone while the robot stands.

    Parameters
    ----------
    prior : Mixture
        Hypotheses at the pose's time.
    measured : PoseEstimate
        Pose of the base in map.
    columns : ndarray of int, shape (m,)
        Columns in the map of the landmarks that it was triangulated from.
    lever : ndarray, shape (2,)
        Pan axis in the base frame, metres.
    probability : float
        Chi-square level of the gate.
    turn_sigma : float
        How far heading and boresight are doubted at most, radians; 0 for not at all.
    odometry : OdometryNoiseConfig
        Has the variances of a motion without odometry.

    """

    def outcomes(state: FilterState) -> list[Outcome]:
        return [_outcome(state, measured, columns, lever, probability, turn_sigma)]

    return weighed(prior, lambda state: standing_or_hanging(state, outcomes, odometry))


def _outcome(
    prior: FilterState,
    measured: PoseEstimate,
    columns: IndexArray,
    lever: FloatArray,
    probability: float,
    turn_sigma: float,
) -> Outcome:
    limit = float(chdtri(3, 1.0 - probability))
    model, turned = _pose_model(prior, measured, columns, lever), 0.0
    nis = _nis(model)
    refusal = Refusal('pose does not fit the expected one', f'NIS {nis:.1f} over {limit:.1f}')
    loose = prior
    if nis > limit and turn_sigma:
        turned = -float(model.innovation[HEADING])
        which = [BORESIGHT] if prior.stands else [HEADING, BORESIGHT]
        loose = widened(prior, which, min(turned**2, turn_sigma**2))
        model = _pose_model(loose, measured, columns, lever)
        nis = _nis(model)
    if nis > limit:
        stray = FusionUpdate(
            prior.stamp_ns, refusal=refusal, contradicts=True, log_likelihood=_LOG_STRAY
        )
        return Outcome(prior, stray)
    update = FusionUpdate(
        prior.stamp_ns,
        innovation_rad=model.innovation,
        nis=nis,
        degrees=3,
        turned_rad=turned,
        log_likelihood=log_density(nis, model.covariance),
    )
    return Outcome(correct(loose, model), update)


def _pose_model(
    prior: FilterState, measured: PoseEstimate, columns: IndexArray, lever: FloatArray
) -> MeasurementModel:
    """
    Return the model of a triangulated pose of the base, linearised at a prior.

    Least squares turn the bearings of landmarks `columns` (m,) into a pose, so errors of these
    landmarks and of the boresight move it: poses, like bearings, never make the estimate more
    certain than the map allows. Directions that the landmarks do not determine (there are fewer
    than three, or none is known) only have the covariance that comes with the pose.
    """
    nothing = np.zeros(len(columns))
    seen = bearing_model(prior, prior, columns, nothing, nothing, nothing, 0.0, lever)
    fix = np.linalg.pinv(seen.jacobian[:, :3])
    jacobian = fix @ seen.jacobian
    jacobian[:, :3] = np.eye(3)
    beside = jacobian - fix @ seen.jacobian
    state_covariance = prior.covariance @ beside.T + seen.state_covariance @ fix.T
    innovation = measured.pose - jacobian[:, BORESIGHT] * prior.mean[BORESIGHT] - prior.mean[:3]
    innovation[2] = wrap_rad(innovation[2])
    return MeasurementModel(
        innovation,
        jacobian,
        state_covariance,
        prior.cross.T @ beside.T + seen.considered_covariance @ fix.T,
        beside @ state_covariance
        + fix @ (seen.covariance @ fix.T + seen.state_covariance.T @ beside.T)
        + measured.covariance,
        np.zeros((LEARNED, 3, 3)),
        columns,
    )


def _nis(model: MeasurementModel) -> float:
    return float(model.innovation @ np.linalg.solve(model.covariance, model.innovation))
