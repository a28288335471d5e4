"""`landmark-nav map`: works on map folders."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from landmark_nav.storage.maps import load_map
from landmark_nav.types import LandmarkMap

__all__ = ['add_parser', 'run']


def add_parser(subparsers: Any) -> None:
    """Declare the arguments."""
    parser = subparsers.add_parser(
        'map', help='look into maps', description='Work on the folder of a learned map.'
    )
    actions = parser.add_subparsers(dest='action', metavar='ACTION', required=True)
    show = actions.add_parser(
        'show',
        help='list the landmarks of a map',
        description='Check a map folder and list its landmarks: where, how sure, how large.',
    )
    show.add_argument('map', metavar='MAP', help='map folder')


def run(args: argparse.Namespace) -> int:
    """Do what `args.action` says."""
    print(describe_map(load_map(args.map)))
    return 0


def describe_map(landmarks: LandmarkMap) -> str:
    """Tell of a map as a table of its landmarks and a summary."""
    lines = [
        f'{"id":>4}  {"wall":<10} {"x m":>8} {"y m":>8} {"z m":>7} {"along cm":>9} '
        f'{"across cm":>9} {"size cm":>9}  {"range m":>7} {"NCC":>5}'
    ]
    for k in landmarks.landmarks:
        x, y, z = k.position
        tangent = np.array([-k.normal[1], k.normal[0], 0.0])
        along, across = (np.sqrt(d @ k.covariance @ d) for d in (tangent, k.normal))
        size = f'{100 * k.width_m:.0f}x{100 * k.height_m:.0f}'
        distance = np.hypot(*(k.position - k.viewpoint)[:2])
        lines.append(
            f'{k.id:>4}  {k.wall_id:<10} {x:>8.3f} {y:>8.3f} {z:>7.3f} {100 * along:>9.2f} '
            f'{100 * across:>9.2f} {size:>9}  {distance:>7.2f} {k.threshold:>5.2f}'
        )
    counts = {wall.id: 0 for wall in landmarks.walls}
    for k in landmarks.landmarks:
        counts[k.wall_id] = counts.get(k.wall_id, 0) + 1
    on_walls = ', '.join(f'{name} {count}' for name, count in counts.items())
    lines += [
        '',
        f'{len(landmarks.landmarks)} landmarks in frame {landmarks.frame_id}: {on_walls}',
        *(
            f'panorama of {p.stamp_ns * 1e-9:.3f} s at ({p.pose[0]:.3f}, {p.pose[1]:.3f}) m, '
            f'{np.degrees(p.pose[2]):.2f} deg; sigma '
            f'{100 * np.sqrt(np.trace(p.covariance[:2, :2])):.2f} cm, '
            f'{np.degrees(np.sqrt(p.covariance[2, 2])):.3f} deg'
            for p in landmarks.panorama_poses
        ),
        *(f'{key}: {value}' for key, value in landmarks.provenance.items()),
    ]
    return '\n'.join(lines)
