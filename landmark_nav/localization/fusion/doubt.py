"""How a pose is doubted that is not believed: its covariance grows until pictures fit again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from landmark_nav.geometry.se2 import squared_distance
from landmark_nav.localization.fusion.state import FilterState, POSE, widened
from landmark_nav.types import PoseEstimate

__all__ = ['doubted_estimate', 'doubted_state', 'is_elsewhere']

# Variances (3,) that each picture adds which contradicts a pose that is not believed, and the
# position sigma at which that ends.
_DOUBT = np.square([0.15, 0.15, 0.05])
_DOUBT_LIMIT_M = 2.0
# Variances (3,) that poses of one place may differ by anyway; beyond five sigmas is another one.
_SAME_PLACE, _ELSEWHERE = np.square([0.1, 0.1, 0.04]), 25.0


def doubted_state(state: FilterState) -> FilterState:
    """Widen a state that measurements keep contradicting, until they can fit again."""
    wide = np.trace(state.covariance[:2, :2]) >= _DOUBT_LIMIT_M**2
    return state if wide else widened(state, POSE, _DOUBT)


def doubted_estimate(found: PoseEstimate, doubts: int) -> PoseEstimate:
    """
    Widen a pose by so many doubts.

    The place is doubted, not the motion: this goes when landmarks are found here again.
    """
    if not doubts:
        return found
    doubt = doubts * _DOUBT
    doubt *= min(1.0, _DOUBT_LIMIT_M**2 / (doubt[0] + 1e-300))
    return replace(found, covariance=found.covariance + np.diag(doubt))


def is_elsewhere(here: PoseEstimate, there: PoseEstimate) -> bool:
    """Whether two poses cannot be the same place."""
    covariance = here.covariance + there.covariance + np.diag(_SAME_PLACE)
    return squared_distance(here.pose, there.pose, covariance) > _ELSEWHERE
