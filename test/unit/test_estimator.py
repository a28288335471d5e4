"""The joint estimator: derivatives, recovery of what is known, statistics, faults."""

from dataclasses import replace
from functools import cache

from builders import bare_landmark
from drawn_drives import CUPBOARD, driven, MOUNT, NS, point_map, sensed, simulated
import numpy as np
import pytest

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.geometry.angles import PanTrack
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.se2 import compose
from landmark_nav.localization.detection.expectation import HALF_PIXEL
from landmark_nav.localization.estimator import filter
from landmark_nav.localization.estimator.config import EstimatorConfig
from landmark_nav.localization.estimator.factors import (
    CALIBRATION,
    DELAY,
    image_points,
    ImagePoints,
    moved,
    project,
    STATES,
)
from landmark_nav.localization.estimator.filter import JointFilter
from landmark_nav.localization.estimator.integrity import protection_level
from landmark_nav.localization.estimator.moved_objects import exchanged, isotropic, STILL_M2
from landmark_nav.localization.estimator.timeline import Timeline
from landmark_nav.localization.odometry.noise import Motion, OdometryNoiseConfig
from landmark_nav.localization.odometry.track import OdometryTrack
from landmark_nav.types import LandmarkMap, OdometrySample, PoseEstimate, Refusal

POINTS = np.array([[3.0, 1.0, 1.0], [2.5, 2.0, 1.5], [4.0, 0.5, 1.2], [3.0, 3.0, 1.7]])
TAPE = Calibration.of_mount(MOUNT)


@cache
def drive_of(seed, seconds, prior):
    return driven(simulated(seed, prior, seconds=seconds))


def usual(seed, seconds=24.0, prior=None):
    """What came of a drive, by an exact mount unless another is given."""
    return drive_of(seed, seconds, prior)


def any_state(seed):
    rng = np.random.default_rng(seed)
    state = rng.normal(0.0, 0.1, STATES)
    state[3:5] *= 0.01
    state[DELAY] *= 0.1
    return state


def image(pan_rad=0.4, track=None):
    count = len(POINTS)
    return ImagePoints(
        0, np.arange(count), np.zeros((count, 2)), np.tile(1e-8 * np.eye(2), (count, 1, 1)),
        np.full(count, pan_rad), 0.05, 1.0, pan_track=track,
        by_lens=np.random.default_rng(5).normal(0.0, 0.2, (count, 2, 3)),
        below=np.linspace(-0.4, 0.3, count), speeds=np.array([0.4, 0.1, -0.5]),
        moved_back=np.array([-0.03, 0.01, -0.05]),
    )  # fmt: skip


@pytest.mark.parametrize('share', [0.0, 0.5, 1.0])
def test_points_of_a_wrong_lens_are_those_of_the_model(share):
    """Whatever part of the error of the lens is known when an image is used."""
    focal, shift, bend = 0.01, 8.0 / 555.0, 0.01
    given = CameraModel(512, 512, 555.0, 555.0, 256.0, 254.0, distortion=(-0.19, 0.06, 0.0, 0.0))
    known, true = (
        replace(
            given,
            fx=555.0 * (1.0 + part * focal),
            fy=555.0 * (1.0 + part * focal),
            cx=256.0 + part * shift * 555.0,
            distortion=(-0.19 + part * bend, *given.distortion[1:]),
        )
        for part in (share, 1.0)
    )
    pixels = np.array([[20.0, 30.0], [256.0, 254.0], [490.0, 400.0]])
    covariance = np.tile(np.eye(2), (3, 1, 1))
    known_rays = known.unproject(pixels[:, None] + HALF_PIXEL)
    points, _, by_lens = image_points(pixels, covariance, given, known, known_rays)
    rays = (1.0 + focal) * true.unproject(pixels)[:, :2] + [shift, 0.0]
    assert points == pytest.approx(rays - by_lens @ [focal, shift, bend], abs=3e-4)


def assert_derivatives(function, at, by, within=1e-7):
    """Last axis of `by`: derivatives of a function (...) by `at`, against differences."""
    at = np.asarray(at, float)
    for k, change in enumerate(1e-6 * np.eye(at.shape[-1])):
        difference = (function(at + change) - function(at - change)) / 2e-6
        assert by[..., k] == pytest.approx(difference, abs=within)


@pytest.mark.parametrize('seed', range(4))
def test_derivatives_of_what_is_seen_agree_with_differences(seed):
    state = any_state(seed)
    track = PanTrack(np.linspace(-0.2, 0.4, 13), 0.4 + 1.3 * np.linspace(-0.2, 0.4, 13))
    seen = image(track=track)
    model = project(state, POINTS, seen)
    assert_derivatives(lambda s: project(s, POINTS, seen).points, state, model.by_state)
    assert_derivatives(lambda p: project(state, p, seen).points, POINTS, model.by_point)
    panned = lambda off: project(state, POINTS, replace(seen, pan_rad=seen.pan_rad + off)).points  # noqa: E731
    assert_derivatives(panned, [0.0], model.by_pan[..., None])


def hardly_known(seed):
    """As of joint states that are far apart: the pan of each second image."""
    rng, sigma = np.random.default_rng(seed), np.radians(6.0)

    def changed(k, seen):
        off = k % 2 * rng.normal(0.0, sigma)
        return replace(seen, pan_rad=seen.pan_rad + off, pan_sigma_rad=k % 2 * sigma)

    return changed


def sagging(_):
    """As if the camera rose: the joint reports more and more."""
    return lambda k, seen: replace(seen, tilt_rad=1e-3 * k)


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize(('change', 'times'), [(hardly_known, 1.5), (sagging, 3.0)])
def test_a_pan_that_is_hardly_known_and_a_camera_that_sags_move_no_pose(change, times, seed):
    drive = simulated(20 + seed, seconds=20.0)
    run, exact = driven(drive, changed=change(seed)), usual(20 + seed, 20.0)
    assert (run.nees < 31.8).all()
    assert np.abs(run.errors[:, :2]).max() < times * np.abs(exact.errors[:, :2]).max()


@pytest.mark.parametrize('seed', range(3))
def test_derivatives_of_the_motion_agree_with_differences(seed):
    state, motion = any_state(seed)[:CALIBRATION], Motion(np.array([0.1, 0.01, -0.05]), 0.1)
    _, by_state, by_motion = moved(state, motion)
    assert_derivatives(lambda s: moved(s, motion)[0], state, by_state, 1e-8)
    assert np.allclose(by_motion @ by_motion.T, np.eye(3))


def test_recovers_the_pose_without_noise():
    drive = simulated(1, seconds=8.0, noise=0.0, pixel_sigma=1e-7, map_sigma_m=0.0)
    exactly = replace(drive.prior, covariance=np.zeros_like(drive.prior.covariance))
    pose = drive.start.pose + np.array([0.04, -0.03, 0.02])
    drive.start = replace(drive.start, pose=pose)
    exact = EstimatorConfig(floor_tilt_sigma_rad=0.0, moved_probability=0.0)
    run = driven(drive, exact, prior=replace(exactly, base=replace(MOUNT, pan_sigma_rad=0.0)))
    images = [event for event in drive.events if isinstance(event, ImagePoints)]
    fixed = np.array([len(seen) >= 3 for seen in images])
    assert fixed.sum() > 10
    assert np.abs(run.errors[fixed][3:]).max() < 1e-6


@pytest.mark.parametrize(
    ('name', 'error'),
    [
        ('axis_x', 0.0),
        *(('axis_x', 0.08), ('center_y', 0.01), ('camera_roll', 0.01), ('focal_scale', 0.01)),
    ],
)
def test_a_value_that_is_given_as_exact_stays_and_is_named_where_it_is_wrong(name, error):
    exactly = Calibration.of_mount(MOUNT, dict.fromkeys(NAMES, 0.0))
    drive = simulated(2, exactly, seconds=24.0)
    given = exactly.with_values(**{name: exactly[name][0] + error})
    run = driven(drive, prior=given)
    assert (run.filter.calibration.values == given.values).all()
    assert not run.filter.calibration.covariance.any()
    named, sigmas = run.filter.contradiction
    assert (named == name and sigmas > 5.0) if error else sigmas < 4.0


@pytest.mark.parametrize('prior', [None, TAPE], ids=['exact', 'tape'])
def test_errors_are_as_large_as_the_covariance_claims(prior):
    runs = [usual(seed, prior=prior) for seed in range(10)]
    each = np.array([run.nees.mean() for run in runs])
    # Errors of a drive have much in common: its mean is about one draw.
    assert abs(each.mean() - 3.0) < 3.0 * max(each.std() / np.sqrt(len(each)), 0.3)
    assert sum(np.sum(run.nees > 31.8) for run in runs) <= 2


def test_the_calibration_is_as_wrong_as_its_covariance_claims():
    squares = []
    for seed in range(10):
        found = usual(seed, prior=TAPE).filter.calibration
        off = found.values - simulated(seed, TAPE, seconds=24.0).true.values
        squares.append(off @ np.linalg.solve(found.covariance, off))
    assert 0.6 * len(NAMES) < np.mean(squares) < 1.5 * len(NAMES)


@pytest.mark.parametrize(
    ('name', 'error', 'within'),
    [
        ('axis_yaw', 0.0122, 0.012),
        ('axis_pitch', 0.014, 0.002),
        ('axis_x', 0.03, 0.02),
        ('axis_y', 0.02, 0.01),
        ('center_x', 0.03, 0.004),
        ('center_y', 0.01, 0.004),
        ('camera_roll', 0.014, 0.002),
        ('focal_scale', 0.01, 0.002),
        ('joint_delay', 0.03, 0.003),
    ],
)
def test_an_error_of_the_mount_is_found(name, error, within):
    true = TAPE.with_values(**{name: TAPE[name][0] + error})
    run = driven(simulated(7, TAPE, true))
    value, sigma = run.filter.calibration[name]
    assert sigma < TAPE[name][1]
    assert abs(value - true[name][0]) < min(within, 4.0 * sigma)
    assert np.sqrt(np.mean(np.sum(run.errors[80:, :2] ** 2, axis=1))) < 0.03


def test_a_robot_that_stands_does_not_learn_its_pan_zero():
    drive = simulated(3, TAPE, TAPE.with_values(axis_yaw=0.012), seconds=16.0)
    still = Motion(np.zeros(3), 0.05)
    seen = next(event for event in drive.events if isinstance(event, ImagePoints))
    drive.events = [each for _ in range(20) for each in (still, still, seen)]
    drive.poses = drive.poses[:1] * 20
    drive.start = replace(drive.start, pose=drive.poses[0] + [0.02, -0.01, 0.01])
    run = driven(drive)
    assert 'axis_yaw' in run.filter.calibration.unobserved(TAPE)
    assert run.covariances[-1, 2, 2] > (0.5 * TAPE['axis_yaw'][1]) ** 2
    assert run.nees.max() < 16.0


def test_outliers_cost_little_and_no_step_is_seen_where_there_is_none():
    def rms(runs):
        errors = np.concatenate([run.errors[20:, :2] for run in runs])
        return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))

    clean, few, many = [*map(usual, range(4))], [], []
    for share, runs in ((0.15, few), (0.3, many)):
        runs += [driven(simulated(seed, outliers=share, seconds=24.0)) for seed in range(4)]
    assert rms(many) < 2.0 * rms(clean)
    assert np.mean([run.nees.mean() for run in many]) < 6.0
    assert not any(update.stepped for run in clean + few for update in run.updates)


def displaced(rad, at):
    def change(k, seen):
        return replace(seen, pan_rad=seen.pan_rad - rad) if k >= at else seen

    return change


def test_a_knock_of_the_camera_is_noticed_at_once():
    run = driven(simulated(4, seconds=24.0), changed=displaced(0.05, 60))
    steps = [update.stamp_ns for update in run.updates if update.stepped]
    assert len(steps) == 1
    assert 0 <= steps[0] - 61 * NS // 5 <= NS
    # Whether the base or the camera was turned shows as the robot drives: the heading says so.
    assert (run.nees < 31.8).all()
    assert np.hypot(*run.errors[60:, :2].T).max() < 0.05


@pytest.mark.parametrize('seed', range(8))
def test_an_object_moved_since_learning_alone_in_an_image_is_no_knock(seed):
    drive = simulated(seed, seconds=24.0, cupboard_moved_m=0.25)
    of_cupboard = np.array([each.wall_id == CUPBOARD for each in drive.landmark_map.landmarks])
    alone = []

    def change(k, seen):
        """It is first seen alone."""
        there = of_cupboard[seen.columns]
        if not alone and k > 10 and there.sum() >= 3:
            alone.append(k)
            return seen.chosen(there)
        return seen if alone else seen.chosen(~there)

    run = driven(drive, changed=change)
    assert alone
    assert not any(update.stepped for update in run.updates)
    assert (run.nees < 31.8).all()
    ((_, by),) = run.filter.moved_objects
    assert by == pytest.approx([0.25, 0.0], abs=0.02)


def test_objects_are_things_that_touch_and_walls():
    at = [(0.0, 0.0, 1.0), (0.25, 0.0, 1.0), (0.5, 0.0, 1.0), (2.0, 0.0, 1.0), (4.0, 1.0, 1.0)]
    walls = ['north', 'north', 'north', 'north', '']
    landmarks = tuple(
        bare_landmark(k, place, 1e-6 * np.eye(3), wall_id=wall, width_m=0.3, height_m=0.2)
        for k, (place, wall) in enumerate(zip(at, walls, strict=True))
    )
    objects = LandmarkMap(landmarks).objects
    assert {tuple(np.flatnonzero(each)) for each in objects.T} == {
        (0, 1, 2), (3,), (4,), (0, 1, 2, 3),
    }  # fmt: skip
    assert LandmarkMap(()).objects.shape == (0, 0)


@pytest.mark.parametrize('seed', range(3))
def test_another_prior_of_displacements_is_as_if_it_had_been_there_from_the_beginning(seed):
    drive = simulated(seed, seconds=8.0)
    still = isotropic(drive.landmark_map.objects.shape[1], STILL_M2)
    wide = isotropic(len(still), 0.01**2)

    def after(prior, other):
        def exchange(joint, _):
            if len(joint.state.objects):
                objects = joint.state.objects
                joint.state, _ = exchanged(joint.state, objects, other[objects])

        return driven(drive, gaussian, displacements=prior, after=exchange)

    gaussian = EstimatorConfig(tail_freedom=0.0, learning_sigma=0.0)
    given, changed = after(wide, wide), after(still, wide)
    to_and_fro = after(still, still)
    plain = driven(drive, gaussian, displacements=still)
    # But for the points of linearisation.
    assert changed.errors[0] == pytest.approx(given.errors[0], abs=2e-4)
    assert changed.covariances[0] == pytest.approx(given.covariances[0], rel=0.02, abs=1e-7)
    assert np.abs(changed.errors[0] - plain.errors[0]).max() > 3e-4
    assert to_and_fro.errors == pytest.approx(plain.errors, abs=1e-9)


@pytest.mark.parametrize('seed', range(4))
def test_a_place_found_by_what_was_moved_is_corrected(seed):
    moved_m = 0.15
    drive = simulated(seed, TAPE, seconds=24.0, cupboard_moved_m=moved_m)
    stands = np.array([each.wall_id == CUPBOARD for each in drive.landmark_map.landmarks])
    images = [event for event in drive.events if isinstance(event, ImagePoints)]
    first = next(k for k, seen in enumerate(images) if stands[seen.columns].sum() >= 3)
    # Its landmarks are where they were learned, and the robot as much the other way.
    pose = drive.poses[first] - [moved_m, 0.0, 0.0]
    found = PoseEstimate(images[first].stamp_ns, pose, np.diag([0.01, 0.01, 0.01]) ** 2)
    filters = []

    def changed(k, seen):
        return (
            seen.chosen(stands[seen.columns])
            if k == first + 1
            else seen.chosen(np.full(len(seen), k > first + 1))
        )

    def after(joint, _):
        filters.append(joint)
        if len(filters) == first + 1:
            joint.state = joint.placed(found, 0.0).state

    run = driven(drive, changed=changed, after=after)
    assert np.hypot(*run.errors[-1, :2]) < 0.03
    assert (run.nees[-40:] < 31.8).all()


def test_another_focal_length_is_noticed_at_once_and_found():
    mount, rng = Calibration.of_mount(MOUNT, dict.fromkeys(NAMES, 1e-4)), np.random.default_rng(0)

    def zoomed(k, seen):
        sizes = np.full(seen.points.shape, 0.1)
        # The first templates have the scale of before: each fits at some point of the patch.
        off = 0.1 * sizes * rng.uniform(-0.5, 0.5, sizes.shape) if k == 40 else 0.0
        points = seen.points / 1.1 + off if k >= 40 else seen.points
        return replace(seen, points=points, sizes=sizes)

    for seed in range(8):
        run = driven(simulated(seed, mount, mount, seconds=24.0), changed=zoomed)
        steps = [update.stamp_ns for update in run.updates if update.stepped]
        assert steps
        assert 0 <= steps[0] - 41 * NS // 5 <= 2 * NS
        assert (run.nees < 31.8).all()
        focal, sigma = run.filter.calibration['focal_scale']
        assert sigma < 0.005
        assert focal == pytest.approx(1.0 / 1.1 - 1.0, abs=4.0 * sigma)


def test_joint_states_that_are_suddenly_late_turn_no_heading_unnoticed():
    mount, late_s = Calibration.of_mount(MOUNT, dict.fromkeys(NAMES, 1e-4)), 0.2

    def late(k, seen):
        phase = 0.5 * (1e-9 * seen.stamp_ns - late_s)
        pan_rad = np.full(len(seen), 2.0 * np.sin(phase))
        return replace(seen, pan_rad=pan_rad, pan_rate_rad_s=np.cos(phase)) if k >= 58 else seen

    for seed in range(4):
        run = driven(simulated(seed, mount, mount, seconds=24.0), changed=late)
        assert (run.nees < 31.8).all()
        delay_s, sigma_s = run.filter.calibration['joint_delay']
        assert delay_s == pytest.approx(late_s, abs=4.0 * sigma_s + 0.005)


@pytest.mark.parametrize(
    'change',
    [
        lambda seen: replace(seen, points=np.full_like(seen.points, np.nan)),
        lambda seen: replace(seen, points=seen.points + 1e6),
        lambda seen: replace(seen, covariance=-seen.covariance),
        lambda seen: replace(seen, columns=seen.columns + 1000),
        lambda seen: replace(seen, columns=-1 - seen.columns),
        lambda seen: replace(seen, tilt_rad=np.nan),
        lambda seen: replace(seen, pan_rad=np.full(len(seen), np.inf)),
        lambda seen: seen.chosen(np.zeros(len(seen), dtype=np.bool_)),
    ],
)
def test_what_is_no_measurement_changes_nothing(change):
    drive = simulated(5, seconds=4.0)
    run = driven(drive)
    before = run.filter.state
    seen = next(event for event in drive.events if isinstance(event, ImagePoints))
    update = run.filter.observe(change(seen))
    assert len(update.columns) == 0
    assert (run.filter.state.mean == before.mean).all()
    assert (run.filter.state.covariance == before.covariance).all()


def test_the_noise_of_the_wheels_is_learned():
    quiet = OdometryNoiseConfig().scaled(3.0, 3.0, 3.0)
    factors = driven(simulated(9), odometry=quiet).filter.state.scales.factors
    assert (factors[:3] < 0.7).all()


def test_late_images_and_odometry_give_the_same_as_in_order():
    drive = simulated(10, seconds=6.0)
    samples, images = [], []
    for what in sensed(drive):
        (samples if isinstance(what, OdometrySample) else images).append(what)

    def run(arrivals):
        odometry = OdometryNoiseConfig()
        joint = JointFilter(drive.landmark_map, drive.prior, drive.start, odometry=odometry)
        line = Timeline(joint, OdometryTrack(odometry), window_s=1.0)
        for _, what in sorted(arrivals, key=lambda arrival: arrival[0]):
            if isinstance(what, OdometrySample):
                assert line.add_odometry(what) is None
            else:
                assert not isinstance(line.add_image(what), Refusal)
        return line.estimate()

    rng = np.random.default_rng(0)
    on_time = [(sample.stamp_ns, sample) for sample in samples]
    expected = run([*on_time, *((seen.stamp_ns, seen) for seen in images)])
    late = [(seen.stamp_ns + int(rng.integers(0, NS // 2)), seen) for seen in images]
    early = [(max(1, seen.stamp_ns - NS // 10), seen) for seen in images]
    for arrivals in (late, early):
        found = run([*on_time, *arrivals])
        assert found.pose == pytest.approx(expected.pose, abs=1e-9)
        assert found.covariance == pytest.approx(expected.covariance, abs=1e-12)


def test_the_protection_level_holds():
    inside, ratios = [], []
    for run in map(usual, range(24)):
        for error, covariance, update in zip(
            run.errors, run.covariances, run.updates, strict=False
        ):
            level = protection_level(PoseEstimate(0, np.zeros(3), covariance), update)
            off = np.hypot(*error[:2])
            inside.append([off <= level.position_m, abs(error[2]) <= level.heading_rad])
            ratios.append(level.position_m / off)
    assert (np.mean(inside, axis=0) > 0.98).all()
    assert np.median(ratios) < 4.0


def test_a_pose_that_the_camera_found_is_off_by_what_the_mount_is_off_by():
    rng, squares = np.random.default_rng(8), []
    # Small, so that squares of the errors do not count.
    sigmas = dict.fromkeys(('axis_x', 'axis_y', 'axis_yaw'), 0.002)
    sigmas |= {'center_x': 0.0, 'center_y': 0.0}
    prior = Calibration.of_mount(PanTiltMount((0.2, 0.1, 1.0), (0.0, 0.0, 0.1)), sigmas)
    which = [NAMES.index(name) for name in ('axis_x', 'axis_y', 'axis_yaw')]
    states = [0, 1, 2, *(CALIBRATION + k for k in which)]
    landmarks = point_map(rng)
    for _ in range(200):
        true = rng.multivariate_normal(prior.values, prior.covariance)[which]
        base = rng.uniform(-2.0, 2.0, 3)
        axis = compose(base, true)
        given = prior.values[which]
        heading = axis[2] - given[2]
        c, s = np.cos(heading), np.sin(heading)
        found = np.array([*(axis[:2] - np.array([[c, -s], [s, c]]) @ given[:2]), heading])
        place = PoseEstimate(0, found, 1e-12 * np.eye(3))
        joint = JointFilter(landmarks, prior, place).placed(place, 0.0)
        error = np.concatenate([found - base, given - true])
        error[2] = np.arctan2(np.sin(error[2]), np.cos(error[2]))
        covariance = joint.state.covariance[np.ix_(states, states)] + 1e-10 * np.eye(6)
        squares.append(error @ np.linalg.solve(covariance, error))
    # The pose has no errors of its own: three numbers are drawn.
    assert 2.5 < np.mean(squares) < 3.6


def test_errors_of_landmarks_are_bounded_in_number_and_stay_consistent(monkeypatch):
    monkeypatch.setattr(filter, '_MOST_LANDMARKS', 10)
    runs = [driven(simulated(seed, seconds=10.0)) for seed in range(4)]
    assert max(len(run.filter.state.landmarks) for run in runs) <= 10
    assert all(np.mean(run.nees < 31.8) == 1.0 for run in runs)
    assert max(np.hypot(*run.errors[-1, :2]) for run in runs) < 0.02


@pytest.mark.parametrize('seed', range(6))
def test_a_misplaced_landmark_is_no_knock(seed):
    drive = simulated(seed, seconds=24.0)
    seen_most = np.bincount(
        np.concatenate([e.columns for e in drive.events if isinstance(e, ImagePoints)])
    ).argmax()

    def change(_, seen):
        off = 0.03 * (seen.columns == seen_most)
        return replace(seen, points=seen.points + off[:, None])

    run = driven(drive, changed=change)
    assert not any(update.stepped for update in run.updates)
    assert (run.nees < 31.8).all()
