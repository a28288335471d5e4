"""
Learning without a plan: scale from odometry between the sweeps, one line a room.

``python test/unmeasured_check.py --seeds 801 802`` simulates rooms; ``--study`` takes the study's
recording. ``../shared/tools/add_odometry.py`` puts odometry between the sweeps. Exits with 1 if a
room misses a bound, or is refused.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
import subprocess
import sys
import tempfile

from as_a_user import command
import numpy as np

from landmark_nav.evaluation.true_places import truth_of_bag
from landmark_nav.geometry import se2
from landmark_nav.storage.bags import Bag

SHARED = Path(__file__).resolve().parents[2] / 'shared'
MAX_POSITION_RMSE_M, MAX_NEES, MAX_SCALE_SIGMAS = 0.008, 8.0, 3.0


def run(recording: Path, folder: Path, seed: int) -> dict[str, float]:
    """Learn and drive in one room; figures after alignment."""
    sweeps, robot = folder / 'sweeps', recording / 'robot.yaml'
    tool = SHARED / 'tools' / 'add_odometry.py'
    subprocess.run(
        [sys.executable, tool, recording / 'learn', sweeps, '--seed', str(seed)],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    command(
        'learn', sweeps, '--robot', robot, '--out', folder / 'map', '--json', folder / 'l.json',
        '--overwrite',
    )  # fmt: skip
    truth = truth_of_bag(Bag(recording / 'learn'))
    start = json.loads((recording / 'start.json').read_text())['pose']
    start = se2.relative(truth.poses[0], np.array(start)).tolist()
    command(
        'evaluate', recording / 'drive', '--map', folder / 'map', '--robot', robot,
        '--start', *start, '--json', folder / 'e.json',
    )  # fmt: skip
    learned, driven = (json.loads((folder / name).read_text()) for name in ('l.json', 'e.json'))
    sigma = float(learned['unmeasured']['scale_sigma'])
    return {
        'landmarks': driven['landmarks'],
        'walls': len(learned['landmarks_per_wall']),
        'rmse_mm': 1e3 * driven['fused_after_scale']['position_rmse_m'],
        'rigid_mm': 1e3 * driven['fused']['position_rmse_m'],
        'heading_deg': driven['fused_after_scale']['heading_rmse_deg'],
        'nees': driven['nees']['mean'],
        'scale': driven['scale'],
        'scale_sigmas': abs(driven['scale'] - 1.0) / sigma,
        'undetected': driven['silently_wrong'],
    }


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', nargs='*', type=int, default=[])
    parser.add_argument('--study', action='store_true')
    args = parser.parse_args()
    failed = False
    with tempfile.TemporaryDirectory() as name:
        rooms = [(SHARED / 'data' / 'study', 0)] if args.study else []
        for seed in args.seeds:
            room = Path(name) / str(seed)
            command('simulate', '--out', room, '--seed', seed, '--light-change')
            rooms.append((room, seed))
        for number, (room, seed) in enumerate(rooms):
            folder = Path(name) / f'run{number}'
            folder.mkdir()
            try:
                figures = run(room, folder, seed)
            except SystemExit as refused:
                print(f'{room.name:>8} refused: {refused}')
                failed = True
                continue
            print(f'{room.name:>8} ' + ' '.join(f'{k} {v:.4g}' for k, v in figures.items()))
            failed |= (
                figures['rmse_mm'] > 1e3 * MAX_POSITION_RMSE_M
                or figures['nees'] > MAX_NEES
                or figures['scale_sigmas'] > MAX_SCALE_SIGMAS
                or figures['undetected'] > 0
            )
    return int(failed)


if __name__ == '__main__':
    sys.exit(main())
