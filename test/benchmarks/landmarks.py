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

from dataclasses import dataclass

from builders import patch_points
import cv2
from harness import learned_room, print_row, rooms_parser, within
import numpy as np
from relocalize import camera_image, free_poses

from landmark_nav.geometry.patches import patch_axes
from landmark_nav.localization.detection.correlation import detect_landmarks
from landmark_nav.localization.detection.expectation import DetectionConfig, View
from landmark_nav.localization.triplet.visibility import (
    axis_position,
    fully_in_view,
    observable,
    TripletConfig,
)
from landmark_nav.matching.alignment import blur_to, Match, match_template
from landmark_nav.simulation.furnishing import another_day, generate_scene
from landmark_nav.simulation.solids import wall_solids
from landmark_nav.simulation.world import RobotWorld
from landmark_nav.types import FloatArray, LandmarkMap, PoseEstimate

# How far along its wall a landmark's texture is looked for.
_SEARCH_M = 0.06
# What truly hangs there scores above 0.99.
_MIN_SCORE = 0.9
# Of two places that look the same, as slats of blinds do, the landmark is that which is so near.
_NEAR_M, _SAME_SCORE = 0.025, 0.02


class TrueWalls:
    """
    Walls of a scene as they are, to find the textures of landmarks on them.

    A landmark is right where its texture is: its patch is found again in the wall's own image,
    as fine as 2 mm, whatever panorama it was cut from. So errors of the panorama count as well
    as errors of its place, along the wall and up. Of a patch that shows things at several
    distances from the wall, that of its edges counts, as it does in stereo.
    """

    def __init__(self, scene):
        """Draw the walls; takes a second."""
        self.scene = scene
        self._walls = {}
        for wall, solid in zip(scene.room.walls, wall_solids(scene), strict=True):
            base, *hung = solid.surfaces
            grey = _grey(base.albedo)
            before = np.zeros_like(grey)
            for surface in hung:
                share, camera_image = _laid_on(base, grey.shape, surface)
                grey = (1.0 - share) * grey + share * camera_image
                depth = float((surface.corner - base.corner) @ base.normal)
                before = np.where(share > 0.5, depth, before)
            # An outline belongs to what is in front.
            nearest = cv2.dilate(before, np.ones((11, 11), np.uint8))
            self._walls[wall.id] = (wall, base, grey.astype(np.float32), nearest)

    def place(self, landmark):
        """
        Where its texture truly is, (3,).

        None if its wall does not show it within 6 cm: it stands before the wall, or is no texture
        of one place.
        """
        wall, base, grey, before = self._walls[landmark.wall_id or self._nearest(landmark)]
        texel = landmark.width_m / landmark.patch.shape[1]
        margin = round(_SEARCH_M / texel) + 2
        shape = (landmark.patch.shape[0] + 2 * margin, landmark.patch.shape[1] + 2 * margin)
        offset = patch_points(landmark.position, landmark.normal, shape, texel) - base.corner
        step = base.width_m / grey.shape[1], base.height_m / grey.shape[0]
        columns = (offset @ base.across / step[0] - 0.5).astype(np.float32)
        rows = (offset @ base.down / step[1] - 0.5).astype(np.float32)
        # As sharp as the panorama that it was cut from.
        ray = landmark.viewpoint - landmark.position
        slant = float(np.hypot(*ray[:2]) / abs(ray @ landmark.normal))
        wide = blur_to(grey, 1.5 * texel * np.array([slant, 1.0]) / step)
        search = cv2.remap(wide, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        found = _best_match(search, landmark.patch)
        if found is None:
            return None
        off = max(0, margin - round(_NEAR_M / texel) - 2)
        near = _best_match(search[off : shape[0] - off, off : shape[1] - off], landmark.patch)
        center = found.xy
        if near is not None and near.score > found.score - _SAME_SCORE:
            center = near.xy + off
        right, down = patch_axes(landmark.normal)
        across, below = (center - (np.array(shape[::-1]) - 1) / 2.0) * texel
        if landmark.edge:  # its texture does not say how high it is
            below = 0.0
        point = landmark.position + across * right + below * down
        size = landmark.patch.shape[::-1]
        there = cv2.remap(
            before, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
        )
        depths, edges = (
            cv2.getRectSubPix(image, size, center.tolist()).astype(np.float64)
            for image in (there, _edges(search))
        )
        before_wall = (point[:2] - wall.start) @ wall.normal[:2]
        return np.asarray(point + (np.average(depths, weights=edges) - before_wall) * wall.normal)

    def _nearest(self, landmark):
        """Wall that lies next to what hangs on none, of those that face as it does."""
        facing = {
            name: abs((landmark.position[:2] - wall.start) @ wall.normal[:2])
            for name, (wall, *_) in self._walls.items()
            if landmark.normal @ wall.normal > 0.5
        }
        return min(facing, key=lambda name: facing[name])

    def hidden(self, eye, points):
        """Whether furniture or walls stand between an eye (3,) and points (..., 3)."""
        way = points - eye
        hidden = ~self.scene.room.visible(
            np.broadcast_to(eye[:2], points[..., :2].shape), points[..., :2]
        )
        for box in self.scene.boxes:
            turn = np.array([np.cos(box.yaw_rad), np.sin(box.yaw_rad)])
            axes = np.array([[*turn, 0.0], [-turn[1], turn[0], 0.0], [0.0, 0.0, 1.0]])
            half = np.array(box.size_m) / 2.0
            start = axes @ (eye - [*box.center_xy, half[2]])
            slope = way @ axes.T
            with np.errstate(divide='ignore', invalid='ignore'):
                ends = (np.stack([-half, half]) - start) / slope[..., None, :]
            enter, leave = ends.min(-2).max(-1), ends.max(-2).min(-1)
            hidden |= (enter < leave) & (enter < 1.0 - 1e-6) & (leave > 0.0)
        return np.asarray(hidden)


def _best_match(search, patch):
    found = match_template(
        np.ascontiguousarray(search, np.float32),
        patch.astype(np.float32),
        min_score=_MIN_SCORE,
        max_second_ratio=1.0,
    )
    return found if isinstance(found, Match) else None


def _grey(camera_image):
    return cv2.cvtColor(camera_image[..., :3], cv2.COLOR_BGR2GRAY).astype(np.float32)


def _edges(image):
    """Squared gradient."""
    return cv2.Sobel(image, cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(image, cv2.CV_32F, 0, 1) ** 2


def _laid_on(base, shape, surface):
    """Share of each of a wall's texels that `surface` covers, and what it shows there."""
    rows, columns = shape
    corner = surface.corner - base.corner
    left, top = float(corner @ base.across), float(corner @ base.down)
    across = _covered(left, left + surface.width_m, base.width_m, columns)
    down = _covered(top, top + surface.height_m, base.height_m, rows)
    camera_image = _grey(surface.albedo)
    finer_x = base.width_m / columns * camera_image.shape[1] / surface.width_m
    finer_y = base.height_m / rows * camera_image.shape[0] / surface.height_m
    first_x = -left / surface.width_m * camera_image.shape[1] + 0.5 * finer_x - 0.5
    first_y = -top / surface.height_m * camera_image.shape[0] + 0.5 * finer_y - 0.5
    shown = cv2.warpAffine(
        camera_image,
        np.array([[finer_x, 0.0, first_x], [0.0, finer_y, first_y]]),
        (columns, rows),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.outer(down, across), shown


def _covered(low, high, length, count):
    """Share of each of `count` texels along a `length` that lies between two places on it."""
    edges = np.linspace(0.0, length, count + 1)
    common = np.minimum(edges[1:], high) - np.maximum(edges[:-1], low)
    return np.clip(common * count / length, 0.0, 1.0)


# Least and greatest figures of all rooms together; those of random poses; those of areas.
BOUNDS = {
    'landmarks': (25, np.inf),
    'median': (0.0, 6.0),
    'p95': (0.0, 20.0),
    'false': (0, 0),
    'nees': (2.0, 4.0),
}
OF_POSES, OF_AREAS = {'found': (0.97, 1.0), 'wrong': (0.0, 0.003)}, {'area': (0.9, 1.0)}

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


def check_places(seed, learned):
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

    def __init__(self, room):
        """Change the light and one piece of furniture."""
        self.rng = np.random.default_rng([room.seed, 50])
        scene = another_day(room.walls.scene, self.rng)
        self.room, self.walls = room, TrueWalls(scene)
        self.world = RobotWorld(scene, next(free_poses(scene, 1, self.rng)), room.seed + 3)
        self.corners = room.learned.corners
        self.there = np.isfinite(room.error_m)

    def in_view(self, pose, pan):
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

    def hidden(self, pose):
        """Which landmarks (n,) something hides, in part or whole."""
        eye = axis_position(pose, self.world.mount)
        points = np.concatenate([self.corners, self.room.learned.positions[:, None]], 1)
        inward = points + 0.02 * self.room.learned.normals[:, None]
        return np.asarray(self.walls.hidden(eye, inward).any(-1))

    def look(self, pose, frame, which):
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


def check_detections(room, poses):
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


def check_area(room):
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


def line_of(rooms, seen, area):
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


def main():
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
    bounds = BOUNDS | (OF_POSES if arguments.poses else {}) | (OF_AREAS if arguments.area else {})
    return int(not within(bounds, row))
