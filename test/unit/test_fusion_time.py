"""Measurements that are late, clocks that step, starts of other times."""

from __future__ import annotations

from filter_runs import EVERY, MAP, run, SIGMA, started
from fusion_drives import (
    detections,
    drive,
    error_of,
    MOUNT,
    PERIOD_NS,
    START,
    start_estimate,
)
import numpy as np
import pytest

from landmark_nav.localization.fusion import FusionConfig, PoseFilter
from landmark_nav.types import Detections, OdometrySample, PoseEstimate


class TestTime:
    def stream(self) -> list[tuple[int, OdometrySample | Detections]]:
        """Odometry, and bearings stamped between its samples, each with its stamp."""
        rng = np.random.default_rng(4)
        found: list[tuple[int, OdometrySample | Detections]] = []
        moments = list(drive(30))
        for k, moment in enumerate(moments):
            found.append((moment.odometry.stamp_ns, moment.odometry))
            if k % EVERY == 0 and k + 1 < len(moments):
                between = moment.odometry.stamp_ns + 13_000_000
                places = rng.choice(10, 4, replace=False)
                noise = rng.normal(0.0, SIGMA, 4)
                seen = detections(MAP, moment.pose, between, places, 0.01, noise)
                found.append((between, seen))
        return found

    def result(
        self, stream: list[tuple[int, OdometrySample | Detections]], landmarks: str
    ) -> PoseEstimate:
        fused = started(FusionConfig(landmarks=landmarks))
        for _, item in stream:
            if isinstance(item, OdometrySample):
                assert fused.add_odometry(item) is None
            else:
                assert fused.add_detections(item).refusal is None
        estimate = fused.estimate()
        assert estimate is not None
        return estimate

    @pytest.mark.parametrize('landmarks', ['consider', 'refine'])
    @pytest.mark.parametrize('delay_ns', [45_000_000, 130_000_000, 700_000_000])
    def test_late_bearings_count_as_in_order(self, delay_ns: int, landmarks: str) -> None:
        stream = self.stream()
        late = sorted(
            stream, key=lambda item: item[0] + delay_ns * isinstance(item[1], Detections)
        )
        assert [k for k, _ in late] != [k for k, _ in stream]
        in_order, delayed = self.result(stream, landmarks), self.result(late, landmarks)
        np.testing.assert_allclose(delayed.pose, in_order.pose, atol=1e-9)
        np.testing.assert_allclose(delayed.covariance, in_order.covariance, atol=1e-12)

    @pytest.mark.parametrize('moved_m', [0.0, 0.1])
    def test_a_late_image_that_contradicts_a_stand_counts_as_in_order(
        self, moved_m: float
    ) -> None:
        """A camera is displaced, or a robot is pushed as well, that stands as odometry says."""
        found = []
        for late in (0, 3):
            rng, fused = np.random.default_rng(0), started()
            for k in range(28):
                fused.add_odometry(OdometrySample(k * PERIOD_NS, np.zeros(3)))
                seen = k - late
                if seen >= 0 and seen % EVERY == 0:
                    displaced = seen == 20
                    pose = START + moved_m * displaced * np.array([1.0, 0.0, 0.0])
                    noise = rng.normal(0.0, SIGMA, 4) + 0.03 * displaced
                    places = (seen + np.arange(4)) % 10
                    fused.add_detections(
                        detections(MAP, pose, seen * PERIOD_NS, places, SIGMA, noise)
                    )
                if seen == 20:
                    break
            for j in range(k + 1, 25):
                fused.add_odometry(OdometrySample(j * PERIOD_NS, np.zeros(3)))
            found.append(fused.estimate(24 * PERIOD_NS))
        in_order, delayed = found
        assert in_order is not None
        assert delayed is not None
        # It is not known any more where the robot goes.
        assert in_order.covariance[0, 0] > 0.1**2
        np.testing.assert_allclose(delayed.pose, in_order.pose, atol=1e-9)
        np.testing.assert_allclose(delayed.covariance, in_order.covariance, atol=1e-9)

    def test_too_late(self) -> None:
        fused = started(FusionConfig(history_s=0.5))
        moment, _ = run(fused, 40)
        update = fused.add_detections(detections(MAP, moment.pose, 0, [1, 2, 3], SIGMA))
        assert update.refusal is not None
        assert 'too late' in str(update.refusal)

    def test_estimate_between_and_beyond(self) -> None:
        fused = started()
        moments = list(drive(20))
        for moment in moments:
            fused.add_odometry(moment.odometry)
        between = fused.estimate(moments[-2].odometry.stamp_ns + PERIOD_NS // 2)
        middle = 0.5 * (moments[-2].pose + moments[-1].pose)
        np.testing.assert_allclose(error_of(between, middle)[:2], 0.0, atol=1e-4)
        ahead = fused.estimate(moments[-1].odometry.stamp_ns + PERIOD_NS)
        *_, next_moment = drive(21)
        np.testing.assert_allclose(error_of(ahead, next_moment.pose), 0.0, atol=2e-3)
        assert fused.estimate().stamp_ns == moments[-1].odometry.stamp_ns  # type: ignore[union-attr]

    def test_covariance_grows_when_odometry_stops(self) -> None:
        fused = started()
        moment, _ = run(fused, 20)
        spread = []
        for seconds in (0, 1, 3):
            later = fused.estimate(moment.odometry.stamp_ns + seconds * 10**9)
            assert later is not None
            spread.append(np.trace(later.covariance[:2, :2]))
        assert spread[1] > 10.0 * spread[0]
        assert spread[2] > 2.0 * spread[1]

    def test_clock_set_back(self) -> None:
        fused = started()
        moment, _ = run(fused, 100)
        before = fused.estimate()
        assert before is not None
        refusal = fused.add_odometry(OdometrySample(10**9, np.zeros(3)))
        assert refusal is not None
        assert 'clock' in str(refusal)
        after = fused.estimate()
        assert after is not None
        assert after.stamp_ns == 10**9
        np.testing.assert_array_equal(after.pose, before.pose)
        assert np.all(np.diag(after.covariance) > np.diag(before.covariance))
        update = fused.add_detections(detections(MAP, moment.pose, 10**9, [0, 1, 2, 3], SIGMA))
        assert update.refusal is None

    def test_start_pose_with_another_clock_holds_now(self) -> None:
        fused = PoseFilter(MAP, MOUNT)
        for moment in drive(20):
            fused.add_odometry(moment.odometry)
        fused.initialize(start_estimate(stamp_ns=10**18))
        estimate = fused.estimate()
        assert estimate is not None
        assert estimate.stamp_ns == moment.odometry.stamp_ns
        # Where odometry has been silent since, now is later.
        now_ns = moment.odometry.stamp_ns + 5 * 10**9
        for stamp_ns in (now_ns, 10**18):
            fused.initialize(start_estimate(stamp_ns=stamp_ns), now_ns)
            reported = fused.estimate(now_ns)
            assert reported is not None
            assert reported.stamp_ns == now_ns
            np.testing.assert_allclose(reported.covariance, start_estimate().covariance, atol=1e-9)
        status, reason = fused.status_at(now_ns)
        assert status == 'coasting'
        assert 'no odometry for 5.0 s' in reason
        status, reason = fused.status_at(now_ns + 20 * 10**9)
        assert status == 'lost'
        assert 'sigma' in reason
        assert 'no odometry for 25.0 s' in reason
        early = PoseFilter(MAP, MOUNT)
        early.initialize(start_estimate(stamp_ns=10**18))
        for moment in drive(20):
            early.add_odometry(moment.odometry)
        assert error_of(early.estimate(), moment.pose) == pytest.approx(np.zeros(3), abs=1e-6)

    def test_a_start_of_long_ago_holds_now(self) -> None:
        fused = PoseFilter(MAP, MOUNT)
        for k in range(2000):
            fused.add_odometry(OdometrySample(k * 10**8, np.array([0.01 * k, 0.0, 0.0])))
        fused.initialize(start_estimate(stamp_ns=10**9))
        estimate = fused.estimate()
        assert estimate is not None
        assert estimate.stamp_ns == 1999 * 10**8
        np.testing.assert_array_equal(estimate.pose, start_estimate(stamp_ns=0).pose)
        assert fused.status[0] == 'tracking'

    def test_start_pose_is_not_undone_by_what_came_before_it(self) -> None:
        fused = started()
        moment, _ = run(fused, 40)
        given = PoseEstimate(moment.odometry.stamp_ns, START + 1.0, np.eye(3) * 1e-4)
        fused.initialize(given)
        old = detections(MAP, moment.pose, moment.odometry.stamp_ns - 10**8, [1, 2, 3], SIGMA)
        assert fused.add_detections(old).refusal is not None
        np.testing.assert_array_equal(error_of(fused.estimate(), given.pose), 0.0)
