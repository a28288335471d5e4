"""`landmark-nav panorama`: a panorama out of a sweep."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.learning.panorama import PanoramaConfig, synthesize_cylinder
from landmark_nav.storage.bags import Bag, read_sweep_folder, read_sweeps
from landmark_nav.storage.setup_files import load_robot
from landmark_nav.storage.whole import write_whole
from landmark_nav.types import Sweep

__all__ = ['add_parser', 'run']


def add_parser(subparsers: Any) -> None:
    """Declare the arguments."""
    parser = subparsers.add_parser(
        'panorama',
        help='make a panorama out of a sweep',
        description='Project the frames of one sweep on a cylinder. What no frame covers is '
        'transparent.',
    )
    parser.add_argument(
        'sweep',
        metavar='BAG_OR_FOLDER',
        type=Path,
        help='bag of one sweep, or folder of pictures with frames.csv '
        '(file,pan_rad,focal_px,width,height)',
    )
    parser.add_argument('--out', required=True, metavar='F.png', type=Path, help='PNG to write')
    parser.add_argument(
        '--robot', metavar='F', help='robot.yaml: the mount; by default an ideal one'
    )
    parser.add_argument(
        '--blend',
        choices=('mean', 'median', 'feather'),
        default=PanoramaConfig.blend,
        help='how frames are joined (default %(default)s)',
    )


def run(args: argparse.Namespace) -> int:
    """Read the sweep, make the panorama, write it."""
    if args.out.suffix.lower() != '.png':
        raise LandmarkNavError(f'--out {args.out}: panoramas are written as .png')
    mount = load_robot(args.robot) if args.robot else PanTiltMount()
    sweep = _read(args.sweep, mount)
    view = synthesize_cylinder(sweep, mount, PanoramaConfig(blend=args.blend))
    alpha = np.where(view.mask, np.uint8(255), np.uint8(0))
    done, data = cv2.imencode('.png', np.dstack([view.image, alpha]))
    assert done, 'OpenCV writes every PNG of this shape'
    write_whole(args.out, data.tobytes())
    print(
        f'{args.out}: {view.cylinder.width} x {view.cylinder.height}, {len(sweep.frames)} frames, '
        f'{100.0 * np.mean(view.mask.any(axis=0)):.1f} % of the turn'
    )
    return 0


def _read(path: Path, mount: PanTiltMount) -> Sweep:
    """Sweep of a folder with ``frames.csv``, else of a bag."""
    if (path / 'frames.csv').is_file():
        return read_sweep_folder(path)
    sweeps = list(read_sweeps(Bag(path), mount))
    if len(sweeps) != 1:
        raise LandmarkNavError(f'{path}: holds {len(sweeps)} sweeps: give a bag of one')
    return sweeps[0]
