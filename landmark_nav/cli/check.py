"""`landmark-nav check`: what is wrong with a recording, before anything is made of it."""

from __future__ import annotations

import argparse
from dataclasses import replace

from landmark_nav.cli.options import add, open_bag
from landmark_nav.diagnosis import check_papers, diagnose, Diagnosis, QUICK, table, worst
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Room
from landmark_nav.storage.atomic_io import check_writable, write_json
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.setup_files import load_robot, load_room


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the command takes."""
    parser.description = (
        'Check the streams of a bag: rates, gaps, clocks, encodings, frames, lens; signs, units '
        'and delays of pan and odometry against how the images themselves turn. Exit status: 0 '
        'without errors, 1 with.'
    )
    add(parser, 'bag', '--topic', '--room', '--robot')
    add(parser, '--map', help='map folder: its walls, if no room is given')
    add(parser, '--json', help='write what was found to F')


def run(args: argparse.Namespace) -> int:
    """Check and print a table."""
    check_writable(args.json)
    mount = load_robot(args.robot) if args.robot else PanTiltMount()
    room = load_room(args.room) if args.room else None
    if args.map and room is None:
        walls = load_map(args.map).walls
        room = Room(walls) if walls else None
    bag = open_bag(args.bag, args)
    found = diagnose(bag, mount, room)
    if room is not None and room.papers:
        found = replace(found, findings=(*found.findings, *check_papers(bag, mount, room)))
    if args.json:
        report = {
            'schema': 1,
            'bag': str(bag.path),
            'status': worst(found.findings),
            'checks': [finding.report() for finding in found.findings],
        }
        write_json(args.json, report)
    print('\n'.join(table(found.findings)))
    print(f'{len(found.errors)} errors, {len(found.warnings)} warnings')
    return int(bool(found.errors))


def checked(bag: Bag, mount: PanTiltMount, room: Room | None) -> Diagnosis:
    """
    Look at a recording quickly before it is used: pass warnings on, a line each.

    Raises `LandmarkNavError`: there is an error, with the first of them.
    """
    found = diagnose(bag, mount, room, QUICK)
    for finding in found.warnings:
        if not finding.when_read:
            bag.warn(f'{bag.path}: {finding.line()}')
    errors = [finding for finding in found.errors if not finding.when_read]
    if errors:
        first, *more = errors
        others = f' (and {len(more)} more: landmark-nav check)' if more else ''
        raise LandmarkNavError(f'{bag.path}: {first.line()}{others}')
    return found
