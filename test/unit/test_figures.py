"""Figures: maps, panoramas and runs, and those of the paper from recorded data."""

from __future__ import annotations

from functools import partial
from pathlib import Path
import re

from bare_landmarks import bare_landmark
import cv2
import numpy as np
import pytest
from scenes import draw_panorama as seen_panorama
from scenes import rectangle_room, textured_room

from landmark_nav.cli.main import main
from landmark_nav.evaluation.figures import (
    draw_errors,
    draw_map,
    draw_panorama,
    draw_trajectory,
)
from landmark_nav.evaluation.figures.map_figure import draw_learned, typical_landmarks
from landmark_nav.evaluation.figures.panorama_figure import draw_sweeps
from landmark_nav.evaluation.figures.stereo_figure import draw_reconstruction, ray_sigma_m
from landmark_nav.evaluation.figures.style import Strip, widest
from landmark_nav.evaluation.metrics import PoseTrack
from landmark_nav.evaluation.replay import Replay
from landmark_nav.evaluation.run_report import run_errors
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.walls import Paper
from landmark_nav.learning.attention.maps import AttentionConfig
from landmark_nav.learning.pipeline import learn_from_panoramas, LearningConfig
from landmark_nav.localization.localizer import LocalizationUpdate
from landmark_nav.localization.observer import Observation
from landmark_nav.storage.maps import write_map
from landmark_nav.types import (
    CameraFrame,
    Candidate,
    Detections,
    LandmarkMap,
    Panorama,
    PoseEstimate,
    Refusal,
    Sweep,
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


def test_map_shows_its_landmarks(tmp_path):
    papers = [Paper('red', (1, 0.02, 1.7), 0.2, 0.3), Paper('#8020c0', (2, 0.02, 1.7), 0.2, 0.3)]
    full, again, empty = (tmp_path / f'{name}.png' for name in ('map', 'again', 'empty'))
    for path, count in ((full, 3), (again, 3), (empty, 0)):
        draw_map(a_map(count), path, papers)
    assert share_of(full, LANDMARK_BGR) > share_of(empty, LANDMARK_BGR)
    assert full.read_bytes() == again.read_bytes()
    assert share_of(full, (0xC0, 0x20, 0x80)) > 0.0


@pytest.mark.parametrize('column', [100.0, 1.0, 399.0])
def test_panorama_marks_what_was_elected(tmp_path, column):
    view = a_panorama()
    candidates = [Candidate(column, 40.0, 20, 20, 1.0)]
    draw_panorama(view, candidates, [landmark(7, 1.0)], tmp_path / 'elected.png')
    draw_panorama(view, candidates, [Refusal('too far')], tmp_path / 'refused.png')
    assert share_of(tmp_path / 'elected.png', LANDMARK_BGR) > 0.0005
    assert share_of(tmp_path / 'refused.png', LANDMARK_BGR) == 0.0


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
PAPERS = tuple(
    Paper(color, (5.0, y, 1.2), 0.21, 0.297)
    for color, y in (('red', 1.0), ('green', 2.0), ('blue', 3.0))
)
ROOM = rectangle_room(5.0, 4.2, PAPERS)
POSES = np.array([[1.8, 1.7, 0.5], [3.0, 2.5, -1.9]])
MOUNT = PanTiltMount(axis_xyz=(0.0, 0.0, 1.1))


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


def test_strips_go_round_the_seam_and_know_where_patches_are():
    panorama = view()
    panorama.image[40:60, [598, 599, 0, 1]] = 255
    strip = Strip.around(panorama, 0.0, 50.0, 120)
    cut = strip.cut(panorama.image)
    assert cut.shape[1] == 120
    assert np.flatnonzero((cut[..., 0] == 255).any(axis=0)).tolist() == [58, 59, 60, 61]
    place = strip.place(Candidate(0.5, 50.0, 10, 10, 1.0), 600)
    assert place == pytest.approx((60.5, 50.0 - strip.top))
    assert strip.place(Candidate(300.0, 50.0, 10, 10, 1.0), 600) is None
    # The widest one shows the first candidate.
    many = [Candidate(300.0 + 5 * k, 50.0, 10, 10, 0.2) for k in range(8)]
    first = Candidate(590.0, 50.0, 10, 10, 1.0)
    assert widest(view(), [first, *many], 100, 10).place(first, 600) is not None


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


def test_typical_landmarks_are_the_strongest_of_different_walls():
    assert [k.id for k in typical_landmarks(typical_map())] == [1, 3, 4]


def test_figures_of_attention_from_a_bag(tmp_path, capsys):
    arguments = ['figures', '--out', str(tmp_path), '--bag', str(BAGS / 'learn')]
    arguments += ['--room', str(BAGS / 'room.yaml'), '--robot', str(BAGS / 'robot.yaml')]
    assert main([*arguments, '--figure', '4', '7', '--feature', 'corners']) == 0
    reported = capsys.readouterr().out
    names = {p.name for p in tmp_path.iterdir()}
    assert names == {'figure_4_attention.png', 'figure_7_features_alone.png'}
    assert all(f'Figure {number}' in reported for number in (4, 7))


def test_a_map_gives_its_observation_areas(tmp_path, capsys):
    (tmp_path / 'map').mkdir()
    write_map(typical_map(), tmp_path / 'map')
    arguments = ['figures', '--out', str(tmp_path / 'out'), '--map', str(tmp_path / 'map')]
    assert main(arguments) == 0
    assert [p.name for p in (tmp_path / 'out').iterdir()] == ['figure_6_observation_areas.png']
    capsys.readouterr()
    assert main([*arguments, '--figure', '5']) == 2
    assert 'need --bag' in capsys.readouterr().err


@pytest.fixture(scope='module')
def learned():
    scene = textured_room(ROOM, seed=4, feature_m=0.045)
    covariance = np.diag([1e-3, 1e-3, 1e-3, 1e-4]) ** 2
    panoramas = [
        seen_panorama(scene, np.array([x, y, 1.1]), heading, covariance=covariance)
        for x, y, heading in POSES
    ]
    config = LearningConfig(attention=AttentionConfig(candidates=30))
    return learn_from_panoramas(panoramas, ROOM, config)


def test_figure_8_counts_landmarks(learned, tmp_path):
    path = tmp_path / 'figure.png'
    assert f'{len(learned.map.landmarks)} landmarks out of' in draw_learned(learned, ROOM, path)
    assert cv2.imread(str(path)) is not None


def test_figure_5_shows_the_angle_between_the_two_rays(learned, tmp_path):
    path = tmp_path / 'figure.png'
    reported = draw_reconstruction(learned, ROOM, path)
    assert cv2.imread(str(path)) is not None
    ((number, angle_deg),) = re.findall(r'landmark (\d+) is searched.* a = (\d+)°', reported)
    point = learned.map.landmarks[learned.map.indices(np.array([int(number)]))[0]].position[:2]
    left, right = (point - panorama.center_map[:2] for panorama in learned.panoramas)
    cosine = left @ right / np.linalg.norm(left) / np.linalg.norm(right)
    assert float(angle_deg) == pytest.approx(np.degrees(np.arccos(cosine)), abs=0.6)


def test_figure_3_shows_how_frames_overlap(learned, tmp_path):
    # 60 degrees wide, one each 10 degrees: neighbours share 5 / 6.
    camera = CameraModel(200, 160, 100.0 / np.tan(np.radians(30.0)), 173.2, 99.5, 79.5)
    empty = np.zeros((160, 200, 3), np.uint8)
    pans = np.radians(np.arange(0.0, 360.0, 10.0))
    sweep = Sweep(0, tuple(CameraFrame(k, empty, camera, pan) for k, pan in enumerate(pans)))
    path = tmp_path / 'figure.png'
    reported = draw_sweeps([sweep, sweep], learned.panoramas, ROOM, path)
    assert '36 frames of 200 x 160 px, one each 10.00°' in reported
    assert 'overlap by 83%' in reported
    assert cv2.imread(str(path)) is not None


def test_a_folder_that_cannot_be_is_refused_before_the_work(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr('landmark_nav.cli.figures._gather', None)  # not reached
    file = tmp_path / 'file'
    file.touch()
    assert main(['figures', '--out', str(file / 'figures')]) == 1
    assert str(file) in capsys.readouterr().err
