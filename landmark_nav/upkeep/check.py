"""Plausibility check of a map: landmarks on their walls, valid covariances."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.patches import patch_axes
from landmark_nav.geometry.walls import Room, Wall
from landmark_nav.types import Landmark, LandmarkMap

# Greatest distance of a patch from the plane of its wall, to both sides, and beyond its ends.
_OFF_WALL_M = 0.1
# Greatest angle between the normals of a patch and its wall.
_MAX_TURN_RAD = np.radians(5.0)
# Greatest sigma of a landmark, and least sigma of the grey levels of a patch.
_MAX_SIGMA_M = 0.5
_MIN_CONTRAST = 2.0
# Greatest difference of the logarithms of width and height of a texel.
_MAX_SQUEEZE = 0.1
_LEAST_LANDMARKS = 3


def problems_of_map(landmarks: LandmarkMap) -> list[str]:
    """List implausible or unusable contents of a map, a line with the id of the landmark each."""
    problems = list(_problems_of_room(landmarks))
    walls = {wall.id: wall for wall in landmarks.walls}
    for k in landmarks.landmarks:
        problems += [f'landmark {k.id}: {text}' for text in _problems_of_landmark(k)]
        if k.wall_id in walls:
            problems += [
                f'landmark {k.id}: {text}' for text in _problems_on_wall(k, walls[k.wall_id])
            ]
        elif walls and k.wall_id:
            problems.append(f'landmark {k.id}: its wall {k.wall_id!r} is not in the map')
    return problems


def _problems_of_room(landmarks: LandmarkMap) -> Iterator[str]:
    count = len(landmarks.landmarks)
    if count < _LEAST_LANDMARKS:
        yield f'{count} landmarks: a pose needs {_LEAST_LANDMARKS}'
    if not landmarks.walls:
        return  # a map of surveyed beacons has no walls
    try:
        room = Room(landmarks.walls)
    except LandmarkNavError as error:
        yield str(error)
        return
    for place in landmarks.panorama_poses:
        if not room.contains(place.pose[:2]):
            yield f'panorama at ({place.pose[0]:.2f}, {place.pose[1]:.2f}) m is not in the room'


def _problems_of_landmark(k: Landmark) -> Iterator[str]:
    eigenvalues = np.linalg.eigvalsh(k.covariance)
    if eigenvalues[-1] > _MAX_SIGMA_M**2:
        yield f'standard deviation of {np.sqrt(eigenvalues[-1]):.2f} m: of no use'
    if eigenvalues[0] <= 0.0 and k.wall_id:
        yield 'its covariance is singular: no estimate is free of errors'
    if not k.patch.size:
        return
    if not 0.0 < k.threshold < 1.0:
        yield f'threshold is {k.threshold:g}: a correlation lies between 0 and 1'
    if float(np.std(k.patch)) < _MIN_CONTRAST:
        yield f'its patch is blank (standard deviation of {np.std(k.patch):.1f} grey levels)'
    rows, columns = k.patch.shape
    squeeze = (k.width_m / columns) / (k.height_m / rows)
    if abs(np.log(squeeze)) > _MAX_SQUEEZE:
        yield (
            f'{k.width_m:.2f} x {k.height_m:.2f} m do not fit a patch of {columns} x {rows} texels'
        )
    viewpoints = np.array([k.viewpoint, *(view.viewpoint for view in k.views)])
    if np.any((viewpoints - k.position) @ k.normal <= 0.0):
        yield 'was learned from behind its wall'


def _problems_on_wall(k: Landmark, wall: Wall) -> Iterator[str]:
    turn = np.arccos(np.clip(k.normal @ wall.normal, -1.0, 1.0))
    if turn > _MAX_TURN_RAD:
        yield f'is turned by {np.degrees(turn):.1f} deg from wall {wall.id}'
    offset = k.position - np.array([*wall.start, 0.0])
    height = float(offset @ wall.normal)
    if abs(height) > _OFF_WALL_M:
        yield f'is {100 * height:.1f} cm off the plane of wall {wall.id}'
    right, _ = patch_axes(wall.normal)
    along = -float(offset @ right)  # `right` points from the end of the wall to its start
    if not -_OFF_WALL_M < along < wall.length + _OFF_WALL_M:
        yield f'lies {along:.2f} m along wall {wall.id}, which is {wall.length:.2f} m long'
    if not 0.0 <= k.position[2] <= wall.height:
        yield f'is {k.position[2]:.2f} m high on wall {wall.id} of {wall.height:.2f} m'
