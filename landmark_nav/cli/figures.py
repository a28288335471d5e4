"""`landmark-nav figures`: draw counterparts of the figures of Livatino and Madsen."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from landmark_nav.cli.learn import located_sweeps
from landmark_nav.cli.lines import progress, wrapped
from landmark_nav.cli.options import add, add_number, open_bag, within
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
from landmark_nav.geometry.se2 import bearings
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.attention import AttentionConfig, FEATURES
from landmark_nav.learning.pipeline import learn_from_panoramas, LearningResult
from landmark_nav.learning.stages import StageLog
from landmark_nav.learning.sweep_pipeline import panorama_from_sweep
from landmark_nav.learning.unmeasured import learn_located
from landmark_nav.localization.detection import detect_landmarks, DetectionConfig
from landmark_nav.simulation.furnishing import another_day, generate_scene
from landmark_nav.simulation.places import choose_sweep_places
from landmark_nav.simulation.renderer import Renderer
from landmark_nav.simulation.scene import Scene
from landmark_nav.simulation.world import DEFAULT_CAMERA, DEFAULT_MOUNT, RobotWorld
from landmark_nav.storage.atomic_io import check_writable
from landmark_nav.storage.bags import read_sweeps
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.setup_files import load_robot, load_room
from landmark_nav.types import (
    CameraFrame,
    FloatArray,
    Landmark,
    LandmarkMap,
    Panorama,
    PoseEstimate,
    Sweep,
)

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
# Positions from which a landmark is searched: spacing and least distance from obstacles; greatest
# error of a correct detection.
_GRID_M, _CLEARANCE_M, _RIGHT_PX = 0.45, 0.25, 1.0
# Covariance of the prior pose in that search.
_PRIOR = np.diag([0.03, 0.03, np.radians(0.5)]) ** 2
# Width of the rendered images, which contain a patch and its surroundings; narrow ones are faster.
_NARROW_PX = 160


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
    """Data of the figures; `truth` holds the true locations of the landmarks."""

    room: Room
    sweeps: tuple[Sweep, ...]
    panoramas: tuple[Panorama, ...]
    learned: LearningResult | None
    landmarks: LandmarkMap | None
    truth: FloatArray | None = None
    tests: tuple[AreaTest, ...] = ()


def run(args: argparse.Namespace) -> int:
    """Gather the data, draw the figures, and print their captions."""
    attention = _attention(args.feature)
    wanted = set(args.figure or ([6] if args.map and not args.bag else _NAMES))
    check_writable(*(args.out / _NAMES[number] for number in wanted))
    data = _gather(args, wanted, attention)
    for number in progress(sorted(wanted), 'figures'):
        path = args.out / _NAMES[number]
        print(wrapped([str(path), f'  {_draw(number, data, attention, path, args.feature)}']))
    return 0


def _attention(features: list[str] | None) -> AttentionConfig:
    """Default weights, with 0 for features that are not among `features`."""
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
    most = None if wanted - _OF_ONE else 1
    if args.bag:
        bag = open_bag(args.bag, args)
        sweeps = tuple(progress(islice(read_sweeps(bag, mount), most), 'sweeps'))
        if not sweeps:
            raise LandmarkNavError('the bag has no sweep: record one with capture_sweep')
        truth = truth_of_bag(bag)
        if room is None and not bag.find('sweep/pose'):
            truth = truth.seen_from(truth.at([sweeps[0].stamp_ns])[0])
        poses = truth.at([sweep.stamp_ns for sweep in sweeps])
    else:
        scene = generate_scene(args.seed, room)
        if (places := choose_sweep_places(scene)) is None:
            raise LandmarkNavError('the room has no two places that see all papers')
        room, poses = scene.room, places.poses[:most]
        sweeps = tuple(_sweep(scene, mount, pose) for pose in progress(poses, 'sweeps'))
    config = replace(Configuration(), attention=attention)
    learned = None
    if room is None:
        located, _ = located_sweeps(bag, mount, config, StageLog())
        room, panoramas = located.room, located.panoramas
        if wanted & _LEARNED:
            learned = learn_located(located, config, config.unmeasured)
    else:
        panoramas = tuple(
            panorama_from_sweep(sweep, room, mount, config)
            for sweep in progress(sweeps, 'panoramas')
        )
        if wanted & _LEARNED:
            learned = learn_from_panoramas(panoramas, room, config)
    data = _Data(room, sweeps, panoramas, learned, given or (learned.map if learned else None))
    if learned is not None and np.all(np.isfinite(poses)):
        data = replace(data, truth=true_places(learned, poses, mount))
    if learned is not None and not args.bag and 6 in wanted:
        chosen = progress(typical_landmarks(learned.map), 'areas')
        data = replace(data, tests=tuple(_look_for(k, scene, mount) for k in chosen))
    return data


def _sweep(scene: Scene, mount: PanTiltMount, pose: FloatArray) -> Sweep:
    """Simulate a sweep at a pose."""
    world = RobotWorld(scene, pose, scene.seed, mount=mount)
    pans = -np.pi + 2.0 * np.pi * np.arange(_FRAMES) / _FRAMES
    frames = tuple(world.frame_at(pose, float(pan)) for pan in pans)
    return Sweep(frames[0].stamp_ns, frames)


def _look_for(landmark: Landmark, scene: Scene, mount: PanTiltMount) -> AreaTest:
    """Search a landmark from all over the floor in the scene of another day."""
    rng = np.random.default_rng([scene.seed, 70])
    later = another_day(scene, rng)
    camera = replace(
        DEFAULT_CAMERA, width=_NARROW_PX, cx=DEFAULT_CAMERA.cx - (512 - _NARROW_PX) / 2
    )
    renderer = Renderer(later, camera)
    low, high = later.room.bounds[0] + _CLEARANCE_M, later.room.bounds[1] - _CLEARANCE_M
    x, y = (np.arange(a, b, _GRID_M) for a, b in zip(low, high, strict=True))
    xy = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    xy = xy[later.room.contains(xy)]
    xy = xy[later.distance_to_obstacles(xy) > _CLEARANCE_M]
    xy = xy[later.sees(xy, landmark.position[:2], mount.axis_xyz[2])]
    found = []
    for place in xy:
        pose = np.append(place, rng.uniform(-np.pi, np.pi))
        pan = float(bearings(pose, landmark.position[:2]))
        rotation, center = mount.camera_pose_map(pose, pan)
        noise = rng.normal(0.0, 2.0, (camera.height, camera.width, 1))
        image = np.clip(renderer.render(rotation, center) + noise, 0, 255).astype(np.uint8)
        seen = detect_landmarks(
            CameraFrame(0, image, camera, pan), PoseEstimate(0, pose, _PRIOR),
            LandmarkMap((landmark,)), mount, DetectionConfig(), np.array([0]),
        ).detections  # fmt: skip
        expected = camera.project((landmark.position - center) @ rotation)
        found.append(bool(len(seen)) and abs(seen.uv_px[0, 0] - expected[0]) < _RIGHT_PX)
    return AreaTest(landmark.id, xy, np.array(found, dtype=np.bool_))


def _draw(
    number: int,
    data: _Data,
    attention: AttentionConfig,
    path: Path,
    features: list[str] | None,
) -> str:
    """Draw a figure; return its caption."""
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
