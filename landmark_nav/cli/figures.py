"""`landmark-nav figures`: counterparts of the figures of Livatino and Madsen from own data."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from landmark_nav.cli.figures_world import FiguresWorld
from landmark_nav.cli.learn import located_sweeps
from landmark_nav.cli.lines import progress, wrapped
from landmark_nav.cli.options import add_number, add_topic_argument, open_bag, within
from landmark_nav.configuration import Configuration
from landmark_nav.errors import LandmarkNavError, UsageError
from landmark_nav.evaluation.figures.area_figure import (
    AreaTest,
    draw_observation_areas,
    typical_landmarks,
)
from landmark_nav.evaluation.figures.attention_figures import draw_attention, draw_features_alone
from landmark_nav.evaluation.figures.learned_figure import draw_learned
from landmark_nav.evaluation.figures.stereo_figure import draw_reconstruction
from landmark_nav.evaluation.figures.sweep_figure import draw_sweeps
from landmark_nav.evaluation.learning_report import true_places, truth_of_bag
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
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.setup_files import load_robot, load_room
from landmark_nav.types import FloatArray, LandmarkMap, Panorama, Sweep

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
        '--map', metavar='MAP', help='a map of your own for Figure 6, which needs nothing else'
    )
    add_number(parser, '--seed', within(int, 0, 2**63 - 1), 7, 'N', 'of the simulated room')
    parser.add_argument(
        '--figure', type=int, nargs='+', choices=sorted(_NAMES), metavar='N',
        help='which figures, 3 to 8 (default: all that the data allow)',
    )  # fmt: skip
    parser.add_argument(
        '--feature', nargs='+', choices=FEATURES, metavar='NAME',
        help=f'the only features that attract attention (default: all): {", ".join(FEATURES)}',
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Data:
    """What there is to draw; `truth` is that of the landmarks."""

    room: Room
    sweeps: tuple[Sweep, ...]
    panoramas: tuple[Panorama, ...]
    learned: LearningResult | None
    landmarks: LandmarkMap | None
    truth: FloatArray | None = None
    tests: tuple[AreaTest, ...] = ()


def run(args: argparse.Namespace) -> int:
    """Gather the data, draw, print the captions."""
    attention = _attention(args.feature)
    wanted = set(args.figure or ([6] if args.map and not args.bag else _NAMES))
    check_writable(*(args.out / _NAMES[number] for number in wanted))
    data = _gather(args, wanted, attention)
    for number in progress(sorted(wanted), 'figures'):
        path = args.out / _NAMES[number]
        print(wrapped([str(path), f'  {_draw(number, data, attention, path, args.feature)}']))
    return 0


def _attention(features: list[str] | None) -> AttentionConfig:
    """Weights as they are by default, but 0 for what is not among `features`."""
    default = AttentionConfig()
    if not features:
        return default
    if len(features) == 1:
        return default.alone(features[0])
    weights: dict[str, Any] = {
        f'weight_{name}': (default.weights[name] or 0.1) if name in features else 0.0
        for name in FEATURES
    }
    return replace(default, **weights)


def _gather(args: argparse.Namespace, wanted: set[int], attention: AttentionConfig) -> _Data:
    if args.bag and not args.robot:
        raise UsageError('--bag needs --robot, as learn does')
    given = load_map(args.map) if args.map else None
    if given is not None and not args.bag:
        if wanted != {6}:
            raise UsageError('--map alone gives Figure 6: the others need --bag')
        return _Data(Room(given.walls), (), (), None, given)
    mount = load_robot(args.robot) if args.robot else DEFAULT_MOUNT
    room = load_room(args.room) if args.room else None
    if args.bag:
        return _recorded(open_bag(args.bag, args), room, mount, wanted, attention, given)
    return _simulated(FiguresWorld.furnish(args.seed, mount, room), wanted, attention)


def _recorded(
    bag: Bag,
    room: Room | None,
    mount: PanTiltMount,
    wanted: set[int],
    attention: AttentionConfig,
    given: LandmarkMap | None,
) -> _Data:
    found = read_sweeps(bag, mount)
    sweeps = tuple(progress(found if wanted - _OF_ONE else islice(found, 1), 'sweeps'))
    truth = truth_of_bag(bag)
    if room is not None:
        data = _learned(sweeps, room, mount, wanted, attention)
    else:
        data = _unmeasured(bag, sweeps, mount, wanted, attention)
        if not bag.find('sweep/pose'):
            truth = truth.seen_from(truth.at([sweeps[0].stamp_ns])[0])
    poses = truth.at([sweep.stamp_ns for sweep in sweeps])
    if data.learned is not None and np.all(np.isfinite(poses)):
        data = replace(data, truth=true_places(data.learned, poses, mount))
    return data if given is None else replace(data, landmarks=given)


def _simulated(world: FiguresWorld, wanted: set[int], attention: AttentionConfig) -> _Data:
    room = world.scene.room
    count = len(world.poses) if wanted - _OF_ONE else 1
    sweeps = tuple(world.sweep(k) for k in progress(range(count), 'sweeps'))
    data = _learned(sweeps, room, world.mount, wanted, attention)
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
    attention: AttentionConfig,
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
        config = replace(LearningConfig(), attention=attention)
        learned = learn_from_panoramas(panoramas, room, config)
    return _Data(room, sweeps, panoramas, learned, learned.map if learned else None)


def _unmeasured(
    bag: Bag,
    sweeps: tuple[Sweep, ...],
    mount: PanTiltMount,
    wanted: set[int],
    attention: AttentionConfig,
) -> _Data:
    """As `_learned`, where walls and poses are found."""
    config = replace(Configuration(), attention=attention)
    located, _ = located_sweeps(bag, mount, config, StageLog())
    learned = None
    if wanted & _LEARNED:
        learned = learn_located(located, config, config.unmeasured)
    landmarks = learned.map if learned else None
    return _Data(located.room, sweeps, located.panoramas, learned, landmarks)


def _draw(
    number: int,
    data: _Data,
    attention: AttentionConfig,
    path: Path,
    features: list[str] | None,
) -> str:
    """Draw a figure; its caption."""
    if number == 3:
        return draw_sweeps(data.sweeps, data.panoramas, data.room, path)
    if number == 4:
        return draw_attention(data.panoramas[0], attention, path)
    if number == 7:
        return draw_features_alone(data.panoramas[0], attention, path, features or FEATURES)
    if number == 6:
        assert data.landmarks is not None, 'learned or given'
        return draw_observation_areas(data.landmarks, data.room, path, data.tests)
    assert data.learned is not None, 'these figures are among _LEARNED'
    if number == 5:
        return draw_reconstruction(data.learned, data.room, path)
    return draw_learned(data.learned, data.room, path, data.truth)
