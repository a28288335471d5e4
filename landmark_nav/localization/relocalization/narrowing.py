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

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.looking import LookingConfig
from landmark_nav.localization.relocalization.hypotheses import propose
from landmark_nav.localization.relocalization.search import best_place, verified_places
from landmark_nav.localization.relocalization.sightings import find_sightings
from landmark_nav.localization.relocalization.verification import CarriedFrames
from landmark_nav.types import CameraFrame, LandmarkMap, PoseEstimate, Refusal

__all__ = ['narrowed']

# What the prior excludes: one in a thousand lies there.
_EXCLUDED = 0.001
# No pose is better known than this, whatever a prior says of one of its directions, m and rad.
_LEAST_SIGMA = (1e-3, 1e-3, 1e-3)


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
    covariance = prior.covariance + np.diag(np.square(_LEAST_SIGMA))
    prior = replace(prior, covariance=covariance)
    sightings = find_sightings(frame, landmark_map, mount, prior)
    poses = propose(sightings, landmark_map).poses
    offset = poses - prior.pose
    offset[:, 2] = wrap_rad(offset[:, 2])
    distance = np.sum(offset * np.linalg.solve(covariance, offset.T).T, axis=1)
    allowed = poses[distance < chdtri(3, _EXCLUDED)]
    still = CarriedFrames(frame.stamp_ns, [frame], np.zeros((1, 3)), np.zeros((1, 3)))
    places = verified_places(allowed, still, landmark_map, mount, looking)
    best = best_place(places, len(allowed))
    return best if isinstance(best, Refusal) else best.estimate
