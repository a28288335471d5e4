"""
The map folder: ``map.yaml`` and ``patches/NNN.png``, to be read, diffed and kept in git.

What other panoramas show of landmark NNN is in ``views/NNN_1.png`` and on.

Numbers are written with as many digits as it takes to read the same ones back.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.patches import PatchView
from landmark_nav.geometry.walls import Wall
from landmark_nav.storage.fields import (
    array_field,
    covariance_field,
    field,
    integer_field,
    list_field,
    number_field,
)
from landmark_nav.storage.setup_files import read_yaml_mapping
from landmark_nav.storage.whole import left_over, whole_folder
from landmark_nav.types import (
    FloatArray,
    ImageArray,
    Landmark,
    LandmarkMap,
    PoseEstimate,
)

__all__ = ['MAP_DATA', 'MAP_FILES', 'SCHEMA_VERSION', 'load_map', 'save_map', 'write_map']

SCHEMA_VERSION = 1

# What this package writes into a map folder, for `whole_folder`: the map, and figures of it.
MAP_DATA = ('map.yaml', 'patches', 'views')
MAP_FILES = (*MAP_DATA, 'map.png', 'panorama_*.png')

# Of a landmark of size 0 x 0: a point that has a bearing but no texture.
_NO_PATCH: ImageArray = np.zeros((0, 0), dtype=np.uint8)


class _Dumper(yaml.SafeDumper):
    """Lists of numbers in one line, all else in block style."""


def _represent_list(dumper: yaml.SafeDumper, values: list[Any]) -> yaml.Node:
    flow = all(isinstance(value, int | float) for value in values)
    return dumper.represent_sequence('tag:yaml.org,2002:seq', values, flow_style=flow)


_Dumper.add_representer(list, _represent_list)


def save_map(landmarks: LandmarkMap, folder: Path | str) -> None:
    """
    Write a map folder whole or not at all; one that is there is replaced.

    Raises
    ------
    LandmarkNavError
        `folder` holds something else, or cannot be written.

    """
    with whole_folder(Path(folder), MAP_FILES) as growing:
        write_map(landmarks, growing)


def write_map(landmarks: LandmarkMap, folder: Path) -> None:
    """Write the files of a map into a folder that is there."""
    document = {
        'schema_version': SCHEMA_VERSION,
        'frame_id': landmarks.frame_id,
        'provenance': dict(landmarks.provenance),
        'walls': [
            {
                'id': wall.id,
                'start': _listed(wall.start),
                'end': _listed(wall.end),
                'height': float(wall.height),
            }
            for wall in landmarks.walls
        ],
        'panorama_poses': [
            {
                'stamp_ns': int(place.stamp_ns),
                'pose': _listed(place.pose),
                'covariance': _listed(place.covariance),
            }
            for place in landmarks.panorama_poses
        ],
        'landmarks': [_described(landmark) for landmark in landmarks.landmarks],
    }
    text = yaml.dump(document, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=1000)
    (folder / 'map.yaml').write_text(text, encoding='utf-8')
    pictures = {
        _patch_name(k.id): k.patch
        for k in landmarks.landmarks
        if k.width_m or k.height_m  # not of a point, such as a surveyed beacon
    }
    for k in landmarks.landmarks:
        pictures |= {_view_name(k.id, n): view.patch for n, view in enumerate(k.views)}
    for kind in ('patches', 'views'):
        (folder / kind).mkdir()
    for name, picture in pictures.items():
        if not cv2.imwrite(str(folder / name), picture):
            raise OSError(f'{folder / name} cannot be written')


def load_map(folder: Path | str) -> LandmarkMap:
    """
    Read a map folder.

    Raises
    ------
    LandmarkNavError
        No map there, another schema version, or anything in it that cannot be.

    """
    folder = Path(folder)
    path = folder / 'map.yaml'
    if not path.is_file():
        raise LandmarkNavError(f'{folder}: {_no_map(folder)}')
    document = read_yaml_mapping(path)
    _check_version(document, path)
    where = str(path)
    entries = list_field(document, 'landmarks', where)
    landmarks = tuple(
        _landmark(e, folder, f'{path}: landmarks[{k}]') for k, e in enumerate(entries)
    )
    ids = [landmark.id for landmark in landmarks]
    doubled = sorted({k for k in ids if ids.count(k) > 1})
    if doubled:
        raise LandmarkNavError(f'{path}: landmark id {doubled[0]} is there twice: rename one')
    if len({landmark.shared_loading.shape for landmark in landmarks}) > 1:
        raise LandmarkNavError(f'{path}: shared_loading must have as many columns everywhere')
    provenance = document.get('provenance') or {}
    if not isinstance(provenance, dict):
        raise LandmarkNavError(f'{path}: provenance is {provenance!r}, not a mapping')
    return LandmarkMap(
        landmarks,
        str(field(document, 'frame_id', where)),
        tuple(
            _wall(entry, f'{path}: walls[{k}]')
            for k, entry in enumerate(list_field(document, 'walls', where))
        ),
        tuple(
            PoseEstimate(
                integer_field(entry, 'stamp_ns', f'{path}: panorama_poses[{k}]'),
                array_field(entry, 'pose', (3,), f'{path}: panorama_poses[{k}]'),
                covariance_field(entry, 'covariance', 3, f'{path}: panorama_poses[{k}]'),
            )
            for k, entry in enumerate(list_field(document, 'panorama_poses', where))
        ),
        {str(key): str(value) for key, value in provenance.items()},
    )


def _no_map(folder: Path) -> str:
    if folder.is_file():
        return f'is a file: a map is a folder, {folder.parent} perhaps'
    left = left_over(folder)
    if left is not None:
        return f'no map there: it was being replaced when that was ended; rename {left} to it'
    return 'no map there (no map.yaml): make one with `landmark-nav learn`'


def _check_version(document: dict[str, Any], path: Path) -> None:
    version = field(document, 'schema_version', str(path))
    if version == SCHEMA_VERSION:
        return
    newer = isinstance(version, int) and version > SCHEMA_VERSION
    remedy = 'update landmark_nav' if newer else 'learn the map again with `landmark-nav learn`'
    raise LandmarkNavError(
        f'{path}: schema version {version!r}, this landmark_nav reads {SCHEMA_VERSION}: {remedy}'
    )


def _listed(values: Any) -> list[Any]:
    """Plain numbers, nested as the array is."""
    listed: list[Any] = np.asarray(values, dtype=np.float64).tolist()
    return listed


def _patch_name(identity: int) -> str:
    return f'patches/{identity:03d}.png'


def _view_name(identity: int, number: int) -> str:
    """Of what another panorama shows of it; the file counts from 1."""
    return f'views/{identity:03d}_{number + 1}.png'


def _described(landmark: Landmark) -> dict[str, Any]:
    views = [_listed(view.viewpoint) for view in landmark.views]
    return {
        'id': int(landmark.id),
        'wall': landmark.wall_id,
        'position': _listed(landmark.position),
        'normal': _listed(landmark.normal),
        'size': [float(landmark.width_m), float(landmark.height_m)],
        'viewpoint': _listed(landmark.viewpoint),
        'threshold': float(landmark.threshold),
        'quality': float(landmark.saliency),
        'covariance': _listed(landmark.covariance),
        'shared_loading': _listed(landmark.shared_loading),
    } | ({'views': views} if views else {})


def _landmark(entry: Any, folder: Path, where: str) -> Landmark:
    identity = integer_field(entry, 'id', where)
    where = f'{where} (id {identity})'
    width, height = array_field(entry, 'size', (2,), where)
    point = width == height == 0.0
    if min(width, height) <= 0.0 and not point:
        raise LandmarkNavError(f'{where}: size is {width:g} x {height:g}: it must be positive')
    normal = array_field(entry, 'normal', (3,), where)
    if abs(np.linalg.norm(normal) - 1.0) > 1e-3 or abs(normal[2]) > 1e-3:
        raise LandmarkNavError(f'{where}: normal is not horizontal and of length 1')
    return Landmark(
        id=identity,
        position=array_field(entry, 'position', (3,), where),
        covariance=covariance_field(entry, 'covariance', 3, where),
        shared_loading=array_field(entry, 'shared_loading', (3, None), where),
        normal=normal,
        width_m=float(width),
        height_m=float(height),
        patch=_NO_PATCH if point else _patch(folder / _patch_name(identity), where),
        viewpoint=array_field(entry, 'viewpoint', (3,), where),
        threshold=number_field(entry, 'threshold', where),
        wall_id=str(field(entry, 'wall', where)),
        saliency=number_field(entry, 'quality', where),
        views=tuple(
            PatchView(viewpoint, _patch(folder / _view_name(identity, k), where))
            for k, viewpoint in enumerate(_viewpoints(entry, where))
        ),
    )


def _viewpoints(entry: Any, where: str) -> FloatArray:
    """Where other panoramas saw a landmark from (m, 3); maps of before do not say."""
    if 'views' not in entry:
        return np.empty((0, 3))
    return array_field(entry, 'views', (None, 3), where)


def _patch(path: Path, where: str) -> ImageArray:
    data = np.frombuffer(path.read_bytes(), np.uint8) if path.is_file() else np.empty(0, np.uint8)
    patch = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
    if patch is None:
        raise LandmarkNavError(f'{where}: {path} is not there or is no picture')
    return np.asarray(patch, dtype=np.uint8)


def _wall(entry: Any, where: str) -> Wall:
    def point(key: str) -> tuple[float, float]:
        values: FloatArray = array_field(entry, key, (2,), where)
        return float(values[0]), float(values[1])

    return Wall(
        str(field(entry, 'id', where)),
        point('start'),
        point('end'),
        number_field(entry, 'height', where),
    )
