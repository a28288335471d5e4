"""
Landmarks against the truth, in simulated rooms: where they are, and from where they are found.

``python test/benchmarks landmarks --seeds 201 202`` simulates rooms, learns them from two sweeps
and prints a line a room and their sum; it exits with 1 if a bound is missed. The robot is given
what a person with a tape would have measured, unless ``--exact`` is given.

=================  ===============================================================================
``median``, ``p95``  distance of landmarks from the truth, millimetres; ``false`` ones are not on
                   their wall at all and count as infinitely far
``nees``           mean of the squared error in units of its covariance, 3 degrees of freedom
``seen``           landmarks looked for from random poses: inside their observation area, not
                   hidden, whole in the image, the light changed, the pose known to 2 cm, 0.3 deg
``found``          share of them found within a pixel of the truth
``wrong``          share of them reported elsewhere
``area``           share of the places on a grid of half a metre, of all landmarks, where the
                   predicted observation area says what was observed: found within a pixel from
                   there or not. Places from where it is hidden or in no image whole don't count
=================  ===============================================================================
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

from harness import learned_room, print_row, rooms_parser
from landmark_truth import TrueWalls
import numpy as np
import numpy.typing as npt
from relocalize import camera_image, free_poses

from landmark_nav.localization.detection import detect_landmarks, DetectionConfig, View
from landmark_nav.localization.triplet.visibility import (
    axis_position,
    fully_in_view,
    observable,
    TripletConfig,
)
from landmark_nav.simulation.furnishing import another_day, generate_scene
from landmark_nav.simulation.world import RobotWorld
from landmark_nav.types import CameraFrame, FloatArray, LandmarkMap, PoseEstimate

MAX_MEDIAN_M = 0.006
MAX_P95_M = 0.020
NEES_BETWEEN = (2.0, 4.0)
MIN_LANDMARKS = 25
MIN_FOUND = 0.97
MAX_WRONG = 0.003
MIN_AREA = 0.90

_WITHIN_PX = 1.0
_PRIOR_SIGMA = np.array([0.02, 0.02, np.radians(0.3)])
_GRID_M = 0.5
_CLEARANCE_M = 0.4
_PANS = np.radians(np.arange(-160.0, 161.0, 40.0))


@dataclass(frozen=True, eq=False)
class Room:
    """A room's map beside the truth; errors are infinite for what is not there."""

    seed: int
    learned: LandmarkMap
    walls: TrueWalls
    truth: FloatArray
    error_m: FloatArray
    nees: FloatArray


def check_places(seed: int, learned: LandmarkMap) -> Room:
    """Compare a map with the room it was learned in."""
    walls = TrueWalls(generate_scene(seed))
    places = [walls.place(landmark) for landmark in learned.landmarks]
    truth = np.array([np.full(3, np.nan) if p is None else p for p in places])
    error = learned.positions - truth
    nees = np.einsum('ni,nij,nj->n', error, np.linalg.inv(learned.covariances), error)
    distance = np.nan_to_num(np.linalg.norm(error, axis=1), nan=np.inf)
    return Room(seed, learned, walls, truth, distance, nees)


class Looker:
    """A robot that looks for landmarks in a room on another day."""

    def __init__(self, room: Room) -> None:
        """Change the light and one piece of furniture."""
        self.rng = np.random.default_rng([room.seed, 50])
        scene = another_day(room.walls.scene, self.rng)
        self.room, self.walls = room, TrueWalls(scene)
        self.world = RobotWorld(scene, next(free_poses(scene, 1, self.rng)), room.seed + 3)
        self.corners = room.learned.corners
        self.there = np.isfinite(room.error_m)

    def in_view(self, pose: FloatArray, pan: float) -> npt.NDArray[np.bool_]:
        """Which landmarks (n,) are truly there, in an image whole, before their walls."""
        world, count = self.world, len(self.corners)
        front = np.sum(
            (axis_position(pose, world.mount) - self.room.learned.positions)
            * self.room.learned.normals,
            -1,
        )
        whole = fully_in_view(
            self.corners, pose, world.camera, world.mount, np.full(count, pan), 0.0, 4.0
        )
        return np.asarray(whole & self.there & (front > 0.0))

    def hidden(self, pose: FloatArray) -> npt.NDArray[np.bool_]:
        """Which landmarks (n,) something hides, in part or whole."""
        eye = axis_position(pose, self.world.mount)
        points = np.concatenate([self.corners, self.room.learned.positions[:, None]], 1)
        inward = points + 0.02 * self.room.learned.normals[:, None]
        return np.asarray(self.walls.hidden(eye, inward).any(-1))

    def look(
        self, pose: FloatArray, frame: CameraFrame, which: npt.NDArray[np.bool_]
    ) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        """Which landmarks (n,) are found within a pixel, and which are reported elsewhere."""
        world, learned = self.world, self.room.learned
        noise = self.rng.normal(0.0, _PRIOR_SIGMA)
        prior = PoseEstimate(frame.stamp_ns, pose + noise, np.diag(_PRIOR_SIGMA**2))
        found = detect_landmarks(
            View(frame, prior, world.mount), learned, DetectionConfig(), np.flatnonzero(which)
        ).detections
        turn, center = world.mount.camera_pose_map(pose, frame.pan_rad, frame.tilt_rad)
        index = learned.indices(found.ids)
        at = world.camera.project((self.room.truth[index] - center) @ turn)
        near = np.linalg.norm(found.uv_px - at, axis=-1) <= _WITHIN_PX
        right, wrong = np.zeros((2, len(learned.landmarks)), bool)
        right[index[near]], wrong[index[~near]] = True, True
        return right, wrong


def check_detections(room: Room, poses: int) -> npt.NDArray[np.int64]:
    """From random poses: landmarks that should be seen, that are found, found elsewhere."""
    looker = Looker(room)
    config = TripletConfig()
    counts = np.zeros(3, np.int64)
    for pose in free_poses(looker.world.scene, poses, looker.rng):
        pan = float(looker.rng.uniform(-np.pi, np.pi))
        axis = axis_position(pose, looker.world.mount)
        which = looker.in_view(pose, pan) & observable(axis, room.learned, config)
        which &= ~looker.hidden(pose)
        right, wrong = looker.look(pose, camera_image(looker.world, pose, pan), which)
        counts += [which.sum(), right.sum(), wrong.sum()]
    return counts


def check_area(room: Room) -> npt.NDArray[np.int64]:
    """Places on a grid, (4,): neither predicted nor observed, observed, predicted, both."""
    looker = Looker(room)
    config = TripletConfig()
    scene = looker.world.scene
    low, high = scene.room.bounds
    axes = [np.arange(a + _GRID_M / 2, b, _GRID_M) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    free = scene.room.contains(grid) & (scene.distance_to_obstacles(grid) > _CLEARANCE_M)
    counts = np.zeros(4, np.int64)
    for place in grid[free]:
        pose = np.array([*place, looker.rng.uniform(-np.pi, np.pi)])
        predicted = observable(axis_position(pose, looker.world.mount), room.learned, config)
        tried = looker.hidden(pose)
        observed = np.zeros(len(tried), bool)
        counted = np.zeros(len(tried), bool)
        for pan in looker.rng.permutation(_PANS):
            which = looker.in_view(pose, float(pan)) & ~tried
            if which.any():
                right, _ = looker.look(pose, camera_image(looker.world, pose, float(pan)), which)
                observed |= right
                counted |= which
                tried |= which
        counts += np.bincount((2 * predicted + observed)[counted], minlength=4)
    return counts


def line_of(rooms: list[Room], seen: FloatArray, area: FloatArray) -> dict[str, float]:
    """Figures of one room or of many."""
    error = np.concatenate([room.error_m for room in rooms])
    there = np.isfinite(error)
    nees = np.concatenate([room.nees for room in rooms])
    return {
        'landmarks': min(len(room.learned.landmarks) for room in rooms),
        'median': 1e3 * float(np.median(error)),
        'p95': 1e3 * float(np.percentile(error, 95.0, method='inverted_cdf')),
        'max': 1e3 * float(error[there].max()),
        'false': int(np.sum(~there)),
        'nees': float(nees[there].mean()),
        'seen': int(seen[0]),
        'found': float(seen[1] / max(seen[0], 1)),
        'wrong': float(seen[2] / max(seen[0], 1)),
        'area': float((area[0] + area[3]) / max(area.sum(), 1)),
    }


def meets_bounds(row: dict[str, float], arguments: argparse.Namespace) -> bool:
    """Whether the sum of all rooms is as good as it has to be."""
    good = row['landmarks'] >= MIN_LANDMARKS and row['median'] <= 1e3 * MAX_MEDIAN_M
    good &= row['p95'] <= 1e3 * MAX_P95_M and row['false'] == 0
    good &= NEES_BETWEEN[0] <= row['nees'] <= NEES_BETWEEN[1]
    if arguments.poses:
        good &= row['found'] >= MIN_FOUND and row['wrong'] <= MAX_WRONG
    return good and (not arguments.area or row['area'] >= MIN_AREA)


def main() -> int:
    """Print a table."""
    parser = rooms_parser(__doc__.split('\n\n')[0])
    parser.add_argument('--exact', action='store_true', help='give the robot the exact room')
    parser.add_argument('--poses', type=int, default=50, help='random poses in each room (50)')
    parser.add_argument('--area', action='store_true', help='check observation areas (a minute)')
    arguments = parser.parse_args()
    rooms, seen, area = [], [], []
    options = ['--exact'] if arguments.exact else []
    for k, seed in enumerate(arguments.seeds):
        rooms.append(check_places(seed, learned_room(seed, arguments.maps, *options)))
        seen.append(check_detections(rooms[-1], arguments.poses))
        area.append(check_area(rooms[-1]) if arguments.area else np.zeros(4, np.int64))
        row = line_of(rooms[-1:], seen[-1], area[-1])
        print_row({'seed': str(seed), **row}, 9, k == 0)
    row = line_of(rooms, np.sum(seen, 0), np.sum(area, 0))
    print_row({'seed': 'all', **row}, 9)
    return 0 if meets_bounds(row, arguments) else 1
