"""Joint states that may be late while the pan turns: hypotheses of how late they are."""

from __future__ import annotations

from dataclasses import replace

from filter_runs import EVERY, MAP, measurement, run, started
from fusion_drives import drive, error_of, MOUNT, start_estimate
import numpy as np
import pytest

from landmark_nav.arrays import FloatArray
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.pan_track import PanTrack
from landmark_nav.localization.fusion import FusionConfig, PoseFilter
from landmark_nav.localization.fusion.late_joints import (
    found_in_swing,
    late_joints,
    seen_in_swing,
)
from landmark_nav.localization.fusion.mixture import Mixture
from landmark_nav.localization.fusion.start import Found, joints_in_doubt
from landmark_nav.localization.fusion.state import (
    BORESIGHT,
    DELAY,
    FilterState,
    HEADING,
    moved_to,
    with_late_joints,
)
from landmark_nav.localization.joint_delay import JointDelay
from landmark_nav.types import Detections, PoseEstimate

LATE_S = 0.2
RATE_RAD_S = 2.1
LEVER = np.asarray(MOUNT.axis_xyz[:2])
NOBODY = np.empty(0, dtype=np.int64)


def pan_range_rad(seconds: float | FloatArray) -> float | FloatArray:
    """A pan at full rate that slows down after 3.3 s and then goes back."""
    after = np.asarray(seconds) - 3.3
    slowing = np.where(after < 0.0, after, after / (1.0 + (after / 0.3) ** 2))
    return np.asarray(RATE_RAD_S * slowing)


def track_at(stamp_ns: int) -> PanTrack:
    """What joint states that are late show of the pan about a time."""
    about = np.linspace(-0.4, 0.4, 33)
    return PanTrack(about, np.asarray(pan_range_rad(1e-9 * stamp_ns - LATE_S + about)))


def late(seen: Detections) -> Detections:
    """Bearings by the pan that joint states show which are late."""
    seconds = 1e-9 * seen.stamp_ns
    off_rad = float(pan_range_rad(seconds) - pan_range_rad(seconds - LATE_S))
    track = track_at(seen.stamp_ns)
    before, after = track.at([-0.01, 0.01])
    return replace(
        seen,
        bearing_rad=wrap_rad(seen.bearing_rad - off_rad),
        pan_rate_rad_s=float(after - before) / 0.02,
        pan_track=track,
    )


def found_state() -> FilterState:
    fused = PoseFilter(MAP, MOUNT)
    fused.initialize(start_estimate(np.array([0.01, 0.01, 0.005])))
    state = fused.state
    assert state is not None
    return state


def test_an_unknown_delay_is_zero_with_a_wide_sigma() -> None:
    whole = late_joints(found_state()).merged()
    assert whole.mean[DELAY] == pytest.approx(0.0, abs=1e-12)
    assert 0.12 < whole.late.sigma_s < 0.15
    found = Found(NOBODY, RATE_RAD_S, track_at(3_200_000_000))
    (single,) = found_in_swing(found_state(), found, LEVER, whole=True).states
    assert single.late.sigma_s == pytest.approx(0.15)


def test_each_delay_turns_the_place_that_was_found_about_the_pan_axis() -> None:
    state, track = found_state(), track_at(3_200_000_000)
    found = Found(NOBODY, RATE_RAD_S, track)
    first, *parts = found_in_swing(state, found, LEVER).states
    np.testing.assert_allclose(first.mean, state.mean, atol=1e-12)
    assert np.sqrt(first.covariance[HEADING, HEADING]) < 0.03
    for part in parts:
        turned = float(np.diff(track.at([0.0, part.mean[DELAY]]))[0])
        assert part.mean[HEADING] == pytest.approx(state.mean[HEADING] - turned)
        axes = [se2.transform_points(one.mean[:3], LEVER) for one in (state, part)]
        np.testing.assert_allclose(axes[0], axes[1], atol=1e-12)
        assert np.linalg.eigvalsh(part.covariance[:9, :9])[0] > -1e-12
    # What is sure is the direction in which the camera looks.
    straight = found_in_swing(state, found._replace(pan_track=None), LEVER).states[1]
    by_heading = np.zeros(len(straight.mean))
    by_heading[[HEADING, DELAY]] = 1.0, RATE_RAD_S
    sigma = np.sqrt(by_heading @ straight.covariance @ by_heading)
    assert sigma == pytest.approx(np.sqrt(first.covariance[HEADING, HEADING]))


@pytest.mark.parametrize('landmarks', ['consider', 'refine'])
@pytest.mark.parametrize('found_at', [48, 60])
def test_a_place_found_in_a_swing_is_put_right_by_the_next_images(
    found_at: int, landmarks: str
) -> None:
    """Found with the pan 24 deg off, at a constant rate; then the pan slows down."""
    fused, errors = PoseFilter(MAP, MOUNT, FusionConfig(landmarks=landmarks)), []
    for k, moment in enumerate(drive(84)):
        fused.add_odometry(moment.odometry)
        stamp_ns = moment.odometry.stamp_ns
        seen = late(measurement(moment, k))
        if k == found_at:
            turned = LATE_S * RATE_RAD_S
            axis = MOUNT.axis_pose_map(moment.pose) + np.array([0.0, 0.0, turned])
            pose = se2.compose(axis, [*-LEVER, 0.0])
            sigma = np.array([0.01, 0.01, 0.005])
            place = PoseEstimate(stamp_ns, pose, np.diag(np.square(sigma)))
            fused.initialize(place, found=Found(MAP.ids, RATE_RAD_S, seen.pan_track))
        elif k > found_at and k % EVERY == 0:
            fused.add_detections(seen)
            state = fused.state
            assert state is not None
            heading_rad = abs(error_of(fused.estimate(), moment.pose)[2])
            errors.append(heading_rad)
            limit = 3.0 if landmarks == 'consider' else 4.0
            assert heading_rad < limit * np.sqrt(state.covariance[HEADING, HEADING])
    assert np.degrees(max(errors[5:])) < 2.0
    assert fused.late.delay_s == pytest.approx(LATE_S, abs=0.01)


def test_a_place_found_with_a_delay_that_is_open_is_turned_back_for_joints_in_time() -> None:
    state, track = with_late_joints(found_state(), 0.09, 0.07), track_at(3_200_000_000)
    first = found_in_swing(state, Found(NOBODY, RATE_RAD_S, track, 0.07), LEVER).states[0]
    turned = float(np.diff(track.at([0.07, 0.0]))[0])
    assert (first.mean[DELAY], first.late.sigma_s) == (0.0, 0.0)
    assert first.mean[HEADING] == pytest.approx(state.mean[HEADING] - turned)


@pytest.mark.parametrize(('seconds', 'inflated'), [(2.8, True), (3.8, True), (30.0, False)])
def test_joints_are_uncertain_where_the_pan_turned_shortly_before(
    seconds: float, inflated: bool
) -> None:
    """After 3.8 s the pan turns back: it stands for a moment."""
    track = track_at(round(1e9 * seconds))
    found = Found(NOBODY, float(np.diff(track.at([-0.01, 0.01]))[0]) / 0.02, track)
    start = start_estimate(np.array([0.01, 0.01, 0.005]))
    assert joints_in_doubt(start, found, JointDelay(), None) == inflated
    assert not joints_in_doubt(start, found, JointDelay(0.2, 0.001), None)


@pytest.mark.parametrize(('rate_rad_s', 'inflated'), [(0.13, True), (-0.4, True), (0.01, False)])
def test_a_slow_swing_leaves_joints_uncertain_as_well(rate_rad_s: float, inflated: bool) -> None:
    """0.2 s late, the first makes the heading 1.5 deg off, which is claimed to 0.05 deg."""
    start = start_estimate(np.array([0.003, 0.003, 0.001]))
    found = Found(NOBODY, rate_rad_s)
    assert joints_in_doubt(start, found, JointDelay(), None) == inflated


@pytest.mark.parametrize('turns', [True, False])
def test_landmarks_that_go_out_of_sight_in_a_swing_flag_the_joints(turns: bool) -> None:
    fused, reported, sigmas = started(), [], []
    run(fused, 40)
    for k, moment in enumerate(drive(52)):
        if k <= 40:
            continue
        fused.add_odometry(moment.odometry)
        if k % EVERY == 0:
            nothing = measurement(moment, k).chosen(np.zeros(4, dtype=np.bool_))
            rate = RATE_RAD_S if turns else 0.0
            fused.add_detections(replace(nothing, missed=MAP.ids, pan_rate_rad_s=rate))
            reported.append(fused.status)
            sigmas.append(fused.late.sigma_s)
    assert reported[0] == ('tracking', '')
    assert sigmas[0] == 0.0
    # Two in a row are no chance; and they are flagged once.
    assert (reported[1][0] == 'coasting') == turns
    assert ('joint_states are late' in reported[1][1]) == turns
    assert (sigmas[1] > 0.05) == turns
    assert sigmas[-1] == pytest.approx(sigmas[1])
    fused.add_detections(measurement(moment, k))
    assert fused.status == ('tracking', '')


@pytest.mark.parametrize('landmarks', ['consider', 'refine'])
def test_a_slow_swing_after_that_does_not_make_a_wrong_heading_sure(landmarks: str) -> None:
    """At a constant rate nothing distinguishes late joints from a robot that turned."""
    fused, rate = started(FusionConfig(landmarks=landmarks)), 0.06
    run(fused, 40)
    for k, moment in enumerate(drive(200)):
        if k <= 40:
            continue
        fused.add_odometry(moment.odometry)
        seen = measurement(moment, k, np.full(4, -LATE_S * rate))
        if k < 100 and k % EVERY == 0:
            nothing = seen.chosen(np.zeros(4, dtype=np.bool_))
            fused.add_detections(replace(nothing, missed=MAP.ids, pan_rate_rad_s=RATE_RAD_S))
        elif k % EVERY == 0:
            fused.add_detections(replace(seen, pan_rate_rad_s=rate))
            found = fused.estimate()
            assert found is not None
            error = error_of(found, moment.pose)[2]
            assert fused.status[0] != 'tracking' or error**2 < 9.0 * found.covariance[2, 2]


def test_what_is_uncertain_is_not_flagged_again() -> None:
    once = seen_in_swing(Mixture((found_state(),)))
    assert len(once.states) == 6
    assert once.weights.sum() == pytest.approx(1.0)
    assert seen_in_swing(once) is once
    many = seen_in_swing(Mixture((found_state(),) * 12, np.full(12, 1.0 / 12.0)))
    assert len(many.states) == 12
    assert many.weights.sum() == pytest.approx(1.0)
    assert (np.diff(many.weights) <= 0.0).all()


def test_a_place_found_again_leaves_covariances_that_can_be() -> None:
    """What was learned of camera and joints goes together, and is carried over to the place."""
    state, sigmas = found_state(), np.array([0.02, 0.001])
    covariance = state.covariance.copy()
    which = np.ix_([BORESIGHT, DELAY], [BORESIGHT, DELAY])
    covariance[which] = np.outer(sigmas, sigmas) * [[1.0, 0.95], [0.95, 1.0]]
    place = start_estimate(np.array([0.01, 0.01, 0.005]))
    again = moved_to(replace(state, covariance=covariance), place)
    for rate_rad_s in (0.0, -1.0, RATE_RAD_S):
        for part in found_in_swing(again, Found(NOBODY, rate_rad_s), LEVER).states:
            scale = np.sqrt(np.diag(part.covariance)) + 1e-12
            assert np.linalg.eigvalsh(part.covariance / np.outer(scale, scale))[0] > -1e-9
