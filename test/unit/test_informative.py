from itertools import combinations

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from scenes import rectangle_room, textured_room, true_landmark

from landmark_nav.geometry.patches import observed_well, relative_sampling
from landmark_nav.localization.observer import most_informative
from landmark_nav.localization.triangulation.model import bearing_gradients
from landmark_nav.types import LandmarkMap, PoseEstimate

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


def information(index):
    """Log determinant of the information on the pose after bearings to some landmarks."""
    gradient = bearing_gradients(AXIS.pose, LANDMARKS.positions[index, :2])
    own = LANDMARKS.covariances[index, :2, :2]
    variance = SIGMA**2 + np.einsum('ni,nij,nj->n', gradient, own, gradient)
    rows = np.column_stack([gradient, -np.ones(len(index))])
    total = np.linalg.inv(AXIS.covariance) + (rows.T / variance) @ rows
    return float(np.linalg.slogdet(total)[1])


def test_three_are_nearly_as_good_as_the_best_three():
    chosen = most_informative(AXIS, LANDMARKS, EVERY, SIGMA, 3)
    assert len(set(chosen)) == 3
    nothing = float(np.linalg.slogdet(np.linalg.inv(AXIS.covariance))[1])
    gains = [information(np.array(three)) - nothing for three in combinations(EVERY, 3)]
    assert information(chosen) - nothing > 0.95 * max(gains)


POINT = np.array([[2.0, 0.0, 1.2]])
NORMAL = np.array([[0.0, 1.0, 0.0]])


@given(st.floats(0.0, 2.0 * np.pi), st.floats(0.1, 9.0), st.floats(-1.2, 1.2))
def test_area_is_the_annulus_between_two_tangent_circles(direction, distance, incidence):
    reference = POINT + 3.0 * np.array([[np.sin(incidence), np.cos(incidence), 0.0]])
    viewer = POINT[0] + distance * np.array([np.cos(direction), np.sin(direction), 0.0])

    def inside_tangent_circle(diameter):
        return bool(np.hypot(viewer[0] - 2.0, viewer[1] - diameter / 2.0) <= diameter / 2.0)

    expected = (
        1.5 <= distance <= 6.0
        and inside_tangent_circle(6.0 / np.cos(incidence))
        and not inside_tangent_circle(1.5 / np.cos(incidence))
    )
    # On the very border rounding decides.
    horizontal, vertical = relative_sampling(POINT, NORMAL, reference, viewer)
    values = np.array([horizontal[0], vertical[0]])
    if np.all(np.abs(values - [[0.5], [2.0]]) > 1e-6):
        assert observed_well(POINT, NORMAL, reference, viewer)[0] == expected
