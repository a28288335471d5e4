"""`room.yaml` and `robot.yaml`: read, checked, with messages that name file and field."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Paper, Room, Wall

__all__ = ['load_robot', 'load_room', 'read_yaml_mapping']


def read_yaml_mapping(path: Path) -> dict[str, Any]:
    """Top-level mapping of a YAML file; `LandmarkNavError` if there is none."""
    try:
        text = path.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise LandmarkNavError(f'{path}: cannot be read: {error}') from error
    try:
        document = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise LandmarkNavError(f'{path}: not YAML: {" ".join(str(error).split())}') from error
    if not isinstance(document, dict):
        raise LandmarkNavError(f'{path}: holds no mapping')
    return document


def load_room(path: Path | str) -> Room:
    """
    Read the walls and the papers of the reference area.

    Raises
    ------
    LandmarkNavError
        Missing or malformed fields; walls that are open or cross.

    """
    path = Path(path)
    document = read_yaml_mapping(path)
    try:
        walls = tuple(
            Wall(
                str(_get(wall, 'id', f'walls[{i}]')),
                _numbers(wall, 'start', 2, f'walls[{i}]'),
                _numbers(wall, 'end', 2, f'walls[{i}]'),
                _number(wall, 'height', f'walls[{i}]'),
            )
            for i, wall in enumerate(_list(document, 'walls'))
        )
        area = document.get('reference_area') or {}
        papers = tuple(
            Paper(
                str(_get(paper, 'color', f'papers[{i}]')),
                _numbers(paper, 'center', 3, f'papers[{i}]'),
                _number(paper, 'width', f'papers[{i}]'),
                _number(paper, 'height', f'papers[{i}]'),
            )
            for i, paper in enumerate(_list(area, 'papers') if area else [])
        )
        return Room(walls, papers, str(document.get('frame_id', 'map')))
    except LandmarkNavError as error:
        raise LandmarkNavError(f'{path}: {error}') from error


def load_robot(path: Path | str) -> PanTiltMount:
    """
    Read where the turning camera sits on the robot.

    Raises
    ------
    LandmarkNavError
        Missing or malformed fields.

    """
    path = Path(path)
    document = read_yaml_mapping(path)
    try:
        axis = _get(document, 'pan_axis', 'robot')
        offset = (
            _numbers(document, 'optical_center_offset', 3, 'robot')
            if 'optical_center_offset' in document
            else (0.0, 0.0, 0.0)
        )
        return PanTiltMount(
            axis_xyz=_numbers(axis, 'xyz', 3, 'pan_axis'),
            axis_rpy=_numbers(axis, 'rpy', 3, 'pan_axis') if 'rpy' in axis else (0.0, 0.0, 0.0),
            optical_center_offset=offset,
            base_frame=str(document.get('base_frame', 'base_link')),
            pan_joint=str(document.get('pan_joint', 'pan_joint')),
            tilt_joint=str(document.get('tilt_joint', 'tilt_joint')),
        )
    except LandmarkNavError as error:
        raise LandmarkNavError(f'{path}: {error}') from error


def _get(mapping: Any, key: str, where: str) -> Any:
    if not isinstance(mapping, Mapping) or key not in mapping:
        raise LandmarkNavError(f'{where}: {key} is missing')
    return mapping[key]


def _list(mapping: Any, key: str) -> list[Any]:
    value = _get(mapping, key, 'file')
    if not isinstance(value, list):
        raise LandmarkNavError(f'{key} is not a list')
    return value


def _number(mapping: Any, key: str, where: str) -> float:
    value = _get(mapping, key, where)
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise LandmarkNavError(f'{where}: {key} is {value!r}, not a number')
    return float(value)


def _numbers(mapping: Any, key: str, count: int, where: str) -> Any:
    value = _get(mapping, key, where)
    if not isinstance(value, list) or len(value) != count:
        raise LandmarkNavError(f'{where}: {key} is {value!r}, not a list of {count} numbers')
    return tuple(_number({key: item}, key, where) for item in value)
