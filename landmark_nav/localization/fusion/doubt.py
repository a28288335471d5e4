"""How the covariance of a lost pose grows, until images fit again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from landmark_nav.geometry.se2 import squared_distance
from landmark_nav.localization.fusion.state import FilterState, POSE, widened
from landmark_nav.types import PoseEstimate

__all__ = ['doubted_estimate', 'doubted_state', 'is_elsewhere']

# Variances (3,) that each image adds which contradicts a lost pose, and the position sigma at
# which that ends.
_TAIL_WIDTH = np.square([0.15, 0.15, 0.05])
_DOUBT_LIMIT_M = 2.0
# Poses are of different places if they are more than five sigmas apart, with these variances (3,)
# added to their own.
_SAME_PLACE, _ELSEWHERE = np.square([0.1, 0.1, 0.04]), 25.0


def doubted_state(state: FilterState) -> FilterState:
    """Widen a state that measurements contradict, up to a limit."""
    wide = np.trace(state.covariance[:2, :2]) >= _DOUBT_LIMIT_M**2
    return state if wide else widened(state, POSE, _TAIL_WIDTH)


def doubted_estimate(found: PoseEstimate, doubts: int) -> PoseEstimate:
    """
    Widen a pose by so many doubts.

    Only what is reported is widened, not the state: it ends when landmarks are found here again.
    """
    if not doubts:
        return found
    doubt = doubts * _TAIL_WIDTH
    doubt *= min(1.0, _DOUBT_LIMIT_M**2 / (doubt[0] + 1e-300))
    return replace(found, covariance=found.covariance + np.diag(doubt))


def is_elsewhere(here: PoseEstimate, there: PoseEstimate) -> bool:
    """Whether two poses cannot be the same place."""
    covariance = here.covariance + there.covariance + np.diag(_SAME_PLACE)
    return squared_distance(here.pose, there.pose, covariance) > _ELSEWHERE
