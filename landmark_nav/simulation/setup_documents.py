"""`room.yaml`, `robot.yaml` and `start.json` of a simulated robot, as text."""

from __future__ import annotations

from dataclasses import replace
import json
from typing import Any, TypeVar

import numpy as np
import yaml

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Marker, Paper, Room
from landmark_nav.simulation.scene import Scene
from landmark_nav.storage.robot_files import MOUNT_FIELDS
from landmark_nav.storage.setup_files import room_text
from landmark_nav.types import FloatArray

# Standard deviations of the extrinsics of a simulated robot: 1 mm, 0.1 degrees.
_SIGMA_M, _SIGMA_RAD = 0.001, 0.00175


def room_document(room: Room) -> str:
    """Text of ``room.yaml``: walls and papers."""
    return (
        '# metres, in the map frame; the inside of the room lies to the left of start -> end\n'
        + room_text(room)
    )


def robot_document(mount: PanTiltMount, measured: bool = False) -> str:
    """Text of ``robot.yaml``: extrinsics of the camera, exact or `as_measured`, and the joints."""
    document: dict[str, Any] = {
        'base_frame': mount.base_frame,
        'pan_joint': mount.pan_joint,
        'tilt_joint': mount.tilt_joint,
        'pan_axis': {
            'xyz': list(mount.axis_xyz),
            'rpy': list(mount.axis_rpy),
            'xyz_sigma': [_SIGMA_M, _SIGMA_M, _HEIGHT_M] if measured else _SIGMA_M,
            'rpy_sigma': _SIGMA_RAD,
        },
        'optical_center_offset': list(mount.optical_center_offset),
        'optical_center_offset_sigma': _SIGMA_M,
        'camera_roll_sigma': _SIGMA_RAD,
    }
    if mount.camera_roll_rad:
        document['camera_roll'] = float(mount.camera_roll_rad)
    if mount.pan_sigma_rad != PanTiltMount.pan_sigma_rad:
        document['pan_sigma'] = float(mount.pan_sigma_rad)
    for key, (argument, *_) in MOUNT_FIELDS.items():
        if getattr(mount, argument) != getattr(PanTiltMount, argument):
            document[key] = float(getattr(mount, argument))
    return (
        '# pose of the pan axis in base_link at pan 0 (the camera then looks along +x), and of '
        'the\n# optical centre from the axis, in metres and radians; sigmas: what the maker of a\n'
        '# simulated robot knows\n'
        + yaml.safe_dump(document, sort_keys=False, default_flow_style=None)
    )


def start_document(pose_map_base: FloatArray) -> str:
    """Text of ``start.json``: pose at the start of a drive."""
    note = 'pose of base_link in map at the start of drive (m, m, rad)'
    pose = [float(value) for value in pose_map_base]
    return json.dumps({'note': note, 'pose': pose}, indent=1) + '\n'


def scene_document(scene: Scene) -> str:
    """
    Text of ``scene.json``: items on the walls, for evaluation only.

    It allows to check which items were learned, above all the specialised target.
    """
    items = [
        {
            'kind': item.kind,
            'wall': scene.room.walls[item.wall].id,
            'center': [round(float(value), 4) for value in item.center(scene.room)],
            'size': [round(item.width_m, 4), round(item.height_m, 4)],
            'seed': item.seed,
        }
        for item in scene.items
    ]
    return json.dumps({'seed': scene.seed, 'items': items}, indent=1) + '\n'


# Standard deviations, metres: of a tape through a room, of a ruler along a wall, of the height of
# a camera above the floor.
_WALL_M = 0.005
_PAPER_M = 0.001
_HEIGHT_M = 0.005
_SAME_CORNER_M = 1e-6
_PARALLEL = 0.1


Sheet = TypeVar('Sheet', Paper, Marker)


def as_measured(
    room: Room, mount: PanTiltMount, rng: np.random.Generator
) -> tuple[Room, PanTiltMount]:
    """
    Room and mount with errors of manual measurement.

    Walls are moved along their normals by `_WALL_M`, with closed corners; papers and markers along
    their walls and vertically by `_PAPER_M`; the mount by `_HEIGHT_M`.
    """
    off = rng.normal(0.0, _WALL_M, len(room.walls))
    ends = np.array([[wall.start, wall.end] for wall in room.walls])
    moved = [
        [_corner(ends, room.normals[:, :2], off, k, side) for side in (0, 1)]
        for k in range(len(off))
    ]
    walls = tuple(
        replace(wall, start=start, end=end)
        for wall, (start, end) in zip(room.walls, moved, strict=True)
    )
    papers = tuple(moved_paper(p, room, rng.normal(0.0, _PAPER_M, 2)) for p in room.papers)
    x, y, z = mount.axis_xyz
    higher = replace(mount, axis_xyz=(x, y, z + float(rng.normal(0.0, _HEIGHT_M))))
    markers = tuple(moved_paper(m, room, rng.normal(0.0, _PAPER_M, 2)) for m in room.markers)
    return replace(room, walls=walls, papers=papers, markers=markers), higher


def moved_paper(paper: Sheet, room: Room, shift_m: FloatArray) -> Sheet:
    """Paper or marker moved along its wall and up by `shift_m` (2,)."""
    wall = room.walls[int(room.nearest_wall(np.array(paper.center[:2])))]
    x, y = paper.center[:2] + shift_m[0] * np.subtract(wall.end, wall.start) / wall.length
    return replace(paper, center=(float(x), float(y), paper.center[2] + float(shift_m[1])))


def _corner(
    ends: FloatArray, normals: FloatArray, off_m: FloatArray, k: int, side: int
) -> tuple[float, float]:
    """Start or end of wall `k` after all walls moved by `off_m` (n,) along their normals."""
    at = ends[k, side]
    shift = off_m[k] * normals[k]
    for j in range(len(ends)):
        both = np.stack([normals[k], normals[j]])
        meets = np.abs(ends[j, 1 - side] - at).max() < _SAME_CORNER_M
        if meets and abs(np.linalg.det(both)) > _PARALLEL:
            shift = np.linalg.solve(both, np.array([off_m[k], off_m[j]]))
    x, y = (at + shift).tolist()
    return x, y
