"""The posterior Cramer-Rao bound of a run: what no estimator can be better than."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from landmark_nav.calibration import Calibration
from landmark_nav.evaluation.tracks import PoseTrack
from landmark_nav.localization.estimator import ImagePoints, JointFilter
from landmark_nav.localization.estimator.factors import project
from landmark_nav.localization.estimator.timeline import move_to
from landmark_nav.localization.localizer import LocalizationConfig
from landmark_nav.localization.odometry.track import OdometryTrack
from landmark_nav.types import FloatArray, LandmarkMap, OdometrySample, PoseEstimate

__all__ = ['posterior_bound']


def posterior_bound(
    truth: PoseTrack,
    images: Sequence[ImagePoints],
    landmark_map: LandmarkMap,
    calibration: Calibration,
    config: LocalizationConfig,
    start: PoseEstimate,
) -> FloatArray:
    """
    Bound of the covariance of the pose at each image.

    For a nonlinear system with Gaussian noise the bound obeys the covariance recursion of the
    extended Kalman filter linearised along the true trajectory (Taylor, IEEE Trans. Automatic
    Control 24(2), 1979; Tichavsky, Muravchik and Nehorai, IEEE Trans. Signal Processing 46(5),
    1998). So the filter is given the truth without noise, with the noise models, the joint
    covariance of map and calibration, and the landmarks that the run used.

    Parameters
    ----------
    truth : PoseTrack
        Base in map.
    images : sequence of ImagePoints
        What was used of each image: landmarks and covariances count, points do not.
    landmark_map : LandmarkMap
        Positions and joint covariance.
    calibration : Calibration
        True values, with the covariance of what was known at the start.
    config : LocalizationConfig
        Noise of odometry, map and mount.
    start : PoseEstimate
        Its covariance is what was known at the start.

    Returns
    -------
    ndarray, shape (n, 3, 3)
        NaN where the truth is not known, and everywhere where it moves as nothing does.

    """
    try:
        return _bound(truth, images, landmark_map, calibration, config, start)
    except np.linalg.LinAlgError:
        return np.full((len(images), 3, 3), np.nan)


def _bound(
    truth: PoseTrack,
    images: Sequence[ImagePoints],
    landmark_map: LandmarkMap,
    calibration: Calibration,
    config: LocalizationConfig,
    start: PoseEstimate,
) -> FloatArray:
    bound = np.full((len(images), 3, 3), np.nan)
    begin = max(start.stamp_ns, int(truth.stamps_ns[0])) if len(truth) else 0
    poses = truth.at([begin, *(seen.stamp_ns for seen in images)])
    if np.isnan(poses[0]).any():
        return bound
    # Points without noise are nothing to learn noise from, and no surprise.
    noise = replace(config.estimator, tail_freedom=0.0, step_probability=0.0, learning_sigma=0.0)
    start = PoseEstimate(begin, poses[0], start.covariance)
    ideal = JointFilter(landmark_map, calibration, start, noise, config.odometry)
    track = OdometryTrack(config.odometry)
    moved = int(np.searchsorted(truth.stamps_ns, begin))
    for k, (seen, pose) in enumerate(zip(images, poses[1:], strict=True)):
        if np.isnan(pose).any() or seen.stamp_ns < begin:
            continue
        while moved < len(truth) and truth.stamps_ns[moved] <= seen.stamp_ns:
            track.add(OdometrySample(int(truth.stamps_ns[moved]), truth.poses[moved]))
            moved += 1
        track.add(OdometrySample(seen.stamp_ns, pose))
        move_to(seen.stamp_ns, ideal, track)
        points = project(ideal.snapshot.mean, landmark_map.positions[seen.columns], seen).points
        ideal.observe(replace(seen, points=points, near=None))
        bound[k] = ideal.estimate.covariance
    return bound
