from __future__ import annotations

from dataclasses import replace

from fusion_drives import (
    bearings,
    detections,
    drive,
    error_of,
    landmark_map,
    Moment,
    MOUNT,
    PERIOD_NS,
    START,
    start_estimate,
)
import numpy as np
import numpy.typing as npt
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.localization.fusion import FusionConfig, PoseFilter
from landmark_nav.localization.fusion.state import (
    bearing_model,
    BORESIGHT,
    initial_state,
    propagate,
)
from landmark_nav.localization.fusion.update import FusionUpdate
from landmark_nav.localization.odometry.noise import Motion, OdometryNoiseConfig
from landmark_nav.types import Detections, LandmarkMap, OdometrySample, PoseEstimate

FloatArray = npt.NDArray[np.float64]

MAP = landmark_map(10)
EXACT = landmark_map(10, shared=1e-9, own=1e-9)
SIGMA = 5e-4
EVERY = 4


def started(
    config: FusionConfig | None = None, true_map: LandmarkMap = MAP, offset: npt.ArrayLike = 0.0
) -> PoseFilter:
    fused = PoseFilter(true_map, MOUNT, config)
    fused.initialize(start_estimate(offset=offset))
    return fused


def sighting(moment: Moment, k: int, noise: npt.ArrayLike = 0.0) -> Detections:
    places = (k + np.array([0, 1, 3, 4])) % 10
    return detections(MAP, moment.pose, moment.odometry.stamp_ns, places, SIGMA, np.asarray(noise))


def run(fused: PoseFilter, steps: int, first: int = 0) -> tuple[Moment, list[FusionUpdate]]:
    """Drive on with perfect odometry and bearings; the last moment and what became of each."""
    updates = []
    for k, moment in enumerate(drive(steps)):
        if k < first:
            continue
        fused.add_odometry(moment.odometry)
        if k % EVERY == 0:
            updates.append(fused.add_detections(sighting(moment, k)))
    return moment, updates


class TestRecovery:
    @pytest.mark.parametrize('landmarks', ['consider', 'refine'])
    def test_noiseless(self, landmarks: str) -> None:
        fused = started(
            FusionConfig(landmarks=landmarks, pan_sigma_rad=1e-7), EXACT, [0.03, -0.02, 0.01]
        )
        for k, moment in enumerate(drive(40)):
            fused.add_odometry(moment.odometry)
            if k % EVERY == 0:
                seen = detections(EXACT, moment.pose, moment.odometry.stamp_ns, range(8), 1e-7)
                assert fused.add_detections(seen).refusal is None
        np.testing.assert_allclose(error_of(fused.estimate(), moment.pose), 0.0, atol=1e-6)
        assert fused.status == ('tracking', '')

    @pytest.mark.parametrize('heading', [np.pi - 0.01, -np.pi + 0.01])
    def test_across_the_seam_of_headings(self, heading: float) -> None:
        start = np.array([3.0, 2.0, heading])
        fused = PoseFilter(MAP, MOUNT)
        fused.initialize(
            PoseEstimate(0, start + np.array([0.0, 0.0, 0.02]), np.diag([0.02, 0.02, 0.03]) ** 2)
        )
        for k, moment in enumerate(drive(60, start=start)):
            fused.add_odometry(moment.odometry)
            if k % EVERY == 0:
                update = fused.add_detections(sighting(moment, k))
                assert not update.rejected
        assert np.abs(error_of(fused.estimate(), moment.pose)).max() < 5e-3

    def test_one_bearing_at_a_time(self) -> None:
        fused = started(offset=[0.02, 0.02, 0.01])
        for k, moment in enumerate(drive(80)):
            fused.add_odometry(moment.odometry)
            if k % 2 == 0:
                stamp = moment.odometry.stamp_ns
                fused.add_detections(detections(MAP, moment.pose, stamp, [k % 10], SIGMA))
        assert np.abs(error_of(fused.estimate(), moment.pose)).max() < 0.01

    def test_learns_what_is_wrong_with_the_odometry(self) -> None:
        fused = started(true_map=EXACT)
        biases = (-0.03, 0.015, 0.02)
        for k, moment in enumerate(drive(400, biases=biases)):
            fused.add_odometry(moment.odometry)
            if k % EVERY == 0:
                fused.add_detections(sighting(moment, k))
        state = fused.state
        assert state is not None
        spread = np.sqrt(np.diag(state.covariance))[3:6]
        assert np.all(np.abs(state.mean[3:6] - biases) < 3.0 * spread)
        assert np.all(spread[:2] < 0.5 * OdometryNoiseConfig().bias_sigmas[:2])

    def test_learns_how_the_camera_sits(self) -> None:
        fused = started(FusionConfig(boresight_sigma_rad=0.05), EXACT)
        turned = np.radians(2.0)
        for k, moment in enumerate(drive(300)):
            fused.add_odometry(moment.odometry)
            if k % EVERY == 0:
                fused.add_detections(sighting(moment, k, turned))
        state = fused.state
        assert state is not None
        assert state.mean[BORESIGHT] == pytest.approx(turned, abs=np.radians(0.5))
        assert abs(error_of(fused.estimate(), moment.pose)[2]) < np.radians(0.5)


class TestJacobians:
    def test_of_bearings(self) -> None:
        lever = np.array(MOUNT.axis_xyz[:2])
        sigmas = OdometryNoiseConfig()
        state = initial_state(start_estimate(), MAP, sigmas, 0.1)
        columns = np.array([1, 4, 7])
        measured = bearings(MAP, START)[columns]
        # With unit covariances and no noise the products are the Jacobians themselves.
        unit = replace(state, covariance=np.eye(len(state.mean)), landmark_covariance=np.eye(20))
        model = bearing_model(unit, unit, columns, measured, np.zeros(3), 0.0, lever)
        step = 1e-6

        def expected(mean: FloatArray, landmarks: FloatArray) -> FloatArray:
            at = replace(unit, mean=mean, landmarks=landmarks)
            return -bearing_model(at, at, columns, measured, np.zeros(3), 0.0, lever).innovation

        for k in range(len(state.mean)):
            offset = np.zeros(len(state.mean))
            offset[k] = step
            change = expected(state.mean + offset, state.landmarks)
            change -= expected(state.mean - offset, state.landmarks)
            np.testing.assert_allclose(model.state_covariance[k], change / (2 * step), atol=1e-8)
        for k in range(20):
            offset = np.zeros(20)
            offset[k] = step
            change = expected(state.mean, state.landmarks + offset.reshape(-1, 2))
            change -= expected(state.mean, state.landmarks - offset.reshape(-1, 2))
            np.testing.assert_allclose(model.map_covariance[k], change / (2 * step), atol=1e-8)

    def test_of_motion(self) -> None:
        quiet = OdometryNoiseConfig(
            along_m_per_sqrt_m=0.0,
            across_m_per_sqrt_m=0.0,
            turn_rad_per_sqrt_m=0.0,
            turn_rad_per_sqrt_rad=0.0,
            floor_m_per_sqrt_s=0.0,
            floor_rad_per_sqrt_s=0.0,
            bias_change_per_sqrt_m=0.0,
            slip_sigma=0.0,
        )
        motion = Motion(np.array([0.3, 0.05, 0.4]), 0.1)
        state = initial_state(start_estimate(), MAP, quiet, 0.1)
        mean = state.mean + np.array([0.0, 0.0, 0.0, 0.02, 0.1, -0.05, 0.03, 0.01, 0.02])
        n = len(mean)
        root = np.random.default_rng(0).normal(size=(n, n))
        state = replace(state, mean=mean, covariance=root @ root.T)
        moved = propagate(state, 10**8, motion, quiet)
        jacobian = np.empty((n, n))
        for k in range(n):
            offset = np.zeros(n)
            offset[k] = 1e-6
            ahead = propagate(replace(state, mean=mean + offset), 10**8, motion, quiet).mean
            behind = propagate(replace(state, mean=mean - offset), 10**8, motion, quiet).mean
            jacobian[:, k] = (ahead - behind) / 2e-6
        np.testing.assert_allclose(
            moved.covariance, jacobian @ state.covariance @ jacobian.T, atol=1e-6
        )


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
            told = fused.estimate(now_ns)
            assert told is not None
            assert told.stamp_ns == now_ns
            np.testing.assert_allclose(told.covariance, start_estimate().covariance, atol=1e-9)
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


class TestDoubt:
    def test_a_pan_that_is_hardly_known_tells_the_place_but_not_the_heading(self) -> None:
        fused = started()
        moment, _ = run(fused, 60)
        before = fused.estimate()
        found = sighting(moment, 0, np.full(4, 0.02))
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
        update = fused.add_detections(sighting(moment, 1, [0.0, 0.05, 0.0, 0.0]))
        assert list(update.rejected) == [12]
        assert len(update.accepted_ids) == 3
        assert update.degrees == 3

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
                assert fused.add_detections(sighting(moment, k)).refusal is None
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
        assert fused.status == ('coasting', 'no odometry')
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
        fused.add_detections(sighting(moment, 0))
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
                fused.add_detections(sighting(moment, k))
                states.append(fused.status[0])
                error = error_of(fused.estimate(), moment.pose)
                spread = fused.estimate().covariance  # type: ignore[union-attr]
                if len(states) > 5 and states[-1] == 'tracking':
                    assert error @ np.linalg.solve(spread, error) < 25.0
        # Said so within five pictures; sure again at the end.
        assert 'lost' in states[:6]
        assert states[-1] == 'tracking'
        assert np.hypot(*error[:2]) < 0.03

    def test_wide_start_is_lost_until_seen(self) -> None:
        fused = PoseFilter(MAP, MOUNT)
        fused.initialize(start_estimate(sigmas=np.array([1.0, 1.0, 0.3])))
        status, reason = fused.status
        assert status == 'lost'
        assert 'sigma' in reason

    def test_innovations_that_stay_too_large(self) -> None:
        """A camera four times as noisy as it says, which is not to be learned."""
        rng = np.random.default_rng(0)
        as_told = OdometryNoiseConfig(learning_sigma=0.0)
        fused = PoseFilter(EXACT, MOUNT, FusionConfig(bearing_probability=1.0), as_told)
        fused.initialize(start_estimate())
        for k, moment in enumerate(drive(100)):
            fused.add_odometry(moment.odometry)
            if k % EVERY == 0:
                fused.add_detections(sighting(moment, k, rng.normal(0.0, 4.0 * SIGMA, 4)))
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
                    fused.add_detections(sighting(moment, k))
        assert fused.status == ('tracking', '')
        assert np.trace(fused.estimate().covariance[:2, :2]) < 0.02**2  # type: ignore[union-attr]
