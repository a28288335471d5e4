"""Bearings whose errors have heavy tails: most are better than they claim, some far worse."""

from __future__ import annotations

from fusion_drives import detections, drive, error_of, landmark_map, MOUNT, start_estimate
import numpy as np
import pytest

from landmark_nav.localization.fusion import FusionConfig, PoseFilter, update
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig

EXACT = landmark_map(14, 1e-5, 1e-5)
NOISE = OdometryNoiseConfig()
SIGMA, SEEN = 1e-3, 6
# Errors that do not repeat, and are as large as they are said to be.
CONFIG = FusionConfig(repeated_share=0.0)


def squared_error(seed: int, degrees: float) -> float:
    """Mean squared position error of a drive, m^2; errors are Student's, of so many degrees."""
    rng = np.random.default_rng(seed)
    fused, squares = PoseFilter(EXACT, MOUNT, CONFIG, NOISE), []
    fused.initialize(start_estimate())
    for k, moment in enumerate(drive(160, rng, NOISE)):
        fused.add_odometry(moment.odometry)
        if k % 4 == 0:
            noise = SIGMA * rng.standard_t(degrees, SEEN) * np.sqrt((degrees - 2.0) / degrees)
            places = rng.choice(14, SEEN, replace=False)
            stamp_ns = moment.odometry.stamp_ns
            fused.add_detections(detections(EXACT, moment.pose, stamp_ns, places, SIGMA, noise))
            squares.append(np.sum(error_of(fused.estimate(), moment.pose)[:2] ** 2))
    return float(np.mean(squares[10:]))


@pytest.mark.parametrize(('degrees', 'gain'), [(3.0, 0.95), (1000.0, 1.03)])
def test_heavy_tails_cost_less_and_light_ones_nothing(
    degrees: float, gain: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    robust = np.mean([squared_error(seed, degrees) for seed in range(20)])
    monkeypatch.setattr(update, '_TAIL_DEGREES', 1e9)
    gaussian = np.mean([squared_error(seed, degrees) for seed in range(20)])
    assert robust < gain * gaussian


def test_a_bearing_that_is_off_counts_less_and_the_others_as_before() -> None:
    weighted, inverse = np.array([3.5, 0.2, -0.9]), np.eye(3)
    factors = update._tails(weighted, inverse)
    np.testing.assert_allclose(factors, [(4.0 + 3.5**2) / 5.0, 1.0, 1.0])
