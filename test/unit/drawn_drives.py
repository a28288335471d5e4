"""Drives whose truth is known: points in a room, wheels and a panning camera, as modelled."""

from dataclasses import dataclass, field, replace

from builders import bare_landmark, nees, pose_error
import numpy as np

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.se2 import compose
from landmark_nav.localization.estimator.config import EstimatorConfig
from landmark_nav.localization.estimator.factors import CALIBRATION, ImagePoints, project
from landmark_nav.localization.estimator.filter import JointFilter
from landmark_nav.localization.estimator.state import Update
from landmark_nav.localization.odometry.noise import (
    Motion,
    OdometryNoiseConfig,
    sensed_variances,
    slip_variance,
)
from landmark_nav.types import FloatArray, LandmarkMap, OdometrySample, PoseEstimate

NS = 10**9
MOUNT = PanTiltMount((0.08, 0.0, 1.1))
# Half of what the camera sees, over the focal length; at most so many landmarks are found.
HALF_VIEW, MOST = 0.46, 8
# Odometry comes with this period, every fourth time with an image.
PERIOD_S, IMAGE_EVERY = 0.05, 4
# Where some of the landmarks are, on one wall.
CUPBOARD = 'cupboard'
START_SIGMA = np.array([0.03, 0.03, 0.02])


@dataclass
class Drive:
    """The map as learned, prior and truth, images and motions by time, poses at the images."""

    landmark_map: LandmarkMap
    prior: Calibration
    true: Calibration
    start: PoseEstimate
    events: list[Motion | ImagePoints] = field(default_factory=list)
    poses: list[FloatArray] = field(default_factory=list)


def point_map(rng, count=40, sigma_m=0.002):
    """Landmarks on the walls of a room of 6 x 4 m, with own errors and two that they share."""
    along, wall = rng.uniform(0.05, 0.95, count), rng.integers(0, 4, count)
    x = np.choose(wall, [6 * along, np.full(count, 6.0), 6 * along, np.zeros(count)])
    y = np.choose(wall, [np.zeros(count), 4 * along, np.full(count, 4.0), 4 * along])
    z = rng.uniform(0.5, 2.0, count)
    normal = np.array([[0, 1, 0], [-1, 0, 0], [0, -1, 0], [1, 0, 0]], float)[wall]
    walls = np.where((wall == 2) & (x > 3.0), CUPBOARD, '').tolist()
    shared = 0.5 * sigma_m * np.eye(3, 2)
    given = {'shared_loading': shared, 'viewpoint': np.array([3.0, 2.0, 1.1])}
    covariance = sigma_m**2 * np.eye(3) + shared @ shared.T
    return LandmarkMap(
        tuple(
            bare_landmark(k, at, covariance, normal=normal[k], wall_id=walls[k], **given)
            for k, at in enumerate(np.column_stack([x, y, z]))
        )
    )


def drawn_calibration(rng, prior):
    """A calibration that the prior allows."""
    return replace(prior, values=prior.values + prior.sigmas * rng.normal(size=len(NAMES)))


def simulated(
    seed,
    prior=None,
    true=None,
    seconds=40.0,
    pixel_sigma=2e-4,
    noise=1.0,
    outliers=0.0,
    map_sigma_m=0.002,
    cupboard_moved_m=0.0,
):
    """
    Draw a drive by the default noise of floor and wheels; `noise` 0 leaves out all of it.

    The cupboard was moved along its wall since learning.
    """
    rng = np.random.default_rng(seed)
    config, wheels = EstimatorConfig(), OdometryNoiseConfig()
    prior = prior or Calibration.exact(MOUNT)
    true = true or (drawn_calibration(rng.spawn(1)[0], prior) if noise else prior)
    learned = point_map(rng, sigma_m=map_sigma_m)
    shape = learned.positions.shape
    shared = noise * learned.shared_loadings @ rng.normal(size=2)
    own = noise * map_sigma_m * rng.normal(size=shape)
    stands = [landmark.wall_id == CUPBOARD for landmark in learned.landmarks]
    moved = cupboard_moved_m * np.outer(stands, [1.0, 0.0, 0.0])
    scale, drift, turn_scale = noise * wheels.bias_sigmas * rng.normal(size=3)
    slip, floor_roll = 0.0, config.floor_tilt_sigma_rad * rng.normal(size=2)
    pose = np.array([1.5, 1.0, 0.0])
    start = pose + noise * START_SIGMA * rng.normal(size=3)
    drive = Drive(learned, prior, true, PoseEstimate(0, start, np.diag(START_SIGMA**2)))
    for tick in range(1, round(seconds / PERIOD_S)):
        step = _toward_eight(tick * PERIOD_S, pose)
        forward, _, turn = step.increment
        motion = [(1 + scale) * forward, slip * forward, (1 + turn_scale) * turn + drift * forward]
        spread = np.sqrt(sensed_variances(step, wheels).sum(axis=0))
        pose = compose(pose, motion + noise * spread * rng.normal(size=3))

        def walked(value, sigma, length_m, way_m=float(forward)):
            """Value of a Gauss-Markov process, a way later."""
            kept = np.exp(-way_m / length_m)
            return kept * value + sigma * np.sqrt(1 - kept**2) * rng.normal(size=np.shape(value))

        slip = walked(slip, noise * np.sqrt(slip_variance(step, wheels)), wheels.slip_length_m)
        floor_roll = walked(
            floor_roll, noise * config.floor_tilt_sigma_rad, config.floor_tilt_length_m
        )
        own = walked(own, noise * map_sigma_m, config.correlation_length_m)
        drive.events.append(step)
        if tick % IMAGE_EVERY:
            continue
        state = np.concatenate([pose, noise * floor_roll, np.zeros(CALIBRATION - 5), true.values])
        blank = _panned(tick * PERIOD_S, len(learned.landmarks), pixel_sigma)
        off = noise * rng.normal(0.0, true.base.pan_sigma_rad)
        places = learned.positions + shared + own + moved
        blank = replace(blank, speeds=step.increment / PERIOD_S)
        # The rows of what is seen while the camera turns are hardly those at rest.
        blank = replace(blank, below=project(state, places, blank).points[:, 1])
        model = project(state, places, replace(blank, pan_rad=blank.pan_rad + off))
        inside = model.ahead & (np.abs(model.points) < HALF_VIEW).all(axis=1)
        chosen = np.isin(np.arange(len(inside)), rng.permutation(np.flatnonzero(inside))[:MOST])
        points = model.points + noise * pixel_sigma * rng.normal(size=model.points.shape)
        wrong = rng.random(len(points)) < outliers
        points[wrong] += rng.uniform(-0.1, 0.1, (int(wrong.sum()), 2))
        drive.poses.append(pose.copy())
        drive.events.append(replace(blank, points=points).chosen(chosen))
    return drive


def _toward_eight(seconds, pose):
    """Motion of a robot that follows a point on a curve of eight."""
    goal = [3.0 + 1.6 * np.sin(0.16 * seconds), 2.0 + 0.9 * np.sin(0.32 * seconds)]
    toward = goal - pose[:2]
    bend = float(wrap_rad(np.arctan2(toward[1], toward[0]) - pose[2]))
    forward = 0.35 * max(np.cos(bend), 0.2) if np.hypot(*toward) > 0.1 else 0.0
    turn = np.clip(1.5 * bend, -0.8, 0.8)
    return Motion(PERIOD_S * np.array([forward, 0.0, turn]), PERIOD_S)


def _panned(seconds, count, sigma):
    """An image of a camera that looks to and fro, without its points."""
    return ImagePoints(
        round(seconds * NS), np.arange(count), np.zeros((count, 2)),
        np.tile(max(sigma, 1e-9) ** 2 * np.eye(2), (count, 1, 1)),
        np.full(count, 2.0 * np.sin(0.5 * seconds)), pan_rate_rad_s=np.cos(0.5 * seconds),
    )  # fmt: skip


def sensed(drive):
    """A drive as a robot sends it: odometry from an origin of its own, and images."""
    pose, stamp = np.zeros(3), 0
    yield OdometrySample(stamp, pose)
    for event in drive.events:
        if isinstance(event, Motion):
            stamp, pose = stamp + round(event.seconds * NS), compose(pose, event.increment)
            forward, _, turn = (event.increment / event.seconds).tolist()
            yield OdometrySample(stamp, pose, forward, turn)
        else:
            yield event


@dataclass
class Run:
    """Errors (n, 3) and covariances (n, 3, 3) at the images, the filter and its updates."""

    errors: FloatArray
    covariances: FloatArray
    filter: JointFilter
    updates: list[Update]

    @property
    def nees(self):
        """Normalised squared errors, (n,)."""
        return nees(self.errors, self.covariances)


def driven(
    drive,
    config=None,
    odometry=None,
    prior=None,
    changed=lambda _, seen: seen,
    after=lambda _joint, _moved: None,
    displacements=None,
):
    """
    Run the joint filter along a drive; `after` each image with the state before it.

    Inverse covariances of `displacements` are those of objects, if given for good.
    """
    joint = JointFilter(drive.landmark_map, prior or drive.prior, drive.start, config, odometry)
    if displacements is not None:
        joint = joint.knowing(displacements)
    errors, covariances, updates, stamp = [], [], [], 0
    for event in drive.events:
        if isinstance(event, Motion):
            stamp += round(event.seconds * NS)
            joint.move(stamp, event)
            continue
        moved = joint.state
        if len(event):
            updates.append(joint.observe(changed(len(errors), event)))
        after(joint, moved)
        estimate = joint.estimate
        errors.append(pose_error(estimate, drive.poses[len(errors)]))
        covariances.append(estimate.covariance)
    return Run(np.array(errors), np.array(covariances), joint, updates)
