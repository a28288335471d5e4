"""Bearings and maps whose errors have heavy tails: most are better than they claim, some worse."""

from __future__ import annotations

from dataclasses import replace

from fusion_drives import detections, drive, error_of, landmark_map, MOUNT, start_estimate
import numpy as np
import pytest

from landmark_nav.localization.fusion import FusionConfig, PoseFilter, update
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.types import FloatArray, LandmarkMap

NOISE = OdometryNoiseConfig()
SIGMA_RAD, COUNT, SEEN = 1e-3, 14, 6


def drawn(rng: np.random.Generator, degrees: float, *shape: int) -> FloatArray:
    """Student's errors of so many degrees of freedom, with a standard deviation of one."""
    return rng.standard_t(degrees, shape) * np.sqrt((degrees - 2.0) / degrees)


def squared_error(seed: int, degrees: float, landmarks: str, own_m: float) -> float:
    """Mean squared position error of a drive, m^2."""
    rng = np.random.default_rng(seed)
    exact = landmark_map(COUNT, 1e-5, own_m)
    off = own_m * drawn(rng, degrees, COUNT, 2)
    given = LandmarkMap(
        tuple(
            replace(k, position=k.position + np.append(away, 0.0))
            for k, away in zip(exact.landmarks, off, strict=True)
        )
    )
    # Errors that do not repeat.
    config = FusionConfig(landmarks=landmarks, correlated_noise_fraction=0.0)
    fused, squares = PoseFilter(given, MOUNT, config, NOISE), []
    fused.initialize(start_estimate())
    for k, moment in enumerate(drive(160, rng, NOISE)):
        fused.add_odometry(moment.odometry)
        if k % 4 == 0:
            noise = SIGMA_RAD * drawn(rng, degrees, SEEN)
            places, stamp_ns = rng.choice(COUNT, SEEN, replace=False), moment.odometry.stamp_ns
            fused.add_detections(
                detections(exact, moment.pose, stamp_ns, places, SIGMA_RAD, noise)
            )
            squares.append(np.sum(error_of(fused.estimate(), moment.pose)[:2] ** 2))
    return float(np.mean(squares[10:]))


@pytest.mark.parametrize(('landmarks', 'own_m'), [('consider', 0.005), ('refine', 0.001)])
@pytest.mark.parametrize(('degrees', 'most'), [(3.0, 0.97), (1000.0, 1.06)])
def test_heavy_tails_cost_less_and_light_ones_hardly_more(
    degrees: float, most: float, landmarks: str, own_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    robust = np.mean([squared_error(seed, degrees, landmarks, own_m) for seed in range(20)])
    monkeypatch.setattr(update, '_WORTH_WHILE', np.inf)
    gaussian = np.mean([squared_error(seed, degrees, landmarks, own_m) for seed in range(20)])
    assert robust < most * gaussian


def test_a_bearing_that_is_off_counts_less_and_the_others_as_before() -> None:
    weighted, inverse = np.array([3.5, 0.2, -0.9]), np.eye(3)
    factors = update._tails(weighted, inverse)
    np.testing.assert_allclose(factors, [(4.0 + 3.5**2) / 5.0, 1.0, 1.0])
