"""
The map folder: ``map.yaml`` and ``patches/NNN.png``, to be read, diffed and kept in git.

What other panoramas show of landmark NNN is in ``views/NNN_1.png`` and on.

Numbers are written with as many digits as it takes to read the same ones back.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import yaml

from landmark_nav.errors import LandmarkNavError, shown
from landmark_nav.image_codec import encode_image
from landmark_nav.storage.atomic_io import atomic_folder, left_over
from landmark_nav.storage.fields import (
    array_field,
    covariance_field,
    field,
    integer_field,
    list_field,
    name_field,
)
from landmark_nav.storage.map_entries import (
    described,
    landmark_of,
    listed,
    patch_name,
    patch_reader,
    view_name,
)
from landmark_nav.storage.reading import read_yaml_mapping
from landmark_nav.storage.setup_files import wall_entry, walls_field
from landmark_nav.types import LandmarkMap, PoseEstimate

__all__ = ['MAP_DATA', 'MAP_FILES', 'SCHEMA_VERSION', 'load_map', 'save_map', 'write_map']

SCHEMA_VERSION = 1

# What this package writes into a map folder, for `atomic_folder`: the map, and figures of it.
MAP_DATA = ('map.yaml', 'patches', 'views')
MAP_FILES = (*MAP_DATA, 'map.png', 'panorama_*.png')


class _Dumper(yaml.SafeDumper):
    """Lists of numbers in one line, all else in block style."""


def _represent_list(dumper: yaml.SafeDumper, values: list[Any]) -> yaml.Node:
    flow = all(isinstance(value, int | float) for value in values)
    return dumper.represent_sequence('tag:yaml.org,2002:seq', values, flow_style=flow)


_Dumper.add_representer(list, _represent_list)


def save_map(landmarks: LandmarkMap, folder: Path | str, overwrite: bool = True) -> None:
    """
    Write a map folder whole or not at all; one that is there is replaced if `overwrite`.

    Raises
    ------
    LandmarkNavError
        `folder` holds something else, or a map that stays, or cannot be written.

    """
    with atomic_folder(Path(folder), MAP_FILES, overwrite) as growing:
        write_map(landmarks, growing)


def write_map(landmarks: LandmarkMap, folder: Path) -> None:
    """Write the files of a map into a folder that is there."""
    document = {
        'schema_version': SCHEMA_VERSION,
        'frame_id': landmarks.frame_id,
        'provenance': dict(landmarks.provenance),
        'walls': [wall_entry(wall) for wall in landmarks.walls],
        'panorama_poses': [
            {
                'stamp_ns': int(place.stamp_ns),
                'pose': listed(place.pose),
                'covariance': listed(place.covariance),
            }
            for place in landmarks.panorama_poses
        ],
        'landmarks': [described(landmark) for landmark in landmarks.landmarks],
    }
    text = yaml.dump(document, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=1000)
    (folder / 'map.yaml').write_text(text, encoding='utf-8')
    images = {
        patch_name(k.id): k.patch
        for k in landmarks.landmarks
        if k.width_m or k.height_m  # not of a point, such as a surveyed beacon
    }
    for k in landmarks.landmarks:
        images |= {view_name(k.id, n): view.patch for n, view in enumerate(k.views)}
    for kind in ('patches', 'views'):
        (folder / kind).mkdir()
    for name, image in images.items():
        (folder / name).write_bytes(encode_image(image, '.png').tobytes())


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
    patch_of = patch_reader(folder)
    landmarks = tuple(
        landmark_of(e, patch_of, f'{path}: landmarks[{k}]') for k, e in enumerate(entries)
    )
    counts = Counter(landmark.id for landmark in landmarks)
    doubled = sorted(k for k, count in counts.items() if count > 1)
    if doubled:
        raise LandmarkNavError(f'{path}: landmark id {doubled[0]} is there twice: rename one')
    if len({landmark.shared_loading.shape for landmark in landmarks}) > 1:
        raise LandmarkNavError(f'{path}: shared_loading must have as many columns everywhere')
    provenance = document.get('provenance') or {}
    if not isinstance(provenance, dict):
        raise LandmarkNavError(f'{path}: provenance is {shown(provenance)}, not a mapping')
    return LandmarkMap(
        landmarks,
        name_field(document, 'frame_id', where),
        walls_field(document, where),
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
        f'{path}: schema version {shown(version)}, this landmark_nav reads {SCHEMA_VERSION}: '
        f'{remedy}'
    )
