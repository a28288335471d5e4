"""The offline commands on the recorded room of bags/, against its expected figures."""

from dataclasses import replace
import json

from calibration import Line
from drive_faults import displaced_drive, late_drive, starved_drive
from harness import BAGS, Drive, evaluate, learn, rms, start_of
import numpy as np
import pytest
from small import recorded_figures, worse

from landmark_nav.calibration import Calibration
from landmark_nav.cli.learn import panoramas_of_bag
from landmark_nav.cli.main import main
from landmark_nav.evaluation.metrics import pose_errors
from landmark_nav.learning.stages import StageLog
from landmark_nav.planning.planner import forecast
from landmark_nav.planning.views import PlanConfig
from landmark_nav.simulation.furnishing import generate_scene
from landmark_nav.storage.bags import Bag, read_sweeps
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.robot_files import load_calibration, load_robot, save_calibration
from landmark_nav.storage.setup_files import load_room


@pytest.fixture(scope='module')
def figures(recorded):
    """What `learn` and `evaluate` measure, by the names of expected.json, and the map."""
    learned, run = (json.loads((recorded / f'{k}.json').read_text()) for k in ('learn', 'run'))
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


def test_as_expected(figures):
    expected = json.loads((BAGS / 'expected.json').read_text())
    del expected['note']
    measured = figures[0]
    assert measured.keys() == expected.keys()
    for name, bounds in expected.items():
        low, high = bounds.get('least', -np.inf), bounds.get('most', np.inf)
        assert low <= measured[name] <= high, name


def test_no_kept_figure_is_worse(recorded):
    assert not worse('recorded', recorded_figures(recorded))


def test_the_images_show_the_map(recorded, capsys):
    robot = ['--robot', str(BAGS / 'robot.yaml')]
    assert main(['check', str(BAGS / 'drive'), *robot, '--map', str(recorded / 'map')]) == 0
    assert 'place found' in capsys.readouterr().out


def off_boxes_m(point, boxes):
    """Distance in plan from the next side of a piece of furniture."""
    away = []
    for box in boxes:
        along = np.array([np.cos(box.yaw_rad), np.sin(box.yaw_rad)])
        offset = point[:2] - box.center_xy
        inside = np.abs([offset @ along, along[0] * offset[1] - along[1] * offset[0]])
        beyond = inside - 0.5 * np.array(box.size_m[:2])
        away.append(np.hypot(*np.maximum(beyond, 0.0)) + max(0.0, -beyond.max()))
    return min(away)


def test_landmarks_lie_where_things_really_hang_or_stand(figures):
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


def test_sigmas_of_sweeps_hold_what_is_unknown_of_the_mount(few, tmp_path):
    mount = load_robot(BAGS / 'robot.yaml')
    (x, y, z), robot = mount.axis_xyz, tmp_path / 'robot.yaml'
    off = replace(mount, axis_xyz=(x + 0.02, y - 0.03, z), axis_rpy=(0.0, 0.0, 0.02))
    save_calibration(Calibration.of_mount(off), robot)
    sweeps = learn(BAGS, tmp_path / 'map', '--robot', robot, *few)['sweeps']
    assert max(sweep['error_position_m'] for sweep in sweeps) > 0.02
    assert max(sweep['nees'] for sweep in sweeps) < 16.0


def test_the_planner_predicts_landmarks_and_sweep_errors(figures):
    sweeps = json.loads((figures[1] / 'learn.json').read_text())['sweeps']
    room, mount = load_room(BAGS / 'room.yaml'), load_robot(BAGS / 'robot.yaml')
    poses = np.array([sweep['pose'] for sweep in sweeps])
    (expected,) = forecast([poses], poses[:, :2], room, mount, PlanConfig())
    assert 0.7 < expected.landmarks.sum() / figures[0]['landmarks'] < 1.4
    papers = np.sqrt(np.diagonal(expected.pose_covariance, axis1=1, axis2=2))
    measured = np.array([sweep['measured']['sigma_without_mount'] for sweep in sweeps])
    assert np.all(papers[:, 2] < 1.6 * measured[:, 2])
    assert np.all(papers[:, 2] > measured[:, 2] / 1.6)


def test_a_sweep_that_is_read_twice_shows_no_more(monkeypatch):
    room, mount = load_room(BAGS / 'room.yaml'), load_robot(BAGS / 'robot.yaml')
    given = Calibration.of_mount(replace(mount, camera_roll_rad=0.02))
    bag = Bag(BAGS / 'learn')
    sweep = next(read_sweeps(bag, mount))
    # A third of the frames still overlap.
    sweep = replace(sweep, frames=sweep.frames[::3])
    monkeypatch.setattr('landmark_nav.cli.learn.read_sweeps', lambda *_: iter([sweep, sweep]))
    panoramas, _ = panoramas_of_bag(bag, room, given, StageLog())
    first, second = (panorama.calibration for panorama in panoramas)
    assert 'camera_roll' in first.surprises(given)
    np.testing.assert_allclose(second.sigmas, first.sigmas, rtol=0.1)


@pytest.fixture
def driven(recorded, tmp_path):
    """What `evaluate` measures on this map, of another drive or with another `robot.yaml`."""

    def run(drive=None, known=None, *, start=True):
        robot = None if known is None else tmp_path / 'robot.yaml'
        if robot and known:
            save_calibration(known, robot)
        given = start_of(BAGS) if start else None
        files = {'drive': drive, 'robot': robot, 'out': tmp_path / 'run.json'}
        return evaluate(BAGS, recorded / 'map', start=given, **files)

    return run


def test_joint_states_that_become_late_are_not_put_right_from_the_start(driven, tmp_path):
    """What is measured in the end is wrong before."""
    run = driven(late_drive(Bag(BAGS / 'drive'), tmp_path / 'late', 0.2, 6.0))
    assert run['calibration']['joint_delay']['value'] == pytest.approx(0.2, abs=0.005)
    assert run['silently_wrong'] == 0
    assert run['nees']['mean'] < run['nees']['interval_95'][1]


@pytest.mark.parametrize('turn_deg', [(-1.0, 0.0, 1.5), (1.0, 0.0, -2.0), (0.0, 0.0, 2.0)])
def test_a_camera_that_was_displaced_while_switched_off_finds_its_place(
    recorded, tmp_path, turn_deg
):
    """
    No start is given; it looks above or below, or is rolled, from the first image on.

    Until the robot has moved, nothing shows the pan zero, with a sigma of 2.5 degrees: the heading
    is as wrong as its covariance says, and right in the second half.
    """
    bag = displaced_drive(Bag(BAGS / 'drive'), tmp_path / 'displaced', turn_deg)
    landmarks = load_map(recorded / 'map')
    known = landmarks.calibration_from(load_calibration(BAGS / 'robot.yaml'))
    drive = Drive(bag, landmarks, known, None)
    run = drive.run(drive.events())
    line = Line.of(run, landmarks, known)
    assert run.start.stamp_ns - run.begin_ns < 2e9
    assert line.position_mm < 6.0
    errors = pose_errors(run.fused, run.truth.at(run.stamps_ns))
    assert np.degrees(rms(errors[len(errors) // 2 :, 2])) < 0.15
    assert line.nees < line.interval[1]
    assert line.undetected == 0


def test_what_a_starved_machine_loses_is_in_the_covariance(driven, tmp_path):
    run = driven(starved_drive(Bag(BAGS / 'drive'), tmp_path / 'starved'), start=False)
    assert run['silently_wrong'] == 0
    assert run['nees']['mean'] < 5.0
    assert run['availability'] > 0.9


def test_the_estimator_is_as_good_where_the_mount_is_exact(driven):
    run = driven(known=Calibration.exact(load_robot(BAGS / 'robot.yaml')))
    assert run['integrity']['undetected_wrong'] == 0
    assert run['fused']['position_median_m'] < 0.01
    bounds = json.loads((BAGS / 'expected.json').read_text())
    assert run['fused']['position_rmse_m'] < bounds['fused_position_rmse_m']['most']
    assert run['fused']['heading_rmse_deg'] < bounds['fused_heading_rmse_deg']['most']
    assert run['availability'] == 1.0
    assert run['integrity']['coverage_99'] > 0.97


@pytest.mark.parametrize(
    'error',
    [
        {'axis_yaw': 0.0122, 'center_x': 0.03, 'center_y': 0.01},
        {'axis_pitch': 0.014, 'camera_roll': 0.014, 'axis_z': 0.03},
    ],
)
def test_the_estimator_knows_how_wrong_it_may_be(driven, error):
    right = Calibration.of_mount(load_robot(BAGS / 'robot.yaml'))
    wrong = right.with_values(**{name: right[name][0] + off for name, off in error.items()})
    run = driven(known=wrong)
    assert run['integrity']['undetected_wrong'] == 0
    assert run['nees']['mean'] < run['nees']['interval_95'][1]
    assert run['fused']['position_rmse_m'] < 0.03
    for name in error:
        found = run['calibration'][name]
        assert abs(found['value'] - right[name][0]) < max(4.0 * found['sigma'], 0.002)
