"""Figures: maps, panoramas and runs, and those of the paper from recorded data."""

from dataclasses import replace
from functools import partial

from builders import bare_landmark, detections_of, panorama_of
import cv2
from harness import BAGS
import numpy as np
import pytest
from scenes import rectangle_room

from landmark_nav.cli.main import main
from landmark_nav.evaluation.figures import draw_errors, draw_map, draw_trajectory
from landmark_nav.evaluation.figures.stereo_figure import ray_sigma_m
from landmark_nav.evaluation.metrics import PoseTrack
from landmark_nav.evaluation.replay import Replay
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.walls import Marker, Paper, Room
from landmark_nav.learning.attention.maps import AttentionConfig
from landmark_nav.localization.localizer import LocalizationUpdate
from landmark_nav.localization.observer import Observation
from landmark_nav.storage.bags import read_sweeps
from landmark_nav.storage.maps import write_map
from landmark_nav.types import LandmarkMap, PoseEstimate, Refusal

WALLS = rectangle_room(5.0, 4.0, ()).walls


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Figures of few pixels, with few candidates."""
    monkeypatch.setattr('landmark_nav.evaluation.figures.style.DPI', 60)
    few = partial(AttentionConfig, candidates=40)
    monkeypatch.setattr('landmark_nav.cli.figures.AttentionConfig', few)


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
    return panorama_of(np.full((80, 400, 3), 200, np.uint8), Cylinder(400, 80, 64.0, 199.5, 40.0))


def share_of(path, color):
    """Share of an image that has a colour; fails if it is no image."""
    camera_image = cv2.imread(str(path))
    return float(np.mean(np.all(np.abs(camera_image.astype(int) - color) < 30, axis=-1)))


def a_run(truth=True, fixed=True):
    stamps, poses = np.arange(30) * 10**8, np.tile([1.0, 1.0, 0.1], (30, 1))
    poses[:, 0] += 0.05 * np.arange(30)
    updates = []
    for k, (stamp, pose) in enumerate(zip(stamps.tolist(), poses, strict=True)):
        fused = PoseEstimate(stamp, pose + 0.01, np.diag([4e-4, 1e-4, 1e-5]))
        fix = fused if fixed and k % 3 else Refusal('too few')
        seen = Observation(detections_of(stamp), {}, lambda fix=fix: fix)
        status = 'lost' if k > 25 else 'OK'
        updates.append(LocalizationUpdate(stamp, seen, k % 3, fused, status, ''))
    known = PoseTrack(stamps, poses) if truth else PoseTrack.of([])
    odometry = PoseTrack(stamps, poses + 0.03)
    start = PoseEstimate(0, poses[0], np.eye(3))
    return Replay(start, (), tuple(updates), np.full(30, 0.01), odometry, known, 1.0)


@pytest.mark.parametrize(('truth', 'fixed'), [(True, True), (False, True), (True, False)])
def test_runs_are_drawn_whatever_is_missing(tmp_path, truth, fixed, recwarn):
    run = a_run(truth, fixed)
    draw_trajectory(run, a_map(), tmp_path / 'trajectory.png')
    draw_errors(run, tmp_path / 'errors.png')
    assert share_of(tmp_path / 'trajectory.png', LANDMARK_BGR) > 0.0
    assert cv2.imread(str(tmp_path / 'errors.png')) is not None
    assert [str(warning.message) for warning in recwarn] == []


def test_two_rays_scatter_as_predicted():
    image, cylinder = np.zeros((100, 600, 3), np.uint8), Cylinder(600, 100, 95.5, 299.5, 50.0)
    covariance = np.diag([1e-3, 1e-3, 1e-3, 1e-4]) ** 2
    pair = [
        panorama_of(image, cylinder, center_map=np.array([*xy, 1.1]), covariance=covariance)
        for xy in ((1.0, 1.0), (3.0, 1.2))
    ]
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


def test_all_figures_come_from_a_bag(tmp_path, capsys, monkeypatch):
    def thinned(*given):
        for sweep in read_sweeps(*given):
            # A third of the frames still overlap.
            yield replace(sweep, frames=sweep.frames[::3])

    monkeypatch.setattr('landmark_nav.cli.figures.read_sweeps', thinned)
    arguments = ['figures', '--out', str(tmp_path), '--bag', str(BAGS / 'learn')]
    arguments += ['--room', str(BAGS / 'room.yaml'), '--robot', str(BAGS / 'robot.yaml')]
    assert main([*arguments, '--feature', 'corners']) == 0
    reported = capsys.readouterr().out
    for number in range(3, 9):
        (path,) = tmp_path.glob(f'figure_{number}_*.png')
        assert cv2.imread(str(path)).std() > 5.0
        assert f'Figure {number}' in reported


@pytest.mark.parametrize('kind', ['papers', 'markers'])
def test_maps_and_pages_show_what_gives_poses(tmp_path, kind):
    center = (2.0, 0.0, 1.4)
    hung = {'papers': (Paper('magenta', center, 0.2, 0.3),), 'markers': (Marker(3, center, 0.1),)}
    room = replace(Room(WALLS), **{kind: hung[kind]})
    color = {'papers': room.anchors[0].bgr, 'markers': (0.0, 0.0, 0.0)}[kind]
    shares = []
    for name, anchors in (('none', ()), ('some', room.anchors)):
        draw_map(a_map(), tmp_path / f'{name}.png', anchors)
        shares.append(share_of(tmp_path / f'{name}.png', color))
    assert shares[1] > shares[0]


def test_a_map_gives_its_observation_areas(tmp_path, capsys):
    (tmp_path / 'map').mkdir()
    write_map(a_map(), tmp_path / 'map')
    arguments = ['figures', '--out', str(tmp_path / 'out'), '--map', str(tmp_path / 'map')]
    assert main(arguments) == 0
    assert [p.name for p in (tmp_path / 'out').iterdir()] == ['figure_6_observation_areas.png']
    capsys.readouterr()
    assert main([*arguments, '--figure', '5']) == 2
    assert 'need --bag' in capsys.readouterr().err
