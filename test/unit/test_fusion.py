"""Fusion of odometry, images and global poses in the order in which a node receives them."""

from dataclasses import replace

from builders import pose_error
from drawn_drives import IMAGE_EVERY, MOUNT, NS, PERIOD_S, sensed, simulated
import numpy as np
import pytest
from wire import FACTORY, over_the_wire

from landmark_nav.calibration import Calibration, DEFAULT_SIGMAS, LENS, NAMES
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import PanTrack
from landmark_nav.localization.estimator.integrity import Status
from landmark_nav.localization.fusion import Fusion
from landmark_nav.localization.triplet.look_around import is_known
from landmark_nav.messages import decode, encode
from landmark_nav.types import (
    Detections,
    JointSample,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Refusal,
)

INTRINSICS = np.array([1.1, 1.1, 0.5, 0.5, 0.0])


def arriving(drive):
    """A drive as messages bring it: odometry, and what was found in images."""
    for what in sensed(drive):
        yield what if isinstance(what, OdometrySample) else seen(what)


def seen(image):
    stamp_ns = image.stamp_ns
    pan, right = image.pan_rad[0] if len(image) else 0.0, image.points[:, 0]
    found = Detections(
        stamp_ns, image.columns.astype(np.int64), MOUNT.azimuth_base_rad(pan) - np.arctan(right),
        np.full(len(image), 2e-4**2), np.ones(len(image)), np.zeros((len(image), 2)),
        points=image.points, point_covariance=image.covariance, below=image.below,
    )  # fmt: skip
    return found, JointSample(stamp_ns, float(pan), 0.0, image.pan_rate_rad_s)


def fused(drive, prior=None):
    fusion = Fusion(drive.landmark_map, prior or drive.prior)
    fusion.initialize(drive.start)
    return fusion


def take(fusion, *arrivals):
    """Hand over what arrives; what comes of the last."""
    done = None
    for what in arrivals:
        is_odometry = isinstance(what, OdometrySample)
        done = fusion.add_odometry(what) if is_odometry else fusion.add_detections(*what)
    return done


def error(fusion, drive):
    """Of the pose at the last image."""
    estimate = fusion.estimate(round(len(drive.poses) * IMAGE_EVERY * PERIOD_S * NS))
    return pose_error(estimate, drive.poses[-1])


def test_messages_lose_nothing():
    drive = simulated(3, seconds=6.0)
    direct, reported = fused(drive), fused(drive)
    for what in arriving(drive):
        if not isinstance(what, OdometrySample):
            what = replace(what[0], intrinsics=INTRINSICS), what[1]
        take(direct, what)
        if not isinstance(what, OdometrySample):
            found = decode.detections(over_the_wire(encode.detections(FACTORY, what[0])))
            what = found, what[1]
        take(reported, what)
    assert reported.estimate().pose == pytest.approx(direct.estimate().pose, abs=1e-12)
    assert np.abs(error(direct, drive)[:2]).max() < 0.02
    stamp = round(6.0 * NS)
    expected, sample = direct.expectation(stamp), OdometrySample(stamp, np.zeros(3), 0.3, -0.2)
    read, speeds = decode.expectation(
        over_the_wire(encode.expectation(FACTORY, expected, sample)), MOUNT
    )
    assert read.pose == pytest.approx(expected.pose)
    assert read.covariance == pytest.approx(expected.covariance)
    assert read.calibration.values == pytest.approx(expected.calibration.values)
    assert read.calibration.sigmas == pytest.approx(expected.calibration.sigmas)
    assert read.calibration.intrinsics == pytest.approx(INTRINSICS)
    assert read.tilt_sigma_rad == pytest.approx(expected.tilt_sigma_rad)
    assert (speeds.linear_m_s, speeds.angular_rad_s) == (0.3, -0.2)


def test_what_a_map_was_learned_with_is_the_prior():
    drive = simulated(4, seconds=2.0, prior=Calibration.of_mount(MOUNT))
    found = Calibration(drive.prior.values + 1e-3, 1e-4 * drive.prior.covariance)
    landmarks = replace(drive.landmark_map, prior=drive.prior, calibration=found)
    # Whether the start is known before the map or not.
    for started in (False, True):
        fusion = Fusion(LandmarkMap(()), drive.prior)
        if started:
            fusion.initialize(drive.start)
        fusion.change_map(landmarks)
        assert fusion.calibration.values == pytest.approx(found.values)
    assert fusion.estimate().pose == pytest.approx(drive.start.pose)
    other = Fusion(LandmarkMap(()), drive.prior.with_values(axis_x=0.5))
    other.change_map(landmarks)
    assert other.calibration['axis_x'][0] == 0.5


@pytest.mark.parametrize('moved_m', [0.002, 5.0])
def test_a_pose_is_lost_in_a_map_that_may_have_another_frame_until_images_show_it(moved_m):
    drive = simulated(4, seconds=12.0, prior=Calibration.of_mount(MOUNT))
    fusion, arrivals = fused(drive), list(arriving(drive))
    take(fusion, *arrivals[:150])
    learned = fusion.calibration
    moved = [
        replace(k, position=k.position + np.array([moved_m, 0.0, 0.0]))
        for k in drive.landmark_map.landmarks
    ]
    fusion.change_map(replace(drive.landmark_map, landmarks=tuple(moved)))
    assert fusion.status_at()[0] is Status.LOST
    assert not is_known(fusion.estimate())
    take(fusion, *arrivals[150:])
    assert (fusion.status_at()[0] is Status.LOST) is (moved_m > 1.0)
    place = fusion.estimate()
    right = PoseEstimate(
        place.stamp_ns, drive.poses[-1] + np.array([moved_m, 0.0, 0.0]), 1e-4 * np.eye(3)
    )
    fusion.place(right)
    assert fusion.status_at()[0] is not Status.LOST
    # What was learned of the robot by the other map is not forgotten.
    assert (fusion.calibration.sigmas < 1.1 * learned.sigmas + 1e-9).all()


@pytest.mark.parametrize('without', ['joints', 'points'])
def test_bearings_count_where_joints_or_points_are_missing(without):
    drive = simulated(5, seconds=12.0)
    fusion = fused(drive)
    for what in arriving(drive):
        if isinstance(what, OdometrySample):
            take(fusion, what)
        elif without == 'joints':
            assert not isinstance(fusion.add_detections(what[0]), Refusal)
        else:
            bare = replace(what[0], points=np.empty((0, 2)), point_covariance=np.empty((0, 2, 2)))
            assert not isinstance(fusion.add_detections(bare, what[1]), Refusal)
    assert np.abs(error(fusion, drive)[:2]).max() < 0.05
    assert fusion.status_at()[0] is Status.OK


def test_a_start_that_is_no_pose_is_refused_and_changes_nothing():
    drive = simulated(5, seconds=2.0)
    fusion = fused(drive)
    before = fusion.estimate()
    for wrong in (
        replace(drive.start, pose=np.array([np.nan, 0.0, 0.0])),
        replace(drive.start, covariance=-np.eye(3)),
    ):
        with pytest.raises(LandmarkNavError):
            fusion.initialize(wrong)
        with pytest.raises(LandmarkNavError):
            fusion.place(wrong)
    after = fusion.estimate()
    assert after.pose == pytest.approx(before.pose)


def test_the_protection_level_follows_from_the_covariance():
    drive = simulated(5, seconds=6.0)
    fusion = fused(drive)
    take(fusion, *arriving(drive))
    estimate = fusion.estimate()
    level = fusion.level(estimate)
    scaled = level.scaled(estimate).covariance
    assert np.sqrt(np.linalg.eigvalsh(scaled[:2, :2])[-1]) == pytest.approx(level.position_m)
    assert np.sqrt(scaled[2, 2]) == pytest.approx(level.heading_rad)
    assert np.linalg.eigvalsh(scaled).min() > 0.0


def test_silence_is_reported():
    drive = simulated(5, seconds=3.0)
    fusion = Fusion(drive.landmark_map, drive.prior)
    assert fusion.status_at()[0] is Status.LOST
    assert fusion.estimate() is None
    assert fusion.expectation(0) is None
    fusion.initialize(drive.start)
    assert 'no odometry' in fusion.status_at(2 * NS)[1]
    take(fusion, *arriving(drive))
    assert 'no odometry' not in fusion.status_at(round(3.5 * NS))[1]
    status, reason = fusion.status_at(5 * NS)
    assert status is not Status.OK
    assert 'no odometry for' in reason


def test_detections_that_stop_are_told_from_images_without_a_landmark():
    drive = simulated(5, seconds=6.0)
    blind, stopped = fused(drive), fused(drive)
    for what in arriving(drive):
        if isinstance(what, OdometrySample) or what[0].stamp_ns < 3 * NS:
            take(blind, what)
            take(stopped, what)
        else:
            take(blind, (what[0].chosen(np.zeros(len(what[0]), np.bool_)), what[1]))
    assert 'no detections' in stopped.status_at()[1]
    assert blind.status_at()[1]
    assert 'no detections' not in blind.status_at()[1]


@pytest.mark.parametrize(
    ('factor', 'scale_sigma', 'reported'),
    [(1.0, 0.0, False), (0.82, 0.02, True), (1.2, 0.0, True), (0.82, 0.1, False)],
)
def test_ways_by_odometry_that_contradict_the_map_are_reported(factor, scale_sigma, reported):
    """Unless the sigma of the map's scale explains it."""
    drive = simulated(3, seconds=8.0)
    provenance = {'scale_sigma': str(scale_sigma)}
    fusion = Fusion(replace(drive.landmark_map, provenance=provenance), drive.prior)
    fusion.initialize(drive.start)
    for what in arriving(drive):
        if isinstance(what, OdometrySample):
            pose, speed = what.pose_odom_base * [factor, factor, 1.0], factor * what.linear_m_s
            what = replace(what, pose_odom_base=pose, linear_m_s=speed)
        take(fusion, what)
    assert bool(fusion.map_contradictions) is reported


@pytest.mark.parametrize(('since', 'is_learned'), [(0, True), (40, True), (40, False)])
def test_a_camera_info_that_changes_restarts_the_estimate_of_the_lens(since, is_learned):
    """Since learning (image 0), and while driving, also after the pose was given anew."""
    before, after = np.array([1.1, 1.1, 0.5, 0.5, 0.0]), np.array([1.122, 1.122, 0.5, 0.5, 0.0])
    exact = Calibration.exact(MOUNT)
    lens = dict(zip(NAMES, np.where(np.isin(NAMES, LENS), DEFAULT_SIGMAS, 0.0), strict=True))
    robot = exact.widened(lens)
    drive = simulated(5, seconds=30.0, prior=exact)
    learned = replace(exact, intrinsics=before)
    landmarks = replace(
        drive.landmark_map, prior=robot, calibration=learned if is_learned else robot
    )
    fusion = Fusion(LandmarkMap(()), robot)
    fusion.change_map(landmarks)
    fusion.initialize(drive.start)
    images = 0
    for what in arriving(drive):
        if isinstance(what, OdometrySample):
            fusion.add_odometry(what)
            continue
        if images == since - 10:
            fusion.initialize(fusion.estimate())
        found, joints = what
        camera = after if images >= since else before
        points = found.points * before[0] / camera[0]
        fusion.add_detections(replace(found, points=points, intrinsics=camera), joints)
        images += 1
    focal, sigma = fusion.calibration['focal_scale']
    assert sigma < 1e-3
    assert abs(focal - (before[0] / after[0] - 1.0)) < 5.0 * sigma
    assert np.abs(error(fusion, drive)[:2]).max() < 0.02
    assert fusion.status_at()[0] is Status.OK


@pytest.mark.parametrize('width', [320, 640])
def test_a_principal_point_that_a_driver_rounds_does_not_forget_the_lens(width, caplog):
    drive = simulated(5, seconds=12.0, prior=Calibration.of_mount(MOUNT))
    fusion, images = fused(drive), 0
    rounded = INTRINSICS + 0.5 / width * np.array([0.0, 0.0, 1.0, 1.0, 0.0])
    for what in arriving(drive):
        if not isinstance(what, OdometrySample):
            images += 1
            camera = rounded if images > 30 and images % 2 else INTRINSICS
            what = replace(what[0], intrinsics=camera), what[1]
        before = fusion.calibration
        take(fusion, what)
        if images > 30:
            for name in ('focal_scale', 'distortion'):
                assert fusion.calibration[name][1] < 1.1 * before[name][1]
    assert len(caplog.messages) == 1
    off = fusion.calibration.values - drive.true.values
    assert (np.abs(off) < 5.0 * fusion.calibration.sigmas + 1e-9).all()


def test_another_map_leaves_the_pose_and_what_was_learned():
    drive = simulated(4, seconds=12.0, prior=Calibration.of_mount(MOUNT))
    fusion, arrivals = fused(drive), list(arriving(drive))
    take(fusion, *arrivals[:150])
    before, learned = fusion.estimate(), fusion.calibration
    fusion.change_map(LandmarkMap(drive.landmark_map.landmarks[::2]))
    after = fusion.estimate()
    assert after.pose == pytest.approx(before.pose)
    assert after.covariance == pytest.approx(before.covariance)
    assert fusion.calibration.sigmas == pytest.approx(learned.sigmas)
    take(fusion, *arrivals[150:])
    assert np.abs(error(fusion, drive)[:2]).max() < 0.05


def test_the_same_map_again_changes_nothing():
    drive = simulated(4, seconds=12.0, prior=Calibration.of_mount(MOUNT))
    fusion, same = fused(drive), fused(drive)
    for k, what in enumerate(arriving(drive)):
        take(fusion, what)
        take(same, what)
        if not k % 20:
            same.change_map(replace(drive.landmark_map))
    assert same.estimate().covariance == pytest.approx(fusion.estimate().covariance)


def test_a_place_found_in_a_pan_motion_has_an_uncertain_heading():
    pans = PanTrack(np.array([-1.0, 0.0, 1.0]), np.array([-1.0, 0.0, 1.0]))
    start = PoseEstimate(0, np.zeros(3), 1e-6 * np.eye(3))
    prior = Calibration.of_mount(MOUNT, {'axis_yaw': 1e-4})
    sigmas = []
    for joints in (
        JointSample(0, 0.0),
        JointSample(0, 0.0, 0.0, 1.0, pan_track=pans),
        JointSample(0, 0.0, pan_sigma_rad=0.2),
    ):
        fusion = Fusion(LandmarkMap(()), prior)
        fusion.place(start, joints)
        estimate, expected = fusion.estimate(), fusion.expectation(0)
        assert expected is not None
        sigmas.append(np.sqrt(estimate.covariance[2, 2]))
    assert sigmas[0] < 0.005
    # Half a turn a second of 0.2 s: two sigmas.
    assert sigmas[1] == pytest.approx(0.1, rel=0.1)
    assert sigmas[2] == pytest.approx(0.2, rel=0.1)


@pytest.mark.parametrize('aside_m', [0.0, 0.1, 1.0])
def test_a_wrong_start_is_lost_for_good_and_its_calibration_forgotten(aside_m):
    drive = simulated(6, seconds=4.0, prior=Calibration.of_mount(MOUNT))
    fusion = fused(drive)
    off = drive.poses[0] + [aside_m, 0.0, 0.0]
    fusion.initialize(PoseEstimate(0, off, np.diag(np.square([0.05, 0.05, 0.035]))))
    given = fusion.calibration
    take(fusion, *arriving(drive))
    wrong = aside_m > 0.5
    assert (fusion.status_at()[0] is Status.LOST) is wrong
    learned = not np.array_equal(fusion.calibration.values, given.values)
    assert learned is not wrong
    fusion.place(drive.start)
    assert fusion.status_at()[0] is not Status.LOST
