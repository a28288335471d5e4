from __future__ import annotations

from itertools import combinations

import numpy as np
from scenes import rectangle_room, textured_room, true_landmark

from landmark_nav.localization.observer import most_informative
from landmark_nav.localization.triangulation.model import bearing_gradients
from landmark_nav.types import FloatArray, LandmarkMap, PoseEstimate

ROOM = rectangle_room(6.0, 5.0)
SCENE = textured_room(ROOM, seed=3)
VIEWPOINT = np.array([3.0, 2.5, 1.1])
LANDMARKS = LandmarkMap(
    tuple(
        true_landmark(SCENE, 4 * k + j, board, place, 0.0, VIEWPOINT, sigma_m=0.002)
        for k, board in enumerate(SCENE.boards)
        for j, place in enumerate((-1.8, -0.5, 0.6, 1.7))
    )
)
AXIS = PoseEstimate(0, np.array([2.2, 2.0, 0.4]), np.diag([0.05, 0.05, 0.02]) ** 2)
EVERY = np.arange(len(LANDMARKS.landmarks))
SIGMA = 4e-4


def information(index: FloatArray) -> float:
    """Log determinant of the information on the pose after bearings to some landmarks."""
    gradient = bearing_gradients(AXIS.pose, LANDMARKS.positions[index, :2])
    own = LANDMARKS.covariances[index, :2, :2]
    variance = SIGMA**2 + np.einsum('ni,nij,nj->n', gradient, own, gradient)
    rows = np.column_stack([gradient, -np.ones(len(index))])
    total = np.linalg.inv(AXIS.covariance) + (rows.T / variance) @ rows
    return float(np.linalg.slogdet(total)[1])


def test_three_are_nearly_as_good_as_the_best_three() -> None:
    chosen = most_informative(AXIS, LANDMARKS, EVERY, SIGMA, 3)
    assert len(set(chosen)) == 3
    nothing = float(np.linalg.slogdet(np.linalg.inv(AXIS.covariance))[1])
    gains = [information(np.array(three)) - nothing for three in combinations(EVERY, 3)]
    assert information(chosen) - nothing > 0.95 * max(gains)
