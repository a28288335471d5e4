"""`landmark-nav learn`: learn a map from a bag of sweeps."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from itertools import count, islice
import logging
from pathlib import Path
import time

from landmark_nav.calibration import Calibration
from landmark_nav.cli.check import checked
from landmark_nav.cli.options import add, open_bag, progress, text_of, wrapped
from landmark_nav.configuration import Configuration, load_configuration
from landmark_nav.errors import inside, LandmarkNavError, release, UsageError
from landmark_nav.evaluation import learning_report
from landmark_nav.evaluation.figures import draw_map, draw_panorama
from landmark_nav.evaluation.report import check_report, learning_page, write_report
from landmark_nav.evaluation.report.tables import learning_tables, learning_verdict
from landmark_nav.geometry.walls import Room
from landmark_nav.learning import unmeasured
from landmark_nav.learning.pipeline import learn_from_panoramas, LearningResult
from landmark_nav.learning.reference_area.faults import PaperRecord
from landmark_nav.learning.stages import StageLog
from landmark_nav.learning.sweep_pipeline import (
    next_prior,
    panorama_from_sweep,
    record_papers,
)
from landmark_nav.localization.sweep_places import known_places
from landmark_nav.messages import decode
from landmark_nav.storage import atomic_io
from landmark_nav.storage.bags import Bag, read_sweeps
from landmark_nav.storage.bags.reader import decoded
from landmark_nav.storage.maps import MAP_FILES, write_map
from landmark_nav.storage.robot_files import load_calibration
from landmark_nav.storage.setup_files import load_room, room_text
from landmark_nav.types import Panorama, PlaceChain, Sweep

_LOG = logging.getLogger(__name__)

# Number of sweeps after a failed one that are examined to find the cause.
_MORE_SWEEPS = 2
# Number of stages of `learn_from_panoramas`, for the progress bar.
_LEARNING_STAGES = 4


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.description = (
        'Make panoramas of the sweeps in a bag, find where they were taken, and learn '
        'the landmarks that two of them or more agree on. The map folder also gets '
        'panorama_K.png with candidates and elected landmarks, and map.png.'
    )
    add(parser, 'bag', help='bag with sweeps')
    add(parser, '--topic', '--overwrite', '--config')
    add(parser, '--robot', required=True)
    text = (
        'room.yaml: walls, and papers or markers; with walls alone its frame is that of the first '
        'sweep, as in the file of --walls-out (default: walls are found, the scale is that of '
        'sweep/pose, odom, papers and markers, the frame that of the first sweep)'
    )
    add(parser, '--room', help=text)
    text = 'write the walls as room.yaml, to be corrected and given as --room'
    add(parser, '--walls-out', metavar='F', type=Path, help=text)
    add(parser, '--out', required=True, metavar='MAP', help='map folder to write')
    text = 'coloured papers of this size hang upright somewhere: they give the scale (without '
    text += 'papers in --room; width and height in metres, A4: 0.210 0.297)'
    add(parser, '--paper-size', nargs=2, type=float, metavar=('W', 'H'), help=text)
    text = 'ArUco or AprilTag markers of this side (black square, m) give the scale'
    add(parser, '--marker-size', type=float, metavar='M', help=text)
    text = 'dictionary of the markers (default: DICT_4X4_50)'
    add(parser, '--marker-dictionary', metavar='NAME', help=text)
    add(parser, '--json', help='write counts, errors and times to F')
    text = 'write a page with the map, the panoramas and all candidates to F.html'
    add(parser, '--report', help=text)


def run(args: argparse.Namespace) -> int:
    """Learn and draw; write only if no error occurs."""
    begin = time.perf_counter()
    check_report(args.report)
    atomic_io.check_writable(args.json, args.walls_out, args.report)
    room = load_room(args.room) if args.room else None
    given = load_calibration(args.robot)
    bag = open_bag(args.bag, args)
    placed = room is not None and is_placed(bag, room)
    config = _config(args, placed)
    log = StageLog()
    with log.measure('checks'):
        checked(bag, given, room)
    with atomic_io.atomic_folder(args.out, MAP_FILES, args.overwrite) as folder:
        located, found = None, {}
        if room is not None and placed:
            panoramas, frames = panoramas_of_bag(bag, room, given, log)
        else:
            check_scale(bag, config, args.room)
            located, frames = located_sweeps(bag, given, config, log)
            if room is not None:
                located = unmeasured.with_plan(located, room)
            panoramas, room, found = list(located.panoramas), located.room, located.provenance
        shown = replace(log, steps=progress(range(_LEARNING_STAGES), 'learning'))
        if located is None:
            result = learn_from_panoramas(panoramas, room, config, shown)
        else:
            result = unmeasured.learn_located(located, config, shown)
        # Walls with a sigma were moved to their patches.
        room = replace(room, walls=result.map.walls)
        learned = result.map.calibration or given
        if off := learned.surprises(given):
            _LOG.warning('%s: the sweeps show, and use, %s more than it gives', args.robot, off)
        result = replace(result, map=replace(result.map, prior=given))
        result.map.provenance.update(
            learned_from=Path(args.bag).name,
            room=Path(args.room).name if args.room else 'none: walls found',
            robot=Path(args.robot).name,
            landmark_nav=release(),
            **found,
        )
        with shown.measure('drawing'):  # beyond the stages of the bar, which has ended
            _draw(result, room, folder)
        write_map(result.map, folder)
    truth = learning_report.truth_of_bag(bag)
    if result.map.has_own_frame:
        truth = truth.seen_from(truth.at([panoramas[0].stamp_ns])[0])
    else:
        learning_report.check_truth_frame(bag, room.frame_id)
    seconds = time.perf_counter() - begin
    known = replace(given, covariance=learned.covariance)
    report = learning_report.learning_report(result, panoramas, frames, truth, known, log, seconds)
    if located is not None:
        scales = {share.name: asdict(share) for share in located.poses.scales}
        sigma = located.poses.scale_sigma
        report['unmeasured'] = {**found, 'scale_sigma': sigma, 'sources': scales}
    if args.walls_out:
        atomic_io.write_atomically(args.walls_out, room_text(room))
    atomic_io.write_json(args.json, report)
    if args.report:
        inputs = {'bag': bag.path, 'room': args.room, 'robot': args.robot, 'config': args.config}
        title = f'{args.out.name}, learned from {bag.path.name}'
        page = learning_page(report, result, room.anchors)
        write_report(args.report, page, title, args.command_line, inputs)
    lines = text_of(learning_verdict(report, result.warning), learning_tables(report))
    lines += [f'panorama {k}: {p.quality}' for k, p in enumerate(result.panoramas, 1)]
    print(wrapped([*lines, f'{seconds:.1f} s; map, map.png and panorama_K.png in {args.out}']))
    if args.report:
        print(f'drawn: {args.report}')
    return 0


def _draw(result: LearningResult, room: Room, folder: Path) -> None:
    draw_map(result.map, folder / 'map.png', room.anchors)
    of_panoramas = zip(result.panoramas, result.candidates, result.outcomes, strict=True)
    for k, drawn in enumerate(of_panoramas, 1):
        draw_panorama(*drawn, folder / f'panorama_{k}.png')


def is_placed(bag: Bag, room: Room) -> bool:
    """Whether bag and room give the poses of sweeps, which walls alone do not."""
    return bool(room.anchors or bag.find('sweep/pose'))


def check_scale(bag: Bag, config: Configuration, walls_file: str | None = None) -> None:
    """Raise `LandmarkNavError` if nothing gives the scale of sweeps without a plan but walls."""
    sheets = config.unmeasured.sheets
    if not (bag.find('odom', 'sweep/pose') or sheets.has_papers or sheets.has_markers):
        if walls_file:
            raise LandmarkNavError(
                f'{walls_file}: has no papers and nothing else gives the scale: give --paper-size '
                'or --marker-size, or record odom'
            )
        raise LandmarkNavError(
            f'{bag.path}: nothing gives the scale: record odom, publish sweep/pose, hang sheets '
            '(--paper-size, --marker-size of learn), or measure walls and papers (--room)'
        )


def located_sweeps(
    bag: Bag, given: Calibration, config: Configuration, log: StageLog
) -> tuple[unmeasured.Located, list[int]]:
    """
    Panoramas of a bag with their poses and walls, and the number of frames of each.

    Raises `LandmarkNavError`: nothing gives the scale, a source of poses does not give that of
    each sweep, or the robot moved during a sweep.
    """
    check_scale(bag, config)
    odometry = bag.find('odom')
    frames: list[int] = []

    def sweeps() -> Iterator[Sweep]:
        frames.clear()
        for sweep in read_sweeps(bag, given.mount):
            frames.append(len(sweep.frames))
            yield sweep

    def known(stamped: Sequence[Sweep]) -> list[PlaceChain]:
        spans = [(sweep.frames[0].stamp_ns, sweep.frames[-1].stamp_ns) for sweep in stamped]
        poses = [sweep.pose_map_base for sweep in stamped]
        samples = []
        if odometry:
            samples = decoded(bag, odometry, lambda entry: decode.odometry(entry.message))
            samples.sort(key=lambda sample: sample.stamp_ns)
        with inside(bag.path):
            return known_places(poses, spans, samples, config.odometry)

    trajectory = bag.find('sweep/trajectory')
    # Calibration and panorama of each sweep, poses and facades; again once they are levelled.
    stages = 2 * (2 * bag.counts[trajectory] + 2) if trajectory else None
    shown = replace(log, steps=progress(count(), 'locating', stages))
    return unmeasured.locate_sweeps(sweeps, known, given, config.unmeasured, shown), frames


def _config(args: argparse.Namespace, placed: bool) -> Configuration:
    """Parameters by the file, and the given sizes of sheets, if sweeps are not yet `placed`."""
    nodes = ('panorama_synthesizer', 'landmark_learner')
    config = load_configuration(args.config, args.robot, *nodes)
    width, height = args.paper_size or (None, None)
    given = {
        'paper_width_m': width,
        'paper_height_m': height,
        'marker_size_m': args.marker_size,
        'marker_dictionary': args.marker_dictionary,
    }
    sizes = {name: value for name, value in given.items() if value is not None}
    if sizes and placed:
        raise UsageError(
            '--paper-size and --marker-size are for sweeps that neither --room (papers, markers) '
            'nor sweep/pose place: leave them out'
        )
    try:
        sheets = replace(config.unmeasured.sheets, **sizes)
    except LandmarkNavError as error:
        raise UsageError(str(error)) from error
    return replace(config, unmeasured=replace(config.unmeasured, sheets=sheets))


def panoramas_of_bag(
    bag: Bag, room: Room, given: Calibration, log: StageLog
) -> tuple[list[Panorama], list[int]]:
    """Make the panoramas of a bag, and return them with the number of frames of each."""
    trajectory = bag.find('sweep/trajectory')
    total = bag.counts[trajectory] if trajectory else None
    panoramas: list[Panorama] = []
    frames: list[int] = []
    papers = PaperRecord(room)
    sweeps, known = progress(read_sweeps(bag, given.mount), 'panoramas', total), given
    while True:
        with log.measure('reading'):
            sweep = next(sweeps, None)
        if sweep is None:
            break
        try:
            known = known.for_camera(sweep.frames[0].camera.intrinsics, given)
            panoramas.append(panorama_from_sweep(sweep, room, known, log, papers))
        except LandmarkNavError as error:
            cause = ''
            if len(papers):
                # Following sweeps may show which paper does not fit.
                with suppress(LandmarkNavError):
                    for later in islice(sweeps, _MORE_SWEEPS):
                        record_papers(later, known, papers)
                cause = papers.faults().cause
            which = f'sweep {len(frames) + 1} (of {sweep.stamp_ns * 1e-9:.1f} s)'
            raise LandmarkNavError(
                f'{bag.path}: {cause}' if cause else f'{bag.path}: {which}: {error}'
            ) from error
        known = next_prior(given, known, panoramas[-1])
        frames.append(len(sweep.frames))
    if warning := papers.faults().text:
        _LOG.warning('%s', warning)
    return panoramas, frames
