"""What `landmark-nav bench` times of localization, and beside what."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, pairwise

import cv2
import numpy as np
from scipy.optimize import least_squares

from landmark_nav.calibration import Calibration
from landmark_nav.cli.bench_world import CAMERA, Comparison, MOUNT, World
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.detection import (
    detect_landmarks,
    DetectionConfig,
    DetectionResult,
)
from landmark_nav.localization.fusion import Fusion
from landmark_nav.localization.localizer import LocalizationConfig, Localizer
from landmark_nav.localization.triangulation import triangulate, triangulate_three
from landmark_nav.localization.triplet import CameraState, rank_triplets, TripletConfig
from landmark_nav.localization.triplet.search import mean_variance, pair_tables
from landmark_nav.types import (
    Detections,
    FloatArray,
    Landmark,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
)

_BEARING_SIGMA_RAD = 1e-3
# A second of a drive: the triplet is chosen twice in it.
_UPDATES = 15


def localization_comparisons(world: World) -> Iterator[Comparison]:
    """Triplet, detection, triangulation, fusion, and all of them in one update."""
    yield _triplet(world)
    for count in (40, 200, 1000):
        yield _triplet_of(count)
    yield _detection(world)
    yield _triangulation(world)
    yield _closed_form(world)
    yield _fusion(world)
    yield _update(world)


def _triplet(world: World) -> Comparison:
    config = TripletConfig()
    positions = world.learned.map.positions[:, :2]
    axis = MOUNT.axis_pose_map(world.prior.pose)[:2]
    # A fifth of all landmarks is about what one view shows.
    triplets = list(combinations(range(len(positions)), 3))[::5]

    def one_by_one() -> float:
        best = np.inf
        for triplet in triplets:
            offset = positions[list(triplet)] - axis
            square = np.sum(offset**2, -1)
            jacobian = np.c_[offset[:, 1] / square, -offset[:, 0] / square, -np.ones(3)]
            information = jacobian.T @ jacobian / _BEARING_SIGMA_RAD**2
            if np.linalg.det(information) > 1e-3:
                best = min(best, float(np.trace(np.linalg.inv(information)[:2, :2])))
        return best

    return Comparison(
        'choice of the triplet',
        lambda: rank_triplets(world.prior, world.learned.map, CAMERA, MOUNT, config),
        f'covariances of {len(triplets)} triplets, one by one',
        one_by_one,
    )


def _triplet_of(count: int) -> Comparison:
    """Choice among `count` landmarks around a room, from all triplets that fit a view."""
    rng = np.random.default_rng(count)
    along = rng.uniform(0.05, 0.95, count)
    walls = [((0.0, 0.0), (7.0, 0.0)), ((7.0, 0.0), (7.0, 4.5)), ((7.0, 4.5), (0.0, 4.5))]
    walls.append(((0.0, 4.5), (0.0, 0.0)))
    wall = rng.integers(4, size=count)
    landmarks = []
    for k in range(count):
        start, end = (np.array(point) for point in walls[wall[k]])
        away = (end - start) / np.linalg.norm(end - start)
        landmarks.append(
            Landmark(
                id=k,
                position=np.array([*(start + along[k] * (end - start)), rng.uniform(0.8, 1.5)]),
                covariance=np.diag([0.006, 0.006, 0.01]) ** 2,
                shared_loading=np.vstack([0.004 * np.eye(2), np.zeros((1, 2))]),
                normal=np.array([-away[1], away[0], 0.0]),
                width_m=0.25,
                height_m=0.2,
                patch=np.zeros((20, 25), np.uint8),
                viewpoint=np.array([3.5, 2.25, 1.1]),
                threshold=0.7,
            )
        )
    landmark_map = LandmarkMap(tuple(landmarks))
    prior = PoseEstimate(0, np.array([3.2, 2.0, 0.4]), np.diag([0.01, 0.01, 0.005]) ** 2)
    config, camera_state = TripletConfig(), CameraState(pan_rad=0.5)
    few = np.array(list(combinations(range(min(count, 40)), 3)))
    tables = pair_tables(prior.pose[None, :2], landmark_map, np.arange(count), 4e-4)
    return Comparison(
        f'triplet among {count}',
        lambda: rank_triplets(prior, landmark_map, CAMERA, MOUNT, config, camera_state),
        f'variances of {len(few)} triplets, all at once',
        lambda: mean_variance(tables, few),
    )


def _detection(world: World) -> Comparison:
    learned, frame = world.learned.map, world.view
    expected = world.expected(frame.pan_rad)
    grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
    patches = [cv2.resize(learned.landmarks[k].patch, (32, 32)) for k in expected]

    def ours() -> DetectionResult:
        return detect_landmarks(frame, world.prior, learned, MOUNT, DetectionConfig(), expected)

    return Comparison(
        'detection of a landmark',
        ours,
        'cv2.matchTemplate over the whole image',
        lambda: [cv2.matchTemplate(grey, patch, cv2.TM_CCOEFF_NORMED) for patch in patches],
        count=max(len(expected), 1),
    )


def _triangulation(world: World) -> Comparison:
    positions, bearings = world.learned.map.positions[:8, :2], world.bearings[:8]
    variances = np.full(len(positions), _BEARING_SIGMA_RAD**2)
    start = se2.compose(world.prior.pose, [0.1, -0.1, 0.05])

    def residuals(pose: FloatArray) -> FloatArray:
        return wrap_rad(bearings - se2.bearings(pose, positions)) / _BEARING_SIGMA_RAD

    return Comparison(
        f'triangulation of {len(positions)} bearings',
        lambda: triangulate(positions, bearings, variances),
        'scipy.optimize.least_squares from near by',
        lambda: least_squares(residuals, start),
    )


def _closed_form(world: World) -> Comparison:
    rng = np.random.default_rng(0)
    count = 10_000
    chosen = np.array([rng.choice(len(world.bearings), 3, replace=False) for _ in range(count)])
    positions = world.learned.map.positions[chosen, :2]
    bearings = world.bearings[chosen]
    square = rng.normal(size=(count, 3, 3))
    return Comparison(
        'triangulation of three, closed form',
        lambda: triangulate_three(positions, bearings),
        'numpy.linalg.solve of as many 3 x 3',
        lambda: np.linalg.solve(square, bearings[..., None]),
        count=count,
    )


def _fusion(world: World) -> Comparison:
    """One second of a drive: 20 odometry samples and 5 images of three landmarks."""
    learned = world.learned.map
    ids, bearings = learned.ids[:3], world.bearings[:3]
    variances = np.full(3, _BEARING_SIGMA_RAD**2)
    samples = [
        OdometrySample(50_000_000 * k, np.array([0.0, 0.0, 1e-6 * k]), 0.0, 0.0) for k in range(21)
    ]

    def ours() -> None:
        fusion = Fusion(learned, Calibration.of_mount(MOUNT))
        fusion.add_odometry(samples[0])
        fusion.initialize(world.prior)
        for sample in samples[1:]:
            fusion.add_odometry(sample)
            if sample.stamp_ns % 200_000_000 == 0:
                fusion.add_detections(
                    Detections(
                        sample.stamp_ns, ids, bearings, variances, np.ones(3), np.zeros((3, 2))
                    )
                )

    def textbook() -> FloatArray:
        """EKF of three states that takes the map for exact and every sample as it comes."""
        pose, covariance = world.prior.pose, world.prior.covariance
        lever = np.asarray(MOUNT.axis_xyz[:2])
        for before, sample in pairwise(samples):
            motion = se2.relative(before.pose_odom_base, sample.pose_odom_base)
            by_pose, by_motion = se2.compose_jacobians(pose, motion)
            pose = se2.compose(pose, motion)
            covariance = by_pose @ covariance @ by_pose.T + 1e-8 * by_motion @ by_motion.T
            if sample.stamp_ns % 200_000_000:
                continue
            for position, bearing in zip(learned.positions[:3, :2], bearings, strict=True):
                offset = position - se2.transform_points(pose, lever)
                square = offset @ offset
                row = np.array([offset[1] / square, -offset[0] / square, -1.0])
                gain = covariance @ row / (row @ covariance @ row + _BEARING_SIGMA_RAD**2)
                expected = np.arctan2(offset[1], offset[0]) - pose[2]
                pose = pose + gain * wrap_rad(bearing - expected)
                covariance = covariance - np.outer(gain, row @ covariance)
        return pose

    return Comparison(
        'fusion, a second of a drive',
        ours,
        'EKF of three states, exact map, no delays',
        textbook,
    )


def _update(world: World) -> Comparison:
    """Predict, find three patches, fuse: 15 images a second."""
    config = LocalizationConfig(detection=DetectionConfig(max_count=3))
    localizer = Localizer(world.learned.map, Calibration.of_mount(MOUNT), config)
    localizer.add_odometry(OdometrySample(0, np.zeros(3)))
    localizer.initialize(world.prior)
    stamps = iter(range(66_000_000, 10**15, 66_000_000))
    sift = cv2.SIFT.create()
    # As images are decoded, from bags and topics alike.
    grey = np.asarray(cv2.cvtColor(world.view.image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)

    def ours() -> None:
        frame = replace(world.view, image=grey, stamp_ns=next(stamps))
        localizer.add_odometry(OdometrySample(frame.stamp_ns, np.zeros(3)))
        localizer.add_frame(frame)

    return Comparison(
        'one update, three patches',
        ours,
        'SIFT of the image alone (OpenCV)',
        lambda: sift.detectAndCompute(grey, None),
        calls=_UPDATES,
    )
