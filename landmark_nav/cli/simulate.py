"""`landmark-nav simulate`: write bags of simulated sweeps and of a drive."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
import shlex
from typing import Any

import numpy as np

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.cli.options import add, evaluate_line, progress, within
from landmark_nav.errors import LandmarkNavError, UsageError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages.factory import rosbag_factory
from landmark_nav.simulation import furnishing, setup_documents
from landmark_nav.simulation.drive_path import plan_tour
from landmark_nav.simulation.pan_tilt_unit import PanControl, PanTiltConfig
from landmark_nav.simulation.scene import Scene, seen_from_all, sweep_places
from landmark_nav.simulation.world import (
    DEFAULT_CAMERA,
    DEFAULT_MOUNT,
    drive_messages,
    Recorded,
    RobotWorld,
    STATE_RATE_HZ,
    sweep_messages,
)
from landmark_nav.storage.atomic_io import atomic_folder
from landmark_nav.storage.bags import BagWriter
from landmark_nav.storage.robot_files import load_calibration
from landmark_nav.storage.setup_files import load_camera, load_room

_FILES = ('start.json', 'room.yaml', 'robot.yaml', 'scene.json', 'learn', 'drive')

# The seed is added, ns: two simulations have no sweep in common, which `map merge` would refuse.
_LEARN_START_NS = 1_000_000_000_000
_DRIVE_START_NS = 5_000_000_000_000

# Number of random positions around the first two, of which further sweeps take free ones.
_PLACES_TRIED = 200

# Time between two sweeps, in which the robot is moved.
_MOVE_S = 5.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.description = (
        'Furnish a room, let a robot with a turning camera make sweeps and drive in '
        'it, and write what it would have recorded: DIR/learn, DIR/drive, DIR/room.yaml, '
        'DIR/robot.yaml, DIR/start.json, and DIR/scene.json with what really hangs where.'
    )
    add(parser, '--out', required=True)
    add(parser, '--overwrite')
    add(parser, '--room', help='room.yaml to furnish (default: a room is drawn, too)')
    add(parser, '--robot', help='robot.yaml: how the camera is mounted (default: 1.1 m up)')
    text = 'its camera, a YAML file as camera_calibration writes it (default: 512 x 512 pixels)'
    add(parser, '--camera', metavar='F', help=text)
    add(parser, '--seed', help='of all that is drawn at random')
    for name, kind, default, metavar, text in (
        ('--sweeps', within(int, 1, 1000), 2, 'N', 'how many sweeps'),
        ('--frames', within(int, 8, 10_000), 72, 'N', 'frames of each sweep'),
        ('--drive-seconds', within(float, 0.5, 1e5), 40.0, 'S', 'length of the drive in seconds'),
        ('--camera-rate', _camera_rate, 5.0, 'HZ', 'images a second, a whole part of 20'),
        ('--speed', within(float, 0.05, 10), 0.35, 'M/S', 'of the robot in the drive'),
        ('--people', within(int, 0, 50), 0, 'N', 'who walk about'),
        ('--exchange', within(float, 0, 1), 0.0, 'SHARE', 'share of the posters on the walls, 0 '
         'to 1, that are replaced by others between sweeps and drive'),
    ):  # fmt: skip
        add(parser, name, type=kind, default=default, metavar=metavar, help=text)
    text = 'dim one lamp and move one piece of furniture between sweeps and drive'
    add(parser, '--light-change', action='store_true', help=text)
    text = 'hang AprilTags (36h11, 16 cm) every M metres where the walls are free (scene.json)'
    add(parser, '--tags', type=within(float, 0.3, 10), metavar='M', help=text)
    text = 'write room.yaml and robot.yaml exactly as they are (default: as a person with a tape '
    text += 'measures them, walls and the height of the camera to 5 mm, papers to 1 mm)'
    add(parser, '--exact', action='store_true', help=text)


def run(args: argparse.Namespace) -> int:
    """Simulate; write all files or none."""
    room = load_room(args.room) if args.room else None
    mount = _mount(args.robot) if args.robot else DEFAULT_MOUNT
    camera = load_camera(args.camera) if args.camera else DEFAULT_CAMERA
    scene = furnishing.generate_scene(args.seed, room)
    rng = np.random.default_rng([args.seed, 30])
    poses = _sweep_poses(scene, args.sweeps, rng)
    if args.tags:
        scene = replace(scene, items=furnishing.hang_tags(scene, args.tags))
    later = furnishing.another_day(scene, rng) if args.light_change else scene
    if args.exchange:
        other = np.random.default_rng([args.seed, 31])
        later = replace(later, items=furnishing.exchange_posters(scene, args.exchange, other))
    robot_in = partial(RobotWorld, camera=camera, mount=mount, people=args.people)
    hung = furnishing.markers_of(scene)
    dictionary = furnishing.TAG_DICTIONARY if hung else scene.room.marker_dictionary
    given = replace(scene.room, markers=hung, marker_dictionary=dictionary), mount
    if not args.exact:
        given = setup_documents.as_measured(*given, np.random.default_rng([args.seed, 60]))
    with atomic_folder(args.out, _FILES, args.overwrite) as folder:
        with BagWriter(folder / 'learn') as bag:
            frames = args.frames * len(poses)
            world = robot_in(scene, poses[0], args.seed, start_ns=_LEARN_START_NS + args.seed)
            _write(bag, _learn(world, poses, args), 'sweeps', frames)
        path = plan_tour(later, poses[-1][:2], 1.2 * args.speed * args.drive_seconds + 2.0, rng)
        ahead = path[min(8, len(path) - 1)] - path[0]
        start = np.array([*path[0], np.arctan2(ahead[1], ahead[0])])
        with BagWriter(folder / 'drive') as bag:
            drawn = world.renderer if later is scene else None
            world = robot_in(later, start, args.seed + 1, start_ns=_DRIVE_START_NS, renderer=drawn)
            frames = round(args.drive_seconds * args.camera_rate)
            known = seen_from_all(scene, [pose[:2] for pose in poses])
            pan_control = PanControl(later, mount, PanTiltConfig.pan_limit_rad, rng, known)
            pace = args.drive_seconds, args.speed, args.camera_rate
            messages = drive_messages(world, rosbag_factory(), path, pan_control, *pace)
            _write(bag, messages, 'drive', frames)
        for name, text in (
            ('room.yaml', setup_documents.room_document(given[0])),
            ('robot.yaml', setup_documents.robot_document(given[1], measured=not args.exact)),
            ('start.json', setup_documents.start_document(start)),
            ('scene.json', setup_documents.scene_document(scene)),
        ):
            (folder / name).write_text(text, encoding='utf-8')
    print(
        f'{args.out}: {len(poses)} sweeps of {args.frames} frames in learn, '
        f'{args.drive_seconds:g} s in drive, room of {len(scene.room.walls)} walls'
    )
    if len(poses) > 1:
        learn, drive, room, robot, learned = (
            args.out / name for name in ('learn', 'drive', 'room.yaml', 'robot.yaml', 'map')
        )
        words = ['learn', learn, '--room', room, '--robot', robot, '--out', learned]
        print(shlex.join(['landmark-nav', *map(str, words)]))
        print(evaluate_line(drive, learned, robot, start))
    return 0


def _mount(path: Path) -> PanTiltMount:
    """Mount of a robot.yaml; `LandmarkNavError` if this gives more than is simulated."""
    known = load_calibration(path)
    given = known.values != Calibration.of_mount(known.mount).values
    if given.any():
        names = ', '.join(np.array(NAMES)[given])
        raise LandmarkNavError(f'{path}: not simulated: {names}: leave them out, or set them to 0')
    return known.mount


def _camera_rate(text: str) -> float:
    """Argument type: rate of images, an integer fraction of the rate of odometry."""
    rate = within(float, 0.5)(text)
    every = max(1, round(STATE_RATE_HZ / rate))
    if abs(every * rate - STATE_RATE_HZ) > 1e-3 * STATE_RATE_HZ:
        near = STATE_RATE_HZ / every
        whole = f'{text} is no whole part of {STATE_RATE_HZ}'
        raise argparse.ArgumentTypeError(f'{whole}: take {near:.4g}')
    return rate


def _sweep_poses(
    scene: Scene, count: int, rng: np.random.Generator
) -> list[np.ndarray[Any, np.dtype[np.float64]]]:
    """Return the two best poses, then random ones around them."""
    places = sweep_places(scene)
    poses = [np.asarray(pose) for pose in places.poses[:count]]
    missing = count - len(poses)
    if not missing:
        return poses
    others = places.poses[:, :2].mean(axis=0) + rng.uniform(-1.0, 1.0, (_PLACES_TRIED, 2))
    others = others[scene.room.contains(others) & (scene.distance_to_obstacles(others) > 0.45)]
    if missing > len(others):
        most = len(poses) + len(others)
        raise UsageError(f'--sweeps: the room has space for {most} sweeps only')
    poses += [np.array([*xy, rng.uniform(-np.pi, np.pi)]) for xy in others[:missing]]
    return poses


def _learn(world: RobotWorld, poses: list[Any], args: argparse.Namespace) -> Iterator[Recorded]:
    factory = rosbag_factory()
    for pose in poses:
        world.place(pose, -np.pi)
        yield from sweep_messages(world, factory, frames=args.frames)
        world.advance(_MOVE_S)


def _write(bag: BagWriter, messages: Iterator[Recorded], what: str, frames: int) -> None:
    """Write messages; the progress bar counts images."""
    bar = iter(progress(range(frames), what, frames))
    for recorded in messages:
        bag.write(recorded.topic, recorded.message, recorded.stamp_ns)
        if recorded.topic.endswith('/compressed'):
            next(bar, None)
    next(bar, None)
