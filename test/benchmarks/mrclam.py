"""
A real robot's logs, bearings alone: UTIAS MR.CLAM set 6, one line a robot.

``python test/benchmarks mrclam`` converts the logs of robots 1 to 3 in ``../shared/data/mrclam``
and replays them; it exits with 1 if a bound is missed. The truth of robot 1 is not what it should
be: over stretches of half a minute its heading is 1.4 to 3.3 degrees off the direction in which
its own positions move, and bearings are off by as much the same way. So the limit of its heading
is wider.
"""

import argparse
from pathlib import Path
import tempfile

from harness import command, SHARED, start_of, START_SIGMA
import numpy as np

from landmark_nav.configuration import load_configuration, READS
from landmark_nav.evaluation.replay import replay
from landmark_nav.evaluation.run_report import pose_report
from landmark_nav.storage.bags import Bag, sensor_events
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.robot_files import load_calibration

# RMSE and median, m; heading RMSE, deg.
LIMITS = {1: (0.13, 0.08, 2.5), 2: (0.09, 0.06, 1.5), 3: (0.07, 0.04, 1.0)}


def driven(robot, data, folder):
    """Return the report of a robot's drive."""
    log = folder / 'log'
    command('convert', 'mrclam', data, '--robot', robot, '--out', log)
    calibration = load_calibration(folder / 'log_robot.yaml')
    bag, posts = Bag(log), load_map(folder / 'log_map')
    run = replay(
        sensor_events(bag, calibration.mount), posts, calibration,
        load_configuration(folder / 'log_config.yaml', folder / 'log_robot.yaml', *READS),
        np.array(start_of(folder, 'log_start.json')), np.diag(START_SIGMA**2),
    )  # fmt: skip
    return pose_report(run, posts)


def meets_bounds(report, robot):
    """Whether a robot is where it was, and its covariance says how well."""
    rmse_m, median_m, heading_deg = LIMITS[robot]
    return bool(
        report['fused']['position_rmse_m'] <= rmse_m
        and report['fused']['position_median_m'] <= median_m
        and report['fused']['heading_rmse_deg'] <= heading_deg
        and 0.5 < report['nees']['mean'] < 3.9
        and report['availability'] == 1.0
    )


def main():
    """Print a line a robot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--robots', type=int, nargs='+', default=list(LIMITS), choices=LIMITS)
    parser.add_argument('--data', type=Path, default=SHARED / 'mrclam')
    args, good = parser.parse_args(), True
    for robot in args.robots:
        with tempfile.TemporaryDirectory() as scratch:
            report = driven(robot, args.data, Path(scratch))
        fused, met = report['fused'], meets_bounds(report, robot)
        print(
            f'robot {robot}: {100 * fused["position_rmse_m"]:.1f} cm, median '
            f'{100 * fused["position_median_m"]:.1f} cm, {fused["heading_rmse_deg"]:.2f} deg, '
            f'NEES {report["nees"]["mean"]:.2f}, available {report["availability"]:.3f}, odometry '
            f'{report["odometry"]["position_rmse_m"]:.1f} m{"" if met else "  misses a bound"}',
            flush=True,
        )
        good &= met
    return int(not good)
