"""Figures of sweeps, stereo and all features together: what they show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
import re

import cv2
import numpy as np
import pytest
from scenes import draw_panorama, rectangle_room, textured_room

from landmark_nav.cli.main import main
from landmark_nav.evaluation.figures.learned_figure import draw_learned
from landmark_nav.evaluation.figures.stereo_figure import draw_reconstruction
from landmark_nav.evaluation.figures.sweep_figure import draw_sweeps
from landmark_nav.evaluation.true_places import true_places
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.walls import Paper
from landmark_nav.learning.attention import AttentionConfig
from landmark_nav.learning.pipeline import learn_from_panoramas, LearningConfig, LearningResult
from landmark_nav.types import CameraFrame, FloatArray, Landmark, Sweep

PAPERS = tuple(
    Paper(color, (5.0, y, 1.2), 0.21, 0.297)
    for color, y in (('red', 1.0), ('green', 2.0), ('blue', 3.0))
)
ROOM = rectangle_room(5.0, 4.2, PAPERS)
POSES = np.array([[1.8, 1.7, 0.5], [3.0, 2.5, -1.9]])
MOUNT = PanTiltMount(axis_xyz=(0.0, 0.0, 1.1))


@pytest.fixture(scope='module')
def learned() -> LearningResult:
    scene = textured_room(ROOM, seed=4, feature_m=0.045)
    covariance = np.diag([1e-3, 1e-3, 1e-3, 1e-4]) ** 2
    panoramas = [
        draw_panorama(scene, np.array([x, y, 1.1]), heading, covariance=covariance)
        for x, y, heading in POSES
    ]
    config = LearningConfig(attention=AttentionConfig(candidates=30))
    return learn_from_panoramas(panoramas, ROOM, config)


def moved(result: LearningResult, off_m: float, along_m: float) -> LearningResult:
    """The same result with all landmarks off their walls and along them."""

    def shift(landmark: Landmark) -> Landmark:
        x, y, _ = landmark.normal
        by = off_m * landmark.normal + along_m * np.array([-y, x, 0.0])
        return replace(landmark, position=landmark.position + by)

    outcomes = tuple(
        tuple(shift(o) if isinstance(o, Landmark) else o for o in group)
        for group in result.outcomes
    )
    members = tuple(map(shift, result.map.landmarks))
    return replace(result, outcomes=outcomes, map=replace(result.map, landmarks=members))


def along(result: LearningResult) -> FloatArray:
    """How far landmarks lie from the true rays (n,), metres."""
    return np.linalg.norm(result.map.positions[:, :2] - true_places(result, POSES, MOUNT), axis=1)


def test_true_rays_shows_errors_along_the_wall_alone(learned: LearningResult) -> None:
    assert np.median(along(learned)) < 0.002
    # Posters hang before their walls, and landmarks with them, on the ray that shows them.
    aside = 0.01 * np.ones(len(learned.map.landmarks))
    np.testing.assert_allclose(along(moved(learned, 0.0, 0.01)), aside, atol=0.005)
    for result in (learned, moved(learned, 0.012, 0.0)):
        difference = result.map.positions[:, :2] - true_places(result, POSES, MOUNT)
        off = [d @ k.normal[:2] for d, k in zip(difference, result.map.landmarks, strict=True)]
        np.testing.assert_allclose(off, 0.0, atol=1e-9)


def test_figure_8_gives_how_far_landmarks_lie_from_the_true_rays(
    learned: LearningResult, tmp_path: Path
) -> None:
    path = tmp_path / 'figure.png'
    reported = draw_learned(learned, ROOM, path, true_places(learned, POSES, MOUNT))
    assert cv2.imread(str(path)) is not None
    (median_mm,) = re.findall(r'all landmarks ([\d.]+) mm', reported)
    assert float(median_mm) == pytest.approx(1e3 * np.median(along(learned)), abs=0.051)
    assert f'{len(learned.map.landmarks)} landmarks out of' in reported
    assert 'true rays' not in draw_learned(learned, ROOM, path)


def test_figure_5_gives_the_angle_between_the_two_rays(
    learned: LearningResult, tmp_path: Path
) -> None:
    path = tmp_path / 'figure.png'
    reported = draw_reconstruction(learned, ROOM, path)
    assert cv2.imread(str(path)) is not None
    ((number, angle_deg),) = re.findall(r'landmark (\d+) is searched.* a = (\d+)°', reported)
    point = learned.map.landmarks[learned.map.indices(np.array([int(number)]))[0]].position[:2]
    left, right = (point - panorama.center_map[:2] for panorama in learned.panoramas)
    cosine = left @ right / np.linalg.norm(left) / np.linalg.norm(right)
    assert float(angle_deg) == pytest.approx(np.degrees(np.arccos(cosine)), abs=0.6)


def test_figure_3_gives_how_frames_overlap(learned: LearningResult, tmp_path: Path) -> None:
    # 60 degrees wide, one each 10 degrees: six show a column, and neighbours share 5 / 6.
    camera = CameraModel(200, 160, 100.0 / np.tan(np.radians(30.0)), 173.2, 99.5, 79.5)
    empty = np.zeros((160, 200, 3), np.uint8)
    pans = np.radians(np.arange(0.0, 360.0, 10.0))
    sweep = Sweep(0, tuple(CameraFrame(k, empty, camera, pan) for k, pan in enumerate(pans)))
    path = tmp_path / 'figure.png'
    reported = draw_sweeps([sweep, sweep], learned.panoramas, ROOM, path)
    assert '36 frames of 200 x 160 px, one each 10.00°' in reported
    assert 'overlap by 83%; a column is shown by 6 frames in the median' in reported
    assert cv2.imread(str(path)) is not None


def test_a_folder_that_cannot_be_is_refused_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr('landmark_nav.cli.figures._gather', None)  # not reached
    file = tmp_path / 'file'
    file.touch()
    assert main(['figures', '--out', str(file / 'figures')]) == 1
    assert str(file) in capsys.readouterr().err
