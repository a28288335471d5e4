"""White noise of the poses of odometry, distinguished from other noise."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from landmark_nav.geometry.se2 import compose, relative
from landmark_nav.localization.odometry.track import Jitter
from landmark_nav.types import FloatArray


def seen(poses: FloatArray, seconds: float = 0.05) -> tuple[float, float]:
    """What a jitter learns of a path (n, 3)."""
    jitter = Jitter()
    for before, after in pairwise(poses):
        jitter.add(relative(before, after), seconds)
    return jitter.variances


def path(noise: FloatArray) -> FloatArray:
    """Poses of a robot that speeds up and slows down, with noise (n, 3) in its increments."""
    time = 0.05 * np.arange(len(noise))
    steps = np.stack([0.02 * np.sin(time) ** 2, 0.0 * time, 0.05 * np.cos(0.7 * time)], -1)
    poses = [np.zeros(3)]
    for step in steps + noise:
        poses.append(compose(poses[-1], step))
    return np.array(poses)


PATH = path(np.zeros((600, 3)))


@pytest.mark.parametrize(('position_m', 'heading_rad'), [(0.003, 0.05), (0.05, 0.01)])
def test_noise_of_poses_is_found(position_m: float, heading_rad: float) -> None:
    rng = np.random.default_rng(1)
    noise = [position_m, position_m, heading_rad]
    found = np.array([seen(quiet + rng.normal(0.0, noise, quiet.shape)) for quiet in [PATH] * 30])
    np.testing.assert_allclose(found.mean(axis=0), np.square([position_m, heading_rad]), rtol=0.15)


@pytest.mark.parametrize('sigma', [0.0, 0.001, 0.01, 0.05])
def test_noise_of_increments_is_none(sigma: float) -> None:
    rng = np.random.default_rng(2)
    found = np.array([seen(path(rng.normal(0.0, sigma, (600, 3)))) for _ in range(30)])
    assert (found.mean(axis=0) <= 0.02 * sigma**2).all()


def test_a_gap_joins_nothing() -> None:
    jitter = Jitter()
    for _ in range(100):
        jitter.interrupt()
        for step in ([0.1, 0.0, 0.0], [0.0, 0.1, 0.1], [-0.1, 0.0, -0.1]):
            jitter.add(np.array(step), 0.05)
    assert jitter.variances == (0.0, 0.0)


def test_uneven_stamps_are_no_noise() -> None:
    rng = np.random.default_rng(5)
    times = np.cumsum(rng.uniform(0.01, 0.09, 600))
    jitter = Jitter()
    for seconds in np.diff(times):
        jitter.add(np.array([0.4 * seconds, 0.0, 0.3 * seconds]), float(seconds))
    assert jitter.variances == pytest.approx((0.0, 0.0), abs=1e-12)
