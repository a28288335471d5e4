"""`landmark-nav map`: show, check, compare, merge and migrate map folders."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from landmark_nav.cli.options import add, aligned
from landmark_nav.errors import LandmarkNavError
from landmark_nav.storage.atomic_io import atomic_folder
from landmark_nav.storage.maps import load_map, MAP_DATA, save_map, SCHEMA_VERSION, write_map
from landmark_nav.types import Landmark, LandmarkMap
from landmark_nav.upkeep.comparison import (
    compare_maps,
    Comparison,
    problems_of_map,
    Texture,
    wall_changes,
)
from landmark_nav.upkeep.frames import in_one_frame, merge_maps

# Least disagreement of a landmark that is listed.
_LISTED_SIGMAS = 3.0
# Least share of landmarks with the same texture in two maps of one room whose walls differ. Maps
# of two rooms share 2 of 40 by chance.
_COMMON_SHARE = 0.1
_HEAD = (
    'id', 'wall', 'x m', 'y m', 'z m', 'along mm', 'across mm', 'size cm', 'range m', 'NCC',
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.description = 'Work on the folders of learned maps.'
    actions = parser.add_subparsers(dest='action', metavar='ACTION', required=True)

    def action(name: str, call: Any, text: str, **folders: str) -> Any:
        one = actions.add_parser(name, help=text.partition(':')[0].lower(), description=text)
        one.set_defaults(call=call)
        for metavar, what in folders.items():
            one.add_argument(metavar.lower(), metavar=metavar, help=what)
        one.epilog = f'example: landmark-nav map {name} {" ".join(folders).lower()}'
        return one

    older, newer = 'map folder, the older one', 'map folder, the newer one'
    action('show', _show, 'List the landmarks: position, sigma, size.', MAP='map folder')
    text = 'Check a map: exit status 1 and a line for each problem.'
    action('check', _check, text, MAP='map folder')
    text = (
        'Compare two maps of one room: what moved, what changed, what only one of them holds '
        '(other sweeps choose other landmarks, though nothing went). Maps with own frames are '
        'aligned first.'
    )
    action('diff', _diff, text, A=older, B=newer)
    text = 'Join two maps of one room: the newer one wins where a texture changed.'
    merge = action('merge', _merge, text, OLDER=older, NEWER=newer)
    merge.epilog += ' --out map'
    merge.add_argument('--out', required=True, metavar='MAP', help='map folder to write')
    text = "Write a map of an older format in today's: nothing else changes."
    migrate = action('migrate', _migrate, text, MAP='map folder')
    migrate.add_argument('--out', metavar='MAP', help='map folder to write (default: the same)')
    add(merge, '--overwrite')
    add(migrate, '--overwrite')


def run(args: argparse.Namespace) -> int:
    """Run the given action."""
    return int(args.call(args))


def _show(args: argparse.Namespace) -> int:
    print(describe_map(load_map(args.map)))
    return 0


def _check(args: argparse.Namespace) -> int:
    landmarks = load_map(args.map)
    problems = problems_of_map(landmarks)
    for problem in problems:
        print(problem)
    verdict = f'{len(problems)} problems' if problems else 'no problem'
    print(f'{args.map}: {len(landmarks.landmarks)} landmarks, {verdict}')
    return 1 if problems else 0


def _diff(args: argparse.Namespace) -> int:
    a, b = load_map(args.a), load_map(args.b)
    b, alignment = in_one_frame(a, b)
    if alignment is not None:
        x, y, heading = alignment.pose
        sigma_x, sigma_y, *_, sigma = np.sqrt(np.diag(alignment.covariance))
        print(
            f'B is aligned to A by {alignment.support} landmarks: its frame is at ({x:.3f}, '
            f'{y:.3f}) m, {np.degrees(heading):.2f} deg (sigma '
            f'{1e3 * np.hypot(sigma_x, sigma_y):.1f} mm); its metre is {alignment.scale:.4f} m of '
            f'A (sigma {sigma:.4f})'
        )
        print(describe_comparison(compare_maps(a, b)))
        return 0
    walls = {name: moved for name, moved in wall_changes(a, b).items() if moved > 0.0}
    comparison = compare_maps(a, b)
    same, fewer = len(comparison.of(Texture.SAME)), min(len(a.landmarks), len(b.landmarks))
    if walls and same < _COMMON_SHARE * fewer:
        raise LandmarkNavError(
            f'the maps are of two rooms: their walls differ, and {same} of {fewer} landmarks '
            'have the same texture in both'
        )
    for name, moved in walls.items():
        how = 'is in one map alone' if moved == np.inf else f'an end moved by {100 * moved:.1f} cm'
        print(f'wall     {name}: {how}')
    print(describe_comparison(comparison))
    return 0


def _merge(args: argparse.Namespace) -> int:
    older, newer = load_map(args.older), load_map(args.newer)
    merged = merge_maps(older, newer)
    save_map(merged, args.out, args.overwrite)
    print(
        f'{args.out}: {len(merged.landmarks)} landmarks of {len(older.landmarks)} and '
        f'{len(newer.landmarks)}'
    )
    return 0


def _migrate(args: argparse.Namespace) -> int:
    landmarks = load_map(args.map)
    out = Path(args.out or args.map)
    # Keep the figures in the folder, which show the same map.
    with atomic_folder(out, MAP_DATA, args.overwrite or args.out is None) as folder:
        write_map(landmarks, folder)
    print(f'{out}: {len(landmarks.landmarks)} landmarks, schema version {SCHEMA_VERSION}')
    return 0


def describe_comparison(comparison: Comparison) -> str:
    """Describe the differences and the agreement of two maps, as lines of text."""
    same = comparison.of(Texture.SAME)
    changed = comparison.of(Texture.CHANGED)
    unknown = comparison.of(Texture.UNKNOWN)
    lines = []
    for pair in sorted(same, key=lambda p: -p.sigmas):
        if pair.sigmas > _LISTED_SIGMAS:
            right, down = 100 * pair.disagreement_m
            lines.append(
                f'moved    {_name(pair.a)} -> {pair.b.id}: {right:+.1f} cm right, {down:+.1f} cm '
                f'down ({pair.sigmas:.1f} sigma)'
            )
    lines += [f'changed  {_name(p.a)} -> {p.b.id}: another texture' for p in changed]
    lines += [f'only A   {_name(k)}' for k in comparison.only_a]
    lines += [f'only B   {_name(k)}' for k in comparison.only_b]
    still = not lines and not unknown
    if same:
        apart = np.array([np.hypot(*pair.disagreement_m) for pair in same])
        nees = float(np.mean([pair.sigmas**2 for pair in same]))
        lines.append(
            f'{len(same)} in both: {1e3 * np.median(apart):.1f} mm apart in the median, '
            f'{1e3 * apart.max():.1f} mm at most'
            + (f'; NEES {nees:.2f} (2 is ideal)' if apart.any() else '')
        )
    if still:
        lines.append('no landmark moved or changed')
    lines.append(
        f'{len(changed)} changed, {len(comparison.only_a)} only in A, '
        f'{len(comparison.only_b)} only in B, {len(unknown)} unclear'
    )
    return '\n'.join(lines)


def _name(k: Landmark) -> str:
    x, y, z = k.position
    return f'{k.id} on {k.wall_id or "no wall"} at ({x:.2f}, {y:.2f}, {z:.2f}) m'


def describe_map(landmarks: LandmarkMap) -> str:
    """Describe a map: a table of its landmarks and a summary."""
    rows = []
    for k in landmarks.landmarks:
        tangent = np.array([-k.normal[1], k.normal[0], 0.0])
        along, across = (np.sqrt(d @ k.covariance @ d) for d in (tangent, k.normal))
        size = f'{100 * k.width_m:.0f}x{100 * k.height_m:.0f}'
        distance = np.hypot(*(k.position - k.viewpoint)[:2])
        rows.append([
            str(k.id), k.wall_id, *(f'{x:.3f}' for x in k.position), f'{1e3 * along:.1f}',
            f'{1e3 * across:.1f}', size, f'{distance:.2f}', f'{k.threshold:.2f}',
        ])  # fmt: skip
    counts = {wall.id: 0 for wall in landmarks.walls}
    for k in landmarks.landmarks:
        counts[k.wall_id] = counts.get(k.wall_id, 0) + 1
    on_walls = ', '.join(f'{name} {count}' for name, count in counts.items())
    lines = [
        *aligned(_HEAD, rows),
        '',
        'along, across: sigma along the wall and off it; range: from where it was learned;',
        'NCC: least correlation at which it counts as found',
        f'{len(landmarks.landmarks)} landmarks in frame {landmarks.frame_id}: {on_walls}',
        *(
            f'panorama of {p.stamp_ns * 1e-9:.3f} s: pan axis at '
            f'({p.pose[0]:.3f}, {p.pose[1]:.3f}) m, {np.degrees(p.pose[2]):.2f} deg; sigma '
            f'{100 * np.sqrt(np.trace(p.covariance[:2, :2])):.2f} cm, '
            f'{np.degrees(np.sqrt(p.covariance[2, 2])):.3f} deg'
            for p in landmarks.panorama_poses
        ),
        *(f'{key}: {value}' for key, value in landmarks.provenance.items()),
    ]
    return '\n'.join(lines)
