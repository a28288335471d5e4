"""
Counterparts of the figures of Livatino and Madsen from own data.

``python docs/paper_figures/draw.py --out figures``, which the documentation shows.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
import sys

from area_figure import (
    AreaTest,
    draw_observation_areas,
    typical_landmarks,
)
from attention_figures import draw_attention, draw_features_alone
from figures_world import FiguresWorld
from learned_figure import draw_learned, true_places
import numpy as np
from stereo_figure import draw_reconstruction
from sweep_figure import draw_sweeps

from landmark_nav.cli.bags import add_topic_argument, open_bag
from landmark_nav.cli.learn import located_sweeps
from landmark_nav.cli.lines import progress, wrapped
from landmark_nav.cli.numbers import within
from landmark_nav.configuration import Configuration
from landmark_nav.errors import LandmarkNavError, UsageError
from landmark_nav.evaluation.true_places import truth_of_bag
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.attention import AttentionConfig, FEATURES
from landmark_nav.learning.pipeline import learn_from_panoramas, LearningConfig, LearningResult
from landmark_nav.learning.stages import StageLog
from landmark_nav.learning.sweep_pipeline import panorama_from_sweep, PanoramaStages
from landmark_nav.learning.unmeasured import learn_located
from landmark_nav.simulation.world import DEFAULT_MOUNT
from landmark_nav.storage.atomic_io import check_writable
from landmark_nav.storage.bags import Bag, read_sweeps
from landmark_nav.storage.setup_files import load_robot, load_room
from landmark_nav.types import FloatArray, Panorama, Sweep

__all__ = ['add_arguments', 'run']

_NAMES = {
    3: 'figure_3_panoramas.png',
    4: 'figure_4_attention.png',
    5: 'figure_5_stereo.png',
    6: 'figure_6_observation_areas.png',
    7: 'figure_7_features_alone.png',
    8: 'figure_8_all_features.png',
}
# Figures that need landmarks, and figures of one panorama.
_LEARNED = {5, 6, 8}
_OF_ONE = {4, 7}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the command takes."""
    parser.description = (
        'Draw the counterparts of Figures 3 to 8 of Livatino and Madsen: panoramas, '
        'attention step by step, stereo, observation areas, each feature alone, all together. '
        'Without --bag, two sweeps are simulated in a furnished room.'
    )
    parser.add_argument('--out', required=True, type=Path, metavar='DIR', help='folder to write')
    parser.add_argument('--bag', metavar='BAG', help='bag of sweeps of your own; needs --robot')
    add_topic_argument(parser)
    parser.add_argument(
        '--room', metavar='F', help='room.yaml: walls and papers (default: as learn finds them)'
    )
    parser.add_argument('--robot', metavar='F', help='robot.yaml: how the camera is mounted')
    parser.add_argument(
        '--seed',
        type=within(int, 0, 2**63 - 1),
        default=7,
        metavar='N',
        help='of the simulated room (default 7)',
    )
    parser.add_argument(
        '--figure', type=int, nargs='+', choices=sorted(_NAMES), metavar='N',
        help='which figures, 3 to 8 (default: all that the data allow)',
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Data:
    """What there is to draw; `truth` is that of the landmarks."""

    room: Room
    sweeps: tuple[Sweep, ...]
    panoramas: tuple[Panorama, ...]
    learned: LearningResult | None
    truth: FloatArray | None = None
    tests: tuple[AreaTest, ...] = ()


def run(args: argparse.Namespace) -> int:
    """Gather the data, draw, print the captions."""
    wanted = set(args.figure or _NAMES)
    check_writable(*(args.out / _NAMES[number] for number in wanted))
    data = _gather(args, wanted)
    for number in progress(sorted(wanted), 'figures'):
        path = args.out / _NAMES[number]
        print(wrapped([str(path), f'  {_draw(number, data, path)}']))
    return 0


def _gather(args: argparse.Namespace, wanted: set[int]) -> _Data:
    if args.bag and not args.robot:
        raise UsageError('--bag needs --robot, as learn does')
    mount = load_robot(args.robot) if args.robot else DEFAULT_MOUNT
    room = load_room(args.room) if args.room else None
    if args.bag:
        return _recorded(open_bag(args.bag, args), room, mount, wanted)
    return _simulated(FiguresWorld.furnish(args.seed, mount, room), wanted)


def _recorded(
    bag: Bag,
    room: Room | None,
    mount: PanTiltMount,
    wanted: set[int],
) -> _Data:
    found = read_sweeps(bag, mount)
    sweeps = tuple(progress(found if wanted - _OF_ONE else islice(found, 1), 'sweeps'))
    truth = truth_of_bag(bag)
    if room is not None:
        data = _learned(sweeps, room, mount, wanted)
    else:
        data = _unmeasured(bag, sweeps, mount, wanted)
        if not bag.find('sweep/pose'):
            truth = truth.seen_from(truth.at([sweeps[0].stamp_ns])[0])
    poses = truth.at([sweep.stamp_ns for sweep in sweeps])
    if data.learned is not None and np.all(np.isfinite(poses)):
        data = replace(data, truth=true_places(data.learned, poses, mount))
    return data


def _simulated(world: FiguresWorld, wanted: set[int]) -> _Data:
    room = world.scene.room
    count = len(world.poses) if wanted - _OF_ONE else 1
    sweeps = tuple(world.sweep(k) for k in progress(range(count), 'sweeps'))
    data = _learned(sweeps, room, world.mount, wanted)
    learned = data.learned
    if learned is None:
        return data
    data = replace(data, truth=true_places(learned, world.poses, world.mount))
    if 6 in wanted:
        chosen = typical_landmarks(learned.map)
        tests = [world.look_for(k, world.scene.seed) for k in progress(chosen, 'areas')]
        data = replace(data, tests=tuple(tests))
    return data


def _learned(
    sweeps: tuple[Sweep, ...],
    room: Room,
    mount: PanTiltMount,
    wanted: set[int],
) -> _Data:
    """Panoramas, and landmarks if a figure needs them."""
    if not sweeps:
        raise LandmarkNavError('the bag has no sweep: record one with capture_sweep')
    stages = PanoramaStages()
    panoramas = tuple(
        panorama_from_sweep(sweep, room, mount, stages) for sweep in progress(sweeps, 'panoramas')
    )
    learned = None
    if wanted & _LEARNED:
        learned = learn_from_panoramas(panoramas, room, LearningConfig())
    return _Data(room, sweeps, panoramas, learned)


def _unmeasured(
    bag: Bag,
    sweeps: tuple[Sweep, ...],
    mount: PanTiltMount,
    wanted: set[int],
) -> _Data:
    """As `_learned`, where walls and poses are found."""
    config = Configuration()
    located, _ = located_sweeps(bag, mount, config, StageLog())
    learned = None
    if wanted & _LEARNED:
        learned = learn_located(located, config, config.unmeasured)
    return _Data(located.room, sweeps, located.panoramas, learned)


def _draw(number: int, data: _Data, path: Path) -> str:
    """Draw a figure; its caption."""
    attention = AttentionConfig()
    if number == 3:
        return draw_sweeps(data.sweeps, data.panoramas, data.room, path)
    if number == 4:
        return draw_attention(data.panoramas[0], attention, path)
    if number == 7:
        return draw_features_alone(data.panoramas[0], attention, path, FEATURES)
    assert data.learned is not None, 'these figures are among _LEARNED'
    if number == 6:
        return draw_observation_areas(data.learned.map, data.room, path, data.tests)
    if number == 5:
        return draw_reconstruction(data.learned, data.room, path)
    return draw_learned(data.learned, data.room, path, data.truth)


def main(argv: list[str] | None = None) -> int:
    """Draw; 1 if the data does not allow it, 2 for wrong usage."""
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    try:
        return run(parser.parse_args(argv))
    except LandmarkNavError as error:
        print(error, file=sys.stderr)
        return 2 if isinstance(error, UsageError) else 1


if __name__ == '__main__':
    sys.exit(main())
