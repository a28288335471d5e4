"""Planning, and its first-order predictions against the stages themselves."""

from dataclasses import replace
from itertools import combinations

from builders import panorama_of
import numpy as np
import pytest
from scenes import rectangle_room
from scipy.linalg import block_diag

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.walls import Marker, Paper
from landmark_nav.learning.adjustment.problem import AdjustmentConfig
from landmark_nav.learning.adjustment.solution import adjust
from landmark_nav.learning.reference_area.common_errors import (
    joined,
    joint_covariance,
    pose_errors,
)
from landmark_nav.learning.reference_area.model import MEASURED
from landmark_nav.learning.stereo.wall_patch import PatchMeasurement
from landmark_nav.planning.planner import exchange, forecast, plan_positions
from landmark_nav.planning.prediction import landmark_errors
from landmark_nav.planning.views import ahead_rad, is_free, PlanConfig

MOUNT = PanTiltMount((0.08, 0.0, 1.1))
# Coarser than by default: quicker.
CONFIG = PlanConfig(spacing_m=0.4)
PAPERS = tuple(
    Paper(color, (x, 0.0, 1.6), 0.21, 0.297)
    for color, x in (('red', 1.6), ('green', 2.7), ('blue', 3.9))
)
ROOM = rectangle_room(5.0, 4.0, PAPERS)

HIGH = tuple(replace(paper, center=(*paper.center[:2], 3.3)) for paper in PAPERS)


def silent(items, _what, _total):
    return iter(items)


@pytest.fixture(scope='module')
def plan():
    return plan_positions(ROOM, MOUNT, 2, CONFIG, np.random.default_rng(1))


class TestSearch:
    def test_finds_the_best_set_of_a_smooth_cost(self):
        xy = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0)), -1).reshape(-1, 2)
        goals = np.array([[0.2, 0.1], [3.9, 0.3], [2.1, 2.8]])

        def cost(places):
            gap = np.linalg.norm(xy[places][:, None] - goals, axis=-1)
            return float(gap.min(axis=0).sum())

        found = exchange(cost, xy, np.array([3, 9, 12]), silent)
        best = min(cost(np.array(s)) for s in combinations(range(len(xy)), 3))
        assert cost(found) == pytest.approx(best)
        assert sorted(xy[found, 0]) == list(xy[found, 0])

    def test_of_many_positions_the_work_is_bounded(self):
        xy = np.random.default_rng(2).uniform(0.0, 10.0, (200, 2))

        def worked(count):
            asked = []

            def cost(places):
                asked.append(len(places) ** 2)
                return float(xy[places].sum())

            start = np.argsort(-xy.sum(axis=1))[:count]
            found = exchange(cost, xy, start, silent)
            return sum(asked), cost(found) / cost(start)

        (few, _), (many, gain) = worked(15), worked(60)
        assert many < 16 * few, '48 times as many if all were tried'
        assert gain < 0.6


class TestPlan:
    def test_beats_random_places(self, plan):
        assert plan.best.cost_m < plan.random[0].cost_m
        costs = [f.cost_m for f in plan.random]
        assert len(costs) == CONFIG.random_sets
        assert costs == sorted(costs)
        xy = plan.best.poses_map_base[:, :2]
        assert is_free(ROOM, CONFIG.clearance_m, xy).all()
        assert 1.0 < np.linalg.norm(xy[1] - xy[0]) < 5.0
        assert len(plan.accuracy_map.floor_xy) > 2 * len(plan.best.floor_xy)
        assert plan.accuracy_map.cost_m == pytest.approx(plan.best.cost_m, rel=0.1)

    def test_headings_are_planned_where_the_camera_does_not_turn_all_round(self, plan):
        limited = replace(CONFIG, pan_min_rad=0.5, pan_max_rad=2.5)
        best = plan_positions(ROOM, MOUNT, 2, limited, np.random.default_rng(1)).best
        assert plan.best.cost_m < best.cost_m < 0.02
        assert best.landmarks.sum() >= 20
        away = ahead_rad(best.poses_map_base[:, :2], ROOM) - best.poses_map_base[:, 2]
        half_fov = np.arctan(0.5 * limited.width_px / limited.focal_px)
        assert np.all(wrap_rad(away - 1.5) < 1.0 + half_fov)
        # Where the joint has its zero is of no importance.
        ahead = replace(CONFIG, pan_min_rad=-1.0, pan_max_rad=1.0)
        still = PanTiltMount((0.0, 0.0, MOUNT.axis_xyz[2]))
        cells = plan.best.floor_xy[::5]
        (one,) = forecast([best.poses_map_base], cells, ROOM, still, limited)
        turned = np.add(best.poses_map_base, [0.0, 0.0, 1.5])
        (other,) = forecast([turned], cells, ROOM, still, ahead)
        assert one.cost_m == pytest.approx(other.cost_m)

    def test_a_room_whose_walls_were_found_names_no_papers(self):
        free = plan_positions(rectangle_room(5.0, 4.0), MOUNT, 2, CONFIG, np.random.default_rng(1))
        places = free.best.poses_map_base
        assert np.linalg.norm(places[1, :2] - places[0, :2]) > 0.5
        assert np.isfinite(free.best.sigma_m).all()
        assert free.best.cost_m < np.median([other.cost_m for other in free.random])

    def test_markers_serve_where_there_are_no_papers(self):
        hung = [(1.5, 0.0, 1.3), (5.0, 1.5, 1.0), (2.4, 4.0, 1.2), (0.0, 2.4, 1.0)]
        markers = tuple(Marker(k, center, 0.16) for k, center in enumerate(hung))
        marked = replace(rectangle_room(5.0, 4.0), markers=markers)
        found = plan_positions(marked, MOUNT, 2, CONFIG, np.random.default_rng(1)).best
        assert np.isfinite(found.sigma_m).all()
        # What hangs all around gives poses; sigmas are those of its errors.
        small = tuple(replace(marker, size=0.02) for marker in markers)
        with pytest.raises(LandmarkNavError, match='see 2 of 4 markers whole'):
            plan_positions(
                replace(marked, markers=small), MOUNT, 2, CONFIG, np.random.default_rng(1)
            )
        with pytest.raises(LandmarkNavError, match='names 1 reference markers: list 2'):
            plan_positions(
                replace(marked, markers=markers[:1]), MOUNT, 2, CONFIG, np.random.default_rng(1)
            )

    @pytest.mark.parametrize('tilt_rad', [-0.3, 0.3])
    def test_a_tilted_camera_sees_other_heights(self, plan, tilt_rad):
        poses, cells = plan.best.poses_map_base, plan.best.floor_xy[::5]
        low = replace(CONFIG, texture_low_m=0.1, texture_high_m=0.8)
        (level,), (tilted,) = (
            forecast([poses], cells, rectangle_room(5.0, 4.0), MOUNT, config)
            for config in (low, replace(low, camera_tilt_rad=tilt_rad))
        )
        more = tilted.landmarks.sum() > level.landmarks.sum()
        assert more == (tilt_rad < 0.0)

    def test_blank_walls_above_the_image_give_nothing(self, plan):
        config = replace(CONFIG, texture_low_m=3.9, texture_high_m=4.0)
        tall = rectangle_room(5.0, 4.0, PAPERS, height=4.0)
        (nothing,) = forecast([plan.best.poses_map_base], plan.best.floor_xy, tall, MOUNT, config)
        assert nothing.landmarks.sum() == 0.0
        assert np.isinf(nothing.sigma_m).all()
        with pytest.raises(LandmarkNavError, match='no 2 places see the same walls'):
            plan_positions(tall, MOUNT, 2, config, np.random.default_rng(0))


class TestBadInput:
    @pytest.mark.parametrize(
        ('room', 'count', 'message'),
        [
            (ROOM, 1, 'from two places or more'),
            (ROOM, -3, 'from two places or more'),
            (rectangle_room(5.0, 4.0, PAPERS[:2]), 2, 'names 2 reference papers'),
            (rectangle_room(5.0, 0.7, PAPERS), 2, 'too small for this clearance'),
            # The papers hang so high that no place in the room has them in its image.
            (rectangle_room(5.0, 4.0, HIGH, height=3.6), 2, '0 places .* see all 3 papers'),
        ],
    )
    def test_what_can_not_be_planned_is_one_line(self, room, count, message):
        with pytest.raises(LandmarkNavError, match=message):
            plan_positions(room, MOUNT, count, CONFIG, np.random.default_rng(0))

    def test_forecast_of_a_place_without_papers(self):
        poses = np.array([[2.0, 2.5, 0.0], [2.5, 0.5, 0.0]])
        with pytest.raises(LandmarkNavError, match='1 of 2 places do not see all 3 papers'):
            forecast([poses], poses[:, :2], ROOM, MOUNT, CONFIG)


DEFAULT = PlanConfig()
HUNG = tuple(
    Paper(color, (x, 0.0, 1.6), 0.21, 0.297)
    for color, x in (('red', 2.0), ('green', 3.1), ('blue', 4.4))
)
LARGE_ROOM = rectangle_room(6.0, 5.0, HUNG)


def errors_at(eye):
    return pose_errors(eye, LARGE_ROOM, DEFAULT.focal_px)


class TestPaperPose:
    def test_covariance_is_that_of_fits_to_noisy_edges(self):
        # Least squares of the twelve edges, its derivatives by differences, many times.
        eye = np.array([2.4, 2.2, 1.1])
        rng = np.random.default_rng(5)
        tilts = [MEASURED.horizon_sigma_rad] * 2
        given = [MEASURED.height_sigma_m, *tilts, MEASURED.paper_size_sigma]
        prior = np.array([np.inf] * 3 + given)
        prior = np.append(prior, [MEASURED.paper_sigma_m] * 6)
        pixel = np.hypot(0.03, MEASURED.edge_sigma_px) / DEFAULT.focal_px

        def edges(p):
            measured = []
            for k, paper in enumerate(HUNG):
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
    image, cylinder = np.zeros((2, 2, 3), np.uint8), Cylinder(2, 2, DEFAULT.focal_px, 0.0, 0.0)
    found = []
    for pose, cov in zip(poses, covariance, strict=True):
        full = np.diag([0.0, 0.0, 1e-8, 0.0])
        full[np.ix_([0, 1, 3], [0, 1, 3])] = cov
        given = {'center_map': np.array([*pose[:2], 1.1]), 'heading_rad': float(pose[2])}
        found.append(panorama_of(image, cylinder, covariance=full, **given))
    return found


def joint(own, loading):
    """Covariance of all landmarks (2n, 2n) out of own (n, 2, 2) and shared (n, 2, m) parts."""
    flat = loading.reshape(2 * len(own), -1)
    return np.asarray(flat @ flat.T + block_diag(*own))


def test_landmark_errors_are_those_of_the_adjustment():
    poses = np.array([[2.0, 2.0, 0.3], [4.1, 2.6, -1.0], [3.0, 3.4, 2.0]])
    walls = np.repeat(np.arange(4), 6)
    rng = np.random.default_rng(3)
    start = np.array([w.start for w in LARGE_ROOM.walls])[walls]
    end = np.array([w.end for w in LARGE_ROOM.walls])[walls]
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
    places = joint_covariance(views, LARGE_ROOM)
    done = adjust(measurements, list(walls), points, views, places, LARGE_ROOM, config)
    own, loading = landmark_errors(
        azimuth, np.linalg.norm(delta, axis=-1),
        np.full((3, 24), 1.0 / (sigma**2 + config.azimuth_sigma_rad**2)),
        LARGE_ROOM.normals[walls, :2], walls, np.ones(24), joined(spread, by_papers), config,
    )  # fmt: skip
    expected = joint(done.own_covariance[:, :2, :2], done.shared_loading[:, :2])
    np.testing.assert_allclose(joint(own, loading), expected, rtol=2e-2, atol=5e-7)
