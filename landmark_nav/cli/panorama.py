"""`landmark-nav panorama`: make a panorama from a sweep."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from landmark_nav.calibration import Calibration
from landmark_nav.cli.options import add, open_bag, within, wrapped
from landmark_nav.errors import LandmarkNavError, UsageError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.image_codec import encode_image
from landmark_nav.learning.calibration.overlap_fit import as_calibrated
from landmark_nav.learning.calibration.sweep_calibration import align_sweep, calibrate_sweep
from landmark_nav.learning.calibration.turn import check_turn
from landmark_nav.learning.panorama.photometry import even_out, measure_photometry
from landmark_nav.learning.panorama.synthesis import synthesize_cylinder
from landmark_nav.learning.sweep_pipeline import tenengrad
from landmark_nav.quality import PanoramaQuality
from landmark_nav.storage.atomic_io import check_new, check_writable, write_atomically
from landmark_nav.storage.bags import read_sweep_folder, read_sweeps
from landmark_nav.storage.robot_files import load_calibration
from landmark_nav.types import Sweep


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.description = (
        'Project the frames of one sweep on a cylinder, cut to the rows that every '
        'covered column has. What no frame covers is transparent.'
    )
    text = 'bag of sweeps, or folder of images with frames.csv: file,pan_rad,focal_px,width,height'
    add(parser, 'sweep', metavar='BAG_OR_FOLDER', type=Path, help=text)
    add(parser, '--topic', '--overwrite')
    which = {'dest': 'number', 'metavar': 'K', 'help': 'which sweep of the bag, from 1 on'}
    add(parser, '--sweep', type=within(int, 1), **which)
    add(parser, '--out', required=True, metavar='F.png', help='PNG to write')
    add(parser, '--robot', help='robot.yaml: how the camera is mounted (default: level, centred)')
    parser.add_argument(
        '--align',
        action=argparse.BooleanOptionalAction,
        default=True,
        help="calibrate from the overlaps; in a folder, where angles are estimates, each frame's "
        'angles too (the default)',
    )


def run(args: argparse.Namespace) -> int:
    """Read the sweep, make the panorama, and write it."""
    if args.out.suffix.lower() != '.png':
        raise UsageError(f'--out {args.out}: panoramas are written as .png')
    check_new(args.overwrite, args.out)
    check_writable(args.out)
    given = load_calibration(args.robot) if args.robot else Calibration.of_mount(PanTiltMount())
    mount = given.mount
    is_image_folder = (args.sweep / 'frames.csv').is_file()
    if not is_image_folder and any(args.sweep.glob('*.[jpJP][pnPN]*[gG]')):
        raise LandmarkNavError(
            f'{args.sweep}: images without frames.csv (file,pan_rad,focal_px,width,height)'
        )
    if is_image_folder and args.number is not None:
        raise UsageError(f'{args.sweep}: is one sweep: leave out --sweep {args.number}')
    sweep = read_sweep_folder(args.sweep) if is_image_folder else _sweep(args, mount)
    raw, sweep = sweep, as_calibrated(sweep, given)
    check_turn(sweep, mount)
    quality = PanoramaQuality(0.0)
    if args.align and is_image_folder:
        given_px = np.median([f.camera.fx for f in sweep.frames])
        sweep, quality = align_sweep(sweep, mount)
        focal = next(t for t in quality.calibration if t.name == 'focal_length')
        scale = 1.0 + focal.value
        print(
            f'focal length {given_px * scale:.2f} +- {given_px * focal.sigma:.2f} px '
            f'({scale:.4f} times the given one), as of a lens without distortion'
        )
    elif args.align:
        found = calibrate_sweep(raw, given)
        sweep, mount = found.sweep, found.mount
        quality = found.quality
    photometry = measure_photometry(sweep, mount)
    view = synthesize_cylinder(even_out(sweep, photometry), mount)
    covered = view.mask.any(axis=0)
    rows = np.flatnonzero(view.mask[:, covered].all(axis=1))
    whole = slice(rows[0], rows[-1] + 1) if len(rows) else slice(None)
    alpha = np.where(view.mask, np.uint8(255), np.uint8(0))
    shown = np.dstack([view.image, alpha])[whole]
    write_atomically(args.out, encode_image(shown, '.png').tobytes())
    quality_text = quality.of(tenengrad(view), photometry.vignetting, photometry.gain_spread)
    print(wrapped([str(quality_text)]))
    print(
        f'{args.out}: {view.cylinder.width} x {len(alpha[whole])} px, {len(sweep.frames)} frames, '
        f'{100.0 * np.mean(covered):.1f} % of the turn'
    )
    return 0


def _sweep(args: argparse.Namespace, mount: PanTiltMount) -> Sweep:
    """Read the sweep with the given number, from 1; by default the only one of the bag."""
    number: int | None = args.number
    bag = open_bag(args.sweep, args)
    found, total = None, 0
    for total, sweep in enumerate(read_sweeps(bag, mount), 1):
        if total == (number or 1):
            found = sweep
        if total == number:
            break
    if not total:
        raise LandmarkNavError(f'{bag.path}: holds no whole sweep: take another')
    if found is None or (number is None and total > 1):
        which = '' if number is None else f', no number {number}'
        raise UsageError(
            f'{bag.path}: holds {total} sweeps{which}: take one by --sweep 1 to {total}'
        )
    return found
