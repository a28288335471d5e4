"""False matches never run the adjustment off, and covariances stay positive."""

from __future__ import annotations

from dataclasses import replace

from hung_rooms import (
    CONFIG,
    given_poses,
    measurements_of,
    POSES,
    solve,
    total_covariance,
    world_of,
)
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.learning.adjustment import AdjustmentConfig
from landmark_nav.learning.least_squares import (
    checked_covariance,
    covariance_of,
    levenberg_marquardt,
    root_of,
    solve_positive,
)
from landmark_nav.types import FloatArray

MORE = np.array([[3.0, 1.2, 1.1, 0.3], [1.2, 3.9, 1.1, 1.0]])
WITHOUT_WALLS = AdjustmentConfig(
    relief_sigma_m=1.0, camera_weight=1e9, place_weight=1e9, room_weight=1e9
)


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('config', [CONFIG, WITHOUT_WALLS], ids=['walls', 'without walls'])
@pytest.mark.parametrize('views', [2, 3, 4])
@pytest.mark.parametrize('off_rad', [0.01, 1.0])
def test_a_false_match_stays_its_own_affair(
    off_rad: float, views: int, config: AdjustmentConfig
) -> None:
    for seed in range(6):
        rng = np.random.default_rng(seed)
        world = replace(world_of(rng, 14), poses=np.vstack([POSES, MORE])[:views])
        measurements = measurements_of(world, rng)
        wrong = measurements[0][-1]
        turn, rise = (off_rad * rng.standard_normal(2)).tolist()
        measurements[0][-1] = replace(
            wrong, azimuth_rad=wrong.azimuth_rad + turn, tangent=wrong.tangent + rise
        )
        found = solve(world, measurements, given_poses(world, rng), config)
        assert np.abs(found.positions).max() < 100.0
        assert np.abs(found.poses[:, :2] - world.poses[:, :2]).max() < 0.05
        assert np.linalg.eigvalsh(total_covariance(found)).min() > 0.0
        sigma = np.sqrt(np.einsum('nii->ni', total_covariance(found)))
        assert (np.abs(found.positions - world.points) / sigma)[1:].max() < 6.0


def test_a_covariance_is_positive_whatever_the_information() -> None:
    rng = np.random.default_rng(3)
    half = rng.standard_normal((6, 3))
    for information in (np.zeros((6, 6)), half @ half.T, np.diag([1e300, 1e-300, 1, 1, 1, 0])):
        covariance = covariance_of(information)
        assert np.isfinite(root_of(covariance)).all()
        assert np.linalg.eigvalsh(covariance).min() >= 0.0
    whole = rng.standard_normal((5, 5))
    whole = whole @ whole.T + np.eye(5)
    np.testing.assert_allclose(covariance_of(whole) @ whole, np.eye(5), atol=1e-9)
    np.testing.assert_allclose(whole @ solve_positive(whole, np.ones(5)), 1.0, atol=1e-9)


@pytest.mark.parametrize('value', [np.nan, np.inf, -1.0, 1e100])
def test_a_covariance_that_is_none_is_refused(value: float) -> None:
    with pytest.raises(LandmarkNavError, match='sweep/pose'):
        checked_covariance(np.diag([value, 1e-4, 1e-4]), np.ones(3), 'sweep/pose')


def test_a_valley_is_followed_down_where_whole_steps_overshoot() -> None:
    def rosenbrock(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        residuals = np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])
        return residuals, np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]])

    def flat(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.arctan(x), np.diag(1.0 / (1.0 + x**2))

    state, cost, _ = levenberg_marquardt(rosenbrock, np.array([-1.2, 1.0]))
    assert cost < 1.0
    # Undamped, arctan runs off from here.
    state, cost, _ = levenberg_marquardt(flat, np.array([3.0]))
    assert abs(state[0]) < 0.1
