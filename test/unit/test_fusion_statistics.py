"""Whether the filter's covariance shows the truth: NEES over drives that follow its model."""

from __future__ import annotations

from dataclasses import replace

from fusion_drives import (
    as_surveyed,
    detections,
    drive,
    error_of,
    landmark_map,
    MOUNT,
    nees_of,
    PERIOD_NS,
    SPEED_M_S,
    start_estimate,
    START_SIGMA,
)
import numpy as np
import pytest
from scipy.stats import chi2

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.fusion import FusionConfig, PoseFilter
from landmark_nav.localization.fusion.state import BORESIGHT, HEADING
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.localization.triangulation import triangulate
from landmark_nav.localization.triangulation.model import base_from_axis
from landmark_nav.types import Refusal

NOISE = OdometryNoiseConfig()
SIGMA = 1e-3
RUNS = 40


def one_run(
    seed: int,
    config: FusionConfig,
    steps: int = 100,
    repeated: float = 0.0,
    stays: bool = False,
    mount: PanTiltMount = MOUNT,
) -> tuple[float, float, float]:
    """
    NEES at the end, mean squared position error and mean NIS per degree of freedom.

    Detections of a landmark repeat so much of their variance; if the view stays, all images show
    the same four, and the map is exact.
    """
    rng = np.random.default_rng(seed)
    true_map = landmark_map(14, 1e-5, 1e-5, seed) if stays else landmark_map(14, seed=seed)
    surveyed = as_surveyed(true_map, rng)
    fused = PoseFilter(surveyed, mount, config, NOISE)
    fused.initialize(start_estimate(offset=rng.normal(0.0, START_SIGMA)))
    biases = tuple(float(b) for b in rng.normal(0.0, NOISE.bias_sigmas))
    squares, nis, degrees = [], 0.0, 0
    truth, lasting = np.zeros(3), rng.normal(0.0, np.sqrt(repeated) * SIGMA, 14)
    kept = np.exp(-4 * SPEED_M_S * PERIOD_NS * 1e-9 / config.repeat_length_m)
    for k, moment in enumerate(drive(steps, rng, NOISE, (biases[0], biases[1], biases[2]))):
        fused.add_odometry(moment.odometry)
        truth = moment.pose
        if k % 4 == 0:
            fresh = rng.normal(0.0, np.sqrt(repeated * (1.0 - kept**2)) * SIGMA, 14)
            lasting = kept * lasting + fresh
            first = 0 if stays else int(rng.integers(14))
            places = (first + np.arange(4)) % 14
            noise = rng.normal(0.0, mount.pan_sigma_rad) + lasting[places]
            noise += rng.normal(0.0, np.sqrt(1.0 - repeated) * SIGMA, 4)
            update = fused.add_detections(
                detections(true_map, truth, moment.odometry.stamp_ns, places, SIGMA, noise)
            )
            nis, degrees = nis + update.nis, degrees + update.degrees
            squares.append(np.sum(error_of(fused.estimate(), truth)[:2] ** 2))
    return nees_of(fused.estimate(), truth), float(np.mean(squares)), nis / degrees


@pytest.mark.parametrize('landmarks', ['consider', 'refine'])
def test_nees_lies_in_its_interval(landmarks: str) -> None:
    config = FusionConfig(
        landmarks=landmarks,
        bearing_probability=0.99999,
        correlated_noise_fraction=0.0,
    )
    mount = replace(MOUNT, pan_sigma_rad=5e-4)
    results = np.array([one_run(seed, config, mount=mount) for seed in range(RUNS)])
    low, high = chi2.ppf([0.025, 0.975], 3 * RUNS) / RUNS
    assert low < results[:, 0].mean() < high
    assert results[:, 2].mean() == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize('landmarks', ['consider', 'refine'])
def test_what_measurements_repeat_is_counted_once(landmarks: str) -> None:
    """Given so, NEES and NIS are as they should be; taken as independent, the pose is too sure."""
    given = FusionConfig(
        landmarks=landmarks, correlated_noise_fraction=0.9, bearing_probability=0.99999
    )
    runs = np.array([one_run(k, given, 80, 0.9, True) for k in range(100)])
    check_consistent(runs[:, 0].tolist())
    assert runs[:, 2].mean() == pytest.approx(1.0, abs=0.2)
    independent = replace(given, correlated_noise_fraction=0.0)
    assert np.mean([one_run(k, independent, 80, 0.9, True)[0] for k in range(20)]) > 4.5


def learning_run(
    seed: int,
    key: int,
    wheels: float,
    claimed: float,
    measurements: float,
    count: int,
    config: FusionConfig | None = None,
    turns: float | None = None,
) -> tuple[PoseFilter, float]:
    """Drive with wheels and detections so many times as noisy as they claim; filter and NEES."""
    noisy = NOISE.scaled(wheels, wheels if turns is None else turns, wheels)
    rng = np.random.default_rng([seed, key])
    true_map = landmark_map(14, seed=seed)
    fused = PoseFilter(as_surveyed(true_map, rng), MOUNT, config, NOISE)
    fused.initialize(start_estimate(offset=rng.normal(0.0, START_SIGMA)))
    for k, moment in enumerate(drive(300, rng, noisy)):
        fused.add_odometry(moment.odometry)
        if k % 4 == 0:
            places = (int(rng.integers(14)) + np.arange(count)) % 14
            noise = measurements * rng.normal(0.0, claimed, count)
            noise += rng.normal(0.0, MOUNT.pan_sigma_rad)
            stamp = moment.odometry.stamp_ns
            fused.add_detections(detections(true_map, moment.pose, stamp, places, claimed, noise))
    return fused, nees_of(fused.estimate(), moment.pose)


def check_consistent(nees: list[float]) -> None:
    """The mean of independent runs lies where it does in 19 of 20 cases."""
    low, high = chi2.ppf([0.025, 0.975], 3 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high


@pytest.mark.parametrize('factor', [0.3, 2.0])
def test_how_noisy_the_wheels_are_is_learned(factor: float) -> None:
    runs = [learning_run(seed, 9, factor, 1e-4, 1.0, 6) for seed in range(16)]
    learned = [fused.odometry_noise for fused, _ in runs]
    found = [(noise.turn_rad_per_sqrt_m, noise.slip_sigma) for noise in learned]
    # Side slip is hard to see where the path is short: what is expected still has some say.
    wanted = np.log([factor * NOISE.turn_rad_per_sqrt_m, factor * NOISE.slip_sigma])
    off = np.exp(np.abs(np.log(found).mean(axis=0) - wanted))
    assert off[0] < 1.2
    assert off[1] < 1.8
    check_consistent([nees for _, nees in runs])


@pytest.mark.parametrize(('factor', 'at_least', 'at_most'), [(0.1, 0.0, 0.6), (3.0, 2.0, 4.0)])
def test_turns_are_learned_apart_from_the_way(
    factor: float, at_least: float, at_most: float
) -> None:
    runs = [learning_run(seed, 11, 1.0, 1e-4, 1.0, 6, turns=factor)[0] for seed in range(16)]
    found = [fused.odometry_noise for fused in runs]
    way = np.mean([np.log(noise.turn_rad_per_sqrt_m) for noise in found])
    turns = np.mean([np.log(noise.turn_rad_per_sqrt_rad) for noise in found])
    assert np.exp(way) == pytest.approx(NOISE.turn_rad_per_sqrt_m, rel=0.25)
    assert at_least < np.exp(turns) / NOISE.turn_rad_per_sqrt_rad < at_most


@pytest.mark.parametrize('factor', [0.5, 2.0])
@pytest.mark.parametrize(
    'config',
    # The latter with errors that do not repeat, as they are drawn here.
    [
        FusionConfig(landmarks='consider'),
        FusionConfig(landmarks='refine', correlated_noise_fraction=0.0),
    ],
)
def test_how_noisy_measurements_are_is_learned(factor: float, config: FusionConfig) -> None:
    runs = [learning_run(seed, 10, 1.0, 2e-3, factor, 8, config) for seed in range(8)]
    found = [fused.detection_sigma_factor for fused, _ in runs]
    assert np.exp(np.mean(np.log(found))) == pytest.approx(factor, rel=0.2)
    check_consistent([nees for _, nees in runs])


def test_a_few_lucky_detections_claim_little() -> None:
    """Four images without any error, in the worst case, leave the noise near what it was."""
    true_map = landmark_map(14)
    fused = PoseFilter(true_map, MOUNT, FusionConfig(), NOISE)
    fused.initialize(start_estimate())
    for k, moment in enumerate(drive(16)):
        fused.add_odometry(moment.odometry)
        if k % 4 == 0:
            stamp = moment.odometry.stamp_ns
            fused.add_detections(detections(true_map, moment.pose, stamp, [0, 3, 6, 9], 3e-4))
    assert 0.5 < fused.detection_sigma_factor < 1.0


@pytest.mark.parametrize(('sigmas', 'displaced'), [(4.3, False), (8.0, True)])
def test_a_slip_of_the_wheels_is_not_taken_for_a_knock(sigmas: float, displaced: bool) -> None:
    """All bearings are off by one angle: a little more than wheels err, or far more."""
    exact = landmark_map(14, shared=1e-5, own=1e-4)
    fused = PoseFilter(
        exact, replace(MOUNT, pan_sigma_rad=1e-5), odometry=NOISE.scaled(1.0, 1.0, 1.0)
    )
    fused.initialize(start_estimate())
    places = np.arange(8)
    *moments, last = drive(60)
    for moment in moments:
        fused.add_odometry(moment.odometry)
        stamp = moment.odometry.stamp_ns
        fused.add_detections(detections(exact, moment.pose, stamp, places, 1e-4))
    before = fused.state
    fused.add_odometry(last.odometry)
    expected = fused.estimate()
    assert before is not None
    assert expected is not None
    off = sigmas * np.sqrt(expected.covariance[2, 2])
    stamp = last.odometry.stamp_ns
    update = fused.add_detections(detections(exact, last.pose, stamp, places, 1e-4, off))
    after = fused.state
    assert after is not None
    assert update.degrees == len(places)
    assert (update.turned_rad != 0.0) == displaced
    grown = np.sqrt(np.diag(after.covariance) / (np.diag(before.covariance) + 1e-12))
    assert (grown[BORESIGHT] > 100.0) == displaced
    assert (grown[HEADING] > 10.0) == displaced


@pytest.mark.parametrize('landmarks', ['consider', 'refine'])
def test_landmarks_that_are_seen_again_after_long_repeat_their_errors(landmarks: str) -> None:
    """The pose is wide then: nothing is estimated, and what they are off by does not average."""
    nees = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        true_map = landmark_map(14, 1e-5, 0.2, seed)
        config = FusionConfig(landmarks=landmarks, correlated_noise_fraction=0.0)
        fused = PoseFilter(as_surveyed(true_map, rng), MOUNT, config, NOISE)
        fused.initialize(start_estimate(offset=rng.normal(0.0, START_SIGMA)))
        for k, moment in enumerate(drive(900, rng, NOISE)):
            fused.add_odometry(moment.odometry)
            # Seen for a moment, out of sight for 15 m, then seen again.
            if k % 4 == 0 and (k < 40 or k > 600):
                noise = rng.normal(0.0, SIGMA, 4)
                stamp = moment.odometry.stamp_ns
                fused.add_detections(
                    detections(true_map, moment.pose, stamp, range(4), SIGMA, noise)
                )
        nees.append(nees_of(fused.estimate(), moment.pose))
    check_consistent(nees)


@pytest.mark.parametrize('wheels', [1.0, 0.3])
def test_the_pose_never_claims_more_than_what_landmarks_share(wheels: float) -> None:
    """However exact the odometry is, and however far the robot drives."""
    nees = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        true_map, noise = landmark_map(14, 0.03, 0.005, seed), NOISE.scaled(wheels, wheels, wheels)
        fused = PoseFilter(as_surveyed(true_map, rng), MOUNT, odometry=noise)
        fused.initialize(start_estimate(offset=rng.normal(0.0, START_SIGMA)))
        for k, moment in enumerate(drive(600, rng, noise)):
            fused.add_odometry(moment.odometry)
            if k % 4 == 0:
                places = (int(rng.integers(14)) + np.arange(4)) % 14
                off, stamp = rng.normal(0.0, SIGMA, 4), moment.odometry.stamp_ns
                fused.add_detections(detections(true_map, moment.pose, stamp, places, SIGMA, off))
        final = fused.estimate()
        assert final is not None
        assert np.sqrt(np.diag(final.covariance)[:2]).min() > 0.8 * 0.03
        nees.append(nees_of(final, moment.pose))
    check_consistent(nees)


def test_refining_the_map_is_worth_it() -> None:
    squares = [
        np.mean([one_run(seed, FusionConfig(landmarks=k))[1] for seed in range(12)])
        for k in ('consider', 'refine')
    ]
    assert squares[1] < squares[0]


def test_poses_of_frames_far_apart_are_fused_consistently() -> None:
    """Loose coupling can't know what two fixes share, so here the map is exact."""
    nees = []
    for seed in range(RUNS):
        rng = np.random.default_rng(seed)
        true_map = landmark_map(14, shared=1e-6, own=1e-6, seed=seed)
        fused = PoseFilter(true_map, MOUNT, FusionConfig(mode='poses'), NOISE)
        fused.initialize(start_estimate(offset=rng.normal(0.0, START_SIGMA)))
        for k, moment in enumerate(drive(60, rng, NOISE)):
            fused.add_odometry(moment.odometry)
            if k % 6 == 0:
                noise = rng.normal(0.0, SIGMA, 14)
                seen = detections(
                    true_map, moment.pose, moment.odometry.stamp_ns, range(14), SIGMA, noise
                )
                fix = triangulate(true_map.positions[:, :2], seen.bearing_rad, seen.variance_rad2)
                assert not isinstance(fix, Refusal)
                fused.add_pose(base_from_axis(fix.at(seen.stamp_ns), MOUNT))
        nees.append(nees_of(fused.estimate(), moment.pose))
    low, high = chi2.ppf([0.025, 0.975], 3 * RUNS) / RUNS
    # The biases are drawn as zero here, so the filter is a little cautious.
    assert low * 0.8 < np.mean(nees) < high


def test_dead_reckoning_covariance_is_that_of_many_drives() -> None:
    ends = []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        biases = rng.normal(0.0, NOISE.bias_sigmas)
        *_, last = drive(60, rng, NOISE, (biases[0], biases[1], biases[2]))
        ends.append(last.pose)
    fused = PoseFilter(landmark_map(3), MOUNT, odometry=NOISE)
    fused.initialize(start_estimate(sigmas=np.full(3, 1e-6)))
    for moment in drive(60):
        fused.add_odometry(moment.odometry)
    claimed = fused.estimate()
    assert claimed is not None
    spread = np.cov(np.array(ends).T)
    # The biases wander a little on the way, which the drives above do not.
    np.testing.assert_allclose(np.diag(spread), np.diag(claimed.covariance), rtol=0.25)


def test_repeated_measurements_never_claim_more_than_the_map() -> None:
    """What any number of perfect bearings from one place leaves open is the map's error."""
    true_map = landmark_map(6)
    still = OdometryNoiseConfig(floor_m_per_sqrt_s=0.0, floor_rad_per_sqrt_s=0.0)
    fused = PoseFilter(true_map, replace(MOUNT, pan_sigma_rad=0.0), odometry=still)
    fused.initialize(start_estimate(sigmas=np.array([0.3, 0.3, 0.2])))
    for moment in drive(0):
        fused.add_odometry(moment.odometry)
    for k in range(200):
        fused.add_detections(detections(true_map, moment.pose, k, [0, 2, 3, 5], 1e-4))
    estimate = fused.estimate()
    assert estimate is not None
    used = np.array([0, 2, 3, 5])
    axis = MOUNT.axis_pose_map(moment.pose)
    fix = triangulate(
        true_map.positions[used, :2],
        detections(true_map, moment.pose, 0, used, 1e-6).bearing_rad,
        np.full(4, 1e-12),
        true_map.joint_covariance_of(used),
    )
    assert not isinstance(fix, Refusal)
    np.testing.assert_allclose(fix.pose, axis, atol=1e-6)
    bound = base_from_axis(fix.at(0), MOUNT).covariance
    # 200 detections of 1e-4 rad and the start pose change the bound by less than that.
    assert np.linalg.eigvalsh(estimate.covariance - 0.99 * bound)[0] > 0.0
    assert np.trace(estimate.covariance[:2, :2]) < 1.2 * np.trace(bound[:2, :2])
