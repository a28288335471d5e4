"""All bearings of an image off by one angle: odometry that strays, or a camera that turned."""

from __future__ import annotations

from dataclasses import replace

from fusion_drives import (
    as_surveyed,
    detections,
    drive,
    error_of,
    landmark_map,
    Moment,
    MOUNT,
    start_estimate,
    START_SIGMA,
)
import numpy as np
import pytest

from landmark_nav.arrays import FloatArray
from landmark_nav.geometry.se2 import compose, inverse
from landmark_nav.localization.fusion import FusionConfig, FusionUpdate, PoseFilter
from landmark_nav.localization.fusion.state import BORESIGHT, HEADING
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.types import LandmarkMap

MAP = landmark_map(10)
SIGMA_RAD = 5e-4
LAST = 120


@pytest.fixture
def fused() -> PoseFilter:
    filter_ = PoseFilter(MAP, MOUNT)
    filter_.initialize(start_estimate())
    return filter_


def drive_and_turn(fused: PoseFilter, angle_sigmas: float) -> tuple[FusionUpdate, float, Moment]:
    """Drive with good bearings, the last off by so many sigmas of the heading."""
    for k, moment in enumerate(drive(LAST)):
        fused.add_odometry(moment.odometry)
        stamp_ns = moment.odometry.stamp_ns
        if k % 4 == 0 and k < LAST - 12:
            fused.add_detections(detections(MAP, moment.pose, stamp_ns, range(8), SIGMA_RAD))
    assert fused.state is not None
    variance = fused.state.covariance[HEADING, HEADING] + 2e-4**2 + SIGMA_RAD**2 / 8
    angle_rad = angle_sigmas * float(np.sqrt(variance))
    seen = detections(MAP, moment.pose, stamp_ns, range(8), SIGMA_RAD, angle_rad)
    return fused.add_detections(seen), angle_rad, moment


def test_an_angle_just_outside_the_gates_is_laid_to_the_odometry(fused: PoseFilter) -> None:
    update, angle_rad, moment = drive_and_turn(fused, 3.4)
    state = fused.state
    assert state is not None
    assert update.degrees == 8
    assert update.turned_rad == 0.0
    assert state.mean[BORESIGHT] == 0.0
    assert state.covariance[BORESIGHT, BORESIGHT] == 0.0
    assert moment.pose[2] - state.mean[HEADING] == pytest.approx(angle_rad, rel=0.2)
    assert fused.status[0] == 'tracking'


@pytest.mark.parametrize('angle_sigmas', [-7.0, 9.0])
def test_a_larger_one_is_flagged_by_as_much_as_was_seen(
    fused: PoseFilter, angle_sigmas: float
) -> None:
    update, angle_rad, moment = drive_and_turn(fused, angle_sigmas)
    state = fused.state
    assert state is not None
    assert update.turned_rad == pytest.approx(angle_rad, rel=0.2)
    together = moment.pose[2] - state.mean[HEADING] + state.mean[BORESIGHT]
    assert together == pytest.approx(angle_rad, rel=0.2)
    for k in (HEADING, BORESIGHT):
        assert 0.3 * abs(angle_rad) < np.sqrt(state.covariance[k, k]) < abs(angle_rad)
    # The camera rested: that shows nothing of the stamps of its joints.
    assert fused.late.sigma_s == 0.0
    status, reason = fused.status
    assert status == 'coasting'
    assert 'turned' in reason


@pytest.mark.parametrize('angle_rad', [0.03, 0.06])
def test_an_angle_is_reported_after_a_second_without_images_as_well(
    fused: PoseFilter, angle_rad: float
) -> None:
    for k, moment in enumerate(drive(LAST)):
        fused.add_odometry(moment.odometry)
        off_rad = angle_rad if k == LAST - 4 else 0.0
        if k % 4 == 0 and not LAST - 40 < k < LAST - 4:
            stamp_ns = moment.odometry.stamp_ns
            fused.add_detections(
                detections(MAP, moment.pose, stamp_ns, range(8), SIGMA_RAD, off_rad)
            )
    status, reason = fused.status
    assert status == 'coasting'
    assert 'turned' in reason


@pytest.mark.parametrize(
    ('landmarks', 'known'),
    # Landmarks that are refined have to be as exact as learned ones are.
    [('consider', MAP), ('refine', landmark_map(10, shared=0.002, own=0.001))],
)
@pytest.mark.parametrize(
    ('knock_rad', 'blind', 'turn_noise', 'sigmas', 'reported_s'),
    [(0.022, 16, 0.08, 4.0, 0.0), (0.035, 240, 0.015, 2.0, 20.0)],
)
def test_a_knock_while_the_heading_was_hardly_known_does_not_stay_in_it(
    knock_rad: float,
    blind: int,
    turn_noise: float,
    sigmas: float,
    reported_s: float,
    landmarks: str,
    known: LandmarkMap,
) -> None:
    """So many sigmas of the heading: as an error of the odometry that is not impossible."""
    noise = OdometryNoiseConfig(turn_rad_per_sqrt_rad=turn_noise, slip_sigma=0.02)
    fused = PoseFilter(known, MOUNT, FusionConfig(landmarks=landmarks), noise)
    fused.initialize(start_estimate())
    first, off_rad, reported = 200 + blind, 0.0, []
    for k, moment in enumerate(drive(first + 1000)):
        fused.add_odometry(moment.odometry)
        if k % 4 or 200 < k < first:
            continue
        if k == first:
            off_rad, before = knock_rad, fused.estimate()
            assert before is not None
            sigma_rad = np.sqrt(before.covariance[2, 2])
            assert knock_rad / sigma_rad == pytest.approx(sigmas, rel=0.15)
        stamp_ns = moment.odometry.stamp_ns
        seen = detections(known, moment.pose, stamp_ns, range(4), 2e-3, off_rad)
        fused.add_detections(seen)
        if off_rad and 'turned' in fused.status[1]:
            reported.append(0.05 * (k - first))
    assert reported[0] <= reported_s
    state = fused.state
    assert state is not None
    error_rad = abs(state.mean[HEADING] - moment.pose[2])
    assert error_rad < 3.0 * np.sqrt(state.covariance[HEADING, HEADING])
    assert error_rad < 0.5 * off_rad


def slipped(seed: int, slip_deg: float, late_s: float) -> tuple[PoseFilter, FloatArray]:
    """
    Drive for 4 m; half way, while the pan swings, wheels turn the base for half a second.

    Errors of the heading, degrees: at the last image of that swing, and in the end.
    """
    rng = np.random.default_rng(seed)
    fused = PoseFilter(as_surveyed(MAP, rng), MOUNT)
    fused.initialize(start_estimate(offset=rng.normal(0.0, START_SIGMA)))
    pivot, errors = np.zeros(3), {}
    for k, moment in enumerate(drive(200, rng, OdometryNoiseConfig())):
        wheels = moment.odometry.pose_odom_base
        pivot = wheels if k <= 100 else pivot
        turned = [0.0, 0.0, np.clip((k - 100) / 10, 0.0, 1.0) * np.radians(slip_deg)]
        wheels = compose(pivot, compose(turned, compose(inverse(pivot), wheels)))
        fused.add_odometry(replace(moment.odometry, pose_odom_base=wheels))
        if k % 4 == 0:
            rate = 2.0 if k % 60 >= 40 else 0.0
            off = rng.normal(0.0, SIGMA_RAD, 4) - late_s * rate * (k > 100)
            places, stamp_ns = (k // 4 + np.arange(4)) % 10, moment.odometry.stamp_ns
            seen = detections(MAP, moment.pose, stamp_ns, places, SIGMA_RAD, off)
            fused.add_detections(replace(seen, pan_rate_rad_s=rate))
            found = fused.estimate()
            assert found is not None
            error = error_of(found, moment.pose)
            nees = error @ np.linalg.solve(found.covariance, error)
            assert fused.status[0] != 'tracking' or nees < 40.0
            errors[k] = np.degrees(error[2])
    return fused, np.array([errors[116], errors[200]])


@pytest.mark.parametrize('slip_deg', [2.0, -1.5])
def test_wheels_that_slip_while_the_camera_swings_are_not_laid_to_the_joints(
    slip_deg: float,
) -> None:
    """Most likely they are not late, and the next swing says so."""
    runs = [slipped(seed, slip_deg, 0.0) for seed in range(32)]
    assert max(abs(fused.late.delay_s) for fused, _ in runs) < 0.005
    at_once, later = np.sqrt(np.mean(np.square([errors for _, errors in runs]), axis=0))
    assert at_once < 0.5 * abs(slip_deg)
    assert later < 0.25 * abs(slip_deg)


@pytest.mark.parametrize(
    ('late_s', 'slip_deg'), [(0.03, 0.0), (0.06, 0.0), (0.2, 0.0), (0.2, 2.0)]
)
def test_joints_that_are_late_are_distinguished_from_wheels_that_slip(
    late_s: float, slip_deg: float
) -> None:
    """At once where that moves bearings by far more than wheels turn the base, else by and by."""
    for seed in range(4):
        fused, errors = slipped(seed, slip_deg, late_s)
        assert fused.late.delay_s == pytest.approx(late_s, abs=0.01)
        assert abs(errors[1]) < 1.2


def test_an_angle_that_was_given_while_nothing_was_seen_is_reported_once(
    fused: PoseFilter,
) -> None:
    """Odometry is not asked again of what the image after it has given."""
    reported, pivot = [], np.zeros(3)
    for k, moment in enumerate(drive(140)):
        wheels = moment.odometry.pose_odom_base
        pivot = wheels if k <= 80 else pivot
        turned = [0.0, 0.0, np.radians(5.0) if k > 80 else 0.0]
        wheels = compose(pivot, compose(turned, compose(inverse(pivot), wheels)))
        fused.add_odometry(replace(moment.odometry, pose_odom_base=wheels))
        if k % 4 == 0 and not 72 < k < 100:
            seen = detections(MAP, moment.pose, moment.odometry.stamp_ns, range(8), SIGMA_RAD)
            fused.add_detections(seen)
            reported.append(fused.status[1])
    assert len({reason for reason in reported if 'turned' in reason}) == 1


def test_wheels_may_slip_again_and_again_but_a_camera_is_displaced_once(fused: PoseFilter) -> None:
    """Ten slips leave the boresight no more open than one does."""
    rng, doubts, slips = np.random.default_rng(0), [], 0
    for k, moment in enumerate(drive(240)):
        slips += k > 20 and k % 20 == 2
        turned = [0.0, 0.0, np.radians(2.0) * slips]
        wheels = compose(turned, moment.odometry.pose_odom_base)
        fused.add_odometry(replace(moment.odometry, pose_odom_base=wheels))
        if k % 4 == 0:
            off = rng.normal(0.0, SIGMA_RAD, 8)
            seen = detections(MAP, moment.pose, moment.odometry.stamp_ns, range(8), SIGMA_RAD, off)
            fused.add_detections(seen)
            state = fused.state
            assert state is not None
            doubts.append(np.degrees(np.sqrt(state.covariance[BORESIGHT, BORESIGHT])))
    assert slips == 11
    assert 0.5 < max(doubts) < 1.5
