"""The figures of the paper: what they show, from recorded data, a map, one feature."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from landmark_nav.cli.main import main
from landmark_nav.evaluation.figures.area_figure import (
    AreaTest,
    draw_observation_areas,
    typical_landmarks,
)
from landmark_nav.evaluation.figures.stereo_figure import ray_sigma_m
from landmark_nav.evaluation.figures.strips import Strip, widest
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.walls import Room, Wall
from landmark_nav.storage.maps import write_map
from landmark_nav.types import Candidate, Landmark, LandmarkMap, Panorama, PoseEstimate

BAGS = Path(__file__).parents[2] / 'bags'
WALLS = (
    Wall('south', (0.0, 0.0), (6.0, 0.0), 2.5),
    Wall('east', (6.0, 0.0), (6.0, 4.0), 2.5),
    Wall('north', (6.0, 4.0), (0.0, 4.0), 2.5),
    Wall('west', (0.0, 4.0), (0.0, 0.0), 2.5),
)


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


def a_map():
    def landmark(number, position, normal, wall, saliency):
        return Landmark(
            number, np.array([*position, 1.3]), 1e-5 * np.eye(3), np.zeros((3, 1)),
            np.array([*normal, 0.0]), 0.2, 0.2, np.full((30, 30), 90, np.uint8),
            np.array([2.0, 2.0, 1.1]), 0.7, wall, saliency,
        )  # fmt: skip

    return LandmarkMap(
        (
            landmark(1, (2.0, 0.0), (0.0, 1.0), 'south', 0.9),
            landmark(2, (2.6, 0.0), (0.0, 1.0), 'south', 0.8),
            landmark(3, (6.0, 2.5), (-1.0, 0.0), 'east', 0.3),
            landmark(4, (3.0, 4.0), (0.0, -1.0), 'north', 0.2),
        ),
        'map',
        WALLS,
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


def test_the_widest_strip_shows_the_first_candidate():
    many = [Candidate(300.0 + 5 * k, 50.0, 10, 10, 0.2) for k in range(8)]
    first = Candidate(590.0, 50.0, 10, 10, 1.0)
    strip = widest(view(), [first, *many], 100, 10)
    assert strip.place(first, 600) is not None


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
    assert [k.id for k in typical_landmarks(a_map())] == [1, 3, 4]


def test_areas_are_compared_with_what_was_found(tmp_path):
    landmarks = a_map()
    xy = np.array([[2.0, 2.0], [2.0, 3.0], [2.0, 0.3], [5.9, 0.2]])
    tests = [AreaTest(1, xy, np.array([True, True, False, True]))]
    text = draw_observation_areas(landmarks, Room(WALLS), tmp_path / 'areas.png', tests)
    assert 'from 4 places' in text
    assert '75%' in text
    assert cv2.imread(str(tmp_path / 'areas.png')) is not None


def test_figures_of_attention_from_a_bag(tmp_path, capsys):
    arguments = ['figures', '--out', str(tmp_path), '--bag', str(BAGS / 'learn')]
    arguments += ['--room', str(BAGS / 'room.yaml'), '--robot', str(BAGS / 'robot.yaml')]
    assert main([*arguments, '--figure', '4', '7', '--feature', 'corners']) == 0
    reported = capsys.readouterr().out
    assert 'Figure 4' in reported
    assert 'Figure 7' in reported
    assert {p.name for p in tmp_path.iterdir()} == {
        'figure_4_attention.png',
        'figure_7_features_alone.png',
    }


def test_a_map_gives_its_observation_areas(tmp_path, capsys):
    (tmp_path / 'map').mkdir()
    write_map(a_map(), tmp_path / 'map')
    arguments = ['figures', '--out', str(tmp_path / 'out'), '--map', str(tmp_path / 'map')]
    assert main(arguments) == 0
    assert [p.name for p in (tmp_path / 'out').iterdir()] == ['figure_6_observation_areas.png']
    capsys.readouterr()
    assert main([*arguments, '--figure', '5']) == 2
    assert 'need --bag' in capsys.readouterr().err


def test_wrong_usage_is_reported_in_a_line(tmp_path, capsys):
    assert main(['figures', '--out', str(tmp_path), '--bag', str(BAGS / 'learn')]) == 2
    assert '--bag needs --robot' in capsys.readouterr().err
    assert main(['figures', '--out', str(tmp_path), '--feature', 'smell']) == 2
    assert main(['figures', '--out', str(tmp_path), '--seed', '-1']) == 2
    assert '--seed' in capsys.readouterr().err
