"""`landmark-nav calibrate`: estimate robot.yaml from sweeps and drives."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, replace
import logging
from pathlib import Path
from typing import Any

import numpy as np

from landmark_nav.calibration import Calibration, NAMES, shown, UNITS
from landmark_nav.cli.check import checked
from landmark_nav.cli.learn import check_scale, is_placed, located_sweeps, panoramas_of_bag
from landmark_nav.cli.options import add, open_bag, progress, text_of, wrapped
from landmark_nav.configuration import Configuration, load_configuration, READS
from landmark_nav.diagnosis.findings import Code
from landmark_nav.errors import inside, LandmarkNavError
from landmark_nav.evaluation import calibration_run
from landmark_nav.evaluation.report import calibration_page, check_report, tables, write_report
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.pipeline import learn_from_panoramas
from landmark_nav.learning.stages import StageLog
from landmark_nav.learning.unmeasured import learn_located, with_plan
from landmark_nav.storage.atomic_io import check_new, check_writable, write_json
from landmark_nav.storage.bags import Bag, sensor_events
from landmark_nav.storage.bags.definitions import DRIVE_IMAGES
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.robot_files import load_calibration, read_robot, save_calibration
from landmark_nav.storage.setup_files import load_room
from landmark_nav.types import LandmarkMap, Panorama

_LOG = logging.getLogger(__name__)

# Least number of panoramas of a map.
_LEAST_PANORAMAS = 2


@dataclass
class _Work:
    """Current estimate, map and evaluated recordings."""

    known: Calibration
    landmarks: LandmarkMap | None
    config: Configuration
    panoramas: list[Panorama] = field(default_factory=list)
    drives: list[calibration_run.CalibrationDrive] = field(default_factory=list)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.description = (
        'Estimate how the camera is mounted out of sweeps, drives or both, and write a robot.yaml '
        'with standard deviations. A drive needs --map, or two sweeps in the bags to learn one '
        'from. Sweeps are used first, in the order of the bags; without --room as learn does, out '
        'of one bag, and not at all if there are --map and a drive.'
    )
    parser.add_argument('bags', metavar='BAG', nargs='+', help='bag with sweeps or a drive')
    add(parser, '--topic', '--room', '--map', '--config', '--overwrite')
    add(parser, '--robot', required=True, help='robot.yaml: what is known before')
    add(parser, '--out', required=True, metavar='F', help='robot.yaml to write; may be --robot')
    add(parser, '--json', help='write the table to F')
    text = 'write a page with the table and the residuals before and after to F.html'
    add(parser, '--report', help=text)
    parser.set_defaults(replaces='robot')


def run(args: argparse.Namespace) -> int:
    """Calibrate; write only if no error occurs."""
    check_report(args.report)
    check_writable(args.out, args.json, args.report)
    check_new(args.overwrite, args.out)
    given = load_calibration(args.robot)
    room = load_room(args.room) if args.room else None
    landmarks = load_map(args.map) if args.map else None
    bags = [open_bag(path, args) for path in args.bags]
    sweeps = [bag for bag in bags if bag.find('sweep/trajectory')]
    drives = [bag for bag in bags if bag.find(*DRIVE_IMAGES) and bag.find('odom')]
    for bag in bags:
        if bag not in sweeps and bag not in drives:
            what = 'no sweep and no drive (images with odometry)'
            raise LandmarkNavError(f'{bag.path}: holds {what}: take another')
    if room is None and drives and landmarks:
        sweeps = []

    # A map learned with the same robot.yaml contains the calibration by its sweeps; use it once.
    known = given
    if landmarks is not None and not sweeps:
        known = landmarks.calibration_from(given)
    work = _Work(known, landmarks, load_configuration(args.config, args.robot, *READS))
    if sweeps:
        _use_sweeps(work, sweeps, room, bool(drives))
        if drives and landmarks is None and work.landmarks is not None:
            work.known = work.landmarks.calibration_from(given)
    for bag in drives:
        _use_drive(work, bag)
    found = work.known
    hidden = found.unobserved(given)
    if len(hidden) + int(np.sum(given.sigmas == 0.0)) == len(NAMES):
        raise LandmarkNavError(
            'the recording shows nothing of the mount, as if the robot stood still: record '
            + '; '.join(motion for motion, _ in calibration_run.advice(hidden)[:3])
        )
    contradicted = calibration_run.contradicted(work.drives[-1], given) if work.drives else {}
    for name, (off, sigma) in contradicted.items():
        _LOG.warning(
            '%s: %s is given as exact (sigma 0), and the drive shows %s beside it: it stays',
            args.robot, name, shown(off, sigma, UNITS[name]),
        )  # fmt: skip
    report, residuals = _report(work, given, contradicted), None
    if work.drives:
        none = np.zeros_like(given.covariance)
        before, after = (
            work.drives[-1].again(replace(known, covariance=none, by_map=None))[1]
            for known in (given, found)
        )
        residuals = before, after
        report['residual_px'] = {
            name: None if np.isnan(one.rms_px).any() else one.rms_px.tolist()
            for name, one in (('before', before), ('after', after))
        }
    save_calibration(found, args.out, read_robot(Path(args.robot), {}).get('odometry'))
    write_json(args.json, report)
    if args.report:
        inputs = {'bags': ', '.join(args.bags), 'robot': args.robot, 'room': args.room}
        inputs['map'] = args.map
        title = f'Calibration of {Path(args.robot).name}'
        page = calibration_page(report, residuals)
        write_report(args.report, page, title, args.command_line, inputs)
    lines = text_of(tables.calibration_verdict(report), tables.calibration_tables(report))
    print(wrapped([*lines, f'written to {args.out}']))
    return 0


def _use_sweeps(work: _Work, bags: list[Bag], room: Room | None, mapped: bool) -> None:
    """Calibrate by sweeps; learn a map from them if one is required and not given."""
    config, given, located = work.config, work.known, None
    for bag in bags:
        plan = room if room is not None and is_placed(bag, room) else None
        if plan is None:
            if len(bags) > 1:
                how = 'give one, or a --room with papers or markers'
                raise LandmarkNavError(f'{bag.path}: each bag of sweeps has its own frame: {how}')
            check_scale(bag, config)
        checked(bag, given, room)
        # Sweeps share errors: each bag begins with what is given.
        if plan is not None:
            work.panoramas += panoramas_of_bag(bag, plan, given, StageLog())[0]
            continue
        located, _ = located_sweeps(bag, given, config, StageLog())
        located = with_plan(located, room) if room is not None else located
        work.panoramas += located.panoramas
    if work.panoramas:
        work.known = work.panoramas[-1].calibration or given
    if len(work.panoramas) < _LEAST_PANORAMAS or (work.landmarks is not None and mapped):
        return
    if located is not None:
        learned = learn_located(located, config).map
        learned.provenance.update(located.provenance)
    elif room is not None:
        learned = learn_from_panoramas(work.panoramas, room, config).map
    else:
        return
    work.landmarks = learned = replace(learned, prior=given)
    if learned.calibration is not None:
        work.known = replace(learned.calibration, base=given.base)


def _use_drive(work: _Work, bag: Bag) -> None:
    """Calibrate by a drive, with the current estimate as the prior."""
    landmarks, known = work.landmarks, work.known
    if landmarks is None or not landmarks.landmarks:
        how = 'give --map, or a bag with two sweeps'
        raise LandmarkNavError(f'{bag.path}: a drive needs a map: {how}')
    room = Room(landmarks.walls) if landmarks.walls else None
    diagnosis = checked(bag, known, room)
    if any(finding.name == Code.ZOOM.check for finding in diagnosis.warnings):
        how = 'robot.yaml holds one lens: record one, or publish one calibration'
        raise LandmarkNavError(f'{bag.path}: the focal length in camera_info changes: {how}')
    late = diagnosis.delays
    if late.joints_s:
        delay_s = known['joint_delay'][0] + late.joints_s
        known = known.measured('joint_delay', delay_s, max(late.pan_sigma_s, 1e-3))
    events = sensor_events(bag, known.mount, 0.0, late.images_s, late.odometry_s)
    total = bag.counts[bag.require('odom')]
    shown_events = progress(events, 'calibrating', 2 * total)
    with inside(bag.path):
        drive = calibration_run.calibrate_by_drive(shown_events, landmarks, known, work.config)
    work.drives.append(drive)
    work.known = drive.calibration


def _report(
    work: _Work, given: Calibration, contradicted: dict[str, tuple[float, float]]
) -> dict[str, Any]:
    found = work.known
    table: dict[str, Any] = {k: dict(row) for k, row in found.differences(given).items()}
    for name, row in table.items():
        row['prior_sigma'] = sigma = given[name][1]
        row['difference_sigmas'] = (row['value'] - row['prior']) / sigma if sigma else None
    return {
        'schema': 1,
        'sweeps': len(work.panoramas),
        'drives': len(work.drives),
        'images': sum(drive.images for drive in work.drives),
        'lost': sum(drive.lost for drive in work.drives),
        'calibration': table,
        'unobserved': [
            {'motion': motion, 'quantities': list(names)}
            for motion, names in calibration_run.advice(found.unobserved(given))
        ],
        'trade_offs': [
            {'quantities': [a, b], 'correlation': value}
            for a, b, value in calibration_run.trade_offs(found)
        ],
        'side_slip_bound_rad': work.drives[-1].slip_bound_rad if work.drives else None,
        'contradicted': {k: {'off': off, 'sigma': s} for k, (off, s) in contradicted.items()},
    }
