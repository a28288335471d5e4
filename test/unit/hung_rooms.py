"""Rooms with patches on their walls, seen from two places, for the adjustment."""

from dataclasses import dataclass, replace

from builders import panorama_of
import numpy as np
from scenes import rectangle_room

from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.learning.adjustment.problem import AdjustmentConfig, wall_sections
from landmark_nav.learning.adjustment.solution import adjust
from landmark_nav.learning.reference_area.common_errors import joint_covariance
from landmark_nav.learning.stereo.wall_patch import PatchMeasurement
from landmark_nav.types import FloatArray

ROOM = rectangle_room(6.0, 5.0)

CONFIG = AdjustmentConfig()
COMMON = CONFIG.azimuth_sigma_rad, CONFIG.tangent_sigma
# Sigmas are what they are said to be: nothing of them is estimated.
AS_EXPECTED = AdjustmentConfig(camera_weight=1e9, place_weight=1e9, room_weight=1e9)
# x, y, z, heading: one at the seam of angles.
POSES = np.array([[2.1, 1.9, 1.1, 3.12], [3.9, 2.8, 1.1, -1.4]])

PRIOR = np.diag([0.008, 0.008, 0.005, 0.003]) ** 2
OWN_SIGMA = np.array([2e-4, 3e-4])


@dataclass(frozen=True, eq=False)
class World:
    """True landmarks (n, 3) on walls (n,), and true panorama poses (views, 4)."""

    points: FloatArray
    walls: list[int]
    poses: FloatArray


def world_of(
    rng, count, *, flat=False, hanging_m=CONFIG.hanging_sigma_m, relief_m=CONFIG.relief_sigma_m
):
    """Landmarks on four walls; things hang differently far, and landmarks on them a little."""
    walls = [k % 4 for k in range(count)]
    points = np.empty((count, 3))
    for k, index in enumerate(walls):
        wall = ROOM.walls[index]
        foot = np.array(wall.start) + rng.uniform(0.15, 0.85) * np.subtract(wall.end, wall.start)
        points[k] = [*foot, rng.uniform(0.6, 1.7)]
    world = World(points, walls, POSES)
    return world if flat else world_hung(world, rng, hanging_m, relief_m)


def panoramas_at(poses, covariance=PRIOR):
    blank, cylinder = np.zeros((4, 16, 3), np.uint8), Cylinder(16, 4, 2.5, 7.5, 2.0)
    return [
        panorama_of(
            blank, cylinder, stamp_ns=k, center_map=pose[:3], heading_rad=float(pose[3]),
            covariance=covariance,
        )
        for k, pose in enumerate(poses)
    ]  # fmt: skip


def measurements_of(world, rng, common=COMMON):
    """The first view proposed each landmark; the other found it with its own noise as well."""
    groups = []
    for point in world.points:
        group = []
        for view, pose in enumerate(world.poses):
            own = OWN_SIGMA if view else np.zeros(2)
            d = point - pose[:3]
            seen = np.array([np.arctan2(d[1], d[0]) - pose[3], d[2] / np.hypot(d[0], d[1])])
            if rng is not None:
                seen += rng.normal(0.0, np.hypot(own, common))
            # Azimuths come unwrapped, as from columns.
            turns = 2.0 * np.pi * view
            group.append(
                PatchMeasurement(
                    view, float(seen[0] + turns), float(seen[1]), *own.tolist(), score=0.9
                )
            )
        groups.append(group)
    return groups


def solve(world, measurements, prior_poses, config=CONFIG):
    # From anywhere near by on the same stretch of wall.
    start = world.points + 0.05 * (ROOM.normals[world.walls] + [0.0, 0.0, 1.0])
    return adjusted(world, measurements, start, panoramas_at(prior_poses), config)


def adjusted(world, measurements, start, panoramas, config=CONFIG):
    places = places_of(panoramas)
    return adjust(measurements, world.walls, start, panoramas, places, ROOM, config)


def places_of(panoramas):
    return joint_covariance(panoramas, ROOM)


def given_poses(world, rng, factor=1.0):
    """Poses as the panoramas show them; most of the error in height is the camera's."""
    count = len(world.poses)
    error = rng.multivariate_normal(np.zeros(4), PRIOR, count)
    error[:, 2] = np.sqrt(0.9) * rng.normal(0.0, np.sqrt(PRIOR[2, 2]))
    error[:, 2] += np.sqrt(0.1) * rng.normal(0.0, np.sqrt(PRIOR[2, 2]), count)
    return world.poses + factor * error


def total_covariance(found):
    loading = found.shared_loading
    return np.asarray(found.own_covariance + loading @ loading.swapaxes(-1, -2))


def world_hung(world, rng, hanging_m=CONFIG.hanging_sigma_m, relief_m=CONFIG.relief_sigma_m):
    """The world with its landmarks hung anew before the walls."""
    thing = wall_sections(world.points, world.walls, ROOM, CONFIG.hanging_length_m)
    off = rng.normal(0.0, CONFIG.common_hanging_sigma_m) + rng.normal(
        0.0, hanging_m, int(thing.max()) + 1
    )
    each = off[thing] + rng.normal(0.0, relief_m, len(thing))
    return replace(world, points=world.points + each[:, None] * ROOM.normals[world.walls])
