"""A camera whose principal point is off: bearings bend with the angle from its axis."""

from __future__ import annotations

from dataclasses import replace

from fusion_drives import (
    as_surveyed,
    bearings,
    detections,
    drive,
    error_of,
    landmark_map,
    MOUNT,
    start_estimate,
    START_SIGMA,
)
import numpy as np
import pytest
from scipy.stats import chi2

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.fusion import FusionConfig, PoseFilter
from landmark_nav.localization.fusion.lens import straightened
from landmark_nav.localization.fusion.state import LENS
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.types import FloatArray

NOISE = OdometryNoiseConfig()
SIGMA = 1e-3
LENS_SIGMA = 0.05
HALF_FIELD = np.radians(40.0)
CONFIG = FusionConfig(
    principal_point_sigma=LENS_SIGMA, boresight_sigma_rad=0.01, bearing_probability=0.99999
)


def run(seed: int, lens: float, config: FusionConfig) -> tuple[PoseFilter, FloatArray]:
    """
    Drive with images of a camera that turns slowly; the filter and its error.

    Pixels are tan(angle) + lens instead of tan(angle); the middle of the image is off by a draw.
    """
    rng = np.random.default_rng(seed)
    true_map = landmark_map(24, seed=seed)
    fused = PoseFilter(as_surveyed(true_map, rng), MOUNT, config, NOISE)
    fused.initialize(start_estimate(offset=rng.normal(0.0, START_SIGMA)))
    boresight = rng.normal(0.0, 0.01) - np.arctan(lens)
    for k, moment in enumerate(drive(300, rng, NOISE)):
        fused.add_odometry(moment.odometry)
        if k % 3:
            continue
        pan = np.sin(0.02 * k)
        off_axis = wrap_rad(bearings(true_map, moment.pose) - pan)
        places = np.flatnonzero(np.abs(off_axis) < HALF_FIELD)
        bent = np.arctan(np.tan(off_axis[places]) + lens) - off_axis[places]
        noise = bent + boresight + rng.normal(0.0, SIGMA, len(places))
        seen = detections(true_map, moment.pose, moment.odometry.stamp_ns, places, SIGMA, noise)
        fused.add_detections(replace(seen, pan_rad=float(pan)))
    return fused, error_of(fused.estimate(), moment.pose)


@pytest.mark.parametrize('lens', [-0.06, 0.06])
def test_it_is_found(lens: float) -> None:
    fused, _ = run(1, lens, CONFIG)
    state = fused.state
    assert state is not None
    sigma = np.sqrt(state.covariance[LENS, LENS])
    assert sigma < 0.1 * LENS_SIGMA
    assert abs(state.mean[LENS] - lens) < 4.0 * sigma


def test_the_pose_is_as_sure_as_it_claims_and_better_than_blind() -> None:
    nees, squares = [], []
    for seed in range(20):
        lens = float(np.random.default_rng([seed, 5]).normal(0.0, LENS_SIGMA))
        fused, error = run(seed, lens, CONFIG)
        _, blind = run(seed, lens, replace(CONFIG, principal_point_sigma=0.0))
        final = fused.estimate()
        assert final is not None
        nees.append(float(error @ np.linalg.solve(final.covariance, error)))
        squares.append([error[:2] @ error[:2], blind[:2] @ blind[:2]])
    low, high = chi2.ppf([0.025, 0.975], 3 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high
    with_it, without = np.sqrt(np.mean(squares, axis=0))
    assert with_it < 0.6 * without


def test_pixels_are_shifted_back() -> None:
    angle, pan, lens, step = np.linspace(-3.0, 3.0, 40), 0.3, 0.07, 1e-6
    measured = np.arctan2(np.sin(angle) + lens * np.cos(angle), np.cos(angle)) - np.arctan(lens)
    found, by_lens = straightened(measured + pan, pan, lens)
    np.testing.assert_allclose(wrap_rad(found - angle - pan), 0.0, atol=1e-12)
    ahead = straightened(measured + pan, pan, lens + step)[0]
    behind = straightened(measured + pan, pan, lens - step)[0]
    np.testing.assert_allclose(by_lens, wrap_rad(ahead - behind) / (2.0 * step), atol=1e-8)


def test_a_calibrated_camera_is_taken_as_such() -> None:
    fused, _ = run(2, 0.0, replace(CONFIG, principal_point_sigma=0.0))
    assert fused.state is not None
    assert fused.state.mean[LENS] == fused.state.covariance[LENS, LENS] == 0.0
