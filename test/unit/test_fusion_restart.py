"""What a filter remembers when its pose or its map changes: the robot, not the place."""

from __future__ import annotations

from dataclasses import replace

from fusion_drives import detections, drive, error_of, landmark_map, Moment, MOUNT, start_estimate
import numpy as np
import pytest

from landmark_nav.arrays import FloatArray
from landmark_nav.geometry.se2 import compose, inverse
from landmark_nav.localization.fusion import PoseFilter
from landmark_nav.localization.fusion.start import Found, with_sigmas
from landmark_nav.localization.fusion.state import (
    BORESIGHT,
    DELAY,
    HEADING,
    initial_state,
    with_late_joints,
)
from landmark_nav.localization.joint_delay import JointDelay
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.types import LandmarkMap, PoseEstimate

MAP = landmark_map(10)
SIGMA_RAD = 5e-4
BUMP_RAD = np.radians(2.0)
FOUND_SIGMA = np.array([0.004, 0.004, 0.002])


def see(fused: PoseFilter, moment: Moment, k: int, off_rad: float = 0.0) -> None:
    places = (k + np.array([0, 1, 3, 4, 6])) % 10
    stamp_ns = moment.odometry.stamp_ns
    fused.add_detections(detections(MAP, moment.pose, stamp_ns, places, SIGMA_RAD, off_rad))


def driven(steps: int, bumped_at: int | None = None) -> tuple[PoseFilter, Moment]:
    """Drive with odometry that is 3 % short; the camera is bumped on the way."""
    fused = PoseFilter(MAP, MOUNT)
    fused.initialize(start_estimate())
    for k, moment in enumerate(drive(steps, biases=(0.03, 0.0, 0.0))):
        fused.add_odometry(moment.odometry)
        if k % 4 == 0:
            off = BUMP_RAD if bumped_at is not None and k >= bumped_at else 0.0
            see(fused, moment, k, off)
    return fused, moment


@pytest.mark.parametrize('begun', [False, True])
def test_a_place_of_seconds_ago_moves_on_with_the_odometry_since_then(begun: bool) -> None:
    moments = list(drive(100))
    fused = PoseFilter(MAP, MOUNT)
    if begun:
        fused.initialize(start_estimate())
    for moment in moments:
        fused.add_odometry(moment.odometry)
    then, now = moments[20], moments[-1]
    assert now.odometry.stamp_ns - then.odometry.stamp_ns > 3 * 10**9
    place = PoseEstimate(then.odometry.stamp_ns, then.pose, np.diag(np.square(FOUND_SIGMA)))
    fused.initialize(place, found=Found(MAP.ids))
    estimate = fused.estimate()
    assert estimate is not None
    assert estimate.stamp_ns == now.odometry.stamp_ns
    assert np.hypot(*error_of(estimate, now.pose)[:2]) < 0.02
    # As if it had been known then.
    then_known = PoseFilter(MAP, MOUNT)
    for k, moment in enumerate(moments):
        then_known.add_odometry(moment.odometry)
        if k == 20:
            then_known.initialize(place, found=Found(MAP.ids))
    expected = then_known.estimate()
    assert expected is not None
    np.testing.assert_allclose(estimate.covariance, expected.covariance, rtol=0.05, atol=1e-7)


@pytest.mark.parametrize('given', [(0, 0, 0), (1, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1)])
def test_a_start_without_a_variance_is_not_exact(given: tuple[int, int, int]) -> None:
    first, *moments = drive(60)
    covariance = np.outer(given, given) * (np.diag([0.02, 0.03, 0.03]) ** 2 + 1e-5)
    off = first.pose + np.array([0.05, -0.05, 0.08])
    start = with_sigmas(PoseEstimate(0, off, covariance), 0.3, 0.2)
    assert np.linalg.eigvalsh(start.covariance)[0] > 0.0
    known = np.ix_(np.flatnonzero(given), np.flatnonzero(given))
    np.testing.assert_array_equal(start.covariance[known], covariance[known])
    fused = PoseFilter(MAP, MOUNT)
    fused.initialize(start)
    for k, moment in enumerate([first, *moments]):
        fused.add_odometry(moment.odometry)
        if k % 4 == 0:
            see(fused, moment, k)
    assert fused.status == ('tracking', '')
    assert np.hypot(*error_of(fused.estimate(), moment.pose)[:2]) < 0.02


def test_a_person_who_gives_a_place_of_seconds_ago_is_at_another_clock() -> None:
    moments = list(drive(100))
    fused = PoseFilter(MAP, MOUNT)
    for moment in moments:
        fused.add_odometry(moment.odometry)
    then, now = moments[20], moments[-1]
    fused.initialize(replace(start_estimate(), stamp_ns=then.odometry.stamp_ns))
    estimate = fused.estimate()
    assert estimate is not None
    assert estimate.stamp_ns == now.odometry.stamp_ns
    np.testing.assert_allclose(estimate.pose, start_estimate().pose)


def test_a_new_map_makes_a_found_place_no_surer() -> None:
    fused = PoseFilter(MAP, MOUNT)
    fused.initialize(start_estimate(), found=Found(MAP.ids[:1]))
    fused.add_odometry(next(iter(drive(1))).odometry)
    assert fused.status[0] == 'coasting'
    fused.change_map(MAP)
    assert fused.status[0] == 'coasting'


def test_the_same_map_given_again_leaves_what_the_pose_shares_with_it() -> None:
    """A learner that is started anew, or loads its map again; ids may be others."""
    fused, _ = driven(60)
    before = fused.state
    assert before is not None
    assert np.abs(before.cross).max() > 0.0
    again = tuple(replace(k, id=k.id + 100) for k in MAP.landmarks)
    for landmark_map_again in (MAP, LandmarkMap(again)):
        fused.change_map(landmark_map_again)
        assert fused.state is not None
        np.testing.assert_array_equal(fused.state.cross, before.cross)
    fused.change_map(landmark_map(10, seed=1))
    assert fused.state is not None
    assert not fused.state.cross.any()


@pytest.mark.parametrize('before_s', [30.0, 0.0])
def test_a_start_reported_before_any_odometry_is_that_of_the_first(before_s: float) -> None:
    """With a stamp of nobody's clock, such as 0, as the command line of ROS gives it."""
    start = start_estimate()
    fused = PoseFilter(MAP, MOUNT)
    fused.initialize(start)
    for moment in drive(4):
        late_ns = moment.odometry.stamp_ns + round(before_s * 1e9)
        fused.add_odometry(replace(moment.odometry, stamp_ns=late_ns))
    estimate = fused.estimate()
    assert estimate is not None
    np.testing.assert_allclose(estimate.covariance, start.covariance, atol=1e-4)


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('sigmas', [(1e9, 1e9, 1e9), (0.05, 0.05, 1e9), (1e9, 1e9, 0.03)])
def test_unknown_may_be_reported_by_any_number(sigmas: tuple[float, float, float]) -> None:
    fused = PoseFilter(MAP, MOUNT)
    fused.initialize(PoseEstimate(0, start_estimate().pose, np.diag(np.square(sigmas))))
    for k, moment in enumerate(drive(20)):
        fused.add_odometry(moment.odometry)
        see(fused, moment, k)
    estimate = fused.estimate()
    assert estimate is not None
    assert np.hypot(*error_of(estimate, moment.pose)[:2]) < 0.02
    assert np.sqrt(estimate.covariance.trace()) < 0.03


@pytest.mark.parametrize('after', [4, 60])
@pytest.mark.parametrize('by', ['camera', 'person'])
def test_a_place_given_after_the_camera_was_bumped_has_an_uncertain_heading(
    after: int, by: str
) -> None:
    """A camera that finds the place is off by 2 deg, and so is the heading it shows."""
    fused, moment = driven(160 + after, bumped_at=160)
    given = moment.pose - np.array([0.0, 0.0, BUMP_RAD if by == 'camera' else 0.0])
    stamp_ns = moment.odometry.stamp_ns
    fused.initialize(PoseEstimate(stamp_ns, given, np.diag(FOUND_SIGMA**2)))
    errors = []
    for k, moment in enumerate(drive(360 + after, biases=(0.03, 0.0, 0.0))):
        if moment.odometry.stamp_ns > stamp_ns:
            fused.add_odometry(moment.odometry)
            if k % 4 == 0:
                see(fused, moment, k, BUMP_RAD)
        if moment.odometry.stamp_ns >= stamp_ns:
            state = fused.state
            assert state is not None
            errors.append(abs(error_of(fused.estimate(), moment.pose)[2]))
            assert errors[-1] < 2.0 * np.sqrt(state.covariance[HEADING, HEADING])
    assert np.degrees(np.sqrt(state.covariance[HEADING, HEADING])) < 0.6
    assert state.mean[BORESIGHT] == pytest.approx(BUMP_RAD, abs=np.radians(0.6))
    assert fused.status == ('tracking', '')
    # What was known of the camera before is known again with the next image.
    if after == 60:
        assert errors[0] == pytest.approx(0.5 * BUMP_RAD, rel=0.2)
        assert max(errors[5:]) < np.radians(0.4)


def test_what_was_learned_of_the_robot_outlasts_a_start_and_a_map() -> None:
    fused, moment = driven(200)
    before, noise = fused.state, fused.odometry_noise
    assert before is not None
    assert before.mean[3] == pytest.approx(0.03, abs=0.005)
    stamp_ns = moment.odometry.stamp_ns
    fused.change_map(landmark_map(6, seed=1))
    fused.initialize(PoseEstimate(stamp_ns, moment.pose, np.diag(FOUND_SIGMA**2)))
    after = fused.state
    assert after is not None
    np.testing.assert_array_equal(after.mean[3:], before.mean[3:])
    np.testing.assert_array_equal(after.covariance[3:, 3:], before.covariance[3:, 3:])
    np.testing.assert_allclose(after.covariance[:3, :3], np.diag(FOUND_SIGMA**2))
    assert fused.odometry_noise == noise


def test_a_new_map_does_not_make_a_lost_pose_believed() -> None:
    fused, moment = driven(200)
    wrong = moment.pose + np.array([0.8, 0.6, 0.0])
    stamp_ns = moment.odometry.stamp_ns
    fused.initialize(PoseEstimate(stamp_ns, wrong, np.diag(FOUND_SIGMA**2)))
    for k, moment in enumerate(drive(300, biases=(0.03, 0.0, 0.0))):
        if moment.odometry.stamp_ns > stamp_ns:
            fused.add_odometry(moment.odometry)
            if k % 4 == 0 and fused.status[0] != 'lost':
                see(fused, moment, k)
    verdict = fused.status
    assert verdict[0] == 'lost'
    fused.change_map(landmark_map(6, seed=1))
    assert fused.status == verdict


def found_after(
    bumped_rad: float = 0.0,
    moved: tuple[float, float, float] = (0.0, 0.0, 0.0),
    searched: bool = True,
) -> tuple[PoseFilter, FloatArray, FloatArray, str]:
    """
    Drive, see nothing for 2 s while the camera is bumped or the base moved, and see again.

    The place is searched for, or landmarks are seen where they should be.

    The filter; errors and sigmas of the heading at all images since, degrees; what was given
    after the first.
    """
    fused, last = driven(160)
    away, headings, given = np.zeros(3), [], []
    for k, here in enumerate(drive(400, biases=(0.03, 0.0, 0.0))):
        if k == 180:
            away = compose(compose(here.pose, moved), inverse(here.pose))
        if here.odometry.stamp_ns <= last.odometry.stamp_ns:
            continue
        fused.add_odometry(here.odometry)
        true = compose(away, here.pose) if away.any() else here.pose
        if k == 200 and searched:
            found = true - np.array([0.0, 0.0, bumped_rad])
            start = PoseEstimate(here.odometry.stamp_ns, found, np.diag(FOUND_SIGMA**2))
            fused.initialize(start, found=Found(MAP.ids[:5]))
        elif k > 200 and k % 4 == 0:
            see(fused, replace(here, pose=true), k, bumped_rad)
            found = fused.estimate()
            assert found is not None
            headings.append([error_of(found, true)[2], np.sqrt(found.covariance[2, 2])])
            given.append(fused.status[1])
    errors, sigmas = np.degrees(headings).T
    return fused, np.abs(errors), sigmas, given[0]


def boresight(fused: PoseFilter) -> tuple[float, float]:
    """And its sigma; degrees."""
    state = fused.state
    assert state is not None
    variance = state.covariance[BORESIGHT, BORESIGHT]
    return float(np.degrees(state.mean[BORESIGHT])), float(np.degrees(np.sqrt(variance)))


@pytest.mark.parametrize(
    ('bumped_rad', 'moved', 'searched'),
    [
        (BUMP_RAD, (0.0, 0.0, 0.0), True),
        (-BUMP_RAD, (0.05, 0.05, 0.0), True),
        (0.0, (0.0, 0.0, BUMP_RAD), True),
        (0.0, (0.05, 0.0, -BUMP_RAD), True),
        (BUMP_RAD, (0.0, 0.0, 0.0), False),
        (0.0, (0.0, 0.0, -BUMP_RAD), False),
    ],
)
def test_what_happened_unseen_to_the_camera_or_the_base_is_recognized_by_the_way_after_it(
    bumped_rad: float, moved: tuple[float, float, float], searched: bool
) -> None:
    fused, errors, sigmas, given = found_after(bumped_rad, moved, searched)
    assert sigmas[0] > 0.5
    off_deg = float(given.rsplit(': ')[-1].removesuffix(' deg'))
    assert off_deg == pytest.approx(np.degrees(bumped_rad - moved[2]), abs=0.4)
    assert (errors < 3.0 * sigmas + 0.05).all()
    angle, sigma = boresight(fused)
    assert abs(angle - np.degrees(bumped_rad)) < 3.0 * sigma + 0.05
    assert fused.status == ('tracking', '')


@pytest.mark.parametrize('searched', [True, False])
def test_a_heading_to_which_odometry_led_leaves_the_camera_certain(searched: bool) -> None:
    fused, errors, sigmas, _ = found_after(searched=searched)
    assert boresight(fused) == (0.0, 0.0)
    assert max(sigmas) < 0.2
    assert (errors < 3.0 * sigmas).all()


@pytest.mark.parametrize(
    'moved', [(1.0, 0.5, 0.1), (0.0, 0.0, 0.5), (0.1, 0.0, -1.6), (0.0, 0.0, 3.0)]
)
def test_a_robot_that_was_carried_or_turned_gives_nothing_of_its_camera(
    moved: tuple[float, float, float],
) -> None:
    fused, errors, sigmas, _ = found_after(moved=moved)
    assert boresight(fused) == (0.0, 0.0)
    assert max(sigmas) < 0.2
    assert (errors < 3.0 * sigmas).all()


def test_joints_of_which_nothing_is_known_any_more_are_taken_as_in_time() -> None:
    start = PoseEstimate(0, np.zeros(3), 1e-4 * np.eye(3))
    state = initial_state(start, MAP, OdometryNoiseConfig(), 0.0, 0.02)
    mean, cross = state.mean.copy(), np.ones_like(state.cross)
    mean[DELAY] = 0.06
    late = with_late_joints(replace(state, mean=mean, cross=cross), 0.15)
    assert late.late == JointDelay(0.0, 0.15)
    assert not late.cross[DELAY].any()
    assert late.cross[BORESIGHT].all()
    np.testing.assert_array_equal(np.delete(late.mean, DELAY), np.delete(mean, DELAY))


def test_a_found_place_by_another_clock_is_of_now() -> None:
    """As images whose stamps count from the start of the camera: not replayed for decades."""
    fused = PoseFilter(MAP, MOUNT)
    for moment in drive(20):
        stamp_ns = moment.odometry.stamp_ns + 50 * 365 * 86400 * 10**9
        fused.add_odometry(replace(moment.odometry, stamp_ns=stamp_ns))
    place = PoseEstimate(10**9, moment.pose, np.diag(np.square(FOUND_SIGMA)))
    assert not fused.reaches(place.stamp_ns)
    fused.initialize(place, found=Found(MAP.ids))
    estimate = fused.estimate()
    assert estimate is not None
    assert estimate.stamp_ns == stamp_ns
    np.testing.assert_allclose(estimate.pose, moment.pose)
