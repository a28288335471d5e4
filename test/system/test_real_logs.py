"""
A real robot's logs, bearings alone: UTIAS MR.CLAM set 6, robots 1 to 3.

The truth of robot 1 is not what it should be: over stretches of half a minute its heading is 1.4
to 3.3 degrees off the direction in which its own positions move, and bearings are off by as much
the same way. So the limit of its heading is wider.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from landmark_nav.cli.main import main

CONFIG = Path(__file__).resolve().parents[2] / 'config' / 'mrclam.yaml'


@pytest.mark.parametrize(
    ('robot', 'rmse_m', 'median_m', 'heading_deg', 'nees'),
    [(1, 0.13, 0.08, 2.5, 3.9), (2, 0.09, 0.06, 1.5, 3.9), (3, 0.07, 0.04, 1.0, 3.9)],
)
def test_bearings_keep_commanded_odometry_on_the_floor(
    shared_data: Path,
    tmp_path: Path,
    robot: int,
    rmse_m: float,
    median_m: float,
    heading_deg: float,
    nees: float,
) -> None:
    bag = tmp_path / 'log'
    data = str(shared_data / 'mrclam')
    assert main(['convert', 'mrclam', data, '--robot', str(robot), '--out', str(bag)]) == 0
    start = json.loads((tmp_path / 'log_start.json').read_text())['pose']
    arguments = ['evaluate', str(bag), '--map', f'{bag}_map', '--robot', f'{bag}_robot.yaml']
    arguments += ['--start', *map(str, start), '--config', str(CONFIG)]
    assert main([*arguments, '--json', str(tmp_path / 'run.json')]) == 0
    report = json.loads((tmp_path / 'run.json').read_text())
    assert report['odometry']['position_rmse_m'] > 2.5
    assert report['fused']['position_rmse_m'] <= rmse_m
    assert report['fused']['position_median_m'] <= median_m
    assert report['fused']['heading_rmse_deg'] <= heading_deg
    assert 0.5 < report['nees']['mean'] < nees
    assert report['availability'] == 1.0
