"""`landmark-nav figures`: draw counterparts of the figures of Livatino and Madsen."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from landmark_nav.calibration import Calibration
from landmark_nav.cli.learn import located_sweeps
from landmark_nav.cli.options import add, open_bag, progress, wrapped
from landmark_nav.configuration import Configuration
from landmark_nav.errors import LandmarkNavError, UsageError
from landmark_nav.evaluation.figures.map_figure import draw_learned, draw_observation_areas
from landmark_nav.evaluation.figures.panorama_figure import (
    draw_attention,
    draw_features_alone,
    draw_sweeps,
)
from landmark_nav.evaluation.figures.stereo_figure import draw_reconstruction
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.attention.maps import AttentionConfig, FEATURES
from landmark_nav.learning.pipeline import learn_from_panoramas
from landmark_nav.learning.stages import StageLog
from landmark_nav.learning.sweep_pipeline import panorama_from_sweep
from landmark_nav.learning.unmeasured import learn_located
from landmark_nav.simulation.furnishing import generate_scene
from landmark_nav.simulation.scene import sweep_places
from landmark_nav.simulation.world import DEFAULT_MOUNT, RobotWorld
from landmark_nav.storage.atomic_io import check_writable
from landmark_nav.storage.bags import read_sweeps
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.robot_files import load_calibration
from landmark_nav.storage.setup_files import load_room
from landmark_nav.types import Panorama, Sweep

_NAMES = {
    3: 'figure_3_panoramas.png',
    4: 'figure_4_attention.png',
    5: 'figure_5_stereo.png',
    6: 'figure_6_observation_areas.png',
    7: 'figure_7_features_alone.png',
    8: 'figure_8_all_features.png',
}
# Figures that require landmarks, and figures of one panorama.
_LEARNED = {5, 6, 8}
_OF_ONE = {4, 7}
# Frames of a simulated sweep.
_FRAMES = 72


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.description = (
        'Draw the counterparts of Figures 3 to 8 of Livatino and Madsen: panoramas, '
        'attention step by step, stereo, observation areas, each feature alone, all together. '
        'Without --bag, two sweeps are simulated in a furnished room.'
    )
    add(parser, '--out', required=True)
    add(parser, '--topic', '--robot')
    parser.add_argument('--bag', metavar='BAG', help='bag of sweeps of your own; needs --robot')
    add(parser, '--room', help='room.yaml: walls and papers (default: as learn finds them)')
    add(parser, '--map', help='a map of your own for Figure 6, which needs nothing else')
    add(parser, '--seed', default=7, help='of the simulated room')
    text = 'which figures, 3 to 8 (default: all that the data allow)'
    add(parser, '--figure', type=int, nargs='+', choices=sorted(_NAMES), metavar='N', help=text)
    text = f'the only features that attract attention (default: all): {", ".join(FEATURES)}'
    add(parser, '--feature', nargs='+', choices=FEATURES, metavar='NAME', help=text)


def run(args: argparse.Namespace) -> int:
    """Gather the data, draw the figures, and print their captions."""
    features, attention = args.feature or FEATURES, AttentionConfig()
    if args.feature:
        weights: dict[str, Any] = dict.fromkeys((f'weight_{name}' for name in FEATURES), 0.0)
        weights |= {f'weight_{name}': attention.weights[name] or 0.1 for name in features}
        attention = replace(attention, **weights)
    wanted = set(args.figure or ([6] if args.map and not args.bag else _NAMES))
    check_writable(*(args.out / _NAMES[number] for number in wanted))
    room, sweeps, panoramas, learned, landmarks = _gather(args, wanted, attention)
    draw: dict[int, Callable[[Path], str]] = {
        3: lambda path: draw_sweeps(sweeps, panoramas, room, path),
        4: lambda path: draw_attention(panoramas[0], attention, path),
        5: lambda path: draw_reconstruction(learned, room, path),
        6: lambda path: draw_observation_areas(landmarks, room, path),
        7: lambda path: draw_features_alone(panoramas[0], attention, path, features),
        8: lambda path: draw_learned(learned, room, path),
    }
    for number in progress(sorted(wanted), 'figures'):
        path = args.out / _NAMES[number]
        print(wrapped([str(path), f'  {draw[number](path)}']))
    return 0


# Room, sweeps and panoramas, result of learning and map; what no wanted figure needs is left out.
_Data = tuple[Room, tuple[Sweep, ...], tuple[Panorama, ...], Any, Any]


def _gather(args: argparse.Namespace, wanted: set[int], attention: AttentionConfig) -> _Data:
    if args.bag and not args.robot:
        raise UsageError('--bag needs --robot, as learn does')
    given = load_map(args.map) if args.map else None
    if given is not None and not args.bag:
        if wanted != {6}:
            raise UsageError('--map alone gives Figure 6: the others need --bag')
        return Room(given.walls), (), (), None, given
    robot = load_calibration(args.robot) if args.robot else Calibration.exact(DEFAULT_MOUNT)
    mount, tilt_rad = robot.mount, robot['camera_tilt'][0]
    room = load_room(args.room) if args.room else None
    most = None if wanted - _OF_ONE else 1
    if args.bag:
        bag = open_bag(args.bag, args)
        sweeps = tuple(progress(islice(read_sweeps(bag, mount), most), 'sweeps'))
        if not sweeps:
            raise LandmarkNavError('the bag has no sweep: record one with capture_sweep')
    else:
        scene = generate_scene(args.seed, room)
        room, simulated = scene.room, []
        for pose in progress(sweep_places(scene).poses[:most], 'sweeps'):
            world = RobotWorld(scene, pose, scene.seed, mount=mount, camera_tilt_rad=tilt_rad)
            pans = -np.pi + 2.0 * np.pi * np.arange(_FRAMES) / _FRAMES
            frames = tuple(world.frame_at(pose, float(pan)) for pan in pans)
            simulated.append(Sweep(frames[0].stamp_ns, frames))
        sweeps = tuple(simulated)
    config = replace(Configuration(), attention=attention)
    learned = None
    if room is None:
        located, _ = located_sweeps(bag, robot, config, StageLog())
        room, panoramas = located.room, located.panoramas
        if wanted & _LEARNED:
            learned = learn_located(located, config)
    else:
        panoramas = tuple(
            panorama_from_sweep(sweep, room, robot) for sweep in progress(sweeps, 'panoramas')
        )
        if wanted & _LEARNED:
            learned = learn_from_panoramas(panoramas, room, config)
    return room, sweeps, panoramas, learned, given or (learned.map if learned else None)
