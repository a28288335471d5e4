"""Learning without a plan, from sweeps with odometry between them, through the commands."""

import json

from harness import BAGS, command, evaluate, start_of
import numpy as np
import pytest
from unmeasured import with_odometry

from landmark_nav.cli.main import main
from landmark_nav.evaluation.learning_report import truth_of_bag
from landmark_nav.geometry import se2
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.setup_files import load_room

pytestmark = pytest.mark.usefixtures('undrawn')
ROBOT = str(BAGS / 'robot.yaml')
SCALE = 1.02


@pytest.fixture(scope='module')
def learned(tmp_path_factory):
    out = tmp_path_factory.mktemp('unmeasured')
    sweeps = with_odometry(BAGS / 'learn', out / 'sweeps', SCALE)
    files = ('--json', out / 'learn.json', '--walls-out', out / 'room.yaml')
    command('learn', sweeps, '--robot', ROBOT, '--out', out / 'map', *files)
    return json.loads((out / 'learn.json').read_text()), out


def test_shape_is_right_and_scale_that_of_odometry(learned):
    truth = truth_of_bag(Bag(BAGS / 'learn'))
    expected = se2.relative(truth.poses[0], truth.poses[-1])
    x, y, heading = learned[0]['sweeps'][1]['pose']
    assert np.hypot(x, y) / np.hypot(*expected[:2]) == pytest.approx(SCALE, abs=0.004)
    assert np.arctan2(y, x) == pytest.approx(np.arctan2(*expected[1::-1]), abs=3e-3)
    assert heading == pytest.approx(expected[2], abs=2e-3)
    assert learned[0]['unmeasured']['scale'] == 'odom'
    assert learned[0]['elected'] >= 40


def test_walls_found_are_those_of_the_room(learned):
    true = load_room(BAGS / 'room.yaml')
    found = load_room(learned[1] / 'room.yaml')
    first = truth_of_bag(Bag(BAGS / 'learn')).poses[0]
    with_landmarks = learned[0]['landmarks_per_wall']
    assert len(with_landmarks) >= 3
    for wall in found.walls:
        if with_landmarks.get(wall.id, 0) < 5:
            continue
        assert wall.sigma_m is not None
        middle = np.mean([wall.start, wall.end], 0) / SCALE
        normal = se2.rotation(first[2]) @ wall.normal[:2]
        at = se2.transform_points(first, middle)
        alike = true.normals[:, :2] @ normal > np.cos(0.01)
        starts = np.array([w.start for w in true.walls])
        off = np.abs(np.sum((at - starts) * true.normals[:, :2], 1))
        assert off[alike].min() < 0.03, wall.id


def test_the_walls_found_can_be_corrected_and_given(learned, tmp_path):
    files = ('--room', learned[1] / 'room.yaml', '--json', tmp_path / 'learn.json')
    sweeps, out = learned[1] / 'sweeps', tmp_path / 'map'
    command('learn', sweeps, '--robot', ROBOT, '--out', out, *files)
    again = json.loads((tmp_path / 'learn.json').read_text())
    assert again['sweeps'][1]['pose'] == pytest.approx(learned[0]['sweeps'][1]['pose'], abs=3e-3)
    assert set(again['landmarks_per_wall']) == set(learned[0]['landmarks_per_wall'])


def test_the_map_serves_a_drive(learned, tmp_path):
    first = truth_of_bag(Bag(BAGS / 'learn')).poses[0]
    start = se2.relative(first, start_of(BAGS)).tolist()
    run = evaluate(BAGS, learned[1] / 'map', start=start, out=tmp_path / 'run.json')
    assert run['aligned']
    assert run['scale'] == pytest.approx(SCALE, abs=0.006)
    assert run['fused_after_scale']['position_rmse_m'] < 0.012
    assert run['fused']['position_rmse_m'] > run['fused_after_scale']['position_rmse_m']
    assert run['availability'] > 0.9


def test_papers_at_unknown_places_give_the_scale(few, tmp_path):
    words = ('--paper-size', 0.210, 0.297, '--json', tmp_path / 'learn.json', *few)
    command('learn', BAGS / 'learn', '--robot', ROBOT, '--out', tmp_path / 'map', *words)
    learned = json.loads((tmp_path / 'learn.json').read_text())
    truth = truth_of_bag(Bag(BAGS / 'learn'))
    expected = se2.relative(truth.poses[0], truth.poses[-1])
    x, y, _ = learned['sweeps'][1]['pose']
    scale = np.hypot(x, y) / np.hypot(*expected[:2])
    found = learned['unmeasured']
    assert list(found['sources']) == ['papers']
    assert abs(scale - 1.0) < 3.0 * float(found['scale_sigma'])
    # The camera of these bags is linear, one sigma off what responses are expected to be: edges of
    # papers then seem to lie farther out, which is in the sigma.
    assert float(found['scale_sigma']) < 0.01


@pytest.mark.parametrize(
    ('words', 'status', 'named'),
    [
        (['--paper-size', '-1', '2'], 2, ''),
        (['--marker-size', '0.1', '--marker-dictionary', 'none'], 2, ''),
        (['--paper-size', '0.2', '0.3', '--room', str(BAGS / 'room.yaml')], 2, ''),
        ([], 1, 'odom sweep/pose --paper-size --room'),
    ],
)
def test_without_a_scale_it_is_refused_in_one_line(
    words, status, named, tmp_path, capsys, monkeypatch
):
    # A slow machine shows progress, which is not the refusal.
    monkeypatch.setattr('landmark_nav.cli.options._LINE_EVERY_S', np.inf)
    given = ['learn', str(BAGS / 'learn'), '--robot', ROBOT, '--out', str(tmp_path / 'map')]
    assert main([*given, *words]) == status
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert len(line) < 300
    assert all(way in line for way in named.split())
    assert not (tmp_path / 'map').exists()
