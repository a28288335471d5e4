"""A base that drives slower while it turns: the way it loses is found."""

from __future__ import annotations

from dataclasses import replace

from fusion_drives import (
    as_surveyed,
    detections,
    drive,
    error_of,
    landmark_map,
    MOUNT,
    PERIOD_NS,
    start_estimate,
    START_SIGMA,
)
import numpy as np
import pytest
from scipy.stats import chi2

from landmark_nav.geometry.se2 import compose, relative
from landmark_nav.localization.fusion import PoseFilter
from landmark_nav.localization.fusion.state import TURN_LOSS
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.types import FloatArray

LOSS_SIGMA = 0.1
NOISE = OdometryNoiseConfig(turn_loss_sigma_m_per_rad=LOSS_SIGMA, learning_sigma=0.0)
SIGMA = 1e-3


def run(seed: int, loss: float, noise: OdometryNoiseConfig) -> tuple[PoseFilter, FloatArray]:
    """Drive with landmarks in view, then 5 s without: the filter and its error."""
    rng = np.random.default_rng(seed)
    true_map = landmark_map(12, seed=seed)
    fused = PoseFilter(as_surveyed(true_map, rng), MOUNT, odometry=noise)
    fused.initialize(start_estimate(offset=rng.normal(0.0, START_SIGMA)))
    reported = before = np.zeros(3)
    for k, moment in enumerate(drive(400, rng, NOISE)):
        # Given of as much more way as it loses.
        step = relative(before, moment.odometry.pose_odom_base)
        reported = compose(reported, step + np.array([loss * abs(step[2]), 0.0, 0.0]))
        before = moment.odometry.pose_odom_base
        fused.add_odometry(replace(moment.odometry, pose_odom_base=reported))
        if k % 4 == 0 and k < 300:
            places = (int(rng.integers(12)) + np.arange(4)) % 12
            noise_rad = rng.normal(0.0, SIGMA, 4)
            seen = detections(true_map, moment.pose, k * PERIOD_NS, places, SIGMA, noise_rad)
            fused.add_detections(seen)
    return fused, error_of(fused.estimate(), moment.pose)


def test_it_is_found_and_coasting_is_better_and_consistent() -> None:
    nees, squares, off = [], [], []
    for seed in range(12):
        loss = float(np.random.default_rng([seed, 7]).normal(0.0, LOSS_SIGMA))
        fused, error = run(seed, loss, NOISE)
        _, blind = run(seed, loss, replace(NOISE, turn_loss_sigma_m_per_rad=0.0))
        state = fused.state
        assert state is not None
        off.append(
            (state.mean[TURN_LOSS] - loss) / np.sqrt(state.covariance[TURN_LOSS, TURN_LOSS])
        )
        assert state.covariance[TURN_LOSS, TURN_LOSS] < (0.5 * LOSS_SIGMA) ** 2
        nees.append(float(error @ np.linalg.solve(state.covariance[:3, :3], error)))
        squares.append([error[:2] @ error[:2], blind[:2] @ blind[:2]])
    low, high = chi2.ppf([0.005, 0.995], 3 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high
    assert np.max(np.abs(off)) < 4.0
    with_it, without = np.sqrt(np.mean(squares, axis=0))
    assert with_it < 0.8 * without


def test_without_leave_none_is_lost() -> None:
    fused, _ = run(1, 0.05, replace(NOISE, turn_loss_sigma_m_per_rad=0.0))
    assert fused.state is not None
    assert fused.state.mean[TURN_LOSS] == fused.state.covariance[TURN_LOSS, TURN_LOSS] == 0.0


@pytest.mark.parametrize('loss', [-0.1, 0.1])
def test_either_sign_is_found(loss: float) -> None:
    fused, _ = run(3, loss, NOISE)
    assert fused.state is not None
    assert fused.state.mean[TURN_LOSS] == pytest.approx(loss, abs=0.05)
