"""A pose that is known to decimetres, and bearings of landmarks that lie close together."""

from __future__ import annotations

from bare_landmarks import bare_landmark
from fusion_drives import detections, drive, MOUNT, nees_of, START
import numpy as np
import pytest

from landmark_nav.localization.fusion import PoseFilter
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.types import FloatArray, LandmarkMap, PoseEstimate

NOISE = OdometryNoiseConfig()
SIGMA, MAP_SIGMA = 3.5e-4, 1e-3
RUNS = 16
# The start, one, two and seven seconds after it.
WATCHED = (0, 5, 10, 35)


def three_close_together(rng: np.random.Generator) -> FloatArray:
    """Places (3, 2) on a width of 0.4 m at 4 m."""
    ahead, slant = START[2] + rng.uniform(-0.8, 0.8, 2).cumsum()
    inward = np.array([np.cos(slant), np.sin(slant)])
    along = np.array([-inward[1], inward[0]]) * np.array([[-0.2], [0.0], [0.2]])
    before = rng.uniform(-0.03, 0.03, (3, 1)) * inward
    return np.asarray(START[:2] + 4.0 * np.array([np.cos(ahead), np.sin(ahead)]) + along + before)


def as_map(places: FloatArray) -> LandmarkMap:
    covariance = MAP_SIGMA**2 * np.eye(3)
    return LandmarkMap(
        tuple(bare_landmark(k, np.array([*p, 1.2]), covariance) for k, p in enumerate(places))
    )


def squares(seed: int, start_sigma: FloatArray) -> list[float]:
    """NEES at the times that are watched."""
    rng = np.random.default_rng(seed)
    places = three_close_together(rng)
    true_map = as_map(places)
    fused = PoseFilter(as_map(places + rng.normal(0.0, MAP_SIGMA, places.shape)), MOUNT)
    start = START + rng.normal(0.0, start_sigma)
    fused.initialize(PoseEstimate(0, start, np.diag(start_sigma**2)))
    found = []
    for k, moment in enumerate(drive(4 * WATCHED[-1], rng, NOISE)):
        fused.add_odometry(moment.odometry)
        if k % 4 == 0:
            noise, stamp_ns = rng.normal(0.0, SIGMA, 3), moment.odometry.stamp_ns
            fused.add_detections(
                detections(true_map, moment.pose, stamp_ns, range(3), SIGMA, noise)
            )
            found.append(nees_of(fused.estimate(), moment.pose))
    return [found[k] for k in WATCHED]


@pytest.mark.parametrize('start_sigma', [(0.3, 0.3, 0.1), (0.6, 0.6, 0.15)])
def test_what_a_few_bearings_leave_open_stays_open(start_sigma: tuple[float, ...]) -> None:
    nees = np.array([squares(seed, np.array(start_sigma)) for seed in range(RUNS)])
    assert (nees.mean(axis=0) < 4.0).all()
    assert nees.max() < 40.0
