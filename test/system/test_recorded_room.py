"""The recorded room of bags/ through the offline commands, against its expected figures."""

from __future__ import annotations

from collections.abc import Callable
import json
from pathlib import Path
from typing import Any

from drive_faults import displaced_drive, late_drive, starved_drive
import numpy as np
import pytest

from landmark_nav.calibration import Calibration
from landmark_nav.cli.main import main
from landmark_nav.planning.config import PlanConfig
from landmark_nav.planning.planner import forecast
from landmark_nav.simulation.furnishing import generate_scene
from landmark_nav.simulation.scene import Box
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.robot_files import save_calibration
from landmark_nav.storage.setup_files import load_robot, load_room

BAGS = Path(__file__).resolve().parents[2] / 'bags'


@pytest.fixture(scope='module')
def figures(recorded: Path) -> tuple[dict[str, float], Path]:
    """What `learn` and `evaluate` measure, by the names of expected.json, and the map."""
    learned = json.loads((recorded / 'learn.json').read_text())
    run = json.loads((recorded / 'run.json').read_text())
    return {
        'landmarks': learned['elected'],
        'walls': len(learned['landmarks_per_wall']),
        'sweep_position_m': max(s['error_position_m'] for s in learned['sweeps']),
        'sweep_heading_deg': max(s['error_heading_deg'] for s in learned['sweeps']),
        'fused_position_rmse_m': run['fused']['position_rmse_m'],
        'fused_heading_rmse_deg': run['fused']['heading_rmse_deg'],
        'odometry_position_rmse_m': run['odometry']['position_rmse_m'],
        'availability': run['availability'],
    }, recorded


def test_as_expected(figures: tuple[dict[str, float], Path]) -> None:
    expected = json.loads((BAGS / 'expected.json').read_text())
    del expected['note']
    measured = figures[0]
    assert measured.keys() == expected.keys()
    for name, bounds in expected.items():
        low, high = bounds.get('least', -np.inf), bounds.get('most', np.inf)
        assert low <= measured[name] <= high, name


def test_the_images_show_the_map(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot = ['--robot', str(BAGS / 'robot.yaml')]
    assert main(['check', str(BAGS / 'drive'), *robot, '--map', str(recorded / 'map')]) == 0
    assert 'place found' in capsys.readouterr().out


def off_boxes_m(point: np.ndarray, boxes: tuple[Box, ...]) -> float:
    """Distance in plan from the next side of a piece of furniture."""
    away = []
    for box in boxes:
        along = np.array([np.cos(box.yaw_rad), np.sin(box.yaw_rad)])
        offset = point[:2] - box.center_xy
        inside = np.abs([offset @ along, along[0] * offset[1] - along[1] * offset[0]])
        beyond = inside - 0.5 * np.array(box.size_m[:2])
        away.append(np.hypot(*np.maximum(beyond, 0.0)) + max(0.0, -beyond.max()))
    return min(away)


def test_landmarks_lie_where_things_really_hang_or_stand(
    figures: tuple[dict[str, float], Path],
) -> None:
    scene = json.loads((BAGS / 'scene.json').read_text())
    boxes = generate_scene(scene['seed']).boxes
    items = [item for item in scene['items'] if item['kind'] != 'door']
    centers = np.array([item['center'] for item in items])
    reach = np.array([0.5 * np.hypot(*item['size']) for item in items])
    landmarks = load_map(figures[1] / 'map').landmarks
    away = np.array([np.linalg.norm(centers - k.position, axis=1) - reach for k in landmarks])
    on_boxes = np.array([off_boxes_m(k.position, boxes) < 0.01 for k in landmarks])
    assert np.mean((away.min(1) < 0.05) | on_boxes) > 0.9
    assert np.mean(on_boxes[[not k.wall_id for k in landmarks]]) > 0.5
    target = next(i for i, item in enumerate(items) if item['kind'] == 'target')
    assert min(np.linalg.norm(k.position - centers[target]) for k in landmarks) < 0.02


def test_the_planner_would_have_forereported_it(figures: tuple[dict[str, float], Path]) -> None:
    sweeps = json.loads((figures[1] / 'learn.json').read_text())['sweeps']
    room, mount = load_room(BAGS / 'room.yaml'), load_robot(BAGS / 'robot.yaml')
    poses = np.array([sweep['pose'] for sweep in sweeps])
    (expected,) = forecast([poses], poses[:, :2], room, mount, PlanConfig())
    assert 0.7 < expected.landmarks.sum() / figures[0]['landmarks'] < 1.4
    papers = np.sqrt(np.diagonal(expected.pose_covariance, axis1=1, axis2=2))
    measured = np.array([sweep['measured']['sigma'] for sweep in sweeps])
    assert np.all(papers[:, 2] < 1.6 * measured[:, 2])
    assert np.all(papers[:, 2] > measured[:, 2] / 1.6)


@pytest.fixture
def evaluated_late(
    figures: tuple[dict[str, float], Path], tmp_path: Path
) -> Callable[[float, float], dict[str, Any]]:
    """What `evaluate` measures where joint states are stamped late from a time on."""
    start = json.loads((BAGS / 'start.json').read_text())['pose']

    def run(late_s: float, since_s: float) -> dict[str, Any]:
        drive = late_drive(Bag(BAGS / 'drive'), tmp_path / 'late', late_s, since_s)
        evaluate = ['evaluate', str(drive), '--map', str(figures[1] / 'map'), '--robot']
        evaluate += [str(BAGS / 'robot.yaml'), '--start', *map(str, start)]
        assert main([*evaluate, '--json', str(tmp_path / 'late.json')]) == 0
        measured: dict[str, Any] = json.loads((tmp_path / 'late.json').read_text())
        return measured

    return run


def test_joint_states_that_are_stamped_late_are_reported_and_put_right(
    figures: tuple[dict[str, float], Path],
    evaluated_late: Callable[[float, float], dict[str, Any]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    run = evaluated_late(0.04, 0.0)
    delay = run['calibration']['joint_delay']
    assert delay['value'] == pytest.approx(0.04, abs=0.002)
    usual = figures[0]['fused_position_rmse_m']
    assert run['fused']['position_rmse_m'] < 1.3 * usual + 1e-3
    assert 'camera: joint_states' in capsys.readouterr().out


def test_joint_states_that_become_late_are_not_put_right_from_the_start(
    evaluated_late: Callable[[float, float], dict[str, Any]],
) -> None:
    """What is measured in the end is wrong before."""
    run = evaluated_late(0.2, 6.0)
    assert run['calibration']['joint_delay']['value'] == pytest.approx(0.2, abs=0.005)
    assert run['silently_wrong'] == 0
    assert run['nees']['mean'] < run['nees']['interval_95'][1]


def test_images_are_drawn(figures: tuple[dict[str, float], Path]) -> None:
    for name in ('map/map.png', 'map/panorama_1.png', 'map/panorama_2.png'):
        assert (figures[1] / name).stat().st_size > 10_000
    assert (figures[1] / 'run.html').stat().st_size > 100_000


@pytest.mark.xfail(strict=True, reason='heading off by 0.29 degrees, which its sigma says')
def test_a_camera_that_was_displaced_while_switched_off_finds_its_place(
    figures: tuple[dict[str, float], Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """No start is given; it looks above or below, or is rolled, from the first image on."""
    drive = displaced_drive(Bag(BAGS / 'drive'), tmp_path / 'displaced', (-1.0, 0.0, 1.5))
    evaluate = ['evaluate', str(drive), '--map', str(figures[1] / 'map')]
    evaluate += ['--robot', str(BAGS / 'robot.yaml'), '--json', str(tmp_path / 'run.json')]
    assert main(evaluate) == 0
    run = json.loads((tmp_path / 'run.json').read_text())
    assert run['found']['after_s'] < 2.0
    assert run['fused']['position_rmse_m'] < 0.006
    assert run['fused']['heading_rmse_deg'] < 0.15
    assert run['silently_wrong'] == 0


def test_what_a_starved_machine_loses_is_in_the_covariance(
    figures: tuple[dict[str, float], Path], tmp_path: Path
) -> None:
    drive = starved_drive(Bag(BAGS / 'drive'), tmp_path / 'starved')
    evaluate = ['evaluate', str(drive), '--map', str(figures[1] / 'map')]
    evaluate += ['--robot', str(BAGS / 'robot.yaml')]
    assert main([*evaluate, '--json', str(tmp_path / 'run.json')]) == 0
    run = json.loads((tmp_path / 'run.json').read_text())
    assert run['silently_wrong'] == 0
    assert run['nees']['mean'] < 5.0
    assert run['availability'] > 0.9


def run_with(
    landmarks: Path, out: Path, calibration: Calibration, *options: str
) -> dict[str, Any]:
    """Figures of `evaluate` with another `robot.yaml`."""
    save_calibration(calibration, out / 'robot.yaml')
    files = ['--map', str(landmarks), '--robot', str(out / 'robot.yaml')]
    files += ['--json', str(out / 'run.json')]
    assert main(['evaluate', str(BAGS / 'drive'), *files, *options]) == 0
    run: dict[str, Any] = json.loads((out / 'run.json').read_text())
    return run


def start_of_the_drive() -> list[str]:
    return ['--start', *map(str, json.loads((BAGS / 'start.json').read_text())['pose'])]


def test_the_estimator_is_as_good_where_the_mount_is_exact(recorded: Path, tmp_path: Path) -> None:
    exact = Calibration.exact(load_robot(BAGS / 'robot.yaml'))
    run = run_with(recorded / 'map', tmp_path, exact, *start_of_the_drive())
    bounds = json.loads((BAGS / 'expected.json').read_text())
    assert run['fused']['position_rmse_m'] < bounds['fused_position_rmse_m']['most']
    assert run['fused']['heading_rmse_deg'] < bounds['fused_heading_rmse_deg']['most']
    assert run['availability'] == 1.0
    assert run['integrity']['coverage_99'] > 0.97
    assert run['integrity']['undetected_wrong'] == 0


@pytest.mark.parametrize(
    'error',
    [
        {'axis_yaw': 0.0122},
        {'center_x': 0.03, 'center_y': 0.01},
        {'axis_x': 0.03},
        {'axis_pitch': 0.014, 'camera_roll': 0.014, 'axis_z': 0.03},
    ],
)
def test_the_estimator_knows_how_wrong_it_may_be(
    recorded: Path, error: dict[str, float], tmp_path: Path
) -> None:
    right = Calibration.of_mount(load_robot(BAGS / 'robot.yaml'))
    wrong = right.with_values(**{name: right[name][0] + off for name, off in error.items()})
    run = run_with(recorded / 'map', tmp_path, wrong, *start_of_the_drive())
    assert run['integrity']['undetected_wrong'] == 0
    assert run['nees']['mean'] < run['nees']['interval_95'][1]
    assert run['fused']['position_rmse_m'] < 0.03
    for name in error:
        found = run['calibration'][name]
        assert abs(found['value'] - right[name][0]) < max(4.0 * found['sigma'], 0.002)


def test_the_estimator_finds_its_own_place(recorded: Path, tmp_path: Path) -> None:
    exact = Calibration.exact(load_robot(BAGS / 'robot.yaml'))
    run = run_with(recorded / 'map', tmp_path, exact)
    assert run['found'] is not None
    assert run['integrity']['undetected_wrong'] == 0
    assert run['fused']['position_median_m'] < 0.01
