"""The posterior Cramer-Rao bound of a run: what no estimator can be better than."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from landmark_nav.evaluation.tracks import PoseTrack
from landmark_nav.geometry import se2
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.fusion import PoseFilter
from landmark_nav.localization.pipeline import LocalizationConfig
from landmark_nav.types import (
    Detections,
    FloatArray,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
)

__all__ = ['posterior_bound']


def posterior_bound(
    truth: PoseTrack,
    detections: Sequence[Detections],
    landmark_map: LandmarkMap,
    mount: PanTiltMount,
    config: LocalizationConfig,
    start: PoseEstimate,
) -> FloatArray:
    """
    Bound of the covariance of the pose at each image.

    For a nonlinear system with Gaussian noise the bound obeys the covariance recursion of the
    extended Kalman filter linearised along the true trajectory (Taylor, IEEE Trans. Automatic
    Control 24(2), 1979; Tichavsky, Muravchik and Nehorai, IEEE Trans. Signal Processing 46(5),
    1998). So a filter is given the truth without noise, with the noise models, the landmarks'
    joint covariance and the detections of the run; it refines the landmarks, as an optimal
    estimator would.

    Parameters
    ----------
    truth : PoseTrack
        Base in map.
    detections : sequence of Detections
        What was used of each image: landmarks and variances count, bearings do not.
    landmark_map : LandmarkMap
        Positions and joint covariance.
    mount : PanTiltMount
        Lever arm of the camera.
    config : LocalizationConfig
        Noise of the odometry and the pan.
    start : PoseEstimate
        Its covariance is what was known at the start.

    Returns
    -------
    ndarray, shape (n, 3, 3)
        NaN where the truth is not known, and everywhere where it moves as nothing does.

    """
    try:
        return _bound(truth, detections, landmark_map, mount, config, start)
    except np.linalg.LinAlgError:
        return np.full((len(detections), 3, 3), np.nan)


def _bound(
    truth: PoseTrack,
    detections: Sequence[Detections],
    landmark_map: LandmarkMap,
    mount: PanTiltMount,
    config: LocalizationConfig,
    start: PoseEstimate,
) -> FloatArray:
    given = replace(
        config.fusion,
        mode='bearings',
        landmarks='estimate',
        correlation_length_m=1e9,
        bearing_probability=1.0,
        nonlinearity_inflation=0.0,
    )
    # Bearings without noise are nothing to learn noise from.
    odometry = replace(config.odometry, learning_sigma=0.0)
    ideal = PoseFilter(landmark_map, mount, given, odometry, config.health)
    bound = np.full((len(detections), 3, 3), np.nan)
    begin = max(start.stamp_ns, int(truth.stamps_ns[0])) if len(truth) else 0
    poses = truth.at([begin, *(seen.stamp_ns for seen in detections)])
    if np.isnan(poses[0]).any():
        return bound
    ideal.initialize(PoseEstimate(begin, poses[0], start.covariance))
    moved = int(np.searchsorted(truth.stamps_ns, begin))
    for k, (seen, pose) in enumerate(zip(detections, poses[1:], strict=True)):
        if np.isnan(pose).any() or seen.stamp_ns < begin:
            continue
        while moved < len(truth) and truth.stamps_ns[moved] <= seen.stamp_ns:
            ideal.add_odometry(OdometrySample(int(truth.stamps_ns[moved]), truth.poses[moved]))
            moved += 1
        ideal.add_odometry(OdometrySample(seen.stamp_ns, pose))
        if len(seen):
            ideal.add_detections(_without_noise(seen, pose, landmark_map, mount))
        estimate = ideal.estimate(seen.stamp_ns)
        assert estimate is not None, 'it was initialized'
        bound[k] = estimate.covariance
    return bound


def _without_noise(
    seen: Detections, pose: FloatArray, landmark_map: LandmarkMap, mount: PanTiltMount
) -> Detections:
    """Give a detection the bearings that the true pose would have shown."""
    places = landmark_map.positions[landmark_map.indices(seen.ids), :2]
    return replace(seen, bearing_rad=se2.bearings(mount.axis_pose_map(pose), places))
