"""
A wide prior made narrow by the picture itself.

Where a prior leaves scale and slant open, no single appearance of a landmark fits. All that may
be in view are looked for as they may look from where the prior allows; a place that several agree
on tells which of their appearances are right, and from there they are looked for as always.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.se2 import squared_distance
from landmark_nav.localization.looking import LookingConfig
from landmark_nav.localization.relocalization.hypotheses import propose
from landmark_nav.localization.relocalization.search import best_place, verified_places
from landmark_nav.localization.relocalization.sightings import find_sightings
from landmark_nav.localization.relocalization.verification import CarriedFrames
from landmark_nav.types import CameraFrame, FloatArray, LandmarkMap, PoseEstimate, Refusal

__all__ = ['narrowed']

# What the prior excludes: one in a thousand lies there.
_EXCLUDED = 0.001
# No pose is better known than this, whatever a prior says of one of its directions; and how exact
# proposed ones are, m and rad.
_LEAST_SIGMA, _PROPOSED_SIGMA = (1e-3, 1e-3, 1e-3), (0.1, 0.1, 0.035)


def narrowed(
    frame: CameraFrame,
    prior: PoseEstimate,
    landmark_map: LandmarkMap,
    mount: PanTiltMount,
    looking: LookingConfig,
) -> PoseEstimate | Refusal:
    """
    Find the one place, of those that a prior allows, which a picture speaks for.

    Returns
    -------
    PoseEstimate or Refusal
        Of the base, out of the picture alone; why there is none, such as too few landmarks.

    """
    prior = replace(prior, covariance=prior.covariance + np.diag(np.square(_LEAST_SIGMA)))
    sightings = find_sightings(frame, landmark_map, mount, prior)
    poses = propose(sightings, landmark_map).poses
    rough = np.diag(np.square(_PROPOSED_SIGMA))
    likely = poses[[_allows(prior, pose, rough) for pose in poses]]
    still = CarriedFrames(frame.stamp_ns, [frame], np.zeros((1, 3)), np.zeros((1, 3)))
    places = [
        place
        for place in verified_places(likely, still, landmark_map, mount, looking)
        if _allows(prior, place.estimate.pose, place.estimate.covariance)
    ]
    best = best_place(places, len(likely))
    return best if isinstance(best, Refusal) else best.estimate


def _allows(prior: PoseEstimate, pose: FloatArray, covariance: FloatArray) -> bool:
    """Whether a pose (3,) of such a covariance may be the one that the prior is of."""
    distance = squared_distance(pose, prior.pose, prior.covariance + covariance)
    return distance < float(chdtri(3, _EXCLUDED))
