"""
A real robot's logs, bearings alone: UTIAS MR.CLAM set 6, robots 1 to 3.

The truth of robot 1 is not what it should be: over stretches of half a minute its heading is 1.4
to 3.3 degrees off the direction in which its own positions move, and bearings are off by as much
the same way. So the limit of its heading is wider.
"""

from __future__ import annotations

import heapq
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from landmark_nav.cli import convert
from landmark_nav.cli.main import main
from landmark_nav.configuration import load_configuration, READS
from landmark_nav.evaluation.replay import replay
from landmark_nav.evaluation.run_report import pose_report, run_errors
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.robot_files import load_calibration

# RMSE and median, m; heading RMSE, deg.
LIMITS = {1: (0.13, 0.08, 2.5), 2: (0.09, 0.06, 1.5), 3: (0.07, 0.04, 1.0)}


def check(report: dict[str, Any], robot: int) -> None:
    rmse_m, median_m, heading_deg = LIMITS[robot]
    assert report['odometry']['position_rmse_m'] > 2.5
    assert report['fused']['position_rmse_m'] <= rmse_m
    assert report['fused']['position_median_m'] <= median_m
    assert report['fused']['heading_rmse_deg'] <= heading_deg
    assert 0.5 < report['nees']['mean'] < 3.9
    assert report['availability'] == 1.0


def converted(shared_data: Path, robot: int, bag: Path) -> list[float]:
    data = str(shared_data / 'mrclam')
    assert main(['convert', 'mrclam', data, '--robot', str(robot), '--out', str(bag)]) == 0
    start = json.loads(bag.with_name(f'{bag.name}_start.json').read_text())['pose']
    return [float(value) for value in start]


def test_bearings_keep_commanded_odometry_on_the_floor(shared_data: Path, tmp_path: Path) -> None:
    bag = tmp_path / 'log'
    start = converted(shared_data, 3, bag)
    arguments = ['evaluate', str(bag), '--map', f'{bag}_map', '--robot', f'{bag}_robot.yaml']
    arguments += ['--start', *map(str, start), '--config', f'{bag}_config.yaml']
    assert main([*arguments, '--json', str(tmp_path / 'run.json')]) == 0
    check(json.loads((tmp_path / 'run.json').read_text()), 3)


@pytest.mark.parametrize('robot', [1, 2])
def test_so_do_those_of_other_robots(
    robot: int,
    shared_data: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As above, but for the bag and what is no pose: two thirds of the time."""
    kept: list[Any] = []
    monkeypatch.setattr(convert, '_write_bag', lambda *given: kept.extend(given))
    start = converted(shared_data, robot, tmp_path / 'log')
    log, odometry, *_ = kept
    events = heapq.merge(log.truth, odometry, log.detections, key=lambda event: event.stamp_ns)
    posts = load_map(tmp_path / 'log_map')
    run = replay(
        events,
        posts,
        load_calibration(tmp_path / 'log_robot.yaml'),
        load_configuration(tmp_path / 'log_config.yaml', tmp_path / 'log_robot.yaml', *READS),
        np.array(start),
        np.diag([0.05, 0.05, 0.035]) ** 2,
    )
    check(pose_report(run, run_errors(run), posts), robot)
