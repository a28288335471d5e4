"""`landmark-nav learn`: a map out of a bag of sweeps."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from itertools import islice
import json
import logging
from pathlib import Path
import time
from typing import Any

from landmark_nav.cli.bags import add_topic_argument, open_bag
from landmark_nav.cli.check import refuse_errors
from landmark_nav.cli.lines import wrapped
from landmark_nav.cli.options import add_overwrite
from landmark_nav.cli.progress import progress
from landmark_nav.diagnosis import diagnose, QUICK
from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.figures import draw_map, draw_panorama
from landmark_nav.evaluation.learning_report import learning_report
from landmark_nav.evaluation.true_places import check_truth_frame, truth_of_bag
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.pipeline import (
    learn_from_panoramas,
    LearningConfig,
    LearningResult,
    panorama_from_sweep,
    PanoramaStages,
)
from landmark_nav.learning.reference_area import PaperRecord
from landmark_nav.learning.stages import StageLog
from landmark_nav.learning.sweep_pipeline import record_papers
from landmark_nav.storage.atomic_io import atomic_folder, check_writable, write_atomically
from landmark_nav.storage.bags import Bag, read_sweeps
from landmark_nav.storage.config_files import load_config
from landmark_nav.storage.maps import MAP_FILES, write_map
from landmark_nav.storage.setup_files import load_robot, load_room
from landmark_nav.types import Panorama, Sweep

__all__ = ['add_arguments', 'run']

_LOG = logging.getLogger(__name__)

# Sweeps that are looked at beyond one that failed, to name the cause.
_MORE_SWEEPS = 2
# Stages of `learn_from_panoramas`, for the bar.
_LEARNING_STAGES = 4


@dataclass(frozen=True)
class _Stages(PanoramaStages, LearningConfig):
    """Parameters of all stages, from sweeps to map: the sections of ``--config``."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the command takes."""
    parser.description = (
        'Make panoramas of the sweeps in a bag, find where they were taken, and learn '
        'the landmarks that two of them or more agree on. The map folder also gets '
        'panorama_K.png with candidates and elected landmarks, and map.png.'
    )
    parser.add_argument('bag', metavar='BAG', help='bag with sweeps')
    add_topic_argument(parser)
    parser.add_argument('--room', required=True, metavar='F', help='room.yaml: walls and papers')
    parser.add_argument(
        '--robot', required=True, metavar='F', help='robot.yaml: how the camera is mounted'
    )
    parser.add_argument(
        '--out', required=True, metavar='MAP', type=Path, help='map folder to write'
    )
    add_overwrite(parser)
    parser.add_argument(
        '--config',
        metavar='F',
        help='parameters that differ from the defaults: YAML with the sections panorama, '
        'calibration, reference_area, attention, stereo, adjustment, wall_fit and election',
    )
    parser.add_argument(
        '--json', metavar='F', type=Path, help='write counts, errors and times to F'
    )


def run(args: argparse.Namespace) -> int:
    """Learn, draw, write; nothing is written unless all went well."""
    begin = time.perf_counter()
    check_writable(args.json)
    room, mount = load_room(args.room), load_robot(args.robot)
    config = load_config(args.config, _Stages()) if args.config else _Stages()
    bag = open_bag(args.bag, args)
    log = StageLog()
    with log.measure('checks'):
        refuse_errors(bag, diagnose(bag, mount, room, QUICK))
    with atomic_folder(args.out, MAP_FILES, args.overwrite) as folder:
        panoramas, frames = _panoramas(bag, room, mount, config, log)
        shown = _ShownStages(progress(range(_LEARNING_STAGES), 'learning'), log)
        result = learn_from_panoramas(panoramas, room, config, shown)
        result.map.provenance.update(_provenance(args))
        with shown.measure('drawing'):  # one more than the bar has: it is gone by then
            _draw(result, room, folder)
        write_map(result.map, folder)
    check_truth_frame(bag, room.frame_id)
    truth = truth_of_bag(bag)
    seconds = time.perf_counter() - begin
    report = learning_report(result, panoramas, frames, truth, mount, log, seconds)
    if args.json:
        write_atomically(args.json, json.dumps(report, indent=2) + '\n')
    print(_summary(report, result.panoramas, args.out))
    return 0


class _ShownStages(StageLog):
    """A log of stages that also moves a bar on."""

    def __init__(self, steps: Iterator[int], log: StageLog) -> None:
        super().__init__(log.seconds, log.peak_memory_mb)
        self._steps = steps

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Add the time of the block to a stage; its start moves the bar."""
        next(self._steps, None)
        with super().measure(stage):
            yield


def _panoramas(
    bag: Bag, room: Room, mount: PanTiltMount, config: PanoramaStages, log: StageLog
) -> tuple[list[Panorama], list[int]]:
    """Make the panoramas of a bag, and count the frames of each."""
    trajectory = bag.find('sweep/trajectory')
    total = bag.counts[trajectory] if trajectory else None
    panoramas: list[Panorama] = []
    frames: list[int] = []
    papers = PaperRecord(room, config.reference_area)
    sweeps = progress(read_sweeps(bag, mount), 'panoramas', total)
    while True:
        with log.measure('reading'):
            sweep = next(sweeps, None)
        if sweep is None:
            break
        try:
            panoramas.append(panorama_from_sweep(sweep, room, mount, config, log, papers))
        except LandmarkNavError as error:
            cause = _cause(papers, sweeps, mount)
            which = f'sweep {len(frames) + 1} (of {sweep.stamp_ns * 1e-9:.1f} s)'
            raise LandmarkNavError(
                f'{bag.path}: {cause}' if cause else f'{bag.path}: {which}: {error}'
            ) from error
        frames.append(len(sweep.frames))
    if warning := papers.faults().text:
        _LOG.warning('%s', warning)
    return panoramas, frames


def _cause(papers: PaperRecord, sweeps: Iterator[Sweep], mount: PanTiltMount) -> str:
    """What is wrong with papers that did not fit in one sweep, by those that follow as well."""
    if not len(papers):
        return ''
    with suppress(LandmarkNavError):
        for sweep in islice(sweeps, _MORE_SWEEPS):
            record_papers(sweep, mount, papers)
    return papers.faults().cause


def _draw(result: LearningResult, room: Room, folder: Path) -> None:
    draw_map(result.map, folder / 'map.png', room.papers)
    for k, panorama in enumerate(result.panoramas):
        path = folder / f'panorama_{k + 1}.png'
        draw_panorama(panorama, result.candidates[k], result.outcomes[k], k + 1, path)


def _provenance(args: argparse.Namespace) -> dict[str, str]:
    try:
        release = version('landmark_nav')
    except PackageNotFoundError:
        release = 'not installed'
    return {
        'learned_from': Path(args.bag).name,
        'room': Path(args.room).name,
        'robot': Path(args.robot).name,
        'landmark_nav': release,
    }


def _summary(report: dict[str, Any], panoramas: Sequence[Panorama], folder: Path) -> str:
    """Summarize what was learned, for a person."""
    lines = []
    for number, (sweep, panorama) in enumerate(zip(report['sweeps'], panoramas, strict=True), 1):
        x, y, heading = sweep['pose']
        lines.append(
            f'sweep {number}: {sweep["frames"]} frames at ({x:.3f}, {y:.3f}) m, '
            f'{57.29578 * heading:.2f} deg; {sweep["candidates"]} candidates, '
            f'{sweep["elected"]} elected'
        )
        if 'error' in sweep:
            before = sweep['measured']
            lines.append(
                f'  error {1e3 * sweep["error_position_m"]:.1f} mm, '
                f'{sweep["error_heading_deg"]:.3f} deg; '
                f'before the refinement {1e3 * before["error_position_m"]:.1f} mm, '
                f'{before["error_heading_deg"]:.3f} deg'
            )
        lines.append(f'  panorama: {panorama.quality}')
    terms = [t for p in panoramas if p.quality is not None for t in p.quality.calibration]
    if any(t.used for t in terms if t.name.startswith('axis')):
        lines.append(
            'the pan axis tilts about x (roll) and y (pitch) of the base, see above: set pan_axis '
            'rpy in robot.yaml, which navigation goes by'
        )
    walls = ', '.join(f'{wall} {count}' for wall, count in report['landmarks_per_wall'].items())
    lines.append(
        f'{report["elected"]} landmarks of {report["candidates"]} candidates '
        f'({report["reconstructed"]} reconstructed): {walls}'
    )
    lines.extend(f'  {count:4d} refused: {why}' for why, count in report['refused'].items())
    lines.extend(f'  {n:4d} not proposed: {why}' for why, n in report['ambiguous'].items())
    stages = ', '.join(
        f'{name.replace("_", " ")} {s["seconds"]:.1f}' for name, s in report['stages'].items()
    )
    peak = max(stage['peak_memory_mb'] for stage in report['stages'].values())
    lines.append(f'{report["seconds"]:.1f} s ({stages}), peak memory {peak:.0f} MB')
    lines.append(f'map, map.png and panorama_K.png in {folder}')
    return wrapped(lines)
