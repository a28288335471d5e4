"""Drives whose truth is known: a room of points, wheels and a panning camera, drawn as modelled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.se2 import compose
from landmark_nav.localization.estimator.config import EstimatorConfig
from landmark_nav.localization.estimator.factors import (
    CALIBRATION,
    ImagePoints,
    LEAN,
    project,
    STATES,
)
from landmark_nav.localization.estimator.filter import JointFilter, Update
from landmark_nav.localization.odometry.noise import Motion, OdometryNoiseConfig
from landmark_nav.types import FloatArray, Landmark, LandmarkMap, PoseEstimate

NS = 10**9
MOUNT = PanTiltMount((0.08, 0.0, 1.1))
# Half of what a camera sees across and down, over the focal length.
HALF_ACROSS, HALF_DOWN = 0.46, 0.46
START_SIGMA = np.array([0.03, 0.03, 0.02])


@dataclass
class Drive:
    """What happened: the map as learned, a prior, images and steps by time, poses at the images."""

    landmark_map: LandmarkMap
    prior: Calibration
    true: Calibration
    start: PoseEstimate
    events: list[Motion | ImagePoints] = field(default_factory=list)
    poses: list[FloatArray] = field(default_factory=list)


def point_map(rng: np.random.Generator, count: int = 40, sigma_m: float = 0.002) -> LandmarkMap:
    """Landmarks on the walls of a room of 6 x 4 m, with errors of their own and two shared ones."""
    along, wall = rng.uniform(0.3, 0.7, count), rng.integers(0, 4, count)
    along = rng.uniform(0.05, 0.95, count)
    x = np.choose(wall, [6 * along, np.full(count, 6.0), 6 * along, np.zeros(count)])
    y = np.choose(wall, [np.zeros(count), 4 * along, np.full(count, 4.0), 4 * along])
    z = rng.uniform(0.5, 2.0, count)
    normal = np.array([[0, 1, 0], [-1, 0, 0], [0, -1, 0], [1, 0, 0]], float)[wall]
    landmarks = []
    for k in range(count):
        shared = np.zeros((3, 2))
        shared[0, 0] = shared[1, 1] = 0.5 * sigma_m
        covariance = sigma_m**2 * np.eye(3) + shared @ shared.T
        landmarks.append(
            Landmark(
                k, np.array([x[k], y[k], z[k]]), covariance, shared, normal[k], 0.2, 0.2,
                np.zeros((1, 1), np.uint8), np.array([3.0, 2.0, 1.1]), 0.8,
            )
        )  # fmt: skip
    return LandmarkMap(tuple(landmarks))


def drawn_calibration(rng: np.random.Generator, prior: Calibration) -> Calibration:
    """A calibration that the prior allows."""
    return replace(prior, values=prior.values + prior.sigmas * rng.normal(size=len(NAMES)))


def simulated(
    seed: int,
    prior: Calibration | None = None,
    true: Calibration | None = None,
    config: EstimatorConfig | None = None,
    odometry: OdometryNoiseConfig | None = None,
    seconds: float = 40.0,
    pixel_sigma: float = 2e-4,
    noise: float = 1.0,
    outliers: float = 0.0,
    most: int = 8,
) -> Drive:
    """Draw a drive; `noise` 0 leaves out all of it."""
    rng = np.random.default_rng(seed)
    config, odometry = config or EstimatorConfig(), odometry or OdometryNoiseConfig()
    prior = prior or Calibration.exact(MOUNT)
    true = true or (drawn_calibration(rng, prior) if noise else prior)
    learned = point_map(rng)
    factors = noise * rng.normal(size=2)
    own = noise * rng.normal(0.0, 0.002, (len(learned.landmarks), 3))
    shared = learned.shared_loadings @ factors
    state = np.zeros(STATES)
    state[CALIBRATION:] = true.values
    rate, images_every = 0.05, 4
    pose, slip, lean = np.array([1.5, 1.0, 0.0]), 0.0, np.zeros(2)
    biases = noise * odometry.bias_sigmas * rng.normal(size=3)
    start = pose + noise * START_SIGMA * rng.normal(size=3)
    drive = Drive(learned, prior, true, PoseEstimate(0, start, np.diag(START_SIGMA**2)))
    slip = noise * odometry.slip_sigma * rng.normal()
    lean = noise * config.lean_sigma_rad * rng.normal(size=2)
    way_since = 0.0
    for tick in range(1, round(seconds / rate)):
        # A curve of eight in the middle of the room, led by the true pose.
        goal = np.array([3.0, 2.0]) + [
            1.6 * np.sin(0.16 * tick * rate),
            0.9 * np.sin(0.32 * tick * rate),
        ]
        toward = goal - pose[:2]
        bend = float(wrap_rad(np.arctan2(toward[1], toward[0]) - pose[2]))
        speed = 0.35 if np.hypot(*toward) > 0.1 else 0.0
        forward, turn = (
            speed * rate * max(np.cos(bend), 0.2),
            float(np.clip(1.5 * bend, -0.8, 0.8)) * rate,
        )
        measured = np.array([forward, 0.0, turn])
        way = forward
        ahead = (1 + biases[0]) * forward
        variance = np.array(
            [
                odometry.along_m_per_sqrt_m**2 * way + odometry.floor_m_per_sqrt_s**2 * rate,
                odometry.across_m_per_sqrt_m**2 * way + odometry.floor_m_per_sqrt_s**2 * rate,
                odometry.turn_rad_per_sqrt_m**2 * way
                + odometry.floor_rad_per_sqrt_s**2 * rate
                + odometry.turn_rad_per_sqrt_rad**2 * abs(turn),
            ]
        )
        motion = np.array([ahead, slip * forward, (1 + biases[2]) * turn + biases[1] * forward])
        pose = compose(pose, motion + noise * np.sqrt(variance) * rng.normal(size=3))
        kept = np.exp(-way / odometry.slip_length_m)
        slip = kept * slip + noise * odometry.slip_sigma * np.sqrt(1 - kept**2) * rng.normal()
        kept = np.exp(-way / config.lean_length_m)
        lean = kept * lean + noise * config.lean_sigma_rad * np.sqrt(1 - kept**2) * rng.normal(
            size=2
        )
        kept = np.exp(-way / config.map_memory_m)
        own = kept * own + noise * 0.002 * np.sqrt(1 - kept**2) * rng.normal(size=own.shape)
        drive.events.append(Motion(measured, rate))
        if tick % images_every:
            continue
        stamp = tick * round(rate * NS)
        # The camera looks to and fro, at speeds that differ.
        seconds_now = tick * rate
        pan = 2.0 * np.sin(0.5 * seconds_now)
        pan_rate = np.cos(0.5 * seconds_now)
        state[:3], state[LEAN : LEAN + 2] = pose, lean
        count = len(learned.landmarks)
        blank = ImagePoints(
            stamp, np.arange(count), np.zeros((count, 2)), np.zeros((count, 2, 2)),
            np.full(count, pan), 0.0, pan_rate,
        )  # fmt: skip
        off = noise * rng.normal(0.0, true.base.pan_sigma_rad)
        points = learned.positions + shared + own
        model = project(state, points, replace(blank, pan_rad=blank.pan_rad + off))
        inside = model.ahead & (np.abs(model.points) < [HALF_ACROSS, HALF_DOWN]).all(axis=1)
        chosen = rng.permutation(np.flatnonzero(inside))[:most]
        seen = model.points[chosen] + noise * pixel_sigma * rng.normal(size=(len(chosen), 2))
        wrong = rng.random(len(chosen)) < outliers
        seen[wrong] += rng.uniform(-0.1, 0.1, (int(wrong.sum()), 2))
        drive.poses.append(pose.copy())
        drive.events.append(
            replace(
                blank.chosen(np.isin(np.arange(count), [])),
                columns=chosen,
                points=seen,
                covariance=np.tile(pixel_sigma**2 * np.eye(2), (len(chosen), 1, 1)),
                pan_rad=np.full(len(chosen), pan),
            )
        )
    return drive


@dataclass
class Run:
    """Errors (n, 3) and covariances (n, 3, 3) at the images, the filter and its updates."""

    errors: FloatArray
    covariances: FloatArray
    filter: JointFilter
    updates: list[Update]

    @property
    def nees(self) -> FloatArray:
        """Normalised squared errors, (n,)."""
        return np.einsum(
            'ni,ni->n',
            self.errors,
            np.linalg.solve(self.covariances, self.errors[..., None])[..., 0],
        )


def driven(
    drive: Drive,
    config: EstimatorConfig | None = None,
    odometry: OdometryNoiseConfig | None = None,
    prior: Calibration | None = None,
    changed: Callable[[int, ImagePoints], ImagePoints] = lambda _, seen: seen,
) -> Run:
    """Run the joint filter along a drive."""
    joint = JointFilter(drive.landmark_map, prior or drive.prior, drive.start, config, odometry)
    errors, covariances, updates, stamp = [], [], [], 0
    for event in drive.events:
        if isinstance(event, Motion):
            stamp += round(event.seconds * NS)
            joint.move(stamp, event)
            continue
        if len(event):
            updates.append(joint.observe(changed(len(errors), event)))
        estimate = joint.estimate
        error = estimate.pose - drive.poses[len(errors)]
        error[2] = wrap_rad(error[2])
        errors.append(error)
        covariances.append(estimate.covariance)
    return Run(np.array(errors), np.array(covariances), joint, updates)
