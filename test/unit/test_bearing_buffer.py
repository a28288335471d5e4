from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from triplet_room import random_map

from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.localization.triangulation import TriangulationConfig
from landmark_nav.localization.triangulation.bearing_buffer import BearingBuffer
from landmark_nav.localization.triangulation.model import axis_from_base
from landmark_nav.types import (
    Detections,
    FloatArray,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Refusal,
)

MOUNT = PanTiltMount(axis_xyz=(0.12, 0.05, 1.1))
LANDMARKS = random_map(12, seed=2)
STEP_NS = 50_000_000
# A motion of 50 ms: 0.4 m/s and 0.5 rad/s.
STEP = np.array([0.02, 0.0, 0.025])
START = np.array([2.4, 1.6, 0.4])
# Landmarks sighted in each of three images, 0.5 s from each other, each by itself.
VIEWS = {0: [0], 10: [3, 5], 20: [8]}


def way(steps: int) -> FloatArray:
    poses = [START]
    for _ in range(steps):
        poses.append(np.asarray(se2.compose(poses[-1], STEP)))
    return np.array(poses)


def sighted(pose: FloatArray, places: list[int], landmarks: FloatArray) -> FloatArray:
    axis = MOUNT.axis_pose_map(pose)
    return se2.bearings(axis, landmarks[places])


def camera_image(
    stamp_ns: int, places: list[int], bearing: FloatArray, sigma_rad: float
) -> Detections:
    n, ids = len(bearing), LANDMARKS.ids[places]
    variance = np.full(n, sigma_rad**2)
    return Detections(stamp_ns, ids, bearing, variance, np.ones(n), np.zeros((n, 2)))


def buffered(
    landmark_map: LandmarkMap,
    noise: OdometryNoiseConfig,
    sigma_rad: float,
    rng: np.random.Generator | None,
    prior_error: FloatArray,
) -> tuple[PoseEstimate, FloatArray]:
    """Drive, sight, and return the fix and the true pose; noise as given, from `rng`."""
    buffer = BearingBuffer(landmark_map, MOUNT, 5.0, noise, TriangulationConfig())
    poses = way(20)
    landmarks = landmark_map.positions[:, :2].copy()
    spread = np.diag(np.square([noise.along_m_per_sqrt_m, noise.across_m_per_sqrt_m, 0.0]))
    turn = noise.turn_rad_per_sqrt_m**2 * 0.02 + noise.turn_rad_per_sqrt_rad**2 * 0.025
    spread = 0.02 * spread + np.diag([0.0, 0.0, turn])
    if rng is not None:
        joint = landmark_map.joint_covariance_xy
        landmarks += rng.multivariate_normal(np.zeros(len(joint)), joint).reshape(-1, 2)
    odometry = np.zeros(3)
    for k, pose in enumerate(poses):
        if k:
            error = rng.multivariate_normal(np.zeros(3), spread) if rng is not None else 0.0
            odometry = np.asarray(se2.compose(odometry, STEP + error))
        buffer.add_odometry(OdometrySample(k * STEP_NS, odometry))
        if k in VIEWS:
            bearing = sighted(pose, VIEWS[k], landmarks)
            if rng is not None:
                bearing = bearing + sigma_rad * rng.normal(size=len(bearing))
            buffer.add(camera_image(k * STEP_NS, VIEWS[k], bearing, sigma_rad))
    prior = PoseEstimate(20 * STEP_NS, poses[-1] + prior_error, np.diag([0.2, 0.2, 0.15]) ** 2)
    fix = buffer.fix(prior)
    assert isinstance(fix, PoseEstimate), str(fix)
    # What was used is used up.
    assert not isinstance(buffer.fix(prior), PoseEstimate)
    return fix, poses[-1]


def test_exact_bearings_give_the_pose_whatever_the_heading_was_taken_for() -> None:
    for error in ([0.0, 0.0, 0.0], [0.1, -0.1, 0.1]):
        fix, true = buffered(LANDMARKS, OdometryNoiseConfig(), 1e-4, None, np.array(error))
        np.testing.assert_allclose(fix.pose, true, atol=2e-5)


def test_bearings_of_one_image_share_the_error_of_its_pan() -> None:
    ids, pose = [0, 3, 5, 8], PoseEstimate(0, START, np.diag([0.1, 0.1, 0.05]) ** 2)
    fixes = []
    for pan_sigma in (0.0, 2e-3):
        mount = replace(MOUNT, pan_sigma_rad=pan_sigma)
        buffer = BearingBuffer(LANDMARKS, mount, 0.0, OdometryNoiseConfig(), TriangulationConfig())
        bearing = sighted(START, ids, LANDMARKS.positions[:, :2])
        buffer.add(camera_image(0, ids, bearing, 1e-4))
        fix = buffer.fix(pose)
        assert isinstance(fix, PoseEstimate)
        fixes.append(axis_from_base(fix, MOUNT))
    more = fixes[1].covariance - fixes[0].covariance
    # It turns the heading and nothing else.
    assert more[2, 2] == pytest.approx(4e-6, rel=1e-3)
    assert np.abs(more[:2]).max() < 1e-9


def test_without_a_window_images_do_not_mix() -> None:
    buffer = BearingBuffer(LANDMARKS, MOUNT, 0.0, OdometryNoiseConfig(), TriangulationConfig())
    for k, ids in enumerate(([0, 3], [5, 8])):
        buffer.add(camera_image(k * STEP_NS, ids, np.zeros(2), 1e-4))
    fix = buffer.fix(PoseEstimate(STEP_NS, START, np.eye(3)))
    assert isinstance(fix, Refusal)
    assert fix.reason == 'fewer than three bearings'


def test_claims_what_odometry_bearings_and_map_allow() -> None:
    """Mean normalised error squared of 200 runs with noise in all three; 3 is ideal."""
    noise = OdometryNoiseConfig(
        along_m_per_sqrt_m=0.02,
        across_m_per_sqrt_m=0.01,
        turn_rad_per_sqrt_m=0.01,
        turn_rad_per_sqrt_rad=0.02,
        floor_m_per_sqrt_s=0.0,
        floor_rad_per_sqrt_s=0.0,
    )
    rng = np.random.default_rng(5)
    nees = []
    for _ in range(200):
        fix, true = buffered(LANDMARKS, noise, 1e-3, rng, np.zeros(3))
        error = fix.pose - true
        error[2] = wrap_rad(error[2])
        nees.append(error @ np.linalg.solve(fix.covariance, error))
    # 600 degrees of freedom: 95 % within 3 +- 0.34.
    assert np.mean(nees) == pytest.approx(3.0, abs=0.34)


def test_odometry_counts() -> None:
    poor = OdometryNoiseConfig(along_m_per_sqrt_m=0.05, turn_rad_per_sqrt_m=0.05)
    good, _ = buffered(LANDMARKS, OdometryNoiseConfig(), 1e-4, None, np.zeros(3))
    less, _ = buffered(LANDMARKS, poor, 1e-4, None, np.zeros(3))
    assert np.trace(less.covariance) > 1.2 * np.trace(good.covariance)


def test_what_is_open_of_the_pan_is_open_of_the_heading_alone() -> None:
    """All bearings of an image are off by the angle that its interpolated pan is."""
    off = 0.02
    exact = sighted(START, [0, 3, 5, 8], LANDMARKS.positions[:, :2])
    prior = PoseEstimate(0, START, np.diag([0.2, 0.2, 0.15]) ** 2)
    fixes = []
    for pan_sigma in (0.0, off):
        buffer = BearingBuffer(LANDMARKS, MOUNT, 0.0, OdometryNoiseConfig(), TriangulationConfig())
        found = camera_image(0, [0, 3, 5, 8], exact + off, 1e-3)
        buffer.add(replace(found, pan_sigma_rad=pan_sigma))
        fixes.append(buffer.fix(prior))
    sure, open_pan = fixes
    assert isinstance(sure, PoseEstimate)
    assert isinstance(open_pan, PoseEstimate)
    assert open_pan.pose[2] == pytest.approx(START[2] - off, abs=1e-3)
    added = np.diag(open_pan.covariance) - np.diag(sure.covariance)
    assert added[2] == pytest.approx(off**2, rel=1e-3)
    # The base turns about the pan axis, which does not move.
    lever = np.hypot(*MOUNT.axis_xyz[:2])
    assert added[:2].sum() == pytest.approx((lever * off) ** 2, rel=1e-2)


def test_measurements_of_a_clock_that_was_set_back_since_are_forgotten() -> None:
    buffer = BearingBuffer(LANDMARKS, MOUNT, 5.0, OdometryNoiseConfig(), TriangulationConfig())
    for stamp_ns, places in ((100 * STEP_NS, [0, 3, 5]), (50 * STEP_NS, [8])):
        bearing = sighted(START, places, LANDMARKS.positions[:, :2])
        buffer.add(camera_image(stamp_ns, places, bearing, 1e-4))
    fix = buffer.fix(PoseEstimate(50 * STEP_NS, START, np.diag([0.1, 0.1, 0.05]) ** 2))
    assert isinstance(fix, Refusal)
    assert fix.detail == '1 given'
