"""Checked reading of rooms and camera calibrations; errors name file and field."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from landmark_nav.errors import inside, LandmarkNavError
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.geometry.walls import Marker, marker_count, Paper, paper_bgr, Room, Wall
from landmark_nav.storage.reading import Entry, read_yaml_mapping

# Greatest distance of a paper from its wall, apart from the error of the wall. Walls and papers
# are measured to a few centimetres, and papers may hang on a frame.
_MAX_OFF_WALL_M = 0.1
# Number of sigmas of the wall that are added to this distance.
_OFF_WALL_SIGMAS = 3.0

# Bounds of the time of checks, in which each wall is compared with each other one.
_MAX_WALLS, _MAX_PAPERS = 1000, 100

# Greatest length and height of a wall; larger values are given in another unit.
_MAX_WALL_M, _MAX_HEIGHT_M = 1000.0, 50.0
# Least and greatest side of a paper or marker.
_SHEET_M = 0.01, 5.0
# Greatest sigma of a wall; a less certain one gives no information.
_MAX_WALL_SIGMA_M = 1.0
# Sigma of a wall that is given as exact.
_EXACT_WALL_M = 1e-4
_METRES = 'lengths are metres'
# Fields of sheets.
_SHEET_FIELDS = {
    'papers': ('color', 'center', 'width', 'height'),
    'markers': ('number', 'center', 'size'),
}

# Frames of REP-105 that are not fixed in a room.
_MOVING_FRAMES = ('odom', 'base_link', 'base_footprint')


def load_room(path: Path | str) -> Room:
    """
    Read the walls and the papers of the reference area.

    Raises `LandmarkNavError`: a field is missing or malformed; walls are open or cross; a paper
    hangs on no wall.
    """
    path = Path(path)
    document = read_yaml_mapping(path, 'room')
    with inside(path):
        entry = Entry(document, 'room', ('frame_id', 'walls', 'reference_area'))
        walls = walls_of(entry)
        papers, markers, dictionary = _reference_area(document.get('reference_area') or {})
        for wall in walls:
            for size, most, what in (
                (wall.length, _MAX_WALL_M, 'long'),
                (wall.height, _MAX_HEIGHT_M, 'high'),
            ):
                if size > most:
                    raise LandmarkNavError(f'wall {wall.id} is {size:g} m {what}: {_METRES}')
        room = Room(walls, papers, entry.name('frame_id', 'map'), markers, dictionary)
        if room.frame_id in _MOVING_FRAMES:
            raise LandmarkNavError(f'frame_id is {room.frame_id}, which the robot moves: take map')
        for i, paper in enumerate(papers):
            _check_on_wall(paper.center, room, f'papers[{i}] ({paper.color})')
        for i, marker in enumerate(markers):
            _check_on_wall(marker.center, room, f'markers[{i}] (number {marker.number})')
        return room


def walls_of(entry: Entry) -> tuple[Wall, ...]:
    """Walls of a room or a map."""
    known = ('id', 'start', 'end', 'height', 'sigma_m')
    return tuple(_wall(wall) for wall in entry.entries('walls', known, _MAX_WALLS))


def _wall(entry: Entry) -> Wall:
    sigma = None
    if 'sigma_m' in entry:
        how = f'take 0 to {_MAX_WALL_SIGMA_M:g} m'
        # 0 is a promise.
        sigma = max(entry.number('sigma_m', 0.0, _MAX_WALL_SIGMA_M, how), _EXACT_WALL_M)
    start, end = (_point(entry, key, 2) for key in ('start', 'end'))
    return Wall(entry.name('id'), start, end, entry.number('height'), sigma)


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


def _reference_area(document: Any) -> tuple[tuple[Paper, ...], tuple[Marker, ...], str]:
    """Papers, markers and the dictionary of these, which a mapping may have."""
    where, default = 'reference_area', Room.marker_dictionary
    if not document:
        return (), (), default
    area = Entry(document, where, ('papers', 'markers', 'marker_dictionary'))
    # A reference area without markers has papers.
    known = [key for key in ('papers', 'markers') if key in area] or ['papers']
    dictionary = area.name('marker_dictionary', default)
    last = marker_count(dictionary) - 1
    how = f'{dictionary} has 0 to {last}: give another number, or its marker_dictionary'
    hung = {key: area.entries(key, _SHEET_FIELDS[key], _MAX_PAPERS) for key in known}
    papers = tuple(map(_paper, hung.get('papers', ())))
    markers = tuple(_marker(entry, last, how) for entry in hung.get('markers', ()))
    numbers = [marker.number for marker in markers]
    if len({*numbers}) < len(numbers):
        twice = max(numbers, key=numbers.count)
        raise area.refused(f'marker {twice} is there twice: hang each number once')
    return papers, markers, dictionary


def _marker(entry: Entry, last: int, how: str) -> Marker:
    """Marker of an entry, with a plausible size and a number up to `last`."""
    number, size = entry.integer('number'), entry.number('size')
    if number > last:
        raise entry.refused(f'number is {number}: {how}')
    if not _SHEET_M[0] <= size <= _SHEET_M[1]:
        raise entry.refused(f'{size:g} m is no size of a marker: {_METRES}')
    return Marker(number, _point(entry, 'center', 3), size)


def _paper(entry: Entry) -> Paper:
    """Paper of an entry, with a known colour and a plausible size."""
    color = entry.name('color')
    with inside(entry.where):
        paper_bgr(color)
    width, height = (entry.number(key) for key in ('width', 'height'))
    if not (_SHEET_M[0] <= min(width, height) and max(width, height) <= _SHEET_M[1]):
        raise entry.refused(f'{width:g} x {height:g} m is no size of a paper: {_METRES}')
    return Paper(color, _point(entry, 'center', 3), width, height)


def _check_on_wall(center: tuple[float, float, float], room: Room, what: str) -> None:
    x, y, z = center
    aside = room.wall_distances([x, y])
    wall = room.walls[int(np.argmin(aside))]
    off = float(np.hypot(aside.min(), max(-z, z - wall.height, 0.0)))
    if off > _MAX_OFF_WALL_M + _OFF_WALL_SIGMAS * (wall.sigma_m or 0.0):
        raise LandmarkNavError(
            f'{what} is {100.0 * off:.0f} cm from its nearest wall, {wall.id}: measure both again'
        )


def load_camera(path: Path | str) -> CameraModel:
    """
    Read the intrinsics of a camera in the format of ROS (camera_calibration, camera_info_manager).

    Raises `LandmarkNavError`: a field is missing or malformed, or the distortion model is not
    supported.
    """
    path = Path(path)
    camera = Entry(read_yaml_mapping(path), 'camera')
    with inside(path):
        width, height = (camera.integer(f'image_{side}') for side in ('width', 'height'))
        matrix, lens = map(camera.section, ('camera_matrix', 'distortion_coefficients'))
        fx, _, cx, _, fy, cy, *_ = matrix.array('data', (9,)).tolist()
        # Trailing zeros are removed as in a camera_info, so that models of one camera are equal.
        coefficients = np.trim_zeros(lens.array('data', (None,)), 'b').tolist()
        model = camera.name('distortion_model')
        return CameraModel(width, height, fx, fy, cx, cy, model, tuple(coefficients))


def _point(entry: Entry, key: str, size: int) -> Any:
    return tuple(entry.array(key, (size,)).tolist())
