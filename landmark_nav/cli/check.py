"""`landmark-nav check`: find faults of a recording before it is used."""

from __future__ import annotations

import argparse
from dataclasses import replace
import itertools

import numpy as np

from landmark_nav.calibration import Calibration
from landmark_nav.cli.options import add, open_bag, progress
from landmark_nav.diagnosis import check_papers, diagnose, Diagnosis, Finding, QUICK, table
from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.replay import replay
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Room
from landmark_nav.localization.localizer import LocalizationConfig
from landmark_nav.storage.atomic_io import check_writable, write_json
from landmark_nav.storage.bags import Bag, sensor_events, SensorEvent
from landmark_nav.storage.bags.definitions import DRIVE_IMAGES
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.robot_files import load_calibration
from landmark_nav.storage.setup_files import load_room
from landmark_nav.types import CameraFrame

# Number of images within which the pose is found if the map is of this room.
_MAP_IMAGES = 50


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.description = (
        'Check the streams of a bag: rates, gaps, clocks, encodings, frames, lens; signs, units '
        'and delays of pan and odometry against how the images themselves turn. Exit status: 0 '
        'without errors, 1 with.'
    )
    add(parser, 'bag', '--topic', '--room', '--robot')
    add(parser, '--map', help='map folder: its walls, if no room is given')
    add(parser, '--json', help='write what was found to F')


def run(args: argparse.Namespace) -> int:
    """Check a bag and print a table of findings."""
    check_writable(args.json)
    known = load_calibration(args.robot) if args.robot else Calibration.of_mount(PanTiltMount())
    room = load_room(args.room) if args.room else None
    if args.map and room is None:
        walls = load_map(args.map).walls
        room = Room(walls) if walls else None
    bag = _shown(open_bag(args.bag, args))
    found = diagnose(bag, known, room)
    if room is not None and room.anchors:
        found = replace(found, findings=(*found.findings, *check_papers(bag, known, room)))
    if args.map and args.robot and not found.errors and bag.find('odom'):
        found = replace(found, findings=(*found.findings, *_check_map(bag, args)))
    checks = [finding.report() for finding in found.findings]
    report = {'schema': 1, 'bag': str(bag.path), 'status': found.status, 'checks': checks}
    write_json(args.json, report)
    print('\n'.join(table(found.findings)))
    print(f'errors: {len(found.errors)}, warnings: {len(found.warnings)}')
    return int(bool(found.errors))


def _check_map(bag: Bag, args: argparse.Namespace) -> list[Finding]:
    """Check whether the first images of a drive show landmarks of a map."""
    landmarks = load_map(args.map)
    if not landmarks.landmarks or not bag.find(*DRIVE_IMAGES):
        return []
    calibration = landmarks.calibration_from(load_calibration(args.robot))
    count = itertools.count(1)

    def early(event: SensorEvent) -> bool:
        return not isinstance(event, CameraFrame) or next(count) <= _MAP_IMAGES

    events = itertools.takewhile(early, sensor_events(bag, calibration.mount))
    try:
        done = replay(events, landmarks, calibration, LocalizationConfig())
    except LandmarkNavError as error:
        return [Finding('map', 'error', str(error), 'take the map of this room, or learn it anew')]
    x, y, heading = done.start.pose.tolist()
    after_s = 1e-9 * (done.start.stamp_ns - done.begin_ns)
    pose = f'({x:.2f}, {y:.2f}) m, {np.degrees(heading):.0f} deg'
    text = f'place found: {pose} after {after_s:.1f} s'
    return [Finding('map', 'ok', text, '', {'pose': done.start.pose.tolist()})]


def _shown(bag: Bag) -> Bag:
    """Bag that shows progress while it is read."""
    return bag.showing(lambda messages, total: progress(messages, 'checking', total))


def checked(bag: Bag, known: Calibration, room: Room | None) -> Diagnosis:
    """
    Check a recording quickly before it is used, and log warnings, one line each.

    Raises `LandmarkNavError`: the recording has errors; the first one is in the message.
    """
    found = diagnose(_shown(bag), known, room, QUICK)
    for finding in found.warnings:
        if not finding.when_read:
            bag.warn(f'{bag.path}: {finding.line()}')
    errors = [finding for finding in found.errors if not finding.when_read]
    if errors:
        first, *more = errors
        others = f' (and {len(more)} more: landmark-nav check)' if more else ''
        raise LandmarkNavError(f'{bag.path}: {first.line()}{others}')
    return found
