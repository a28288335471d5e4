"""`landmark-nav panorama`: a panorama out of a sweep."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.learning.alignment import align_sweep, AlignmentConfig
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
        description='Project the frames of one sweep on a cylinder, cut to the rows that every '
        'covered column has. What no frame covers is transparent.',
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
    parser.add_argument(
        '--align',
        action=argparse.BooleanOptionalAction,
        help="mend the frames' angles and focal length from their overlaps; by default for "
        'folders of pictures, whose angles are estimates, not for bags, whose encoder is better',
    )


def run(args: argparse.Namespace) -> int:
    """Read the sweep, make the panorama, write it."""
    if args.out.suffix.lower() != '.png':
        raise LandmarkNavError(f'--out {args.out}: panoramas are written as .png')
    mount = load_robot(args.robot) if args.robot else PanTiltMount()
    pictures = (args.sweep / 'frames.csv').is_file()
    sweep = read_sweep_folder(args.sweep) if pictures else _only_sweep(args.sweep, mount)
    if args.align or (args.align is None and pictures):
        aligned = align_sweep(sweep, mount, AlignmentConfig())
        sweep = aligned.sweep
        print(
            f'aligned: neighbours agree to {aligned.residual_px:.2f} px '
            f'({aligned.before_px:.2f} px before), focal length x {aligned.focal_scale:.4f}'
        )
    view = synthesize_cylinder(sweep, mount, PanoramaConfig(blend=args.blend))
    covered = view.mask.any(axis=0)
    rows = np.flatnonzero(view.mask[:, covered].all(axis=1))
    whole = slice(rows[0], rows[-1] + 1) if len(rows) else slice(None)
    alpha = np.where(view.mask, np.uint8(255), np.uint8(0))
    done, data = cv2.imencode('.png', np.dstack([view.image, alpha])[whole])
    assert done, 'OpenCV writes every PNG of this shape'
    write_whole(args.out, data.tobytes())
    print(
        f'{args.out}: {view.cylinder.width} x {len(alpha[whole])}, {len(sweep.frames)} frames, '
        f'{100.0 * np.mean(covered):.1f} % of the turn'
    )
    return 0


def _only_sweep(path: Path, mount: PanTiltMount) -> Sweep:
    sweeps = list(read_sweeps(Bag(path), mount))
    if len(sweeps) != 1:
        raise LandmarkNavError(f'{path}: holds {len(sweeps)} sweeps: give a bag of one')
    return sweeps[0]
