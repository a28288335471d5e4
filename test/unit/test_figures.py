"""Figures: maps, panoramas and runs, and those of the paper from recorded data."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from builders import bare_landmark
import cv2
import numpy as np
import pytest
from scenes import rectangle_room

from landmark_nav.cli.main import main
from landmark_nav.evaluation.figures import (
    draw_errors,
    draw_trajectory,
)
from landmark_nav.evaluation.figures.stereo_figure import ray_sigma_m
from landmark_nav.evaluation.metrics import PoseTrack
from landmark_nav.evaluation.replay import Replay
from landmark_nav.evaluation.run_report import run_errors
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.localization.localizer import LocalizationUpdate
from landmark_nav.localization.observer import Observation
from landmark_nav.storage.maps import write_map
from landmark_nav.types import (
    Detections,
    LandmarkMap,
    Panorama,
    PoseEstimate,
    Refusal,
)

WALLS = rectangle_room(5.0, 4.0, ()).walls

# How the figures draw landmarks, as OpenCV reads it back.
LANDMARK_BGR = (0x73, 0x9E, 0x00)


def landmark(identity, x):
    normal = np.array([0.0, 1.0, 0.0])
    position = np.array([x, 0.0, 1.2])
    return bare_landmark(identity, position, 1e-4 * np.eye(3), normal=normal, wall_id='south')


def a_map(count=3):
    places = (PoseEstimate(0, np.array([2.0, 2.0, 0.3]), 1e-5 * np.eye(3)),)
    members = tuple(landmark(k, 0.5 + 0.4 * k) for k in range(count))
    return LandmarkMap(members, 'map', WALLS, places)


def a_panorama():
    """A grey one."""
    cylinder, pixels = Cylinder(400, 80, 64.0, 199.5, 40.0), np.full((80, 400, 3), 200, np.uint8)
    return Panorama(0, pixels, np.ones((80, 400), bool), cylinder, np.zeros(3), 0.0, np.eye(4))


def share_of(path, color):
    """Share of an image that has a colour; fails if it is no image."""
    camera_image = cv2.imread(str(path))
    assert camera_image is not None
    return float(np.mean(np.all(np.abs(camera_image.astype(int) - color) < 30, axis=-1)))


def chosen(fix):
    return fix or Refusal('too few')


def a_run(truth=True, fixed=True):
    updates = []
    for k in range(30):
        pose = np.array([1.0 + 0.05 * k, 1.0, 0.1])
        fused = PoseEstimate(k * 10**8, pose + 0.01, np.diag([4e-4, 1e-4, 1e-5]))
        none = np.empty(0)
        seen = Detections(fused.stamp_ns, np.empty(0, int), none, none, none, np.empty((0, 2)))
        updates.append(
            LocalizationUpdate(
                fused.stamp_ns,
                Observation(seen, {}, partial(chosen, fused if fixed and k % 3 else None)),
                k % 3,
                fused,
                'lost' if k > 25 else 'tracking',
                '',
            )
        )
    stamps = np.arange(30) * 10**8
    poses = np.array([[1.0 + 0.05 * k, 1.0, 0.1] for k in range(30)])
    known = PoseTrack(stamps, poses) if truth else PoseTrack.of([])
    odometry = PoseTrack(stamps, poses + 0.03)
    start = PoseEstimate(0, poses[0], np.eye(3))
    return Replay(start, (), tuple(updates), np.full(30, 0.01), odometry, known, 1.0)


@pytest.mark.parametrize(('truth', 'fixed'), [(True, True), (False, True), (True, False)])
def test_runs_are_drawn_whatever_is_missing(tmp_path, truth, fixed, recwarn):
    run = a_run(truth, fixed)
    draw_trajectory(run, a_map(), tmp_path / 'trajectory.png')
    draw_errors(run, run_errors(run), tmp_path / 'errors.png')
    assert share_of(tmp_path / 'trajectory.png', LANDMARK_BGR) > 0.0
    assert cv2.imread(str(tmp_path / 'errors.png')) is not None
    assert [str(warning.message) for warning in recwarn] == []


BAGS = Path(__file__).parents[2] / 'bags'


WIDER_WALLS = rectangle_room(6.0, 4.0, ()).walls


def view(x=2.0, y=2.0, sigma_m=1e-3, sigma_rad=1e-4):
    return Panorama(
        0,
        np.full((100, 600, 3), 128, np.uint8),
        np.ones((100, 600), np.bool_),
        Cylinder(600, 100, 95.5, 299.5, 50.0),
        np.array([x, y, 1.1]),
        0.3,
        np.diag([sigma_m, sigma_m, 1e-3, sigma_rad]) ** 2,
    )


def typical_map():
    def landmark(number, position, normal, wall, saliency):
        return bare_landmark(
            number, np.array([*position, 1.3]), 1e-5 * np.eye(3), normal=np.array([*normal, 0.0]),
            patch=np.full((30, 30), 90, np.uint8), wall_id=wall, saliency=saliency,
        )  # fmt: skip

    return LandmarkMap(
        (
            landmark(1, (2.0, 0.0), (0.0, 1.0), 'south', 0.9),
            landmark(2, (2.6, 0.0), (0.0, 1.0), 'south', 0.8),
            landmark(3, (6.0, 2.5), (-1.0, 0.0), 'east', 0.3),
            landmark(4, (3.0, 4.0), (0.0, -1.0), 'north', 0.2),
        ),
        'map',
        WIDER_WALLS,
        (PoseEstimate(0, np.array([2.0, 2.0, 0.3]), 1e-6 * np.eye(3)),),
    )


def test_two_rays_scatter_as_predicted():
    pair = view(1.0, 1.0), view(3.0, 1.2)
    point = np.array([2.2, 3.5])
    rng = np.random.default_rng(0)
    found = []
    for _ in range(4000):
        rows, right = [], []
        for panorama in pair:
            away = point - panorama.center_map[:2]
            azimuth = np.arctan2(away[1], away[0]) + rng.normal(0.0, 1e-4)
            azimuth += rng.normal(0.0, 0.1 / panorama.cylinder.fx)
            center = panorama.center_map[:2] + rng.normal(0.0, 1e-3, 2)
            normal = np.array([-np.sin(azimuth), np.cos(azimuth)])
            rows.append(normal)
            # The ray starts where the panorama is, seen from where it is thought to be.
            right.append(normal @ center)
        found.append(np.linalg.solve(rows, right))
    scatter = np.sqrt(np.trace(np.cov(np.array(found).T)))
    assert ray_sigma_m(pair, point[None])[0] == pytest.approx(scatter, rel=0.05)


def test_all_figures_come_from_a_bag(tmp_path, capsys):
    arguments = ['figures', '--out', str(tmp_path), '--bag', str(BAGS / 'learn')]
    arguments += ['--room', str(BAGS / 'room.yaml'), '--robot', str(BAGS / 'robot.yaml')]
    assert main([*arguments, '--feature', 'corners']) == 0
    reported = capsys.readouterr().out
    for number in range(3, 9):
        (path,) = tmp_path.glob(f'figure_{number}_*.png')
        assert cv2.imread(str(path)).std() > 5.0
        assert f'Figure {number}' in reported


def test_a_map_gives_its_observation_areas(tmp_path, capsys):
    (tmp_path / 'map').mkdir()
    write_map(typical_map(), tmp_path / 'map')
    arguments = ['figures', '--out', str(tmp_path / 'out'), '--map', str(tmp_path / 'map')]
    assert main(arguments) == 0
    assert [p.name for p in (tmp_path / 'out').iterdir()] == ['figure_6_observation_areas.png']
    capsys.readouterr()
    assert main([*arguments, '--figure', '5']) == 2
    assert 'need --bag' in capsys.readouterr().err
