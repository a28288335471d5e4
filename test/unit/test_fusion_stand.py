"""Robots that stand, and odometry that says so of those that do not."""

from __future__ import annotations

from dataclasses import replace

from filter_runs import MAP, SIGMA, started
from fusion_drives import detections, error_of, PERIOD_NS, START
import numpy as np
import pytest

from landmark_nav.arrays import FloatArray
from landmark_nav.geometry.se2 import compose
from landmark_nav.localization.fusion import FusionConfig, PoseFilter
from landmark_nav.types import OdometrySample, PoseEstimate

# An image with each second sample of an odometry that never moves.
IMAGE_NS = 2 * PERIOD_NS
EVENT = 10


def still(fused: PoseFilter, k: int) -> None:
    for j in (2 * k - 1, 2 * k):
        fused.add_odometry(OdometrySample(j * PERIOD_NS, np.zeros(3)))


def watch(
    fused: PoseFilter,
    pose: FloatArray,
    k: int,
    rng: np.random.Generator,
    off_rad: float = 0.0,
) -> tuple[FloatArray, float]:
    """Error (3,) of the pose and its NEES after image `k`, which a robot took at a pose."""
    still(fused, k)
    noise = rng.normal(0.0, SIGMA, 6) + off_rad
    places = (k + np.arange(6)) % 10
    fused.add_detections(detections(MAP, pose, k * IMAGE_NS, places, SIGMA, noise))
    found = fused.estimate()
    assert found is not None
    error = error_of(found, pose)
    return error, float(error @ np.linalg.solve(found.covariance, error))


def sigma_m(fused: PoseFilter) -> float:
    found = fused.estimate()
    assert found is not None
    return float(np.sqrt(np.trace(found.covariance[:2, :2])))


@pytest.mark.parametrize(('seed', 'landmarks'), [(0, 'consider'), (1, 'consider'), (0, 'refine')])
@pytest.mark.parametrize(
    'step', [(0.02, 0.0, 0.0), (0.0, 0.01, 0.02), (0.0, 0.0, 0.05), (-0.01, 0.0, -0.01)]
)
def test_a_robot_that_is_pushed_is_followed(
    step: tuple[float, float, float], seed: int, landmarks: str
) -> None:
    """Its wheels do not turn, or what they show hangs: nothing but images shows where it is."""
    rng, fused = np.random.default_rng(seed), started(FusionConfig(landmarks=landmarks))
    pose, reported = START, []
    for k in range(1, 60):
        pose = compose(pose, step) if EVENT <= k < 40 else pose
        error, nees = watch(fused, pose, k, rng)
        assert nees < 25.0
        if EVENT + 2 <= k < 40:
            reported.append(fused.status[1])
            assert np.hypot(*error[:2]) < 0.03
    assert np.mean(['odometry stands' in reason for reason in reported]) > 0.9
    # It is believed again when they agree that it stands.
    assert np.hypot(*error[:2]) < 0.015
    assert sigma_m(fused) < 0.02


@pytest.mark.parametrize('landmarks', ['consider', 'refine'])
@pytest.mark.parametrize(('seed', 'off_rad'), [(0, 0.03), (1, -0.03), (2, 0.01)])
def test_a_camera_that_is_displaced_does_not_carry_the_robot_away(
    off_rad: float, seed: int, landmarks: str
) -> None:
    """Then it drives 1 m on, by which landmarks show who was turned, it or the robot."""
    rng, fused = np.random.default_rng(seed), started(FusionConfig(landmarks=landmarks))
    for k in range(1, 40):
        error, nees = watch(fused, START, k, rng, off_rad if k >= EVENT else 0.0)
        assert nees < 25.0
        assert np.hypot(*error[:2]) < 0.03
    assert abs(error[2]) < 0.03
    state = fused.state
    assert state is not None
    assert not state.hangs
    assert sigma_m(fused) < 0.02
    for j in range(1, 51):
        way = np.array([0.02 * j, 0.0, 0.0])
        stamp_ns = (78 + j) * PERIOD_NS
        fused.add_odometry(OdometrySample(stamp_ns, way, 0.4))
        if j % 2 == 0:
            noise = rng.normal(0.0, SIGMA, 6) + off_rad
            pose, places = compose(START, way), (j // 2 + np.arange(6)) % 10
            fused.add_detections(detections(MAP, pose, stamp_ns, places, SIGMA, noise))
            found = fused.estimate()
            assert found is not None
            error = error_of(found, pose)
            assert error @ np.linalg.solve(found.covariance, error) < 25.0


def test_odometry_that_moves_on_is_believed() -> None:
    rng, fused, pose = np.random.default_rng(0), started(), START
    for k in range(1, 20):
        pose = compose(pose, [0.03, 0.0, 0.0]) if k >= EVENT else pose
        watch(fused, pose, k, rng)
    state = fused.state
    assert state is not None
    assert state.hangs
    before = sigma_m(fused)
    for j in range(1, 21):
        way = np.array([0.02 * j, 0.0, 0.0])
        fused.add_odometry(OdometrySample((38 + j) * PERIOD_NS, way, 0.4))
    state = fused.state
    assert state is not None
    assert not state.hangs
    # The first sample shows that it moves again, not since when.
    assert sigma_m(fused) < before + 0.15
    np.testing.assert_allclose(state.mean[:2], compose(pose, way)[:2], atol=0.05)


@pytest.mark.parametrize('count', [1, 2])
def test_few_mistaken_bearings_do_not_carry_a_robot_away(count: int) -> None:
    rng, fused = np.random.default_rng(0), started()
    for k in range(1, 30):
        if k < EVENT:
            watch(fused, START, k, rng)
            continue
        still(fused, k)
        wrong = (rng.uniform(0.05, 0.3, 2) * [1.0, -1.0])[:count]
        places = [k % 10, (k + 3) % 10][:count]
        fused.add_detections(detections(MAP, START, k * IMAGE_NS, places, SIGMA, wrong))
        state = fused.state
        assert state is not None
        assert not state.hangs
        assert np.hypot(*(state.mean[:2] - START[:2])) < 0.02


def test_images_that_agree_flag_no_stand() -> None:
    rng, fused = np.random.default_rng(0), started()
    for k in range(1, 200):
        watch(fused, START, k, rng)
        assert fused.status == ('tracking', '')
        state = fused.state
        assert state is not None
        assert not state.hangs
        assert state.still_s == 0.0


def test_poses_follow_a_robot_that_is_pushed() -> None:
    rng, fused, pose = np.random.default_rng(0), started(FusionConfig(mode='poses')), START
    covariance = np.diag(np.square([0.01, 0.01, 0.003]))
    for k in range(1, 60):
        pose = compose(pose, [0.03, 0.0, 0.0]) if EVENT <= k < 40 else pose
        still(fused, k)
        measured = pose + rng.multivariate_normal(np.zeros(3), covariance)
        fused.add_pose(PoseEstimate(k * IMAGE_NS, measured, covariance))
        found = fused.estimate()
        assert found is not None
        error = error_of(found, pose)
        assert error @ np.linalg.solve(found.covariance, error) < 25.0
        if k == 39:
            assert 'odometry stands' in fused.status[1]
            assert np.hypot(*error[:2]) < 0.06
    assert np.hypot(*error[:2]) < 0.03


def test_poses_of_a_camera_that_is_displaced_leave_the_heading_open() -> None:
    rng, fused = np.random.default_rng(0), started(FusionConfig(mode='poses'))
    covariance = np.diag(np.square([0.01, 0.01, 0.001]))
    for k in range(1, 40):
        still(fused, k)
        off = np.array([0.0, 0.0, 0.03 if k >= EVENT else 0.0])
        measured = START + off + rng.multivariate_normal(np.zeros(3), covariance)
        fused.add_pose(PoseEstimate(k * IMAGE_NS, measured, covariance))
        found = fused.estimate()
        assert found is not None
        error = error_of(found, START)
        assert error @ np.linalg.solve(found.covariance, error) < 25.0


@pytest.mark.parametrize('anew', ['start', 'map'])
def test_what_is_reported_while_a_stand_is_flagged_keeps_its_own_covariance(anew: str) -> None:
    rng, fused, pose = np.random.default_rng(0), started(), START
    for k in range(1, 20):
        pose = compose(pose, [0.02, 0.0, 0.03]) if k >= EVENT else pose
        watch(fused, pose, k, rng)
    for j in range(1, 4):
        fused.add_odometry(OdometrySample((38 + j) * PERIOD_NS, np.zeros(3)))
    stamp_ns = 41 * PERIOD_NS
    if anew == 'start':
        reported = PoseEstimate(stamp_ns, pose, np.diag(np.square([0.02, 0.02, 0.01])))
        fused.initialize(reported)
    else:
        fused.change_map(MAP)
    noise = rng.normal(0.0, SIGMA, 6)
    update = fused.add_detections(detections(MAP, pose, stamp_ns, range(6), SIGMA, noise))
    assert update.degrees == 6
    found = fused.estimate(stamp_ns)
    assert found is not None
    assert np.linalg.eigvalsh(found.covariance)[0] > 0.0
    error = error_of(found, pose)
    assert error @ np.linalg.solve(found.covariance, error) < 25.0
    assert sigma_m(fused) < 0.03


def test_a_camera_that_is_covered_for_long_moves_no_robot_that_stands() -> None:
    """However long the history is in which images were of use."""
    rng, fused = np.random.default_rng(0), started(FusionConfig(history_s=1.0))
    for k in range(1, 80):
        if k < 40:
            watch(fused, START, k, rng)
            continue
        still(fused, k)
        seen = detections(MAP, START, k * IMAGE_NS, range(6), SIGMA)
        nothing = seen.chosen(np.zeros(6, dtype=np.bool_))
        fused.add_detections(replace(nothing, missed=MAP.ids))
        state = fused.state
        assert state is not None
        assert not state.hangs
        assert np.sqrt(np.trace(state.covariance[:2, :2])) < 0.02
