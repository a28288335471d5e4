"""
Which feature proposes patches that are found again? Measure each alone, set weights, and check.

``python test/attention_weights.py --seeds 31 32 33 34 35 36`` simulates rooms with two sweeps
each, lets attention propose patches with each feature alone, with chance, with equal weights and
with the default ones, and looks for every patch from other places after a lamp was dimmed and a
piece of furniture moved. Places and walls are the true ones, and so is how far before a wall a
patch hangs, so that it is attention alone that is judged. Found again means: above the threshold
and within 1 px of the truth; what no wall shows is never found. It prints the share of the first
40 patches of a panorama that are found, of all, what is found in a wrong place, in percent, the
root mean squared error in pixels of the first 40 that are found, and the weights that follow: in
proportion to what a feature finds more than chance among the first 40.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, replace
import sys
from unittest.mock import patch as patched

import cv2
from landmark_truth import TrueWalls
import numpy as np

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import bearings
from landmark_nav.learning.attention import attend, AttentionConfig, AttentionMaps, FEATURES
from landmark_nav.learning.stereo import hypothesize, StereoConfig
from landmark_nav.learning.stereo.wall_patch import wall_texture, WallPatch
from landmark_nav.learning.sweep_pipeline import panorama_from_sweep, PanoramaStages
from landmark_nav.localization.detection import detect_landmarks, DetectionConfig
from landmark_nav.localization.triplet.visibility import (
    axis_position,
    observable,
    TripletConfig,
    visible_landmarks,
)
from landmark_nav.simulation.furnishing import another_day, generate_scene
from landmark_nav.simulation.places import choose_sweep_places
from landmark_nav.simulation.scene import Scene
from landmark_nav.simulation.world import DEFAULT_MOUNT, RobotWorld
from landmark_nav.types import (
    CameraFrame,
    Candidate,
    FloatArray,
    Landmark,
    LandmarkMap,
    Panorama,
    PoseEstimate,
    Refusal,
    Sweep,
)

FIRST = 40
FRAMES = 72
PLACES = 8
VIEWS = 9
CLEARANCE_M = 0.5
THRESHOLD = 0.7
RIGHT_PX = 1.0
PRIOR = np.diag([0.05, 0.05, np.radians(1.0)]) ** 2


@dataclass(frozen=True, eq=False)
class View:
    """A turn of the camera at a place that was not learned from."""

    pose: PoseEstimate
    frames: tuple[CameraFrame, ...]


@dataclass(frozen=True, eq=False)
class Study:
    """A room, what was learned from, and what is seen later."""

    walls: TrueWalls
    later: Scene
    panoramas: tuple[Panorama, ...]
    views: tuple[View, ...]


def simulate(seed: int) -> Study:
    """Two sweeps, then as many turns as `PLACES` on another day."""
    scene = generate_scene(seed)
    rng = np.random.default_rng([seed, 50])
    chosen = choose_sweep_places(scene)
    assert chosen is not None, f'seed {seed} has no two places for sweeps'
    world = RobotWorld(scene, chosen.poses[0], seed)
    panoramas = []
    for pose in chosen.poses:
        known = PoseEstimate(0, pose, 1e-10 * np.eye(3))
        sweep = Sweep(0, turn(world, pose, FRAMES), known)
        panoramas.append(panorama_from_sweep(sweep, scene.room, DEFAULT_MOUNT, PanoramaStages()))
    later = another_day(scene, rng)
    places = rng.uniform(*scene.room.bounds, (100 * PLACES, 2))
    places = places[scene.room.contains(places)]
    places = places[later.distance_to_obstacles(places) > CLEARANCE_M][:PLACES]
    world = RobotWorld(later, np.append(places[0], 0.0), seed + 1)
    views = []
    for place in places:
        pose = np.append(place, rng.uniform(-np.pi, np.pi))
        views.append(View(PoseEstimate(0, pose, PRIOR), turn(world, pose, VIEWS)))
    return Study(TrueWalls(scene), later, tuple(panoramas), tuple(views))


def turn(world: RobotWorld, pose: FloatArray, count: int) -> tuple[CameraFrame, ...]:
    """Images all round."""
    pans = -np.pi + 2.0 * np.pi * np.arange(count) / count
    return tuple(world.frame_at(pose, float(pan)) for pan in pans)


def found_again(study: Study, config: AttentionConfig) -> FloatArray:
    """Rank of each patch, how often looked for, right, wrong, and the sum of squared pixels."""
    rows: list[tuple[float, ...]] = []
    landmarks: list[Landmark] = []
    for panorama in study.panoramas:
        grey = np.asarray(cv2.cvtColor(panorama.image, cv2.COLOR_BGR2GRAY), np.float32)
        for rank, candidate in enumerate(attend(panorama, config).candidates):
            landmark = on_wall(candidate, panorama, grey, study.walls, len(rows))
            if landmark is not None:
                landmarks.append(landmark)
            rows.append((rank, landmark is None, 0.0, 0.0, 0.0))
    table = np.array(rows).reshape(-1, 5)
    learned = LandmarkMap(tuple(landmarks), 'map', study.later.room.walls)
    for view in study.views:
        look(view, learned, study.later, table)
    return table


def on_wall(
    candidate: Candidate,
    panorama: Panorama,
    grey: np.ndarray[tuple[int, ...], np.dtype[np.float32]],
    walls: TrueWalls,
    number: int,
) -> Landmark | None:
    """What a candidate shows of a wall, None if it shows something else or can't be one."""
    found = hypothesize(candidate, 0, panorama, walls.scene.room, StereoConfig())
    if isinstance(found, Refusal):
        return None
    flush = _landmark(found, panorama, grey, walls.scene, number)
    if flush is None:
        return None
    place = walls.place(flush)
    if place is None:
        return flush
    return _landmark(replace(found, position=place), panorama, grey, walls.scene, number)


def _landmark(
    patch: WallPatch,
    panorama: Panorama,
    grey: np.ndarray[tuple[int, ...], np.dtype[np.float32]],
    scene: Scene,
    number: int,
) -> Landmark | None:
    """A patch as it would be learned where it is."""
    place, normal = patch.position, patch.normal
    texture = wall_texture(panorama, grey, place, normal, patch.shape, patch.texel_m)
    if texture is None:
        return None
    return Landmark(
        number,
        place,
        1e-8 * np.eye(3),
        np.zeros((3, 1)),
        normal,
        patch.shape[1] * patch.texel_m,
        patch.shape[0] * patch.texel_m,
        np.clip(np.rint(texture), 0, 255).astype(np.uint8),
        panorama.center_map,
        THRESHOLD,
        scene.room.walls[patch.wall].id,
    )


def look(view: View, learned: LandmarkMap, later: Scene, table: FloatArray) -> None:
    """Look for all patches that should be seen; add to `table` what came of it."""
    pose, mount = view.pose.pose, DEFAULT_MOUNT
    axis = axis_position(pose, mount)
    seen = observable(axis, learned, TripletConfig())
    seen &= later.sees(axis[:2], learned.positions[:, :2], float(axis[2]))
    way = learned.positions - axis
    pans = bearings(np.array([*axis[:2], pose[2]]), learned.positions[:, :2])
    gap = np.abs(wrap_rad(pans[:, None] - [frame.pan_rad for frame in view.frames]))
    for k, frame in enumerate(view.frames):
        index = visible_landmarks(
            view.pose, learned, frame.camera, mount, frame.pan_rad, 0.0, TripletConfig()
        )
        index = index[seen[index] & (gap[index].argmin(axis=1) == k)]
        # The prior is the truth, its covariance is not: the search is as wide as in a drive.
        result = detect_landmarks(frame, view.pose, learned, mount, DetectionConfig(), index)
        found = result.detections
        at = learned.indices(found.ids)
        off = found.bearing_rad - np.arctan2(way[at, 1], way[at, 0]) + pose[2]
        off_px = np.abs(wrap_rad(off)) * frame.camera.fx
        right = off_px < RIGHT_PX
        table[learned.ids[index], 1] += 1.0
        table[found.ids[right], 2] += 1.0
        table[found.ids[~right], 3] += 1.0
        table[found.ids[right], 4] += off_px[right] ** 2


def shares(table: FloatArray) -> FloatArray:
    """Found of the first and of all, wrong, in percent; how many there are; pixels of error."""
    looked = table[:, 1] > 0.0
    right, wrong = (table[looked, k] / table[looked, 1] for k in (2, 3))
    first = table[looked, 0] < FIRST
    if not looked.any():
        return np.zeros(5)
    rms_px = np.sqrt(table[looked][first, 4].sum() / max(table[looked][first, 2].sum(), 1.0))
    percent = 100.0 * np.array([right[first].mean(), right.mean(), wrong.mean()])
    return np.array([*percent, len(table), rms_px])


def configurations(weights: Mapping[str, float] | None) -> dict[str, AttentionConfig]:
    """What is compared, by name."""
    plain = {f'weight_{name}': 0.0 for name in FEATURES}
    named = {feature: AttentionConfig().alone(feature) for feature in FEATURES}
    named['equal'] = AttentionConfig(**dict.fromkeys(plain, 1.0))
    named['default'] = AttentionConfig()
    if weights:
        asked = {f'weight_{name}': value for name, value in weights.items()}
        named['asked'] = AttentionConfig(**{**plain, **asked})
    return named


def measure(seed: int, named: Mapping[str, AttentionConfig]) -> dict[str, FloatArray]:
    """Shares of one room by configuration, `chance` among them."""
    study = simulate(seed)
    rows = {name: shares(found_again(study, config)) for name, config in named.items()}
    rng = np.random.default_rng([seed, 60])

    def noise(image: FloatArray, *_: object) -> AttentionMaps:
        coarse = cv2.GaussianBlur(rng.random(image.shape, np.float32), (0, 0), 8.0)
        return AttentionMaps({}, {}, np.asarray((coarse - coarse.min()) / np.ptp(coarse)), 0)

    with patched('landmark_nav.learning.attention.attend.attention_maps', noise):
        rows['chance'] = shares(found_again(study, AttentionConfig()))
    return rows


def main() -> int:
    """Print a table and the weights that follow from it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, nargs='+', required=True)
    parser.add_argument(
        '--weights', type=float, nargs=len(FEATURES), metavar='W', help=f'also: {FEATURES}'
    )
    args = parser.parse_args()
    cv2.setNumThreads(1)
    named = configurations(dict(zip(FEATURES, args.weights, strict=True)) if args.weights else {})
    rooms = [measure(seed, named) for seed in args.seeds]
    columns = f'{"first 40":>16}{"all":>16}{"wrong":>16}{"patches":>9}{"px":>7}'
    print(f'{"":<16}{columns}  first 40 by room')
    table = {name: np.array([room[name] for room in rooms]) for name in rooms[0]}
    for name, values in table.items():
        mean, spread = values.mean(axis=0), values.std(axis=0) / max(len(rooms) - 1, 1) ** 0.5
        cells = (f'{m:9.1f} +- {s:<3.1f}' for m, s in zip(mean[:3], spread[:3], strict=True))
        each = ' '.join(f'{v:.0f}' for v in values[:, 0])
        print(f'{name:<16}{"".join(cells)}{mean[3]:9.0f}{mean[4]:7.3f}  {each}')
    for name in ('equal', 'asked'):
        if name in table:
            gain = table[name][:, 0] - table['default'][:, 0]
            error = gain.std() / max(len(gain) - 1, 1) ** 0.5
            print(f'{name} against default, first 40: {gain.mean():+.1f} +- {error:.1f}')
    more = np.array([(table[f] - table['chance'])[:, 0].mean() for f in FEATURES])
    rule = np.maximum(more, 0.0) / max(np.maximum(more, 0.0).sum(), 1e-9)
    print('by the rule:', ', '.join(f'{n} {w:.2f}' for n, w in zip(FEATURES, rule, strict=True)))
    return 0


if __name__ == '__main__':
    sys.exit(main())
