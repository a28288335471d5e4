"""First-order predictions of planning against the stages themselves."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import rectangle_room
from scipy.linalg import block_diag

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.walls import Paper
from landmark_nav.learning.adjustment import adjust, AdjustmentConfig
from landmark_nav.learning.reference_area import joined, joint_covariance, pose_errors
from landmark_nav.learning.stereo.wall_patch import PatchMeasurement
from landmark_nav.localization.triangulation import triangulate
from landmark_nav.localization.triangulation.model import bearing_gradients
from landmark_nav.planning.prediction import landmark_errors, localization_sigma, Predictor
from landmark_nav.planning.views import free_floor, look, papers_seen, PlanConfig, sample_walls
from landmark_nav.types import FloatArray, Panorama, Refusal

CONFIG = PlanConfig()
MOUNT = PanTiltMount((0.0, 0.0, 1.1))
PAPERS = tuple(
    Paper(color, (x, 0.0, 1.6), 0.21, 0.297)
    for color, x in (('red', 2.0), ('green', 3.1), ('blue', 4.4))
)
ROOM = rectangle_room(6.0, 5.0, PAPERS)


def errors_at(eye: FloatArray) -> tuple[FloatArray, FloatArray]:
    return pose_errors(eye, ROOM, CONFIG.reference_area, CONFIG.focal_px)


class TestPaperPose:
    def test_covariance_is_that_of_fits_to_noisy_edges(self) -> None:
        # Least squares of the twelve edges, its derivatives by differences, many times.
        eye = np.array([2.4, 2.2, 1.1])
        rng = np.random.default_rng(5)
        area = CONFIG.reference_area
        tilts = [area.horizon_sigma_rad] * 2
        given = [area.height_sigma_m, *tilts, area.paper_size_sigma]
        prior = np.array([np.inf] * 3 + given)
        prior = np.append(prior, [area.paper_sigma_m] * 6)
        pixel = np.hypot(0.03, area.edge_sigma_px) / CONFIG.focal_px

        def edges(p: FloatArray) -> FloatArray:
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

    def test_papers_are_seen_from_before_them_and_not_too_near(self) -> None:
        eye = np.array([[3.1, 2.0, 1.1], [3.1, 0.6, 1.1], [0.2, 0.4, 1.1], [3.1, -2.0, 1.1]])
        seen = papers_seen(eye, ROOM, CONFIG)
        assert seen[0].all()
        assert not seen[1, 1]
        assert not seen[2:].any()


def panoramas(poses: FloatArray, covariance: FloatArray) -> list[Panorama]:
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


def joint(own: FloatArray, loading: FloatArray) -> FloatArray:
    """Covariance of all landmarks (2n, 2n) out of own (n, 2, 2) and shared (n, 2, m) parts."""
    flat = loading.reshape(2 * len(own), -1)
    return np.asarray(flat @ flat.T + block_diag(*own))


def test_landmark_errors_are_those_of_the_adjustment() -> None:
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


def test_two_landmarks_at_a_point_are_worth_two() -> None:
    rng = np.random.default_rng(8)
    azimuth, reach = rng.uniform(-3.0, 3.0, (2, 10)), rng.uniform(1.0, 4.0, (2, 10))
    normal = np.tile([[1.0, 0.0]], (10, 1))
    spread = np.diag([1e-5, 1e-5, 1e-6] * 2)
    weight = np.full((2, 10), 1e6)
    twice = [np.concatenate([a, a], -1) for a in (azimuth, reach, weight)]
    config = AdjustmentConfig()
    wall = np.zeros(20, np.intp)
    _, one = landmark_errors(
        azimuth, reach, weight, normal, wall[:10], np.full(10, 2.0), spread, config
    )
    _, two = landmark_errors(*twice, np.tile(normal, (2, 1)), wall, np.ones(20), spread, config)
    first = two[:10].reshape(20, -1)
    np.testing.assert_allclose(
        one.reshape(20, -1) @ one.reshape(20, -1).T, first @ first.T, rtol=1e-6, atol=1e-12
    )


def test_localization_sigma_is_that_of_a_triangulation() -> None:
    rng = np.random.default_rng(4)
    landmarks = rng.uniform((-4.0, 2.0), (4.0, 10.0), (9, 2))
    places = rng.uniform(-1.0, 1.0, (5, 2))
    half = rng.normal(0.0, 3e-3, (9, 2, 2))
    own = half @ half.swapaxes(1, 2)
    loading = rng.normal(0.0, 4e-3, (9, 2, 7))
    joint = np.einsum('iap,jbp->iajb', loading, loading)
    for k in range(9):
        joint[k, :, k] += own[k]
    seen = np.ones((5, 9))
    seen[:, 7:] = 0.0
    gradient = bearing_gradients(places, landmarks)
    found = localization_sigma(gradient, seen, own, loading, 5e-4)
    for k, place in enumerate(places):
        delta = landmarks[:7] - place
        fix = triangulate(
            landmarks[:7],
            np.arctan2(delta[:, 1], delta[:, 0]),
            np.full(7, 5e-4**2),
            joint[:7, :, :7].reshape(14, 14),
        )
        assert not isinstance(fix, Refusal)
        assert found[k] == pytest.approx(np.sqrt(np.trace(fix.covariance[:2, :2])), rel=1e-6)


def test_fewer_than_three_landmarks_give_nothing() -> None:
    landmarks = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.5], [0.3, -2.0]])
    gradient = bearing_gradients(np.zeros((3, 2)), landmarks)
    seen = np.array([[1.0, 1.0, 0.0, 0.0], [1.0, 1.0, 1.0, 0.0], [0.7, 0.7, 0.7, 0.8]])
    sigma = localization_sigma(
        gradient, seen, np.tile(1e-6 * np.eye(2), (4, 1, 1)), np.zeros((4, 2, 2)), 1e-3
    )
    assert np.isinf(sigma[:2]).tolist() == [True, False]
    assert np.isinf(sigma[2])


class TestPredictor:
    def predictor(self, poses: FloatArray) -> Predictor:
        samples = sample_walls(ROOM, 0.3, 1000)
        views = look(poses, samples, ROOM, MOUNT, CONFIG)
        assert len(views) == len(poses)
        return Predictor(views, samples, free_floor(ROOM, 0.4, 0.5, 100), ROOM, CONFIG)

    def test_wider_baseline_is_better_until_views_part(self) -> None:
        x = np.array([3.0, 3.15, 3.4, 4.0, 5.0])
        poses = np.column_stack([x, np.full(5, 2.4), np.zeros(5)])
        predictor = self.predictor(poses)
        costs = [predictor.cost_m(np.array([0, k])) for k in range(1, 5)]
        assert costs == sorted(costs, reverse=True)
        sigmas = [predictor.predict(np.array([0, k])).landmark_sigma_m for k in range(1, 5)]
        assert sigmas[0] > 2.0 * sigmas[-1]

    def test_one_place_twice_shows_no_depth(self) -> None:
        poses = np.tile([3.0, 2.4, 0.0], (2, 1))
        nothing = self.predictor(poses).predict(np.array([0, 1]))
        assert nothing.landmarks.sum() == 0.0
        assert nothing.landmark_sigma_m == np.inf
        assert np.isinf(nothing.sigma_m).all()
        assert nothing.cost_m == pytest.approx(0.05)

    def test_no_more_landmarks_than_a_map_may_hold(self) -> None:
        poses = np.array([[2.0, 2.0, 0.0], [4.0, 2.2, 0.0], [3.0, 3.0, 0.0], [2.5, 2.8, 0.0]])
        prediction = self.predictor(poses).predict(np.arange(4))
        assert prediction.landmarks.sum() <= CONFIG.election.max_count + 1e-9
        assert prediction.landmarks.sum() > 0.5 * CONFIG.election.max_count
        other = self.predictor(poses).predict(np.array([2, 0, 3, 1]))
        np.testing.assert_allclose(prediction.sigma_m, other.sigma_m, rtol=1e-6)
