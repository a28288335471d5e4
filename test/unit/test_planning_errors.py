"""First-order predictions of planning against the stages themselves."""

import numpy as np
import pytest
from scenes import rectangle_room
from scipy.linalg import block_diag

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.walls import Paper
from landmark_nav.learning.adjustment.problem import AdjustmentConfig
from landmark_nav.learning.adjustment.solution import adjust
from landmark_nav.learning.reference_area.common_errors import (
    joined,
    joint_covariance,
    pose_errors,
)
from landmark_nav.learning.stereo.wall_patch import PatchMeasurement
from landmark_nav.planning.prediction import landmark_errors, Predictor
from landmark_nav.planning.views import free_floor, look, PlanConfig, sample_walls
from landmark_nav.types import Panorama

CONFIG = PlanConfig()
MOUNT = PanTiltMount((0.0, 0.0, 1.1))
PAPERS = tuple(
    Paper(color, (x, 0.0, 1.6), 0.21, 0.297)
    for color, x in (('red', 2.0), ('green', 3.1), ('blue', 4.4))
)
ROOM = rectangle_room(6.0, 5.0, PAPERS)


def errors_at(eye):
    return pose_errors(eye, ROOM, CONFIG.reference_area, CONFIG.focal_px)


class TestPaperPose:
    def test_covariance_is_that_of_fits_to_noisy_edges(self):
        # Least squares of the twelve edges, its derivatives by differences, many times.
        eye = np.array([2.4, 2.2, 1.1])
        rng = np.random.default_rng(5)
        area = CONFIG.reference_area
        tilts = [area.horizon_sigma_rad] * 2
        given = [area.height_sigma_m, *tilts, area.paper_size_sigma]
        prior = np.array([np.inf] * 3 + given)
        prior = np.append(prior, [area.paper_sigma_m] * 6)
        pixel = np.hypot(0.03, area.edge_sigma_px) / CONFIG.focal_px

        def edges(p):
            measured = []
            for k, paper in enumerate(PAPERS):
                x, y, z = np.add(paper.center, (p[7 + 2 * k], 0.0, p[8 + 2 * k])) - eye
                x, y, z = x - p[0], y - p[1], z - p[3]
                x, y, z = np.array([x, y, z]) - np.cross([p[4], p[5], 0.0], [x, y, z])
                half = (1.0 + p[6]) * paper.width / 2
                left, right = x - half, x + half
                measured += [np.arctan2(y, left) - p[2], np.arctan2(y, right) - p[2]]
                for side in (-1.0, 1.0):
                    reach, up = np.hypot(x, y), side * (1.0 + p[6]) * paper.height / 2
                    measured.append((z + up) / reach)
            return np.array(measured)

        zero, step = np.zeros(13), 1e-6
        jacobian = np.stack(
            [(edges(step * e) - edges(-step * e)) / (2 * step) for e in np.eye(13)], 1
        )
        truth = rng.normal(size=(20000, 13)) * np.where(np.isfinite(prior), prior, 0.0)
        noise = rng.normal(0.0, pixel, (20000, 12))
        normal = jacobian.T @ jacobian / pixel**2 + np.diag(prior**-2)
        estimate = (truth @ jacobian.T + noise) @ jacobian @ np.linalg.inv(normal) / pixel**2
        spread = np.cov((estimate - truth)[:, :3].T)
        predicted, by_papers = (a[0] for a in errors_at(eye[None]))
        sigma = np.sqrt(np.diag(predicted))
        np.testing.assert_allclose(
            spread / np.outer(sigma, sigma), predicted / np.outer(sigma, sigma), atol=0.05
        )
        assert edges(zero).shape == (12,)
        # What a size or a paper's place moves, estimates follow.
        moved = np.linalg.lstsq(truth[:, 6:] / prior[6:], (estimate - truth)[:, :3], rcond=None)[0]
        np.testing.assert_allclose(
            moved.T / sigma[:, None], -by_papers / sigma[:, None], atol=0.05
        )


def panoramas(poses, covariance):
    """Of x, y and heading; heights are known."""
    found = []
    for pose, cov in zip(poses, covariance, strict=True):
        full = np.diag([0.0, 0.0, 1e-8, 0.0])
        full[np.ix_([0, 1, 3], [0, 1, 3])] = cov
        image = np.zeros((2, 2, 3), np.uint8)
        cylinder = Cylinder(2, 2, CONFIG.focal_px, 0.0, 0.0)
        center = np.array([*pose[:2], 1.1])
        found.append(Panorama(0, image, image[..., 0] > 0, cylinder, center, float(pose[2]), full))
    return found


def joint(own, loading):
    """Covariance of all landmarks (2n, 2n) out of own (n, 2, 2) and shared (n, 2, m) parts."""
    flat = loading.reshape(2 * len(own), -1)
    return np.asarray(flat @ flat.T + block_diag(*own))


def test_landmark_errors_are_those_of_the_adjustment():
    poses = np.array([[2.0, 2.0, 0.3], [4.1, 2.6, -1.0], [3.0, 3.4, 2.0]])
    walls = np.repeat(np.arange(4), 6)
    rng = np.random.default_rng(3)
    start = np.array([w.start for w in ROOM.walls])[walls]
    end = np.array([w.end for w in ROOM.walls])[walls]
    # Apart from each other: each hangs for itself.
    along = np.tile(np.linspace(0.1, 0.85, 6), 4) + rng.uniform(0.0, 0.04, 24)
    xy = start + along[:, None] * (end - start)
    points = np.column_stack([xy, np.full(24, 1.1)])
    sigma = 4e-4
    delta = xy - poses[:, None, :2]
    azimuth = np.arctan2(delta[..., 1], delta[..., 0])
    measurements = [
        [PatchMeasurement(i, azimuth[i, k] - poses[i, 2], 0.0, sigma, 1e-3, 1.0) for i in range(3)]
        for k in range(24)
    ]
    eye = np.column_stack([poses[:, :2], np.full(3, 1.1)])
    spread, by_papers = errors_at(eye)
    config = AdjustmentConfig(camera_weight=1e9, place_weight=1e9, room_weight=1e9)
    views = panoramas(poses, spread)
    places = joint_covariance(views, ROOM, CONFIG.reference_area)
    done = adjust(measurements, list(walls), points, views, places, ROOM, config)
    own, loading = landmark_errors(
        azimuth,
        np.linalg.norm(delta, axis=-1),
        np.full((3, 24), 1.0 / (sigma**2 + config.azimuth_sigma_rad**2)),
        ROOM.normals[walls, :2],
        walls,
        np.ones(24),
        joined(spread, by_papers),
        config,
    )
    expected = joint(done.own_covariance[:, :2, :2], done.shared_loading[:, :2])
    np.testing.assert_allclose(joint(own, loading), expected, rtol=2e-2, atol=5e-7)


class TestPredictor:
    def predictor(self, poses):
        samples = sample_walls(ROOM, 0.3, 1000)
        views = look(poses, samples, ROOM, MOUNT, CONFIG)
        assert len(views) == len(poses)
        return Predictor(views, samples, free_floor(ROOM, 0.4, 0.5, 100), ROOM, CONFIG)

    def test_wider_baseline_is_better_until_views_part(self):
        x = np.array([3.0, 3.15, 3.4, 4.0, 5.0])
        poses = np.column_stack([x, np.full(5, 2.4), np.zeros(5)])
        predictor = self.predictor(poses)
        costs = [predictor.cost_m(np.array([0, k])) for k in range(1, 5)]
        assert costs == sorted(costs, reverse=True)
        sigmas = [predictor.predict(np.array([0, k])).landmark_sigma_m for k in range(1, 5)]
        assert sigmas[0] > 2.0 * sigmas[-1]

    def test_one_place_twice_shows_no_depth(self):
        poses = np.tile([3.0, 2.4, 0.0], (2, 1))
        nothing = self.predictor(poses).predict(np.array([0, 1]))
        assert nothing.landmarks.sum() == 0.0
        assert nothing.landmark_sigma_m == np.inf
        assert np.isinf(nothing.sigma_m).all()
        assert nothing.cost_m == pytest.approx(0.05)
