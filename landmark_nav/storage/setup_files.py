"""Checked reading of rooms, robots and camera calibrations; errors name file and field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from landmark_nav.errors import inside, LandmarkNavError, shown
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.walls import (
    Marker,
    marker_count,
    Paper,
    paper_bgr,
    Room,
    Wall,
)
from landmark_nav.storage import reading
from landmark_nav.storage.urdf import robot_of_urdf

# Greatest distance of a paper from its wall, apart from the error of the wall. Walls and papers
# are measured to a few centimetres, and papers may hang on a frame.
_MAX_OFF_WALL_M = 0.1
# Number of sigmas of the wall that are added to this distance.
_OFF_WALL_SIGMAS = 3.0

# Bounds of the time of checks, in which each wall is compared with each other one.
_MAX_WALLS, _MAX_PAPERS = 1000, 100

# Greatest length and height of a wall, and greatest coordinate of the mount; larger values are
# given in another unit.
_MAX_WALL_M, _MAX_HEIGHT_M, _MAX_MOUNT_M = 1000.0, 50.0, 10.0
# Least and greatest side of a paper or marker.
_SHEET_M = 0.01, 5.0
# Greatest sigma of a wall; a less certain one gives no information.
_MAX_WALL_SIGMA_M = 1.0
# Sigma of a wall that is given as exact.
_EXACT_WALL_M = 1e-4

# Greatest angle: half a turn, rounded up. Larger ones are given in degrees.
_HALF_TURN_RAD = 3.15

# Field -> argument of a mount, range and unit. A joint may make a full turn to both sides; rates
# and accelerations beyond the range are given in another unit. Images are never early.
MOUNT_FIELDS = {
    'pan_min': ('pan_min_rad', -6.2832, 6.2832, 'radians'),
    'pan_max': ('pan_max_rad', -6.2832, 6.2832, 'radians'),
    'pan_rate': ('pan_rate_rad_s', 0.01, 100.0, 'radians a second'),
    'pan_acceleration': ('pan_acceleration_rad_s2', 0.01, 1e4, 'radians a second, each second'),
    'image_delay': ('image_delay_s', 0.0, 1.0, 'seconds'),
}

# Greatest sigma of the pan; a less certain one gives no information.
_RANGES = MOUNT_FIELDS | {'pan_sigma': ('pan_sigma_rad', 0.0, 0.1, 'radians')}

_URDF = '.urdf'
# Frames of REP-105 that are not fixed in a room.
_MOVING_FRAMES = ('odom', 'base_link', 'base_footprint')

ROBOT_FIELDS = (
    *('base_frame', 'pan_joint', 'tilt_joint'),
    *('pan_axis', 'optical_center_offset', 'camera_roll', 'pan_sigma'),
    # Fields that `robot_files` reads.
    *('optical_center_offset_sigma', 'camera_roll_sigma', 'camera_tilt', 'camera_tilt_sigma'),
    *('pan_scale', 'pan_scale_sigma', 'focal_scale', 'focal_scale_sigma', 'principal_point'),
    *('principal_point_sigma', 'distortion', 'distortion_sigma'),
    *('joint_delay', 'joint_delay_sigma', 'row_delay', 'row_delay_sigma', 'correlations'),
    *('odometry', *MOUNT_FIELDS),
)
_AXIS_FIELDS = ('xyz', 'rpy', 'xyz_sigma', 'rpy_sigma')


def load_room(path: Path | str) -> Room:
    """
    Read the walls and the papers of the reference area.

    Raises `LandmarkNavError`: a field is missing or malformed; walls are open or cross; a paper
    hangs on no wall.
    """
    path = Path(path)
    document = reading.read_yaml_mapping(path)
    with inside(path):
        reading.check_spelling(document, ('frame_id', 'walls', 'reference_area'), 'room')
        walls = walls_field(document, 'room')
        papers, markers, dictionary = _reference_area(document.get('reference_area') or {})
        for wall in walls:
            for size, most, what in (
                (wall.length, _MAX_WALL_M, 'long'),
                (wall.height, _MAX_HEIGHT_M, 'high'),
            ):
                if size > most:
                    where = f'wall {wall.id} is {size:g} m {what}'
                    raise LandmarkNavError(f'{where}: lengths are metres')
        frame_id = reading.name_field(document, 'frame_id', 'room', 'map')
        room = Room(walls, papers, frame_id, markers, dictionary)
        if room.frame_id in _MOVING_FRAMES:
            raise LandmarkNavError(f'frame_id is {room.frame_id}, which the robot moves: take map')
        for i, paper in enumerate(papers):
            _check_on_wall(paper.center, room, f'papers[{i}] ({paper.color})')
        for i, marker in enumerate(markers):
            _check_on_wall(marker.center, room, f'markers[{i}] (number {marker.number})')
        return room


def walls_field(mapping: Any, where: str) -> tuple[Wall, ...]:
    """Walls of a room or a map."""
    return tuple(
        wall_of(entry, f'{where}: walls[{k}]')
        for k, entry in enumerate(reading.list_field(mapping, 'walls', where, _MAX_WALLS))
    )


def wall_of(entry: Any, where: str) -> Wall:
    """Wall of an entry of a room or a map."""
    sigma = None
    if isinstance(entry, dict):
        reading.check_spelling(entry, ('id', 'start', 'end', 'height', 'sigma_m'), where)
        sigma = reading.number_field(entry, 'sigma_m', where) if 'sigma_m' in entry else None
    if sigma is not None and not 0.0 <= sigma <= _MAX_WALL_SIGMA_M:
        how = f'take 0 to {_MAX_WALL_SIGMA_M:g} m'
        raise LandmarkNavError(f'{where}: sigma_m is {sigma:g}: {how}')
    return Wall(
        reading.name_field(entry, 'id', where),
        _point(entry, 'start', 2, where),
        _point(entry, 'end', 2, where),
        reading.number_field(entry, 'height', where),
        # 0 is a promise.
        sigma if sigma is None else max(sigma, _EXACT_WALL_M),
    )


def wall_entry(wall: Wall) -> dict[str, Any]:
    """Entry of a wall in a room or a map."""
    start, end = ([float(value) for value in point] for point in (wall.start, wall.end))
    entry = {'id': wall.id, 'start': start, 'end': end, 'height': float(wall.height)}
    return entry if wall.sigma_m is None else {**entry, 'sigma_m': float(wall.sigma_m)}


def room_text(room: Room) -> str:
    """Text of the `room.yaml` of a room."""
    document: dict[str, Any] = {
        'frame_id': room.frame_id,
        'walls': [wall_entry(wall) for wall in room.walls],
    }
    area: dict[str, Any] = {}
    for name, sheets in (('papers', room.papers), ('markers', room.markers)):
        if sheets:
            area[name] = [{**asdict(sheet), 'center': list(sheet.center)} for sheet in sheets]
    if room.markers:
        area['marker_dictionary'] = room.marker_dictionary
    if area:
        document['reference_area'] = area
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None)


def _reference_area(area: Any) -> tuple[tuple[Paper, ...], tuple[Marker, ...], str]:
    """Papers, markers and the dictionary of these, which a mapping may have."""
    where, default = 'reference_area', Room.marker_dictionary
    if not area:
        return (), (), default
    if not isinstance(area, dict):
        raise LandmarkNavError(f'{where} is {shown(area)}, not a mapping')
    reading.check_spelling(area, ('papers', 'markers', 'marker_dictionary'), where)
    # A reference area without markers has papers.
    known = [key for key in ('papers', 'markers') if key in area] or ['papers']
    dictionary = reading.name_field(area, 'marker_dictionary', where, default)
    last = marker_count(dictionary) - 1
    hung = {key: reading.list_field(area, key, where, _MAX_PAPERS) for key in known}
    papers = tuple(_paper(k, f'papers[{i}]') for i, k in enumerate(hung.get('papers', [])))
    markers = tuple(_marker(k, f'markers[{i}]') for i, k in enumerate(hung.get('markers', [])))
    numbers = [marker.number for marker in markers]
    if len({*numbers}) < len(numbers):
        twice = max(numbers, key=numbers.count)
        raise LandmarkNavError(f'{where}: marker {twice} is there twice: hang each number once')
    for i, number in enumerate(numbers):
        if number > last:
            how = f'{dictionary} has 0 to {last}: give another number, or its marker_dictionary'
            raise LandmarkNavError(f'markers[{i}]: number is {number}: {how}')
    return papers, markers, dictionary


def _marker(document: Any, where: str) -> Marker:
    """Marker of an entry, with a plausible size."""
    number = reading.integer_field(document, 'number', where)
    size = reading.number_field(document, 'size', where)
    if not _SHEET_M[0] <= size <= _SHEET_M[1]:
        raise LandmarkNavError(f'{where}: {size:g} m is no size of a marker: lengths are metres')
    return Marker(number, _point(document, 'center', 3, where), size)


def _paper(document: Any, where: str) -> Paper:
    """Paper of an entry, with a known colour and a plausible size."""
    color = reading.name_field(document, 'color', where)
    with inside(where):
        paper_bgr(color)
    width, height = (reading.number_field(document, key, where) for key in ('width', 'height'))
    if not (_SHEET_M[0] <= min(width, height) and max(width, height) <= _SHEET_M[1]):
        size = f'{width:g} x {height:g} m is no size of a paper'
        raise LandmarkNavError(f'{where}: {size}: lengths are metres')
    return Paper(color, _point(document, 'center', 3, where), width, height)


def _check_on_wall(center: tuple[float, float, float], room: Room, what: str) -> None:
    x, y, z = center
    aside = room.wall_distances([x, y])
    wall = room.walls[int(np.argmin(aside))]
    off = float(np.hypot(aside.min(), max(-z, z - wall.height, 0.0)))
    if off > _MAX_OFF_WALL_M + _OFF_WALL_SIGMAS * (wall.sigma_m or 0.0):
        raise LandmarkNavError(
            f'{what} is {100.0 * off:.0f} cm from its nearest wall, {wall.id}: measure both again'
        )


def read_robot(path: Path, former: Mapping[str, Any]) -> dict[str, Any]:
    """
    Content of `robot.yaml`, or of a URDF, completed by `former` parameters for absent fields.

    A path ``FILE.urdf:FRAME`` names the optical frame of the camera.
    """
    name, _, camera_frame = path.name.partition(f'{_URDF}:')
    if camera_frame or path.suffix == _URDF:
        file = path.with_name(f'{name}{_URDF}') if camera_frame else path
        text = reading.read_text(file)
        with inside(file):
            document = robot_of_urdf(text, camera_frame)
        # Limits that mean none, as of a simulator, are left out.
        for key in document.keys() & MOUNT_FIELDS.keys():
            _, low, high, _ = MOUNT_FIELDS[key]
            if not low <= document[key] <= high:
                del document[key]
    else:
        document = reading.read_yaml_mapping(path)
    for key, value in former.items():
        own = document.get(key, {} if isinstance(value, Mapping) else value)
        document[key] = {**value, **own} if isinstance(own, dict) else own
    return document


def load_robot(path: Path | str, former: Mapping[str, Any] | None = None) -> PanTiltMount:
    """
    Read the extrinsics of the camera on the robot, and the limits of its pan joint.

    `former` are fields given by parameters of the last release; the file takes precedence.

    Raises `LandmarkNavError`: a field is missing or malformed.
    """
    path = Path(path)
    return mount_of(read_robot(path, former or {}), path)


def mount_of(document: dict[str, Any], path: Path) -> PanTiltMount:
    """Mount of the content of the `robot.yaml` at `path`; errors as those of `load_robot`."""
    with inside(path):
        reading.check_spelling(document, ROBOT_FIELDS, 'robot')
        axis = reading.field(document, 'pan_axis', 'robot')
        if isinstance(axis, dict):
            reading.check_spelling(axis, _AXIS_FIELDS, 'pan_axis')
        offset = (
            _point(document, 'optical_center_offset', 3, 'robot')
            if 'optical_center_offset' in document
            else (0.0, 0.0, 0.0)
        )
        place = _point(axis, 'xyz', 3, 'pan_axis')
        for name, xyz in (('pan_axis: xyz', place), ('optical_center_offset', offset)):
            if max(map(abs, xyz)) > _MAX_MOUNT_M:
                raise LandmarkNavError(f'{name} is {list(xyz)}: lengths are metres')
        pan, tilt = (
            reading.name_field(document, name, 'robot', name)
            for name in ('pan_joint', 'tilt_joint')
        )
        if pan == tilt:
            raise LandmarkNavError(f'robot: pan_joint and tilt_joint are both {pan}: rename one')
        return PanTiltMount(
            axis_xyz=place,
            axis_rpy=_angles(axis, 'rpy', (3,), 'pan_axis') if 'rpy' in axis else (0.0, 0.0, 0.0),
            optical_center_offset=offset,
            camera_roll_rad=_angles({'camera_roll': 0.0, **document}, 'camera_roll', (), 'robot'),
            base_frame=reading.name_field(document, 'base_frame', 'robot', 'base_link'),
            pan_joint=pan,
            tilt_joint=tilt,
            **{
                argument: _within(document, key, low, high, unit)
                for key, (argument, low, high, unit) in _RANGES.items()
                if key in document
            },
        )


def _within(document: dict[str, Any], key: str, low: float, high: float, unit: str) -> float:
    value = reading.number_field(document, key, 'robot')
    if not low <= value <= high:
        how = f'take {low:g} to {high:g}; it is in {unit}'
        raise LandmarkNavError(f'robot: {key} is {value:g}: {how}')
    return value


def load_camera(path: Path | str) -> CameraModel:
    """
    Read the intrinsics of a camera in the format of ROS (camera_calibration, camera_info_manager).

    Raises `LandmarkNavError`: a field is missing or malformed, or the distortion model is not
    supported.
    """
    path = Path(path)
    document = reading.read_yaml_mapping(path)
    with inside(path):
        width = reading.integer_field(document, 'image_width', 'camera')
        height = reading.integer_field(document, 'image_height', 'camera')
        matrix = reading.field(document, 'camera_matrix', 'camera')
        fx, _, cx, _, fy, cy, *_ = reading.array_field(
            matrix, 'data', (9,), 'camera_matrix'
        ).tolist()
        lens = reading.field(document, 'distortion_coefficients', 'camera')
        # Trailing zeros are removed as in a camera_info, so that models of one camera are equal.
        coefficients = np.trim_zeros(
            reading.array_field(lens, 'data', (None,), 'distortion_coefficients'), 'b'
        ).tolist()
        model = reading.name_field(document, 'distortion_model', 'camera')
        return CameraModel(width, height, fx, fy, cx, cy, model, tuple(coefficients))


def _angles(mapping: Any, key: str, shape: tuple[int, ...], where: str) -> Any:
    angles = reading.array_field(mapping, key, shape, where)
    if np.any(np.abs(angles) > _HALF_TURN_RAD):
        raise LandmarkNavError(
            f'{where}: {key} is {shown(mapping[key])}, more than half a turn: '
            'give it in radians, within +-pi'
        )
    return tuple(angles.tolist()) if shape else float(angles)


def _point(mapping: Any, key: str, size: int, where: str) -> Any:
    return tuple(reading.array_field(mapping, key, (size,), where).tolist())
