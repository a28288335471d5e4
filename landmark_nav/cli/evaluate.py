"""`landmark-nav evaluate`: localize along a drive and compare with its ground truth."""

from __future__ import annotations

import argparse
from dataclasses import replace
import logging
from pathlib import Path
from typing import Any

import numpy as np

from landmark_nav.cli.check import checked
from landmark_nav.cli.options import add, open_bag, progress, text_of, within, wrapped
from landmark_nav.configuration import load_configuration
from landmark_nav.errors import LandmarkNavError, UsageError
from landmark_nav.evaluation import run_report
from landmark_nav.evaluation.learning_report import check_truth_frame
from landmark_nav.evaluation.replay import replay, UnknownPlaceError
from landmark_nav.evaluation.report import (
    check_report,
    drive_page,
    FrameStrip,
    write_report,
    write_video,
)
from landmark_nav.evaluation.report.tables import drive_tables, drive_verdict
from landmark_nav.geometry.walls import Room
from landmark_nav.storage.atomic_io import check_writable, write_json
from landmark_nav.storage.bags import sensor_events
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.robot_files import load_calibration
from landmark_nav.types import LandmarkMap

_LOG = logging.getLogger(__name__)

# Names in the contract of the topics of `sensor_events`, for the length of the progress bar.
_EVENTS = ('camera/image_raw', 'detections', 'odom', 'ground_truth/odom')

# Greatest coordinate, half the circumference of the earth, and least sigma of the start.
_FARTHEST_M, _LEAST_SIGMA = 2e7, 1e-9

_FIGURES = ('trajectory.png', 'errors.png')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.description = (
        'Localize along a recorded drive with the same stages as the nodes, compare '
        'with ground_truth/odom at the stamps of the images, and write what --json, --tum, '
        '--report, --video and --out ask for.'
    )
    add(parser, 'bag', help='bag of a drive')
    add(parser, '--topic', '--config')
    add(parser, '--map', '--robot', required=True)
    text = 'pose of base_link in map at the start: m, m, rad (default: it finds its own place)'
    pose = {'type': within(float, -_FARTHEST_M, _FARTHEST_M), 'metavar': ('X', 'Y', 'THETA')}
    add(parser, '--start', **pose, nargs=3, help=text)
    text = 'sigma of x and y at the start in m, of the heading in rad (default 0.05 0.035)'
    sigmas = {'type': within(float, _LEAST_SIGMA, _FARTHEST_M), 'metavar': ('M', 'RAD')}
    add(parser, '--start-sigma', **sigmas, nargs=2, default=(0.05, 0.035), help=text)
    text = 'also estimate each pose from all images of the drive, later ones too'
    add(parser, '--smooth', action='store_true', help=text)
    add(parser, '--json', help='write errors, availability and times to F')
    text = 'write truth.tum, fused.tum, triangulation.tum, odometry.tum and, with --smooth, '
    text += 'smoothed.tum to DIR, for evo and the like'
    add(parser, '--tum', metavar='DIR', type=Path, help=text)
    add(parser, '--report', help='write a page that plays the drive to F.html')
    add(parser, '--video', metavar='F.mp4', type=Path, help='write the drive as a video to F.mp4')
    text = 'folder for trajectory.png and errors.png (default: they are not drawn)'
    add(parser, '--out', help=text)


def run(args: argparse.Namespace) -> int:
    """Replay, evaluate and draw; write only if no error occurs."""
    check_report(args.report)
    if args.video and args.video.suffix.lower() != '.mp4':
        raise UsageError(f'--video {args.video}: videos are written as .mp4')
    figures_in = [args.out / name for name in _FIGURES] if args.out else []
    tum = args.tum and args.tum / 'fused.tum'
    check_writable(*figures_in, args.json, args.report, args.video, tum)
    landmarks = load_map(args.map)
    calibration = landmarks.calibration_from(load_calibration(args.robot))
    mount = calibration.mount
    start, covariance = _start(args, landmarks)
    if not landmarks.landmarks:
        raise LandmarkNavError(f'{args.map}: the map holds no landmark: learn it again')
    bag = open_bag(args.bag, args)
    topics = {bag.find(name) for name in _EVENTS} - {None}
    total = sum(bag.counts[topic] for topic in topics if topic)
    nodes = ('triplet_selector', 'triangulation_localizer', 'odometry_fusion')
    config = load_configuration(args.config, args.robot, *nodes)

    _LOG.info('%s: %d landmarks', args.map, len(landmarks.landmarks))
    _LOG.info('checks')
    # Walls that were found, not measured, carry no information about units.
    measured = landmarks.walls and not landmarks.has_own_frame
    diagnosis = checked(bag, calibration, Room(landmarks.walls) if measured else None)
    late = diagnosis.delays
    # A measured delay has a sigma.
    delayed = calibration.with_values(joint_delay=calibration['joint_delay'][0] + late.joints_s)
    calibration = delayed.widened({'joint_delay': late.pan_sigma_s})
    events = sensor_events(bag, mount, 0.0, late.images_s, late.odometry_s)
    events = progress(events, 'localizing', total)
    _LOG.info('localization')
    strip = FrameStrip()
    if args.report or args.video:
        events = strip.watch(events)
    try:
        done = replay(events, landmarks, calibration, config, start, covariance)
    except UnknownPlaceError as error:
        raise LandmarkNavError(f'{error} Else give --start') from error
    if not len(done.truth):
        bag.warn(f'{bag.path}: no ground_truth/odom: the errors stay empty')
    for contradiction in done.map_contradictions:
        bag.warn(f'{bag.path}: {contradiction}')
    done, in_frame = run_report.against_truth(done, landmarks)
    if not in_frame:
        check_truth_frame(bag, landmarks.frame_id)
        if other := run_report.other_frame(done):
            text = 'ground_truth/odom is in another frame or unit than the map'
            bag.warn(f'{bag.path}: {text}: {other}')
    if len(done.truth) and np.isnan(done.errors.fused).all():
        begin_s, end_s = (1e-9 * done.truth.stamps_ns[k] for k in (0, -1))
        bag.warn(
            f'{bag.path}: ground_truth/odom is from {begin_s:.1f} to {end_s:.1f} s, the drive '
            f'from {1e-9 * done.begin_ns:.1f} s on: the errors stay empty'
        )
    learned = replace(config, odometry=done.odometry_noise)
    report = run_report.run_report(done, landmarks, calibration, learned) | in_frame
    report['checks'] = [finding.report() for finding in diagnosis.findings]
    smoothed = None
    if args.smooth:
        smoothed = run_report.smooth_run(done, landmarks, calibration, learned)
    if smoothed is not None:
        report['smoothed'] = run_report.smoothed_report(done, smoothed)
        if apart := run_report.departures(done, smoothed):
            bag.warn(
                f'{bag.path}: the smoothed line is off that of the filter by {apart}: it does not '
                'check odometry, joint_states and camera where they seem to be wrong'
            )
    if args.out:
        # Matplotlib takes a third of a second to import.
        from landmark_nav.evaluation.figures import draw_errors, draw_trajectory

        trajectory, drawn_errors = figures_in
        draw_trajectory(done, landmarks, trajectory, smoothed)
        draw_errors(done, drawn_errors)
    if args.report or args.video:
        known = done.calibration or calibration
        page = drive_page(report, done, landmarks, known, strip, smoothed)
        if args.report:
            title = f'{bag.path.name} on {Path(args.map).name}'
            inputs = {k: getattr(args, k) for k in ('bag', 'map', 'robot', 'config')}
            write_report(args.report, page, title, args.command_line, inputs)
        if args.video:
            write_video(args.video, page)
    if args.tum:
        run_report.write_tum_files(done, args.tum, smoothed)
    write_json(args.json, report)
    tables = drive_tables({**report, 'checks': ()})  # which were logged
    print(wrapped(text_of(drive_verdict(report), tables)))
    if drawn := [*figures_in, *filter(None, (args.report, args.video))]:
        print(f'drawn: {", ".join(map(str, drawn))}')
    return 0


def _start(args: argparse.Namespace, landmarks: LandmarkMap) -> tuple[Any, Any]:
    """Given initial pose (3,) and its covariance (3, 3); None if not given."""
    if args.start is None:
        return None, None
    start, (position, heading) = np.array(args.start), args.start_sigma
    if abs(start[2]) > 2.0 * np.pi:
        raise UsageError(f'--start: THETA is {start[2]:g}, over a full turn: give it in radians')
    room = Room(landmarks.walls) if landmarks.walls else None
    if room is not None and not room.contains(start[:2]):
        beyond = float(room.wall_distances(start[:2]).min())
        if beyond > 3.0 * position:
            own = ' (base_link at the first sweep)' if landmarks.has_own_frame else ''
            raise UsageError(
                f'--start {start[0]:g} {start[1]:g} lies {beyond:.2f} m outside the room of '
                f'{args.map}: give x and y in {landmarks.frame_id}{own}, in metres'
            )
    return start, np.diag([position**2, position**2, heading**2])
