from builders import bare_landmark, nees, panorama_of, pose_error
from drawn_drives import driven, MOUNT, NS, sensed, simulated
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.evaluation.learning_report import learning_report
from landmark_nav.evaluation.metrics import (
    consistency,
    crlb_ratio,
    nees_interval_95,
    PoseTrack,
    posterior_bound,
    undetected_failures,
)
from landmark_nav.geometry import se2
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.learning.pipeline import LearningResult
from landmark_nav.learning.stages import StageLog
from landmark_nav.localization.estimator.config import EstimatorConfig
from landmark_nav.localization.estimator.factors import ImagePoints
from landmark_nav.localization.estimator.filter import JointFilter
from landmark_nav.localization.estimator.smoothing import ErrorRepetition, smoothed_poses
from landmark_nav.localization.localizer import LocalizationConfig
from landmark_nav.localization.odometry.noise import Motion, OdometryNoiseConfig
from landmark_nav.localization.odometry.track import OdometryTrack
from landmark_nav.types import LandmarkMap, OdometrySample, PoseEstimate

SECOND = 1_000_000_000

# Tracks


@given(
    start=st.tuples(*[st.floats(-5, 5)] * 3),
    forward=st.floats(-2, 2),
    turn=st.floats(-3, 3),
    share=st.floats(0, 1),
)
def test_interpolation_follows_the_arc_of_a_constant_twist(start, forward, turn, share):
    def along(part):
        angle = part * turn
        if abs(turn) < 1e-9:
            return [part * forward, 0.0, angle]
        radius = forward / turn
        return [radius * np.sin(angle), radius * (1 - np.cos(angle)), angle]

    ends = [se2.compose(start, along(0.0)), se2.compose(start, along(1.0))]
    track = PoseTrack(np.array([10, 10 + 2**40]), np.array(ends))
    stamp = 10 + int(share * 2**40)
    error = se2.relative(se2.compose(start, along(share)), track.at([stamp])[0])
    np.testing.assert_allclose(error, 0.0, atol=1e-7)


# Figures of errors


def test_undetected_failures_are_counted():
    errors = np.zeros((6, 3))
    errors[1, 0], errors[2, 2], errors[3, 1], errors[4, :2] = 0.06, -0.06, 0.04, np.nan
    covariances = np.broadcast_to(np.eye(3) * 0.01**2, (6, 3, 3))
    assert undetected_failures(errors, covariances, np.ones(6, bool)) == 2
    assert undetected_failures(errors, covariances, np.zeros(6, bool)) == 0


def test_errors_of_the_claimed_size_are_consistent():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3)) * 0.1
    errors = rng.normal(size=(20000, 3)) @ root.T
    covariances = np.broadcast_to(root @ root.T, (20000, 3, 3))
    mean, inside = consistency(errors, covariances)
    low, high = nees_interval_95(len(errors))
    assert low < mean < high < low + 0.2
    assert mean == pytest.approx(3.0, abs=0.08)
    assert inside == pytest.approx(0.95, abs=0.005)
    assert crlb_ratio(errors, covariances) == pytest.approx(1.0, abs=0.02)
    assert consistency(2 * errors, covariances).mean == pytest.approx(12.0, abs=0.4)
    nothing = np.full((3, 3), np.nan)
    assert consistency(nothing, covariances[:3]) is None
    assert crlb_ratio(nothing, covariances[:3]) is None


@pytest.mark.parametrize('prior', [None, Calibration.of_mount(MOUNT)])
def test_nees_of_nineteen_of_twenty_drives_is_in_its_interval(prior):
    """Errors of map, mount and odometry last for a while, or all the time."""
    inside = []
    for seed in range(30):
        drive = simulated(seed, prior, seconds=8.0)
        repetition, before = ErrorRepetition(len(drive.poses)), None

        def add(joint, moved, repetition=repetition):
            nonlocal before
            repetition.add(before or moved, moved, joint)
            joint.mark()
            before = joint.state

        run = driven(drive, after=add)
        low, high = nees_interval_95(repetition.independent)
        inside.append(low < consistency(run.errors, run.covariances).mean < high)
    assert np.mean(inside) >= 0.85


# The bound

NOISE = (
    *('along_m_per_sqrt_m', 'across_m_per_sqrt_m', 'turn_rad_per_sqrt_m', 'slip_m_per_rad'),
    *('turn_rad_per_sqrt_rad', 'floor_m_per_sqrt_s', 'floor_rad_per_sqrt_s'),
)
PLACES = np.array([[3.0, 0.0], [0.0, 4.0], [-2.0, -1.0], [2.0, 2.0]])


def landmarks(covariance, loading):
    whole = covariance + loading @ loading.T
    return LandmarkMap(
        tuple(
            bare_landmark(10 * k, [x, y, 1.0], whole, shared_loading=loading)
            for k, (x, y) in enumerate(PLACES)
        )
    )


def image(stamp, variance, mount, pose):
    count = len(PLACES)
    bearings = se2.bearings(mount.axis_pose_map(pose), PLACES)
    return ImagePoints.of_bearings(
        stamp, np.arange(count), bearings, np.full(count, variance), mount
    )


def bound_of_standing_robot(covariance, loading, lever=0.0, times=6):
    config = LocalizationConfig(
        estimator=EstimatorConfig(correlation_length_m=1e9, floor_tilt_sigma_rad=0.0),
        odometry=OdometryNoiseConfig(**dict.fromkeys(NOISE, 0.0), estimate_odometry_bias=False),
    )
    pose = np.array([0.3, -0.2, 0.5])
    truth = PoseTrack.of([(k * SECOND // 10, pose) for k in range(times * 10)])
    prior = np.diag([0.1**2, 0.2**2, 0.1**2])
    mount = PanTiltMount(axis_xyz=(lever, 0.0, 1.0), pan_sigma_rad=0.0)
    images = [image(k * SECOND, 1e-6, mount, pose) for k in range(times)]
    exact = Calibration.of_mount(mount, dict.fromkeys(NAMES, 0.0))
    start, world = PoseEstimate(0, pose + 0.1, prior), landmarks(covariance, loading)
    return pose, prior, posterior_bound(truth, images, world, exact, config, start).covariances


@pytest.mark.parametrize('lever', [0.0, 0.25])
def test_bound_of_a_standing_robot_is_the_inverse_of_its_information(lever):
    pose, prior, bound = bound_of_standing_robot(1e-14 * np.eye(3), np.zeros((3, 1)), lever)
    offset = se2.rotation(pose[2]) @ [lever, 0.0]
    delta = PLACES - pose[:2] - offset
    square = np.sum(delta**2, axis=1)
    by_position = np.stack([delta[:, 1], -delta[:, 0]], -1) / square[:, None]
    by_heading = by_position @ np.array([-offset[1], offset[0]]) - 1.0
    jacobian = np.column_stack([by_position, by_heading])
    for k, found in enumerate(bound):
        information = np.linalg.inv(prior) + (k + 1) * jacobian.T @ jacobian / 1e-6
        np.testing.assert_allclose(found, np.linalg.inv(information), rtol=1e-3, atol=1e-10)


def test_bound_knows_what_landmarks_share_and_is_unknown_without_truth():
    shift = np.zeros((3, 2))
    shift[0, 0] = shift[1, 1] = 0.01
    _, _, bound = bound_of_standing_robot(1e-12 * np.eye(3), shift, times=12)
    np.testing.assert_allclose(np.diag(bound[-1])[:2], 1e-4, rtol=0.02)
    start, mount = PoseEstimate(0, np.zeros(3), np.eye(3)), PanTiltMount()
    world, known = landmarks(1e-6 * np.eye(3), np.zeros((3, 1))), Calibration.of_mount(mount)
    seen = image(SECOND, 1e-6, mount, np.zeros(3))
    for truth in (PoseTrack.of([]), PoseTrack.of([(9 * SECOND, np.zeros(3))])):
        bound = posterior_bound(truth, [seen], world, known, LocalizationConfig(), start)
        assert np.isnan(bound.covariances).all()
        assert np.isnan(bound.independent)


def line(drive, lost_at=-1):
    """Errors (n, 3) of the smoothed poses, and their squares (n,) over the covariance."""
    odometry = OdometryNoiseConfig()
    track, images = OdometryTrack(odometry), []
    for what in sensed(drive):
        (track.add if isinstance(what, OdometrySample) else images.append)(what)
    joint = JointFilter(drive.landmark_map, drive.prior, drive.start, odometry=odometry)
    smoothed = smoothed_poses(joint, track, images, np.arange(len(images)) == lost_at)
    off = pose_error(np.array([each.pose for each in smoothed]), drive.poses)
    return off, nees(off, np.array([each.covariance for each in smoothed]))


def test_what_comes_later_shows_what_was_before():
    drives = [simulated(seed, seconds=12.0) for seed in range(4)]
    smoothed, squares = map(np.concatenate, zip(*map(line, drives), strict=True))
    filtered = np.concatenate([driven(drive).errors for drive in drives])

    def rms(errors):
        return float(np.sqrt(np.mean(np.sum(errors[:, :2] ** 2, axis=1))))

    assert rms(smoothed) < 0.9 * rms(filtered)
    assert 1.0 < squares.mean() < 5.0


@pytest.mark.parametrize('seed', range(3))
def test_what_was_moved_is_known_from_the_beginning_when_smoothed(seed):
    off, squares = line(simulated(seed, seconds=24.0, cupboard_moved_m=0.15))
    assert (squares < 31.8).all()
    assert np.abs(off[:, :2]).max() < 0.05


def test_the_mount_found_at_the_end_corrects_the_beginning():
    prior = Calibration.of_mount(simulated(0, seconds=1.0).prior.mount)
    drive = simulated(7, prior, prior.with_values(center_x=0.03, axis_pitch=0.014), seconds=16.0)
    smoothed, squares = line(drive)
    assert np.hypot(*smoothed[:20, :2].T).max() < 0.03
    assert squares.mean() < 9.0


def test_a_robot_that_was_carried_off_is_found():
    drive = simulated(3, seconds=16.0)
    images = [k for k, event in enumerate(drive.events) if isinstance(event, ImagePoints)]
    # It is taken from one place to another, with the wheels at rest.
    for k in range(len(drive.events)):
        if images[30] <= k < images[45]:
            event = drive.events[k]
            drive.events[k] = (
                Motion(np.zeros(3), event.seconds)
                if isinstance(event, Motion)
                else event.chosen(np.zeros(len(event), dtype=np.bool_))
            )
    smoothed, squares = line(drive, lost_at=45)
    for part in (slice(0, 30), slice(50, None)):
        assert (squares[part] < 31.8).all()
        assert np.median(np.hypot(*smoothed[part, :2].T)) < 0.02


@pytest.mark.parametrize('lengths', [0.8, 1.0, 1.15])
def test_sweeps_are_consistent_whatever_the_scale_of_the_map(lengths):
    rng, sigma = np.random.default_rng(3), 1e-3
    true = np.array([[0.0, 0.0, 0.0], [2.0, 0.4, 0.7], [3.0, -1.0, -2.0], [1.0, 2.0, 1.0]])
    poses = true * [lengths, lengths, 1.0]
    poses[1:] += rng.normal(0.0, sigma, (3, 3))
    image, cylinder = np.zeros((8, 16), np.uint8), Cylinder(16, 8, 2.5, 7.5, 4.0)
    panoramas = tuple(
        panorama_of(
            image, cylinder, stamp_ns=k * NS, center_map=np.array([x, y, 1.0]), heading_rad=yaw,
            covariance=sigma**2 * np.eye(4),
        )
        for k, (x, y, yaw) in enumerate(poses)
    )  # fmt: skip
    learned = LandmarkMap((), provenance={'frame': 'first sweep'})
    result = LearningResult(learned, panoramas, ((),) * 4, ((),) * 4, 0)
    truth = PoseTrack.of((k * NS, pose) for k, pose in enumerate(true))
    known = Calibration.exact(PanTiltMount())
    report = learning_report(result, panoramas, [1] * 4, truth, known, StageLog(), 1.0)
    assert report['scale'] == pytest.approx(lengths, abs=1e-3)
    sweeps = report['sweeps'][1:]
    assert np.mean([sweep['nees'] for sweep in sweeps]) < 9.3
    off = [abs(lengths - 1.0) * np.hypot(*pose[:2]) for pose in true[1:]]
    np.testing.assert_allclose([s['error_position_m'] for s in sweeps], off, atol=5.0 * sigma)
