"""
How well papers show the place of a sweep: many simulated places, errors against covariances.

``python test/benchmarks papers --rooms 12`` draws rooms with three to six papers on one wall or
several, in changing light, with distractors of the papers' colours and size, and sweeps at five
places each; what is given of papers, height, axis and joint angles is as wrong as the
configuration says. It prints a line a place and exits with 1 if a bound is missed.
"""

import argparse
from dataclasses import replace

import cv2
from harness import as_jpeg
import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.walls import Paper
from landmark_nav.learning.panorama.synthesis import synthesize_cylinder
from landmark_nav.learning.reference_area.location import PaperSearch
from landmark_nav.learning.reference_area.model import ReferenceAreaConfig
from landmark_nav.simulation.furnishing import generate_room, generate_scene
from landmark_nav.simulation.scene import Lamp, view_quality, WallItem
from landmark_nav.simulation.setup_documents import moved_paper
from landmark_nav.simulation.world import DEFAULT_MOUNT, RobotWorld
from landmark_nav.types import Sweep

COLORS = ('red', 'green', 'blue', 'yellow', 'magenta', 'orange', '#1a9090')
SIZES = ((0.21, 0.297), (0.297, 0.21), (0.297, 0.42), (0.25, 0.25))
PANS = np.radians(np.arange(-180.0, 180.0, 5.0))
CONFIG = ReferenceAreaConfig()

# Of the mean over many places: about 3.3 standard deviations of that of a good covariance, and
# the cheaper side for what is given with a margin.
NEES_RANGE = (1.5, 4.2)
MAX_REFUSED = 0.1


def draw_papers(room, count, walls, rng):
    """The same room with so many papers on so many of its longest walls."""
    longest = sorted(room.walls, key=lambda wall: -wall.length)[:walls]
    papers: list[Paper] = []
    for k in range(count):
        wall = longest[k % walls]
        for along in rng.uniform(0.5, wall.length - 0.5, 50):
            x, y = wall.start + along * wall.along
            if all(np.hypot(p.center[0] - x, p.center[1] - y) > 0.6 for p in papers):
                size = SIZES[int(rng.integers(len(SIZES)))]
                center = (float(x), float(y), float(rng.uniform(1.2, 1.65)))
                papers.append(Paper(COLORS[int(rng.integers(len(COLORS)))], center, *size))
                break
    return replace(room, papers=tuple(papers))


def draw_scene(seed, rng):
    """A furnished room, with sheets of the papers' size about and its light changed."""
    plain = generate_room(rng)
    room = draw_papers(plain, int(rng.integers(3, 7)), int(rng.integers(1, 4)), rng)
    try:
        scene = generate_scene(seed, room)
    except LandmarkNavError:
        return None
    sheets: list[WallItem] = []
    for _ in range(8):
        wall = int(rng.integers(len(room.walls)))
        along, up = (
            float(rng.uniform(0.4, room.walls[wall].length - 0.4)),
            float(rng.choice([p.center[2] for p in room.papers])),
        )
        sheet = WallItem('sheet', wall, along, up, 0.21, 0.297, int(rng.integers(2**31)))
        clear = [np.linalg.norm(sheet.center(room) - p.center) for p in room.papers]
        clear += [np.linalg.norm(sheet.center(room) - s.center(room)) for s in sheets]
        if min(clear) > 0.55:
            sheets.append(sheet)
    tint = np.array([1.0, 1.0, 1.0]) + rng.uniform(-0.35, 0.35) * np.array([1.0, 0.0, -1.0])
    dim = float(rng.uniform(0.3, 1.6))
    lamps = tuple(replace(lamp, power=dim * lamp.power, tint=tuple(tint)) for lamp in scene.lamps)
    if rng.random() < 0.3:  # a window that burns out what is beside it
        x, y, z = room.papers[0].center
        lamps += (Lamp((x, y, z + 0.6), (0.0, 0.0), 1.5),)
    return replace(scene, items=(*scene.items, *sheets), lamps=lamps)


def places_of(scene, count, rng):
    """Poses (n, 3) that see three papers or more."""
    xy = rng.uniform(*scene.room.bounds, (400, 2))
    xy = xy[scene.room.contains(xy)]
    xy = xy[scene.distance_to_obstacles(xy) > 0.5]
    points = np.array([p.center for p in scene.room.papers])
    seen = view_quality(scene, xy, points, scene.room.nearest_wall(points[:, :2]), 65.0) > 0.0
    xy = xy[seen.sum(axis=1) >= 3][:count]
    return np.column_stack([xy, rng.uniform(-np.pi, np.pi, len(xy))])


def take_sweep(world, pose, gamma):
    """The frames of a turn that look towards papers, as JPEG."""
    table = np.rint(255.0 * (np.arange(256) / 255.0) ** (1.0 / gamma)).astype(np.uint8)
    axis = world.mount.axis_pose_map(pose)
    azimuth = se2.bearings(axis, np.array([p.center[:2] for p in world.scene.room.papers]))
    frames = []
    for pan in PANS:
        if np.abs(wrap_rad(pan - azimuth)).min() > np.radians(26.0):
            continue
        frame = world.frame_at(pose, float(pan))
        frames.append(replace(frame, image=as_jpeg(table[frame.image])))
    return Sweep(0, tuple(frames))


def reported(room, sweep, rng):
    """What a robot is given: all a little wrong."""
    shifts = rng.normal(0.0, CONFIG.paper_sigma_m, (len(room.papers), 2))
    papers = tuple(moved_paper(p, room, s) for p, s in zip(room.papers, shifts, strict=True))
    slips = rng.normal(0.0, DEFAULT_MOUNT.pan_sigma_rad, (len(sweep.frames), 2))
    frames = tuple(
        replace(f, pan_rad=f.pan_rad + float(a), tilt_rad=f.tilt_rad + float(b))
        for f, (a, b) in zip(sweep.frames, slips, strict=True)
    )
    x, y, z = DEFAULT_MOUNT.axis_xyz
    camera_tilt = rng.normal(0.0, CONFIG.horizon_sigma_rad, 2)
    mount = replace(
        DEFAULT_MOUNT,
        axis_xyz=(x, y, z + float(rng.normal(0.0, CONFIG.height_sigma_m))),
        axis_rpy=(float(camera_tilt[0]), float(camera_tilt[1]), 0.0),
    )
    return replace(room, papers=papers), replace(sweep, frames=frames), mount


def main():
    """Print a table and the verdict."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--rooms', type=int, default=12)
    parser.add_argument('--places', type=int, default=5, help='in each room (5)')
    parser.add_argument('--first-seed', type=int, default=4000)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    nees, worst, refused, millimetres = [], [], 0, []
    for seed in range(args.first_seed, args.first_seed + args.rooms):
        rng = np.random.default_rng(seed)
        scene = draw_scene(seed, rng)
        if scene is None:
            print(f'{seed}: the papers are not seen together from anywhere', flush=True)
            continue
        poses = places_of(scene, args.places, rng)
        world = RobotWorld(scene, poses[0], seed) if len(poses) else None
        for pose in poses:
            assert world is not None
            gamma = float(rng.choice([1.0, 1.4, 1.8]))
            room, sweep, mount = reported(scene.room, take_sweep(world, pose, gamma), rng)
            head = f'{seed}: {len(room.papers)} papers, gamma {gamma}: '
            try:
                view = synthesize_cylinder(sweep, mount)
                place = PaperSearch(sweep, view, room, mount, CONFIG).located()
            except LandmarkNavError as error:
                refused += 1
                print(f'{head}refused: {error}', flush=True)
                continue
            error = place.pose_map_base - pose
            error[2] = wrap_rad(error[2])
            covariance = place.covariance[np.ix_([0, 1, 3], [0, 1, 3])]
            deviation = np.abs(error) / np.sqrt(np.diag(covariance))
            nees.append(float(error @ np.linalg.solve(covariance, error)))
            worst.append(float(deviation.max()))
            millimetres.append(1e3 * float(np.hypot(error[0], error[1])))
            print(
                f'{head}{millimetres[-1]:.1f} mm (sigma '
                f'{1e3 * np.sqrt(covariance[0, 0] + covariance[1, 1]):.1f}), '
                f'{np.degrees(abs(error[2])):.3f} deg, NEES {nees[-1]:.1f}',
                flush=True,
            )
    count = len(nees)
    mean = float(np.mean(nees))
    outside = float(np.mean(np.array(worst) > 3.0))
    good = (
        NEES_RANGE[0] < mean < NEES_RANGE[1]
        and max(worst) < 5.0
        and refused <= MAX_REFUSED * (count + refused)
    )
    print(
        f'{count} places, {refused} refused; NEES mean {mean:.2f} (3 expected), beyond 3 sigma in '
        f'an axis {100 * outside:.1f} %, worst {max(worst):.1f} sigma; error median '
        f'{np.median(millimetres):.1f} mm, 95 % {np.percentile(millimetres, 95):.1f} mm'
    )
    return 0 if good else 1
