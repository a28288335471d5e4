"""The landmark map as RViz and Foxglove draw it."""

from __future__ import annotations

from typing import Any

import numpy as np

from landmark_nav.geometry.walls import Wall
from landmark_nav.messages.encode.headers import header, upright, vector
from landmark_nav.messages.factory import MessageFactory
from landmark_nav.types import Landmark, LandmarkMap

__all__ = ['landmark_markers']

# visualization_msgs/Marker constants.
_CUBE, _SPHERE, _LINE_LIST, _TEXT = 1, 2, 5, 9
_DELETE_ALL = 3

_PLATE_RGBA = (0.10, 0.55, 0.35, 0.9)
_UNCERTAINTY_RGBA = (0.95, 0.60, 0.10, 0.4)
_TEXT_RGBA = (1.0, 1.0, 1.0, 1.0)
_WALL_RGBA = (0.55, 0.55, 0.60, 1.0)


def landmark_markers(factory: MessageFactory, landmarks: LandmarkMap, stamp_ns: int) -> Any:
    """Build the visualization_msgs/MarkerArray of a map; it replaces the one before."""
    stamp = header(factory, stamp_ns, landmarks.frame_id)
    markers = [factory('visualization_msgs/msg/Marker', header=stamp, action=_DELETE_ALL)]
    if landmarks.walls:
        markers.append(_walls(factory, stamp, landmarks.walls))
    for landmark in landmarks.landmarks:
        markers.extend(_landmark(factory, stamp, landmark))
    return factory('visualization_msgs/msg/MarkerArray', markers=markers)


def _landmark(factory: MessageFactory, stamp: Any, landmark: Landmark) -> list[Any]:
    """Return the plate on the wall, its 3-sigma ellipsoid, its number."""
    yaw = np.arctan2(landmark.normal[1], landmark.normal[0])
    x, y, z = landmark.position
    variances, axes = np.linalg.eigh(landmark.covariance[:2, :2])
    major = np.arctan2(axes[1, 1], axes[0, 1])
    three_sigma = 6.0 * np.sqrt(np.maximum([*variances[::-1], landmark.covariance[2, 2]], 1e-8))
    plate = (0.01, landmark.width_m, landmark.height_m)
    above = z + 0.5 * landmark.height_m + 0.08

    def marker(namespace: str, kind: int, pose: Any, scale: Any, rgba: Any, text: str = '') -> Any:
        return factory(
            'visualization_msgs/msg/Marker',
            header=stamp,
            ns=namespace,
            id=landmark.id,
            type=kind,
            pose=pose,
            scale=vector(factory, 'Vector3', *scale),
            color=_color(factory, rgba),
            text=text,
        )

    return [
        marker('landmarks', _CUBE, upright(factory, x, y, z, yaw), plate, _PLATE_RGBA),
        marker(
            'uncertainty',
            _SPHERE,
            upright(factory, x, y, z, major),
            three_sigma,
            _UNCERTAINTY_RGBA,
        ),
        marker(
            'numbers',
            _TEXT,
            upright(factory, x, y, above, 0.0),
            (0.0, 0.0, 0.12),
            _TEXT_RGBA,
            str(landmark.id),
        ),
    ]


def _walls(factory: MessageFactory, stamp: Any, walls: tuple[Wall, ...]) -> Any:
    """Return the edges of all walls as lines."""
    ends = []
    for wall in walls:
        low = [(*wall.start, 0.0), (*wall.end, 0.0)]
        high = [(*wall.start, wall.height), (*wall.end, wall.height)]
        ends.extend([*low, *high, low[0], high[0]])
    return factory(
        'visualization_msgs/msg/Marker',
        header=stamp,
        ns='walls',
        type=_LINE_LIST,
        pose=upright(factory, 0.0, 0.0, 0.0, 0.0),
        scale=vector(factory, 'Vector3', 0.02, 0.0),
        color=_color(factory, _WALL_RGBA),
        points=[vector(factory, 'Point', *end) for end in ends],
    )


def _color(factory: MessageFactory, rgba: tuple[float, float, float, float]) -> Any:
    red, green, blue, alpha = rgba
    return factory('std_msgs/msg/ColorRGBA', r=red, g=green, b=blue, a=alpha)
