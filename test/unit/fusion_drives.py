"""Seeded drives through a room of landmarks, as the filter's model has them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import FloatArray
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.se2 import compose
from landmark_nav.localization.odometry.noise import (
    Motion,
    motion_variances,
    OdometryNoiseConfig,
    twist_motion,
)
from landmark_nav.types import Detections, Landmark, LandmarkMap, OdometrySample, PoseEstimate

MOUNT = PanTiltMount(axis_xyz=(0.08, -0.02, 1.1))
START = np.array([2.5, 1.2, 0.2])
START_SIGMA = np.array([0.02, 0.02, 0.01])
PERIOD_NS = 50_000_000
SPEED_M_S = 0.4


def landmark_map(n: int, shared: float = 0.004, own: float = 0.005, seed: int = 0) -> LandmarkMap:
    """Landmarks on a circle of 3 m around (3, 2.5), with an error that they share."""
    rng = np.random.default_rng(seed)
    made = []
    for k in range(n):
        angle = 2.0 * np.pi * (k + 0.7 * rng.random()) / n
        inward = -np.array([np.cos(angle), np.sin(angle), 0.0])
        loading = np.zeros((3, 3))
        loading[:2, :2] = shared * np.eye(2)
        loading[:2, 2] = shared * np.array([np.sin(angle), -np.cos(angle)])
        made.append(
            Landmark(
                id=10 + k,
                position=np.array([3.0, 2.5, 1.2]) - rng.uniform(2.5, 3.5) * inward,
                covariance=loading @ loading.T + own**2 * np.eye(3),
                shared_loading=loading,
                normal=inward,
                width_m=0.2,
                height_m=0.2,
                patch=np.zeros((8, 8), np.uint8),
                viewpoint=np.array([3.0, 2.5, 1.1]),
                threshold=0.7,
            )
        )
    return LandmarkMap(tuple(made))


def as_surveyed(true_map: LandmarkMap, rng: np.random.Generator) -> LandmarkMap:
    """Return the map with one draw of its error."""
    error = rng.multivariate_normal(
        np.zeros(2 * len(true_map.landmarks)), true_map.joint_covariance_xy
    ).reshape(-1, 2)
    return LandmarkMap(
        tuple(
            replace(k, position=k.position + np.array([*e, 0.0]))
            for k, e in zip(true_map.landmarks, error, strict=True)
        )
    )


def bearings(true_map: LandmarkMap, pose: FloatArray) -> FloatArray:
    """Bearings (n,) at the pan axis."""
    axis = MOUNT.axis_pose_map(pose)
    return se2.bearings(axis, true_map.positions[:, :2])


def detections(
    true_map: LandmarkMap,
    pose: FloatArray,
    stamp_ns: int,
    places: npt.ArrayLike,
    sigma: float,
    noise: FloatArray | float = 0.0,
) -> Detections:
    """Detections of some landmarks from a pose."""
    chosen = np.asarray(places, dtype=np.intp)
    n = len(chosen)
    return Detections(
        stamp_ns,
        true_map.ids[chosen],
        wrap_rad(bearings(true_map, pose)[chosen] + noise),
        np.full(n, sigma**2),
        np.ones(n),
        np.zeros((n, 2)),
    )


@dataclass(frozen=True, eq=False)
class Moment:
    """One odometry sample and where the robot really is."""

    odometry: OdometrySample
    pose: FloatArray


def drive(
    steps: int,
    rng: np.random.Generator | None = None,
    noise: OdometryNoiseConfig | None = None,
    biases: tuple[float, float, float] = (0.0, 0.0, 0.0),
    start: FloatArray = START,
) -> Iterator[Moment]:
    """
    Drive a wavy circle; with `rng` and `noise` the truth strays from the odometry as modelled.

    `biases` are the scale, the drift per metre and the turn scale that correct the odometry.
    """
    odometry, truth = np.zeros(3), start.copy()
    slip = rng.normal(0.0, noise.slip_sigma) if rng is not None and noise is not None else 0.0
    yield Moment(OdometrySample(0, odometry), truth)
    for k in range(1, steps + 1):
        speed, rate = SPEED_M_S, 0.35 + 0.5 * np.sin(0.05 * k)
        step = twist_motion(speed, rate, PERIOD_NS * 1e-9)
        scale, drift, turn_scale = biases
        moved = np.array(
            [
                (1.0 + scale) * step[0],
                (1.0 + scale) * step[1] + slip * step[0],
                (1.0 + turn_scale) * step[2] + drift * step[0],
            ]
        )
        if rng is not None and noise is not None:
            motion = Motion(step, PERIOD_NS * 1e-9)
            moved = moved + rng.normal(0.0, np.sqrt(motion_variances(motion, noise)))
            kept = np.exp(-np.hypot(step[0], step[1]) / noise.slip_length_m)
            slip = kept * slip + noise.slip_sigma * np.sqrt(1.0 - kept**2) * rng.normal()
        odometry, truth = compose(odometry, step), compose(truth, moved)
        yield Moment(OdometrySample(k * PERIOD_NS, odometry, speed, float(rate)), truth)


def start_estimate(
    sigmas: FloatArray = START_SIGMA, offset: npt.ArrayLike = 0.0, stamp_ns: int = 0
) -> PoseEstimate:
    """Start pose, off by an offset."""
    return PoseEstimate(stamp_ns, START + np.asarray(offset), np.diag(sigmas**2))


def error_of(estimate: PoseEstimate | None, truth: FloatArray) -> FloatArray:
    """Estimate minus truth (3,), the heading wrapped."""
    assert estimate is not None
    error = estimate.pose - truth
    error[2] = wrap_rad(error[2])
    return error


def nees_of(estimate: PoseEstimate | None, truth: FloatArray) -> float:
    """Squared error of an estimate in units of its covariance."""
    assert estimate is not None
    error = error_of(estimate, truth)
    return float(error @ np.linalg.solve(estimate.covariance, error))
