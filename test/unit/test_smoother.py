from __future__ import annotations

from dataclasses import replace

from bare_landmarks import bare_landmark
import numpy as np
import pytest
from scipy.stats import chi2

from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.metrics import pose_errors
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.fusion import FusionConfig
from landmark_nav.localization.odometry.noise import (
    Motion,
    motion_variances,
    OdometryNoiseConfig,
    twist_motion,
)
from landmark_nav.localization.smoother import smooth
from landmark_nav.localization.smoother.motion import motions_between
from landmark_nav.localization.smoother.problem import Bearings, Problem
from landmark_nav.types import (
    Detections,
    FloatArray,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
)

BEGIN_NS = 7_000_000_000_000
STEP_NS = 50_000_000
MOUNT = PanTiltMount(axis_xyz=(0.1, 0.02, 1.0), pan_sigma_rad=2e-3)
NOISE = OdometryNoiseConfig(slip_sigma=0.0, floor_m_per_sqrt_s=0.002, floor_rad_per_sqrt_s=0.002)
FUSION = FusionConfig(boresight_sigma_rad=0.02, correlated_noise_fraction=0.6)
SIGMA = 2e-3
START = np.diag([0.05, 0.05, 0.03]) ** 2
MAP_SIGMA = 0.01
PLACES = np.array([[0.0, 0.0], [5.0, -0.2], [6.0, 3.0], [4.0, 5.0], [1.0, 5.2], [-1.0, 2.5]])


def surveyed(places: FloatArray) -> LandmarkMap:
    return LandmarkMap(
        tuple(
            bare_landmark(10 + k, np.array([*place, 0.0]), MAP_SIGMA**2 * np.eye(3))
            for k, place in enumerate(places)
        )
    )


class Drive:
    """A circle of 20 s, odometry at 20 Hz, bearings at 2 Hz; the noise is the smoother's own."""

    def __init__(self, seed: int, noise: float = 1.0) -> None:
        rng = np.random.default_rng(seed)
        step = twist_motion(0.4, 0.35, STEP_NS * 1e-9)
        deviation = np.sqrt(motion_variances(Motion(step, STEP_NS * 1e-9), NOISE))
        bias = noise * rng.normal(size=3) * NOISE.bias_sigmas
        truth, reckoned = [np.array([3.0, 1.0, 0.1])], [np.zeros(3)]
        for _ in range(400):
            real = step + noise * deviation * rng.normal(size=3)
            truth.append(se2.compose(truth[-1], real))
            scaled = step - [bias[0] * step[0], bias[0] * step[1], bias[1] * step[0]]
            scaled[2] -= bias[2] * step[2]
            reckoned.append(se2.compose(reckoned[-1], scaled))
        self.boresight = noise * FUSION.boresight_sigma_rad * rng.normal()
        self.map = surveyed(PLACES)
        self.real = PLACES + noise * MAP_SIGMA * rng.normal(size=PLACES.shape)
        self.odometry = [
            OdometrySample(BEGIN_NS + k * STEP_NS, pose) for k, pose in enumerate(reckoned)
        ]
        self.truth = np.array(truth[10::10])
        self.start = PoseEstimate(
            BEGIN_NS, truth[0] + noise * np.sqrt(np.diag(START)) * rng.normal(size=3), START
        )
        self._repeated = rng.normal(size=6)
        self.detections = [
            self._seen(10 * (k + 1), pose, rng, noise) for k, pose in enumerate(self.truth)
        ]
        origin = se2.compose(self.start.pose, se2.inverse(reckoned[0]))
        self.initial = se2.compose(origin, np.array(reckoned[10::10]))

    def _seen(
        self, k: int, pose: FloatArray, rng: np.random.Generator, noise: float
    ) -> Detections:
        axis = MOUNT.axis_pose_map(pose)
        bearing = se2.bearings(axis, self.real) + self.boresight
        kept, share = np.exp(-0.2 / FUSION.repeat_length_m), FUSION.correlated_noise_fraction
        self._repeated = kept * self._repeated + np.sqrt(1.0 - kept**2) * rng.normal(size=6)
        alone = np.sqrt(share) * self._repeated + np.sqrt(1.0 - share) * rng.normal(size=6)
        bearing += noise * (rng.normal() * MOUNT.pan_sigma_rad + SIGMA * alone)
        view = rng.permutation(6)[:3]
        return Detections(
            BEGIN_NS + k * STEP_NS,
            10 + view,
            wrap_rad(bearing[view]),
            np.full(3, SIGMA**2),
            np.ones(3),
            np.zeros((3, 2)),
        )

    def smoothed(self, **changes):
        given = {'detections': self.detections, 'fusion': FUSION, **changes}
        return smooth(
            self.start,
            self.odometry,
            given['detections'],
            self.initial,
            self.map,
            MOUNT,
            given['fusion'],
            NOISE,
            given.get('unknown_motion'),
            tolerance=1e-7,
        )

    def carry_off(self, place: int, moved: FloatArray) -> None:
        """Let the wheels know nothing of a motion before a detection."""
        first = 10 * (place + 1)
        here = self.odometry[first - 1].pose_odom_base
        away = se2.compose(se2.compose(here, se2.inverse(moved)), se2.inverse(here))
        self.odometry[first:] = [
            replace(k, pose_odom_base=se2.compose(away, k.pose_odom_base))
            for k in self.odometry[first:]
        ]


def test_without_noise_the_truth_comes_back() -> None:
    drive = Drive(0, noise=0.0)
    found = drive.smoothed()
    assert np.abs(pose_errors(found.poses, drive.truth)).max() < 1e-5
    np.testing.assert_allclose(found.landmarks, PLACES, atol=1e-5)
    np.testing.assert_array_equal(found.stamps_ns, [seen.stamp_ns for seen in drive.detections])


def test_a_robot_that_was_carried_off_is_found_where_its_motion_is_not_known() -> None:
    drive, place = Drive(0, noise=0.0), 17
    drive.carry_off(place, np.array([0.1, -0.05, 0.25]))
    unknown = np.arange(len(drive.truth)) == place
    found = drive.smoothed(unknown_motion=unknown)
    assert np.abs(pose_errors(found.poses, drive.truth)).max() < 1e-3
    trusting = drive.smoothed()
    assert np.abs(pose_errors(trusting.poses, drive.truth)).max() > 0.01


def test_errors_are_as_large_as_claimed() -> None:
    squares = []
    for seed in range(1, 25):
        drive = Drive(seed)
        found = drive.smoothed()
        errors = pose_errors(found.poses, drive.truth)[[0, 20, 39]]
        covariances = found.covariances[[0, 20, 39]]
        squares.append(np.einsum('ni,nij,nj->n', errors, np.linalg.inv(covariances), errors))
    mean = np.mean(squares, axis=0)
    low, high = chi2.ppf([0.0005, 0.9995], 3 * len(squares)) / len(squares)
    assert np.all((low < mean) & (mean < high)), mean


def test_a_camera_that_looks_aside_is_noticed() -> None:
    drive = Drive(0, noise=0.0)
    aside = [replace(seen, bearing_rad=seen.bearing_rad + 0.03) for seen in drive.detections]
    found = drive.smoothed(detections=aside)
    assert found.boresight_rad == pytest.approx(0.03, abs=1e-3)
    assert np.degrees(np.abs(pose_errors(found.poses, drive.truth)[:, 2]).max()) < 0.1


def test_a_principal_point_that_is_off_is_noticed() -> None:
    drive, lens = Drive(0, noise=0.0), 0.03
    bent = []
    for k, seen in enumerate(drive.detections):
        pan = float(np.sin(k))
        x, y = np.cos(seen.bearing_rad - pan), np.sin(seen.bearing_rad - pan)
        bearing = wrap_rad(np.arctan2(y + lens * x, x) - np.arctan(lens) + pan)
        bent.append(replace(seen, bearing_rad=bearing, pan_rad=pan))
    found = drive.smoothed(detections=bent, fusion=replace(FUSION, principal_point_sigma=0.05))
    assert found.lens == pytest.approx(lens, abs=1e-3)
    assert np.hypot(*pose_errors(found.poses, drive.truth)[:, :2].T).max() < 0.005


def test_mistaken_landmarks_are_outvoted() -> None:
    drive = Drive(30)
    rng = np.random.default_rng(5)
    plain = drive.smoothed()
    mixed = [
        replace(seen, bearing_rad=seen.bearing_rad + np.array([0.5, 0.0, 0.0]))
        if rng.random() < 0.2
        else seen
        for seen in drive.detections
    ]
    found = drive.smoothed(detections=mixed)
    apart = pose_errors(found.poses, plain.poses)
    assert np.hypot(apart[:, 0], apart[:, 1]).max() < 0.02


def test_all_of_a_drive_gives_more_than_its_past() -> None:
    drive = Drive(31)
    cut = drive.smoothed(
        detections=[replace(s) for s in drive.detections[:20]]
        + [s.chosen(np.zeros(3, np.bool_)) for s in drive.detections[20:]]
    )
    whole = drive.smoothed()
    trace = np.trace(whole.covariances[:, :2, :2], axis1=1, axis2=2)
    trace_cut = np.trace(cut.covariances[:, :2, :2], axis1=1, axis2=2)
    assert np.all(trace <= trace_cut * (1 + 1e-6))
    assert trace[-1] < 0.2 * trace_cut[-1]


def test_derivatives_agree_with_differences() -> None:
    drive = Drive(2)
    stamps = np.array([BEGIN_NS, *(seen.stamp_ns for seen in drive.detections[:4])])
    problem = Problem(
        drive.start,
        motions_between(stamps, drive.odometry, NOISE),
        Bearings.of(drive.detections[:4], drive.map),
        drive.map,
        np.array(MOUNT.axis_xyz[:2]),
        np.array([*NOISE.bias_sigmas, 0.1, 0.02, 0.05]),
        2e-3,
        0.35,
        0.5,
        1e9,  # weights that do not change
    )
    unknowns = problem.at(np.vstack([drive.start.pose, drive.initial[:4]]))
    unknowns = unknowns + 0.01 * np.random.default_rng(0).normal(size=len(unknowns))
    jacobian, _ = problem.linearized(unknowns)
    numeric = np.empty(jacobian.shape)
    for k in range(len(unknowns)):
        step = np.zeros(len(unknowns))
        step[k] = 1e-6
        after, before = (
            problem.linearized(unknowns + step)[1],
            problem.linearized(unknowns - step)[1],
        )
        numeric[:, k] = (after - before) / 2e-6
    np.testing.assert_allclose(jacobian.toarray(), numeric, atol=2e-4, rtol=1e-5)


def test_motions_compound_as_one() -> None:
    """Halves compounded by hand agree with the whole."""
    drive = Drive(3)
    stamps = np.array([BEGIN_NS, BEGIN_NS + 100 * STEP_NS, BEGIN_NS + 200 * STEP_NS])
    halves = motions_between(stamps, drive.odometry, NOISE)
    whole = motions_between(stamps[[0, 2]], drive.odometry, NOISE)
    first, second = halves.increment
    np.testing.assert_allclose(se2.compose(first, second), whole.increment[0], atol=1e-9)
    by_first, by_second = se2.compose_jacobians(first, second)
    covariance = by_first @ halves.covariance[0] @ by_first.T
    covariance += by_second @ halves.covariance[1] @ by_second.T
    np.testing.assert_allclose(covariance, whole.covariance[0], rtol=1e-2, atol=1e-7)
    by_bias = by_first @ halves.by_bias[0] + by_second @ halves.by_bias[1]
    np.testing.assert_allclose(by_bias, whole.by_bias[0], atol=1e-6)


def test_bad_input() -> None:
    drive = Drive(4)
    with pytest.raises(LandmarkNavError, match='in the order of time'):
        drive.smoothed(detections=drive.detections[::-1])
    with pytest.raises(LandmarkNavError, match='needs detections'):
        smooth(drive.start, drive.odometry, [], drive.initial[:0], drive.map, MOUNT)
