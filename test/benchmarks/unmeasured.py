"""
Learning without a plan, one line a room and way: scale from odometry between sweeps (``odom``), or
from A4 papers at unknown places (``papers``); or walls that are off by 10 cm (``walls``).

``python test/benchmarks unmeasured --seeds 801 802`` simulates rooms; ``--study`` takes that
of the study; ``--ways`` chooses. ``../shared/tools/add_odometry.py`` puts odometry between sweeps.
Exits with 1 if a room misses a bound, or is refused.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from itertools import product
import json
from pathlib import Path
import subprocess
import sys
import tempfile

from as_a_user import command
import numpy as np
import yaml

from landmark_nav.evaluation.learning_report import truth_of_bag
from landmark_nav.geometry import se2
from landmark_nav.geometry.walls import Room
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.setup_files import load_room, wall_entry

SHARED = Path(__file__).resolve().parents[3] / 'shared'
WAYS = ('odom', 'papers', 'walls')
MAX_POSITION_RMSE_M, MAX_NEES, MAX_SCALE_SIGMAS = 0.008, 8.0, 3.0
OFF_M = 0.1


def moved(room: Room, rng: np.random.Generator) -> Room:
    """The same room, each wall off by `OFF_M` one way or the other, and marked so."""
    off = rng.choice([-OFF_M, OFF_M], len(room.walls))
    starts, ends = (
        np.array([getattr(w, end) for w in room.walls]) + off[:, None] * room.normals[:, :2]
        for end in ('start', 'end')
    )
    corners = []
    for k in range(len(room.walls)):
        sides = np.stack([ends[k - 1] - starts[k - 1], starts[k] - ends[k]], 1)
        share = np.linalg.solve(sides, starts[k] - starts[k - 1])[0]
        corners.append(starts[k - 1] + share * (ends[k - 1] - starts[k - 1]))
    walls = tuple(
        replace(w, start=tuple(a), end=tuple(b), sigma_m=OFF_M)
        for w, a, b in zip(room.walls, corners, [*corners[1:], corners[0]], strict=True)
    )
    return replace(room, walls=walls)


def sources(way: str, recording: Path, folder: Path, seed: int) -> list[object]:
    """Recording of the sweeps and what `learn` is given with it."""
    if way == 'papers':
        return [recording / 'learn', '--paper-size', 0.210, 0.297]
    if way == 'odom':
        tool = SHARED / 'tools' / 'add_odometry.py'
        subprocess.run(
            [sys.executable, tool, recording / 'learn', folder / 'sweeps', '--seed', str(seed)],
            check=True,
            stdout=subprocess.DEVNULL,
        )
        return [folder / 'sweeps']
    room = load_room(recording / 'room.yaml')
    document = yaml.safe_load((recording / 'room.yaml').read_text())
    walls = moved(room, np.random.default_rng(seed)).walls
    document['walls'] = [wall_entry(wall) for wall in walls]
    (folder / 'room.yaml').write_text(yaml.safe_dump(document))
    return [recording / 'learn', '--room', folder / 'room.yaml']


def run(way: str, recording: Path, folder: Path, seed: int) -> dict[str, float]:
    """Learn and drive in one room; figures after alignment where the map has its own frame."""
    robot = recording / 'robot.yaml'
    command(
        'learn', *sources(way, recording, folder, seed), '--robot', robot,
        '--out', folder / 'map', '--json', folder / 'l.json', '--overwrite',
    )  # fmt: skip
    truth = truth_of_bag(Bag(recording / 'learn'))
    start = json.loads((recording / 'start.json').read_text())['pose']
    if way != 'walls':
        start = se2.relative(truth.poses[0], np.array(start)).tolist()
    command(
        'evaluate', recording / 'drive', '--map', folder / 'map', '--robot', robot,
        '--start', *start, '--json', folder / 'e.json',
    )  # fmt: skip
    learned, driven = (json.loads((folder / name).read_text()) for name in ('l.json', 'e.json'))
    scaled, scale, sigma = driven['fused'], 1.0, 1.0
    if way != 'walls':
        sigma = float(learned['unmeasured']['scale_sigma'])
        scaled, scale = driven['fused_after_scale'], driven['scale']
    return {
        'landmarks': driven['landmarks'],
        'walls': len(learned['landmarks_per_wall']),
        'rmse_mm': 1e3 * scaled['position_rmse_m'],
        'rigid_mm': 1e3 * driven['fused']['position_rmse_m'],
        'heading_deg': driven['fused']['heading_rmse_deg'],
        'nees': driven['nees']['mean'],
        'scale': scale,
        'scale_sigmas': abs(scale - 1.0) / sigma,
        'undetected': driven['silently_wrong'],
    }


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', nargs='*', type=int, default=[])
    parser.add_argument('--study', action='store_true')
    parser.add_argument('--ways', nargs='+', choices=WAYS, default=WAYS)
    parser.add_argument('--recordings', nargs='*', type=Path, default=[], help='of `simulate`')
    args = parser.parse_args()
    failed = False
    with tempfile.TemporaryDirectory() as name:
        rooms = [(SHARED / 'data' / 'study', 0)] if args.study else []
        for seed in args.seeds:
            room = Path(name) / str(seed)
            command('simulate', '--out', room, '--seed', seed, '--light-change')
            rooms.append((room, seed))
        rooms += [(recording, number) for number, recording in enumerate(args.recordings)]
        for number, ((room, seed), way) in enumerate(product(rooms, args.ways)):
            folder = Path(name) / f'run{number}'
            folder.mkdir()
            try:
                figures = run(way, room, folder, seed)
            except SystemExit as refused:
                print(f'{room.name:>8} {way:>6} refused: {refused}', flush=True)
                failed = True
                continue
            line = ' '.join(f'{k} {v:.4g}' for k, v in figures.items())
            print(f'{room.name:>8} {way:>6} {line}', flush=True)
            failed |= (
                figures['rmse_mm'] > 1e3 * MAX_POSITION_RMSE_M
                or figures['nees'] > MAX_NEES
                or figures['scale_sigmas'] > MAX_SCALE_SIGMAS
                or figures['undetected'] > 0
            )
    return int(failed)
