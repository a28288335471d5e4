"""Images, joint states and odometry that fail, fed to the localizer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from degraded_drives import (
    check_consistent,
    FAULT_S,
    first,
    KNOWN,
    pan_rad,
    run,
    Sensed,
)
import numpy as np
import pytest
from rendered_drives import camera_image, error_of, MAP, MOUNT, START, START_SIGMA, Step

from landmark_nav.calibration import Calibration
from landmark_nav.evaluation.replay import replay as replay_events
from landmark_nav.geometry import se2
from landmark_nav.localization.estimator import Status
from landmark_nav.localization.fusion import Fusion
from landmark_nav.localization.late_joints import JointDelay
from landmark_nav.localization.localizer import (
    LocalizationConfig,
    LocalizationUpdate,
    Localizer,
)
from landmark_nav.types import (
    CameraFrame,
    FloatArray,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Refusal,
)


def test_images_that_stop_or_come_from_another_clock(sensed: list[Sensed]) -> None:
    def shifted(step: Step, frame: CameraFrame | None) -> Sensed:
        if frame is not None and step.stamp_ns * 1e-9 < FAULT_S + 2.5:
            frame = replace(frame, stamp_ns=frame.stamp_ns - 100 * 10**9)
        return step, frame

    moments = list(run(sensed, shifted))
    coasting = first(moments, 'coasting')
    assert coasting.after_s <= 2.0
    assert {m.status for m in moments if 3.0 < m.after_s < 6.0} == {'tracking'}


def test_an_image_angle_that_is_not_a_number_is_left_out(sensed: list[Sensed]) -> None:
    def broken_pan(step: Step, frame: CameraFrame | None) -> Sensed:
        if frame is not None and step.stamp_ns * 1e-9 < FAULT_S + 2.0:
            frame = replace(frame, pan_rad=float('nan'))
        return step, frame

    moments = list(run(sensed, broken_pan))
    assert first(moments, 'coasting').after_s <= 2.0
    assert {m.status for m in moments if 2.5 < m.after_s < 6.0} == {'tracking'}


@pytest.mark.parametrize('angle_deg', [2.0, -2.0])
def test_a_camera_bumped_against_the_base_goes_on(sensed: list[Sensed], angle_deg: float) -> None:
    def bumped(step: Step, frame: CameraFrame | None) -> Sensed:
        if frame is not None:
            frame = replace(frame, pan_rad=frame.pan_rad + np.radians(angle_deg))
        return step, frame

    moments = list(run(sensed, bumped))
    given = next(m for m in moments if m.after_s >= 0.0 and 'turned' in m.reason)
    assert given.after_s <= 2.0
    assert given.status == 'coasting'
    assert np.degrees(given.sigma[2]) > 1.0
    assert {m.status for m in moments if 3.0 < m.after_s < 6.0} == {'tracking'}
    assert max(np.hypot(*m.error[:2]) for m in moments if m.after_s > 2.0) < 0.05
    check_consistent(moments)


@pytest.mark.parametrize(
    ('angle_deg', 'of'), [(1.0, 'tilt'), (-2.0, 'tilt'), (-2.0, 'roll'), (3.0, 'roll')]
)
def test_a_camera_bumped_in_its_tilt_or_roll_finds_all_as_before(
    sensed: list[Sensed], angle_deg: float, of: str
) -> None:
    """The joints say too much, so the camera looks lower, or is rolled to the left."""

    def tilted(step: Step, frame: CameraFrame | None) -> Sensed:
        if frame is not None:
            angle = np.radians(angle_deg)
            if of == 'tilt':
                frame = replace(frame, tilt_rad=frame.tilt_rad + angle)
            else:
                frame = replace(frame, roll_rad=frame.roll_rad + angle)
        return step, frame

    short = sensed[: round(20 * (FAULT_S + 4.0))]
    moments = list(run(short, tilted))
    assert 'lost' not in {m.status for m in moments}
    assert {m.status for m in moments if m.after_s > 2.0} == {'tracking'}
    assert max(np.hypot(*m.error[:2]) for m in moments) < 0.03
    check_consistent(moments)


def test_a_place_is_found_with_a_camera_whose_tilt_was_displaced_before(
    sensed: list[Sensed],
) -> None:
    localizer = Localizer(MAP, KNOWN, LocalizationConfig())
    localizer.initialize(PoseEstimate(0, START, np.diag(START_SIGMA**2)))
    search: list[PoseEstimate | Refusal | None] = []
    reported_wrong = False
    for step, frame in sensed:
        seconds = step.stamp_ns * 1e-9
        localizer.add_odometry(step.odometry)
        if seconds > FAULT_S + 1.0 and not reported_wrong:
            off = np.array([-1.0, 0.9, 2.5])
            wrong = PoseEstimate(step.stamp_ns, step.pose + off, np.eye(3) * 1e-4)
            localizer.initialize(wrong)
            reported_wrong = True
        if frame is None or seconds > FAULT_S + 6.0:
            continue
        knock = np.radians(2.0) if seconds > 1.0 else 0.0
        update = localizer.add_frame(replace(frame, tilt_rad=frame.tilt_rad - knock))
        assert isinstance(update, LocalizationUpdate)
        search.append(update.search)
        if isinstance(update.search, PoseEstimate):
            assert np.hypot(*(update.search.pose - step.pose)[:2]) < 0.05
    assert any(isinstance(outcome, PoseEstimate) for outcome in search)


def delay_of(events: list[CameraFrame | OdometrySample]) -> JointDelay:
    """Delay of the joints as it is known at the end of a drive."""
    calibration, config = Calibration.of_mount(MOUNT), LocalizationConfig()
    done = replay_events(events, MAP, calibration, config, START, np.diag(START_SIGMA**2))
    assert done.calibration is not None
    return JointDelay(*done.calibration['joint_delay'])


@pytest.mark.parametrize('late_s', [0.0, 0.04, -0.04])
def test_joint_states_that_are_late_are_measured(sensed: list[Sensed], late_s: float) -> None:
    events: list[CameraFrame | OdometrySample] = []
    for step, frame in sensed:
        events.append(step.odometry)
        if frame is None or step.stamp_ns * 1e-9 > 9.0:
            continue
        seconds = step.stamp_ns * 1e-9 - late_s
        rate = (pan_rad(seconds + 0.025) - pan_rad(seconds - 0.025)) / 0.05
        events.append(replace(frame, pan_rad=pan_rad(seconds), pan_rate_rad_s=rate))
    late = delay_of(events)
    assert late.sigma_s < 0.008
    assert abs(late.delay_s - late_s) < 4.0 * late.sigma_s
    assert late.matters == (late_s != 0.0)


def test_a_wheel_that_slips_shows_no_late_joints(sensed: list[Sensed]) -> None:
    events: list[CameraFrame | OdometrySample] = []
    given, before = sensed[0][0].odometry.pose_odom_base, sensed[0][0].odometry.pose_odom_base
    for step, frame in sensed:
        odometry, seconds = step.odometry, step.stamp_ns * 1e-9
        moved, before = se2.relative(before, odometry.pose_odom_base), odometry.pose_odom_base
        slips = 7.0 < seconds < 7.6
        given = se2.compose(given, moved + np.array([0.0, 0.0, -0.003 if slips else 0.0]))
        events.append(replace(odometry, pose_odom_base=given))
        if frame is None or seconds > 9.0:
            continue
        rate = (pan_rad(seconds + 0.025) - pan_rad(seconds - 0.025)) / 0.05
        events.append(replace(frame, pan_rad=pan_rad(seconds), pan_rate_rad_s=rate))
    late = delay_of(events)
    assert abs(late.delay_s) < 4.0 * late.sigma_s
    assert not late.matters


def test_joint_states_far_too_late_lose_the_pose_for_as_long_as_they_last(
    sensed: list[Sensed],
) -> None:
    """The camera turns at up to 62 deg/s; where it is said to look it looked 0.2 s before."""

    def late(step: Step, frame: CameraFrame | None) -> Sensed:
        seconds = step.stamp_ns * 1e-9
        if frame is not None and seconds < FAULT_S + 1.5:
            frame = replace(frame, pan_rad=pan_rad(seconds - 0.2))
        return step, frame

    moments = list(run(sensed, late))
    given = next(m for m in moments if m.after_s >= 0.0 and m.status != 'tracking')
    assert given.after_s <= 2.0
    assert given.reason
    back = next(m for m in moments if m.after_s > 1.5 and m.status == 'tracking')
    assert back.after_s <= 5.0
    assert np.hypot(*back.error[:2]) < 0.05
    check_consistent(moments)


def test_without_joint_states_no_image_counts_and_odometry_goes_on(
    sensed: list[Sensed],
) -> None:
    """Images without joint angles reach nobody: readers and nodes leave them out."""
    fused = Fusion(MAP, KNOWN)
    fused.initialize(PoseEstimate(0, START, np.diag(START_SIGMA**2)))
    sigmas = []
    for step, _ in sensed[: round(20 * 5.0)]:
        fused.add_odometry(step.odometry)
        estimate = fused.estimate()
        assert estimate is not None
        sigmas.append(float(np.hypot(*np.sqrt(np.diag(estimate.covariance)[:2]))))
        if step.stamp_ns > 2 * 10**9:
            assert fused.status_at()[0] is not Status.OK
    assert np.all(np.diff(sigmas) > 0.0)


def jumping(k: int, step: Step) -> Step | None:
    """Odometry that starts anew somewhere else."""
    moved = se2.compose([5.0, 1.0, 1.0], step.odometry.pose_odom_base)
    return replace(step, odometry=replace(step.odometry, pose_odom_base=moved))


def repeated(k: int, step: Step) -> Step | None:
    """Odometry that repeats its last sample."""
    return replace(step, odometry=replace(step.odometry, stamp_ns=round(FAULT_S * 1e9)))


def at_rest(step: Step, pose: FloatArray) -> Step:
    """Odometry that stays where it is and says that it stands."""
    odometry = replace(step.odometry, pose_odom_base=pose, linear_m_s=0.0, angular_rad_s=0.0)
    return replace(step, odometry=odometry)


def silent(k: int, step: Step) -> Step | None:
    """Odometry that stops."""
    return None


def broken(k: int, step: Step) -> Step | None:
    """Odometry that is not a number."""
    bad = replace(step.odometry, pose_odom_base=np.array([np.nan, 0.0, np.inf]))
    return replace(step, odometry=bad)


def behind(k: int, step: Step) -> Step | None:
    """Stamps that go back, a little more each time."""
    return replace(step, odometry=replace(step.odometry, stamp_ns=step.stamp_ns - 2 * k * 10**8))


@pytest.mark.parametrize('fault', [jumping, repeated, silent, broken, behind])
def test_odometry_that_fails_is_noticed_while_the_camera_goes_on(
    sensed: list[Sensed], fault: Callable[[int, Step], Step | None]
) -> None:
    localizer = Localizer(MAP, KNOWN, LocalizationConfig())
    localizer.initialize(PoseEstimate(0, START, np.diag(START_SIGMA**2)))
    reported: list[tuple[float, str]] = []
    refused = 0
    for k, (step, frame) in enumerate(sensed):
        seconds = step.stamp_ns * 1e-9 - FAULT_S
        wrong = fault(k, step) if 0.0 < seconds < 4.0 else step
        if seconds > 7.0:
            break
        if wrong is not None:
            refused += localizer.add_odometry(wrong.odometry) is not None
        if frame is None:
            continue
        update = localizer.add_frame(frame)
        assert isinstance(update, LocalizationUpdate)
        assert np.isfinite(update.fused.pose).all()
        reported.append((seconds, update.status))
        error = error_of(update.fused, step.pose)
        spread = np.linalg.solve(update.fused.covariance, error)
        assert update.status == 'lost' or error @ spread < 40.0
    noticed = any(status != 'tracking' for seconds, status in reported if 0.0 <= seconds <= 2.0)
    assert refused or noticed
    # It is over soon after the fault is.
    assert reported[-1][1] == 'tracking'
    assert np.hypot(*error[:2]) < 0.05


def test_odometry_that_comes_twice_is_as_good_as_once(sensed: list[Sensed]) -> None:
    once, twice = (Localizer(MAP, KNOWN, LocalizationConfig()) for _ in range(2))
    for localizer in (once, twice):
        localizer.initialize(PoseEstimate(0, START, np.diag(START_SIGMA**2)))
    for step, frame in sensed[: round(20 * FAULT_S)]:
        for localizer in (once, twice, twice):
            assert localizer.add_odometry(step.odometry) is None
        if frame is not None:
            updates = [localizer.add_frame(frame) for localizer in (once, twice)]
            poses = [u.fused for u in updates if isinstance(u, LocalizationUpdate)]
            np.testing.assert_array_equal(poses[0].pose, poses[1].pose)
            np.testing.assert_array_equal(poses[0].covariance, poses[1].covariance)
            assert twice.status == once.status


def test_poses_that_jitter_are_weighed_as_such(sensed: list[Sensed]) -> None:
    rng = np.random.default_rng(3)
    localizer = Localizer(MAP, KNOWN, LocalizationConfig())
    localizer.initialize(PoseEstimate(0, START, np.diag(START_SIGMA**2)))
    nees = []
    for step, frame in sensed:
        pose = step.odometry.pose_odom_base + rng.normal(0.0, [0.01, 0.01, 0.005])
        localizer.add_odometry(replace(step.odometry, pose_odom_base=pose))
        if frame is None:
            continue
        update = localizer.add_frame(frame)
        assert isinstance(update, LocalizationUpdate)
        error = error_of(update.fused, step.pose)
        nees.append(error @ np.linalg.solve(update.fused.covariance, error))
    assert np.mean(nees[10:]) < 4.5
    assert np.max(nees[10:]) < 25.0


@pytest.mark.parametrize('ahead_m', [0.2, -0.2])
def test_wheels_that_spin_are_not_taken_for_a_turned_camera_alone(
    sensed: list[Sensed], ahead_m: float
) -> None:
    """From here a few landmarks are off by one angle, as they are when the camera is turned."""
    pivot = sensed[round(FAULT_S * 20)][0].odometry.pose_odom_base

    def spun(step: Step, frame: CameraFrame | None) -> Sensed:
        done = np.clip((step.stamp_ns * 1e-9 - FAULT_S) / 0.5, 0.0, 1.0)
        since = se2.compose(se2.inverse(pivot), step.odometry.pose_odom_base)
        pose = se2.compose(pivot, se2.compose([done * ahead_m, 0.0, 0.0], since))
        return replace(step, odometry=replace(step.odometry, pose_odom_base=pose)), frame

    moments = list(run(sensed[: round(20 * (FAULT_S + 4.0))], spun))
    assert first(moments, 'coasting').after_s <= 1.0
    assert all(m.nees < 25.0 for m in moments if m.after_s >= 0.0)
    assert {m.status for m in moments if m.after_s > 2.5} == {'tracking'}
    assert all(np.hypot(*m.error[:2]) < 0.03 for m in moments if m.after_s > 1.0)


@pytest.mark.parametrize('late', [0, 5])
def test_odometry_that_states_it_stands_is_not_believed_while_images_show_motion(
    sensed: list[Sensed], late: int
) -> None:
    here = sensed[round(FAULT_S * 20)][0].odometry.pose_odom_base

    def stuck(step: Step, frame: CameraFrame | None) -> Sensed:
        return (at_rest(step, here) if step.stamp_ns * 1e-9 < FAULT_S + 4.0 else step), frame

    fed = run(sensed[: round(20 * (FAULT_S + 7.2))], stuck, late=late)
    moments = [m for m in fed if m.after_s > 0.0]
    assert 'tracking' not in {m.status for m in moments if m.after_s < 4.0}
    check_consistent(moments)


def test_a_clock_set_back_by_a_second_is_no_second_of_silence(sensed: list[Sensed]) -> None:
    """Odometry is not late for that second: it comes as before, by another clock."""
    second = 10**9

    def set_back(step: Step, frame: CameraFrame | None) -> Sensed:
        wheels = replace(step.odometry, stamp_ns=step.odometry.stamp_ns - second)
        if frame is not None:
            frame = replace(frame, stamp_ns=frame.stamp_ns - second)
        return replace(step, odometry=wheels), frame

    moments = list(run(sensed[: round(20 * (FAULT_S + 4.0))], set_back))
    later = [m for m in moments if m.after_s > 0.5]
    assert all(np.hypot(*m.error[:2]) < 0.07 and m.nees < 25.0 for m in later)
    assert {m.status for m in later if m.after_s > 2.5} == {'tracking'}


def test_images_that_show_nothing_do_not_hold_up_the_verdict_where_odometry_stops() -> None:
    localizer = Localizer(LandmarkMap(()), KNOWN, LocalizationConfig())
    localizer.initialize(PoseEstimate(0, START, np.diag(START_SIGMA**2)))
    localizer.add_odometry(OdometrySample(0, np.zeros(3)))
    reported, frame = [], camera_image(START, 0.0)
    for k in range(50):
        update = localizer.add_frame(replace(frame, stamp_ns=k * 200_000_000))
        assert isinstance(update, LocalizationUpdate)
        reported.append(update.status)
    assert reported[0] == 'tracking'
    assert 'tracking' not in reported[10:]
    assert reported[-1] == 'lost'
