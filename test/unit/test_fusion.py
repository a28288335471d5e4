"""The filter recovers what is true, and its derivatives are right."""

from __future__ import annotations

from dataclasses import replace

from filter_runs import EVERY, EXACT, MAP, measurement, run, SIGMA, started
from fusion_drives import (
    bearings,
    detections,
    drive,
    error_of,
    MOUNT,
    START,
    start_estimate,
)
import numpy as np
import pytest

from landmark_nav.arrays import FloatArray
from landmark_nav.localization.fusion import FusionConfig, PoseFilter
from landmark_nav.localization.fusion.measurement import bearing_model
from landmark_nav.localization.fusion.noise import LEARNED, NoiseScales
from landmark_nav.localization.fusion.state import (
    BORESIGHT,
    initial_state,
    looking_again,
    propagate,
)
from landmark_nav.localization.odometry.noise import Motion, OdometryNoiseConfig
from landmark_nav.types import PoseEstimate


class TestRecovery:
    @pytest.mark.parametrize('landmarks', ['consider', 'refine'])
    def test_noiseless(self, landmarks: str) -> None:
        mount = replace(MOUNT, pan_sigma_rad=1e-7)
        fused = started(FusionConfig(landmarks=landmarks), EXACT, [0.03, -0.02, 0.01], mount)
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
                update = fused.add_detections(measurement(moment, k))
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
                fused.add_detections(measurement(moment, k))
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
                fused.add_detections(measurement(moment, k, turned))
        state = fused.state
        assert state is not None
        assert state.mean[BORESIGHT] == pytest.approx(turned, abs=np.radians(0.5))
        assert abs(error_of(fused.estimate(), moment.pose)[2]) < np.radians(0.5)

    def test_what_measurements_repeat_is_estimated_where_landmarks_are_refined(self) -> None:
        as_given = OdometryNoiseConfig(learning_sigma=0.0)
        fused = PoseFilter(EXACT, MOUNT, FusionConfig(landmarks='refine'), as_given)
        fused.initialize(PoseEstimate(0, START, 1e-14 * np.eye(3)))
        moment = next(drive(1))
        for k in range(20):
            fused.add_odometry(replace(moment.odometry, stamp_ns=k * 10**8))
            off = np.array([SIGMA, 0.0, 0.0, 0.0, 0.0])
            fused.add_detections(detections(EXACT, moment.pose, k * 10**8, range(5), SIGMA, off))
        assert fused.state is not None
        # Over the sigma of the share of a detection's error that others repeat.
        first, *others = fused.state.map_errors.repeated(np.arange(5))
        assert 0.8 < first < 1.0 / np.sqrt(FusionConfig().correlated_noise_fraction)
        assert np.abs(others).max() < 0.3 * first

    def test_what_was_seen_of_landmarks_is_forgotten_on_the_way(self) -> None:
        """Slowly what each is off by itself, soon what detections repeat, not what all share."""
        fused = started(FusionConfig(landmarks='estimate'), offset=[0.02, -0.01, 0.005])
        run(fused, 40)
        before = fused.state
        assert before is not None
        after = looking_again(replace(before, way_m=1.0), 0.5, 3.0)
        factors, kept = MAP.shared_loadings.shape[2], np.exp(-1.0 / np.array([3.0, 0.5]))
        shares = np.concatenate([np.ones(factors), np.tile(kept[[0, 0, 1]], 10)])
        np.testing.assert_allclose(
            after.map_errors.estimate, shares * before.map_errors.estimate, atol=1e-15
        )
        np.testing.assert_allclose(after.cross, shares * before.cross, atol=1e-15)
        assert after.way_m == 0.0
        assert np.abs(before.map_errors.estimate[factors:]).max() > 1e-3

    def test_a_new_start_forgets_what_was_seen_of_landmarks(self) -> None:
        fused = started(FusionConfig(landmarks='refine'), offset=[0.02, -0.01, 0.005])
        moment, _ = run(fused, 40)
        assert fused.state is not None
        assert fused.state.map_errors.estimate.any()
        fused.initialize(PoseEstimate(moment.odometry.stamp_ns, moment.pose, 1e-4 * np.eye(3)))
        assert not fused.state.map_errors.estimate.any()

    def test_slip_stays_as_large_as_given(self) -> None:
        config = OdometryNoiseConfig(learning_sigma=0.0)
        state = initial_state(start_estimate(), MAP, config, 0.0)
        for k in range(1, 6):
            motion = Motion(np.array([0.7, 0.0, 0.0]), 1.0)
            state = propagate(state, k * 10**9, motion, config)
        slip = BORESIGHT - 1
        assert np.sqrt(state.covariance[slip, slip]) == pytest.approx(config.slip_sigma)

    def test_beyond_the_odometry_it_may_have_sped_up(self) -> None:
        fused = started()
        moment, _ = run(fused, 40)
        stamp, ahead_s = moment.odometry.stamp_ns, 0.2
        at, ahead = fused.estimate(stamp), fused.estimate(stamp + round(ahead_s * 1e9))
        assert at is not None
        assert ahead is not None
        along = np.array([np.cos(ahead.pose[2]), np.sin(ahead.pose[2])])
        grown = along @ (ahead.covariance - at.covariance)[:2, :2] @ along
        # By half an acceleration times time squared.
        assert np.sqrt(grown) == pytest.approx(0.5 * 0.5 * ahead_s**2, rel=0.2)

    def test_how_noisy_it_is_is_forgotten_on_the_way(self) -> None:
        config = OdometryNoiseConfig()
        learned = NoiseScales(np.full(LEARNED + 1, 0.8), np.zeros((LEARNED + 1,) * 2))
        shares = [learned.moved(way_m, config).log_scale[0] / 0.8 for way_m in (0.0, 10.0, 1000.0)]
        assert shares[0] == 1.0
        assert 0.5 < shares[1] < 0.95
        assert shares[2] == pytest.approx(0.0, abs=1e-6)
        fresh = NoiseScales.unknown(config).covariance
        np.testing.assert_allclose(learned.moved(1000.0, config).covariance, fresh, atol=1e-6)

    def test_what_is_wrong_with_the_odometry_may_change_on_the_way(self) -> None:
        config = OdometryNoiseConfig()
        state = initial_state(start_estimate(), MAP, config, 0.0)
        known = replace(state, covariance=np.zeros_like(state.covariance))
        moved = propagate(known, 10**9, Motion(np.array([4.0, 0.0, 0.0]), 1.0), config)
        sigmas = np.sqrt(np.diag(moved.covariance)[3:6])
        np.testing.assert_allclose(
            sigmas, 2.0 * config.bias_change_per_sqrt_m * config.bias_sigmas
        )


class TestJacobians:
    def test_of_bearings(self) -> None:
        lever = np.array(MOUNT.axis_xyz[:2])
        sigmas = OdometryNoiseConfig()
        state = initial_state(start_estimate(), MAP, sigmas, 0.1)
        columns = np.array([1, 4, 7])
        measured = bearings(MAP, START)[columns]
        # With unit covariances and no noise the products are the Jacobians themselves.
        errors = replace(state.map_errors, own=np.broadcast_to(np.eye(2), (10, 2, 2)))
        unit = replace(state, covariance=np.eye(len(state.mean)), map_errors=errors)
        quiet, repeated = np.zeros(3), np.array([1e-3, 2e-3, 3e-3])
        model = bearing_model(unit, unit, columns, measured, quiet, repeated, 0.0, lever)
        step, count = 1e-6, len(errors.estimate)

        def expected(mean: FloatArray, off: FloatArray) -> FloatArray:
            at = replace(unit, mean=mean, map_errors=replace(errors, estimate=off))
            model = bearing_model(at, at, columns, measured, quiet, repeated, 0.0, lever)
            return -model.innovation

        for k in range(len(state.mean)):
            offset = np.zeros(len(state.mean))
            offset[k] = step
            change = expected(state.mean + offset, np.zeros(count))
            change -= expected(state.mean - offset, np.zeros(count))
            np.testing.assert_allclose(model.state_covariance[k], change / (2 * step), atol=1e-8)
        for k in range(count):
            offset = np.zeros(count)
            offset[k] = step
            change = expected(state.mean, offset) - expected(state.mean, -offset)
            np.testing.assert_allclose(
                model.considered_covariance[k], change / (2 * step), atol=1e-8
            )

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
        mean = state.mean + np.array(
            [0.0, 0.0, 0.0, 0.02, 0.1, -0.05, 0.03, 0.01, 0.02, 0.04, 0.06]
        )
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
