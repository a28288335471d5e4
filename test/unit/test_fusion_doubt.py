"""What the filter does not believe, and what it says of itself."""

from __future__ import annotations

from dataclasses import replace

from filter_runs import EVERY, EXACT, MAP, measurement, run, SIGMA, started
from fusion_drives import (
    detections,
    drive,
    error_of,
    Moment,
    MOUNT,
    PERIOD_NS,
    START,
    start_estimate,
)
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.se2 import compose
from landmark_nav.localization.fusion import FusionConfig, PoseFilter
from landmark_nav.localization.fusion.doubt import doubted_state
from landmark_nav.localization.fusion.state import initial_state
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.types import OdometrySample, PoseEstimate


class TestInflation:
    def test_a_pan_that_is_hardly_known_gives_the_place_but_not_the_heading(self) -> None:
        fused = started()
        moment, _ = run(fused, 60)
        before = fused.estimate()
        found = measurement(moment, 0, np.full(4, 0.02))
        update = fused.add_detections(replace(found, pan_sigma_rad=0.02))
        assert len(update.accepted_ids) == 4
        assert not update.turned_rad
        after = fused.estimate()
        assert before is not None
        assert after is not None
        np.testing.assert_allclose(after.pose, before.pose, atol=2e-3)
        assert fused.status[0] == 'tracking'

    def test_outlier_is_left_out(self) -> None:
        fused = started()
        moment, _ = run(fused, 40)
        update = fused.add_detections(measurement(moment, 1, [0.0, 0.05, 0.0, 0.0]))
        assert list(update.rejected) == [12]
        assert len(update.accepted_ids) == 3
        assert update.degrees == 3

    def test_a_pose_is_flagged_up_to_two_metres(self) -> None:
        state = initial_state(start_estimate(), MAP, OdometryNoiseConfig(), 0.0)
        sigmas = []
        for _ in range(200):
            state = doubted_state(state)
            sigmas.append(np.sqrt(np.trace(state.covariance[:2, :2])))
        assert sigmas[1] > sigmas[0] > 0.15
        assert 2.0 <= sigmas[-2] == sigmas[-1] < 2.1

    def test_what_makes_a_bearing_wrong_is_less_likely(self) -> None:
        fused = started()
        moment, _ = run(fused, 39)
        seen = measurement(moment, 1, [0.0, 0.05, 0.0, 0.0])
        with_it = fused.add_detections(seen)
        other = started()
        run(other, 39)
        without = other.add_detections(seen.chosen(np.array([True, False, True, True])))
        np.testing.assert_array_equal(with_it.accepted_ids, without.accepted_ids)
        assert with_it.log_likelihood < without.log_likelihood - 1.0

    def test_one_that_agrees_is_no_reason_to_be_lost(self) -> None:
        """After a mistaken one it takes two to be used, where two should be in view."""
        fused = started()
        moment, _ = run(fused, 40)
        stamp = moment.odometry.stamp_ns
        mistaken = fused.add_detections(detections(MAP, moment.pose, stamp, [1], SIGMA, 0.05))
        assert mistaken.contradicts
        for k in range(6):
            seen = detections(MAP, moment.pose, stamp + k + 1, [0], SIGMA)
            update = fused.add_detections(replace(seen, missed=MAP.ids[2:3]))
            assert update.refusal is not None
            assert not update.contradicts
        assert fused.status[0] == 'tracking'

    def test_one_that_agrees_makes_a_lost_pose_no_wider(self) -> None:
        fused = started()
        moment, _ = run(fused, 40)
        stamp = moment.odometry.stamp_ns
        for k in range(6):
            fused.add_detections(detections(MAP, moment.pose, stamp + k, [1], SIGMA, 0.05))
        assert fused.status[0] == 'lost'
        before = fused.state
        for k in range(3):
            seen = detections(MAP, moment.pose, stamp + 10 + k, [0], SIGMA)
            assert not fused.add_detections(replace(seen, missed=MAP.ids[2:3])).contradicts
        after = fused.state
        assert before is not None
        assert after is not None
        assert after.covariance[0, 0] < 1.01 * before.covariance[0, 0]

    @pytest.mark.parametrize(('score', 'used'), [(0.99, 3), (0.85, 0)])
    def test_few_among_many_missing_are_used_where_they_cannot_be_mistaken(
        self, score: float, used: int
    ) -> None:
        """Before a wall whose other posters were exchanged."""
        fused = started()
        moment, _ = run(fused, 40)
        stamp = moment.odometry.stamp_ns
        seen = detections(MAP, moment.pose, stamp, [0, 1, 2], SIGMA)
        missed = np.tile(MAP.ids[3:], 3)
        update = fused.add_detections(replace(seen, score=np.full(3, score), missed=missed))
        assert len(update.accepted_ids) == used

    def test_unusable_bearings(self) -> None:
        fused = started()
        moment = next(iter(drive(0)))
        seen = detections(MAP, moment.pose, 0, [0, 1, 2, 3, 3], SIGMA)
        broken = replace(
            seen,
            ids=np.array([10, 11, 12, 999, 10]),
            bearing_rad=seen.bearing_rad * [1.0, np.nan, 1.0, 1.0, 1.0],
            variance_rad2=seen.variance_rad2 * [1.0, 1.0, -1.0, 1.0, 1.0],
        )
        update = fused.add_detections(broken)
        np.testing.assert_array_equal(update.accepted_ids, [10])
        assert set(update.rejected) == {10, 11, 12, 999}
        assert np.isfinite(fused.estimate().pose).all()  # type: ignore[union-attr]

    def test_nothing_seen_is_no_contradiction(self) -> None:
        fused = started()
        for moment in drive(10):
            fused.add_odometry(moment.odometry)
            fused.add_detections(detections(MAP, moment.pose, moment.odometry.stamp_ns, [], SIGMA))
        assert fused.status[0] == 'tracking'

    def test_odometry_that_is_not_a_number(self) -> None:
        fused = started()
        moment, _ = run(fused, 20)
        stamp = moment.odometry.stamp_ns + PERIOD_NS
        refusal = fused.add_odometry(OdometrySample(stamp, np.array([np.nan, 0.0, 0.0])))
        assert refusal is not None
        assert np.isfinite(fused.estimate().pose).all()  # type: ignore[union-attr]

    def test_odometry_that_jumps(self) -> None:
        fused = started()
        moment = Moment(OdometrySample(0, np.zeros(3)), START)
        for k, moment in enumerate(drive(100)):
            odometry = moment.odometry
            if k >= 50:
                odometry = replace(
                    odometry, pose_odom_base=odometry.pose_odom_base + np.array([7.0, 2.0, 0.0])
                )
            refusal = fused.add_odometry(odometry)
            assert (refusal is not None) == (k == 50)
            if k % EVERY == 0:
                assert fused.add_detections(measurement(moment, k)).refusal is None
        assert np.abs(error_of(fused.estimate(), moment.pose)).max() < 0.02

    def test_start_pose_must_be_numbers(self) -> None:
        fused = PoseFilter(MAP, MOUNT)
        with pytest.raises(LandmarkNavError, match='not a number'):
            fused.initialize(PoseEstimate(0, np.array([np.nan, 0.0, 0.0]), np.eye(3)))
        with pytest.raises(LandmarkNavError, match='positive'):
            fused.initialize(PoseEstimate(0, np.zeros(3), -np.eye(3)))


class TestStatus:
    def test_before_the_start(self) -> None:
        fused = PoseFilter(MAP, MOUNT)
        assert fused.status[0] == 'lost'
        assert fused.estimate() is None
        update = fused.add_detections(detections(MAP, START, 0, [0, 1, 2], SIGMA))
        assert update.refusal is not None
        assert 'not initialized' in str(update.refusal)

    def test_without_odometry_it_only_waits(self) -> None:
        fused = started()
        assert fused.status == ('coasting', 'no odometry yet')
        run(fused, 2)
        assert fused.status[0] == 'tracking'

    def test_coasting(self) -> None:
        fused = started()
        run(fused, 20)
        assert fused.status[0] == 'tracking'
        for k, moment in enumerate(drive(60)):
            if k > 20:
                fused.add_odometry(moment.odometry)
        status, reason = fused.status
        assert status == 'coasting'
        assert 'nothing accepted for' in reason
        fused.add_detections(measurement(moment, 0))
        assert fused.status[0] == 'tracking'

    @pytest.mark.parametrize('shift', [(1.0, 0.0, 0.0), (0.0, -0.5, 0.4), (0.3, 0.3, -0.3)])
    def test_kidnapped_robot_is_lost_and_found_again(
        self, shift: tuple[float, float, float]
    ) -> None:
        fused = started()
        run(fused, 40)
        moved = START + np.asarray(shift)
        states = []
        for k, moment in enumerate(drive(160, start=moved)):
            if k <= 40:
                continue
            fused.add_odometry(moment.odometry)
            if k % EVERY == 0:
                fused.add_detections(measurement(moment, k))
                states.append(fused.status[0])
                error = error_of(fused.estimate(), moment.pose)
                spread = fused.estimate().covariance  # type: ignore[union-attr]
                if len(states) > 5 and states[-1] == 'tracking':
                    assert error @ np.linalg.solve(spread, error) < 25.0
        # Said so within five images; sure again at the end.
        assert 'lost' in states[:6]
        assert states[-1] == 'tracking'
        assert np.hypot(*error[:2]) < 0.03

    @pytest.mark.parametrize('seen_once', [False, True])
    def test_images_that_go_blind_as_the_odometry_stands_flag_the_stand(
        self, seen_once: bool
    ) -> None:
        """They do not where one of that stand has been used: then the camera is to blame."""
        fused = started()
        moment, _ = run(fused, 61)
        for k in range(1, 13):
            stamp_ns = moment.odometry.stamp_ns + k * PERIOD_NS
            fused.add_odometry(OdometrySample(stamp_ns, moment.odometry.pose_odom_base))
            seen = detections(MAP, moment.pose, stamp_ns, range(8), SIGMA)
            if k == EVERY and seen_once:
                fused.add_detections(seen)
            elif k % EVERY == 0:
                nothing = seen.chosen(np.zeros(8, dtype=np.bool_))
                fused.add_detections(replace(nothing, missed=MAP.ids))
        found, (status, reason) = fused.estimate(), fused.status
        assert found is not None
        sigma_m = np.sqrt(np.trace(found.covariance[:2, :2]))
        if seen_once:
            assert status == 'tracking'
            assert sigma_m < 0.02
            return
        assert status == 'coasting'
        assert 'odometry stands' in reason
        assert 0.2 < sigma_m < 1.0
        # The next image that shows something shows where the robot went meanwhile.
        pose = compose(moment.pose, [0.2, 0.0, 0.4])
        update = fused.add_detections(detections(MAP, pose, stamp_ns, range(8), SIGMA))
        assert update.degrees == 8
        assert np.abs(error_of(fused.estimate(stamp_ns), pose)).max() < 0.02

    def test_images_that_were_blind_before_a_stand_state_nothing_of_it(self) -> None:
        """A robot that stops where nothing is to be seen knows where it is."""
        fused, sigmas, moments = started(), [], list(drive(140))
        run(fused, 61)
        stands = moments[70].odometry.pose_odom_base
        for k, moment in enumerate(moments[62:], 62):
            stamp_ns = moment.odometry.stamp_ns
            here = moment.odometry.pose_odom_base if k <= 70 else stands
            fused.add_odometry(replace(moment.odometry, pose_odom_base=here))
            if k % EVERY == 0:
                seen = detections(MAP, moment.pose, stamp_ns, range(8), SIGMA)
                nothing = seen.chosen(np.zeros(8, dtype=np.bool_))
                missed = MAP.ids if k <= 70 else MAP.ids[:0]
                fused.add_detections(replace(nothing, missed=missed))
            state = fused.state
            assert state is not None
            sigmas.append(np.sqrt(np.trace(state.covariance[:2, :2])))
        assert max(sigmas) < 0.05

    def test_wide_start_is_lost_until_seen(self) -> None:
        fused = PoseFilter(MAP, MOUNT)
        fused.initialize(start_estimate(sigmas=np.array([1.0, 1.0, 0.3])))
        status, reason = fused.status
        assert status == 'lost'
        assert 'sigma' in reason

    def test_innovations_that_stay_too_large(self) -> None:
        """A camera four times as noisy as it says, which is not to be learned."""
        rng = np.random.default_rng(0)
        as_given = OdometryNoiseConfig(learning_sigma=0.0)
        fused = PoseFilter(EXACT, MOUNT, FusionConfig(bearing_probability=1.0), as_given)
        fused.initialize(start_estimate())
        for k, moment in enumerate(drive(100)):
            fused.add_odometry(moment.odometry)
            if k % EVERY == 0:
                fused.add_detections(measurement(moment, k, rng.normal(0.0, 4.0 * SIGMA, 4)))
        status, reason = fused.status
        assert status == 'lost'
        assert 'innovations' in reason
        # What is claimed says so too: nodes that see no more than that search the place.
        assert np.trace(fused.estimate().covariance[:2, :2]) > 0.5**2  # type: ignore[union-attr]
        # It is over when they fit again.
        for k, moment in enumerate(drive(200)):
            if k > 100:
                fused.add_odometry(moment.odometry)
                if k % EVERY == 0:
                    fused.add_detections(measurement(moment, k))
        assert fused.status == ('tracking', '')
        assert np.trace(fused.estimate().covariance[:2, :2]) < 0.02**2  # type: ignore[union-attr]
