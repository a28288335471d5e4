"""Poses of sweeps from given poses and odometry."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import turn_sweep

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.learning.calibration.turn import check_turn, measure_turn
from landmark_nav.learning.sweep import assemble_sweep
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.localization.sweep_places import carried_on, known_places, places_by_odometry
from landmark_nav.types import JointSample, OdometrySample, PoseEstimate

STEP_NS = 50_000_000
CONFIG = OdometryNoiseConfig()
# Frame of odometry at the first sweep; the way to the second one, and farther on.
ODOM = np.array([3.0, -1.0, 0.7])
WAY, FARTHER = np.array([1.8, 0.4, 0.9]), np.array([1.0, -0.2, 1.3])
# Steps of 50 ms: it stands, drives, stands, drives on.
STANDS, DRIVES = 60, 100


def drive():
    """Odometry of both sweeps and what follows."""
    shares = np.linspace(0.0, 1.0, DRIVES)[:, None]
    legs = [np.zeros((STANDS, 3)), shares * WAY, np.tile(WAY, (STANDS, 1))]
    legs.append(WAY + shares * (FARTHER - WAY))
    poses = se2.compose(ODOM, np.concatenate(legs))
    return [OdometrySample(STEP_NS * (k + 1), pose) for k, pose in enumerate(poses)]


def span(first, last):
    return STEP_NS * (first + 1), STEP_NS * (last + 1)


SPANS = [span(5, STANDS - 5), span(STANDS + DRIVES + 5, 2 * STANDS + DRIVES - 5)]


def test_odometry_gives_relative_poses_and_errors_that_grow_with_the_way():
    places = places_by_odometry(SPANS, drive(), CONFIG)
    np.testing.assert_allclose(places.poses, [np.zeros(3), WAY], atol=1e-3)
    sigma = np.sqrt(np.diag(places.covariance)).reshape(2, 3)
    assert not sigma[0].any()
    assert 0.005 < np.hypot(*sigma[1, :2]) < 0.2


def test_a_pose_is_carried_on_with_what_odometry_adds():
    samples = drive()
    known = PoseEstimate(SPANS[1][1], np.array([0.5, 0.6, -2.0]), np.diag([1e-6, 4e-6, 1e-6]))
    now = carried_on(known, samples, CONFIG)
    assert now.stamp_ns == samples[-1].stamp_ns
    expected = se2.compose(known.pose, se2.relative(WAY, FARTHER))
    np.testing.assert_allclose(now.pose, expected, atol=1e-3)
    assert np.all(np.linalg.eigvalsh(now.covariance) > 0.0)
    assert np.trace(now.covariance) > np.trace(known.covariance)


def test_errors_of_given_poses_are_relative_to_the_first():
    first = PoseEstimate(1, np.array([1.0, 2.0, 0.5]), np.diag([1e-4, 1e-4, 1e-6]))
    second = PoseEstimate(2, np.array([3.0, 2.0, 0.1]), np.diag([4e-4, 1e-4, 4e-6]))
    (places,) = known_places([first, second], [], [], CONFIG)
    np.testing.assert_array_equal(places.poses[0], first.pose)
    rng = np.random.default_rng(3)
    draws = np.array(
        [
            rng.multivariate_normal(place.pose, place.covariance, 100_000)
            for place in (first, second)
        ]
    )
    # With the first one moved to where it is given.
    moved = se2.compose(first.pose, se2.relative(draws[0], draws[1]))
    drawn = np.cov(moved.T)
    np.testing.assert_allclose(places.covariance[3:, 3:], drawn, atol=0.05 * np.max(drawn))


@pytest.mark.parametrize(
    ('spans', 'samples', 'why'),
    [
        (SPANS, drive()[:STANDS], 'odom does not cover sweep 2'),
        (SPANS, [], 'odom does not cover sweep 1'),
        ([SPANS[0], span(STANDS + 20, STANDS + DRIVES)], drive(), 'moved .* in sweep 2'),
    ],
)
def test_odometry_that_does_not_say_is_refused(spans, samples, why):
    with pytest.raises(LandmarkNavError, match=why):
        places_by_odometry(spans, samples, CONFIG)


def test_a_sweep_without_its_pose_is_named():
    given = PoseEstimate(1, np.zeros(3), np.eye(3))
    with pytest.raises(LandmarkNavError, match='sweep 2 has no sweep/pose'):
        known_places([given, None], [], [], CONFIG)


CAMERA = CameraModel(64, 48, 60.0, 60.0, 31.5, 23.5)
TRAJECTORY = [JointSample(10**9 * k, 0.1 * k, 0.01) for k in range(1, 6)]
IMAGES = {10**9 * k: (np.full((48, 64), k, np.uint8), CAMERA) for k in range(8)}


@pytest.mark.parametrize(
    ('trajectory', 'images', 'message'),
    [
        (TRAJECTORY, {}, 'lacks all of its 5 frames'),
        ([], IMAGES, 'no frames'),
        (
            [JointSample(10**9 * k, 5.0 * k, 0.01) for k in range(1, 6)],
            IMAGES,
            'the pan goes over 20 rad: are these degrees',
        ),
    ],
)
def test_what_is_no_sweep_is_refused(trajectory, images, message):
    with pytest.raises(LandmarkNavError, match=message):
        assemble_sweep(trajectory, images)


MOUNT = PanTiltMount((0.1, 0.0, 1.0))
LENS = CameraModel(160, 120, 150.0, 150.0, 79.5, 59.5)
PANS = -np.pi + np.radians(10.0) * np.arange(36)


@pytest.fixture(scope='module')
def turn():
    return turn_sweep(LENS, MOUNT, PANS)


def reported(sweep, pan=lambda pan: pan, focal=1.0, frozen=False):
    camera = replace(LENS, fx=focal * LENS.fx, fy=focal * LENS.fy)
    images = [sweep.frames[0 if frozen else k].image for k in range(len(sweep.frames))]
    frames = (
        replace(f, pan_rad=float(pan(f.pan_rad)), camera=camera, image=image)
        for f, image in zip(sweep.frames, images, strict=True)
    )
    return replace(sweep, frames=tuple(frames))


def test_images_that_turn_with_the_pan_pass(turn):
    check_turn(turn, MOUNT)
    ratio, full_turn = measure_turn(turn, MOUNT)
    assert ratio == pytest.approx(1.0, abs=0.02)
    assert full_turn == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    ('wrong', 'cause'),
    [
        ({'pan': lambda pan: -pan}, 'sign of the pan'),
        ({'pan': lambda pan: 0.0}, 'does not turn'),
        ({'pan': lambda pan: float(pan > 0.0)}, 'does not turn'),
        ({'pan': lambda pan: 0.01 * pan}, 'does not turn'),
        ({'pan': lambda pan: 1.5 * pan}, 'times the pan'),
        ({'pan': np.degrees}, 'degrees'),
        # Of another size of image, which is no wrong pan.
        *(({'focal': focal}, 'focal length') for focal in (0.5, 1.5, 2.0)),
        ({'frozen': True}, 'do not turn'),
    ],
)
def test_a_sweep_that_contradicts_its_images_is_refused_with_the_cause(turn, wrong, cause):
    with pytest.raises(LandmarkNavError, match=cause):
        check_turn(reported(turn, **wrong), MOUNT)
