"""
A wide prior made narrow by the image itself.

A wide prior leaves open at which scale and slant landmarks appear. So all that may be in view are
searched at all scales and slants that the prior allows. Several detections that agree on a pose
give a narrow prior, with which landmarks are looked for as usual.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.se2 import squared_distance
from landmark_nav.localization.looking import LookingConfig
from landmark_nav.localization.relocalization.candidate_detections import find_candidate_detections
from landmark_nav.localization.relocalization.hypotheses import propose
from landmark_nav.localization.relocalization.search import (
    best_place,
    CANDIDATES,
    verified_places,
)
from landmark_nav.localization.relocalization.verification import CarriedFrames, Verification
from landmark_nav.types import CameraFrame, FloatArray, LandmarkMap, PoseEstimate, Refusal

__all__ = ['localize_within_prior']

# A pose is excluded if the prior leaves it less than this probability.
_EXCLUDED = 0.001
# Least sigmas of a prior, which may be singular, and those of a proposed pose, m and rad.
_LEAST_SIGMA, _PROPOSED_SIGMA = (1e-3, 1e-3, 1e-3), (0.1, 0.1, 0.035)


def localize_within_prior(
    frame: CameraFrame,
    prior: PoseEstimate,
    landmark_map: LandmarkMap,
    mount: PanTiltMount,
    looking: LookingConfig,
    tilt_sigma_rad: float = 0.0,
) -> Verification | Refusal:
    """
    Find the pose within a wide prior that fits an image.

    Parameters
    ----------
    tilt_sigma_rad : float
        How far tilt and roll of the camera may be off; a small roll is found without.

    Returns
    -------
    Verification or Refusal
        Pose of the base by this image alone, or why there is none.

    """
    prior = replace(prior, covariance=prior.covariance + np.diag(np.square(_LEAST_SIGMA)))
    detections = find_candidate_detections(frame, landmark_map, mount, prior, tilt_sigma_rad)
    poses = propose(detections, landmark_map).poses
    rough = np.diag(np.square(_PROPOSED_SIGMA))
    likely = poses[[_allows(prior, pose, rough) for pose in poses]]
    still = CarriedFrames(frame.stamp_ns, [frame], np.zeros((1, 3)), np.zeros((1, 3)))
    some = likely[:CANDIDATES]
    places = [
        place
        for place in verified_places(some, still, landmark_map, mount, looking, tilt_sigma_rad)
        if _allows(prior, place.estimate.pose, place.estimate.covariance)
    ]
    return best_place(places, len(likely))


def _allows(prior: PoseEstimate, pose: FloatArray, covariance: FloatArray) -> bool:
    """Whether a prior allows a pose (3,) with this covariance."""
    distance = squared_distance(pose, prior.pose, prior.covariance + covariance)
    return distance < float(chdtri(3, _EXCLUDED))
