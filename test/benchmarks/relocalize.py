"""
Robots put down anywhere: one sweep each, in rooms learned before and changed since.

``python test/benchmarks relocalize --seeds 201 202 203`` simulates the rooms, learns their maps,
dims a lamp, moves a box, places the robot at random and prints how many places were found; it
exits with 1 if one was wrong or too few were right. ``--maps DIR/room_{seed}/map`` takes what
``test/benchmarks rooms --out DIR`` has kept.
"""

from dataclasses import replace
import time

from harness import as_jpeg, learned_room, print_row, rooms_parser
import numpy as np

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.relocalization.stream import Relocalizer
from landmark_nav.simulation.furnishing import another_day, generate_scene
from landmark_nav.simulation.world import RobotWorld
from landmark_nav.types import OdometrySample, PoseEstimate, Refusal

MAX_ERROR_M = 0.05
MAX_ERROR_DEG = 1.0
MIN_RIGHT = 0.98
PERIOD_NS = 10**8

_CLEARANCE_M = 0.4


def check_room(seed, learned, poses, frames):
    """Place the robot at random and let it look around, once at most, until it knows its place."""
    rng = np.random.default_rng([seed, 40])
    scene = another_day(generate_scene(seed), rng)
    pans = -np.pi + 2.0 * np.pi * np.arange(frames) / frames
    world: RobotWorld | None = None
    errors, seconds, refused, wrong = [], [], 0, 0
    for pose in free_poses(scene, poses, rng):
        world = world or RobotWorld(scene, pose, seed + 2)
        relocalizer, spent_s = Relocalizer(learned, world.mount), 0.0
        for k, pan in enumerate(pans):
            frame = replace(camera_image(world, pose, float(pan)), stamp_ns=k * PERIOD_NS)
            begin = time.process_time()
            relocalizer.add_odometry(OdometrySample(frame.stamp_ns, np.zeros(3)))
            found = relocalizer.add_frame(frame)
            spent_s += time.process_time() - begin
            if isinstance(found, PoseEstimate):
                break
        seconds.append(spent_s)
        if isinstance(found, Refusal):
            refused += 1
            print(f'room {seed} at {np.round(pose, 2)}: {found}')
            continue
        error = found.pose - pose
        away = float(np.hypot(*error[:2]))
        turned = float(np.degrees(abs(wrap_rad(error[2]))))
        errors.append((away, turned))
        if away > MAX_ERROR_M or turned > MAX_ERROR_DEG:
            wrong += 1
            print(f'room {seed} at {np.round(pose, 2)}: WRONG, {np.round(found.pose, 2)}')
    position, heading = np.array(errors or [(np.nan, np.nan)]).T
    return {
        'seed': seed,
        'landmarks': len(learned.landmarks),
        'poses': poses,
        'right': len(errors) - wrong,
        'wrong': wrong,
        'refused': refused,
        'median_mm': 1e3 * np.median(position),
        'max_mm': 1e3 * position.max(),
        'max_deg': heading.max(),
        'median_s': np.median(seconds),
    }


def free_poses(scene, count, rng):
    """Poses (3,) where the robot can stand."""
    while count:
        place = rng.uniform(*scene.room.bounds)
        free = scene.room.contains(place) and scene.distance_to_obstacles(place) > _CLEARANCE_M
        if free:
            count -= 1
            yield np.array([*place, rng.uniform(-np.pi, np.pi)])


def camera_image(world, pose, pan_rad):
    """One image of a standing robot, as a bag would hold it."""
    frame = world.frame_at(pose, pan_rad)
    return replace(frame, image=as_jpeg(frame.image))


def main():
    """Print a table."""
    parser = rooms_parser(__doc__)
    parser.add_argument('--poses', type=int, default=20, help='in each room (20)')
    parser.add_argument('--frames', type=int, default=24, help='images of a sweep (24)')
    arguments = parser.parse_args()
    rows = [
        check_room(seed, learned_room(seed, arguments.maps), arguments.poses, arguments.frames)
        for seed in arguments.seeds
    ]
    for k, row in enumerate(rows):
        print_row(row, 9, k == 0)
    right, wrong, poses = (sum(r[k] for r in rows) for k in ('right', 'wrong', 'poses'))
    print(f'{right} of {poses} right ({right / poses:.1%}), {wrong} wrong')
    return 0 if wrong == 0 and right >= MIN_RIGHT * poses else 1
