"""
Rooms never seen: simulate, learn from two sweeps, evaluate a drive; one line a room.

Before the drive a lamp is dimmed, a piece of furniture moved, and one poster in five exchanged.
The robot is given a ``room.yaml`` as a person measures it; the exact one with ``--exact``.
``python test/benchmarks rooms --seeds 201 202 203`` prints the table of the README and exits
with 1 if a room misses a bound. Seeds are not used anywhere else: nothing is fitted to them.
"""

import argparse
import json
from pathlib import Path
import tempfile

from harness import command, evaluate, figures_of, learn, print_row, start_of, within
import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2
import yaml

MAX_CRLB_RATIO = 1.2
EXCHANGED = 0.2
# Least and greatest figures of every room.
BOUNDS = {
    'fused_mm': (0.0, 8.0),
    'fused_deg': (0.0, 0.4),
    'availability': (0.95, 1.0),
    'landmarks': (20, np.inf),
    'walls': (3, np.inf),
    'target': (True, True),
    'sweep_mm': (0.0, 20.0),
    'sweep_deg': (0.0, 0.3),
    'crlb_ratio': (0.0, MAX_CRLB_RATIO),
    'beyond_5s': (0, 0),
}


def run_room(seed, folder, *options, exact=False):
    """Take the commands that a user would, in `folder`; what came of it."""
    changes = ['--light-change', '--exchange', EXCHANGED, *(['--exact'] if exact else [])]
    command('simulate', '--out', folder, '--overwrite', '--seed', seed, *changes, *options)
    learned = learn(folder, folder / 'map')
    driven = evaluate(folder, folder / 'map', start=start_of(folder))
    low, high = driven['nees']['interval_95']
    return {
        'seed': seed,
        **figures_of(driven),
        'walls': len(learned['landmarks_per_wall']),
        'target': _target_elected(folder),
        'sweep_mm': 1e3 * max(s['error_position_m'] for s in learned['sweeps']),
        'sweep_deg': max(s['error_heading_deg'] for s in learned['sweeps']),
        'nees_low': low,
        'nees_high': high,
        'odometry_mm': 1e3 * driven['odometry']['position_rmse_m'],
    }


def meets_bounds(row):
    """Whether a room is as good as every room has to be."""
    return within({**BOUNDS, 'nees': (row['nees_low'], row['nees_high'])}, row)


def over_by_chance(nees_high):
    """
    Probability that an estimator at the bound is over `MAX_CRLB_RATIO` in a room.

    What a map is off by is drawn once a room: few numbers make up the errors of a drive. How many
    is shown by the upper end of the 95 % interval of their mean NEES, which is 3 on average.
    """

    def excess(count):
        return float(3.0 * chi2.ppf(0.975, count) / count - nees_high)

    count = brentq(excess, 0.5, 1e4)
    return float(chi2.sf(MAX_CRLB_RATIO**2 * count, count))


def _target_elected(folder):
    """Whether a landmark lies on the specialised target."""
    scene = json.loads((folder / 'scene.json').read_text())
    target = next(item for item in scene['items'] if item['kind'] == 'target')
    landmarks = yaml.safe_load((folder / 'map' / 'map.yaml').read_text())['landmarks']
    places = np.array([landmark['position'] for landmark in landmarks])
    away = np.linalg.norm(places - np.array(target['center']), axis=1)
    return bool(away.min() < 0.5 * max(target['size']))


def main():
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, nargs='+', required=True)
    parser.add_argument('--out', type=Path, help='keep the rooms here')
    parser.add_argument('--exact', action='store_true', help='give the robot the exact room')
    arguments, options = parser.parse_known_args()
    rows = []
    for seed in arguments.seeds:
        with tempfile.TemporaryDirectory() as scratch:
            folder = (arguments.out or Path(scratch)) / f'room_{seed}'
            rows.append(run_room(seed, folder, *options, exact=arguments.exact))
    for k, row in enumerate(rows):
        print_row(row, 12, k == 0)
    ratios = np.array([row['crlb_ratio'] for row in rows])
    chance = sum(over_by_chance(row['nees_high']) for row in rows)
    print(
        f'all: {np.mean([row["fused_mm"] for row in rows]):.1f} mm, '
        f'NEES {np.mean([row["nees"] for row in rows]):.2f} in the mean; '
        f'{np.sqrt(np.mean(ratios**2)):.2f} times the bound, over {MAX_CRLB_RATIO} in '
        f'{np.sum(ratios > MAX_CRLB_RATIO)} (an estimator at the bound: in {chance:.1f})'
    )
    return 0 if all(meets_bounds(row) for row in rows) else 1
