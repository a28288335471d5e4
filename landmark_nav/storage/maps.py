"""
The map folder: ``map.yaml`` and ``patches/NNN.png``, suited to reading, diffs and git.

Appearances of landmark NNN in other panoramas are in ``views/NNN_1.png``, ``views/NNN_2.png``, ...

Numbers are written with enough digits to read back the same values.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from landmark_nav.calibration import Calibration, DEFAULT_SIGMAS, NAMES
from landmark_nav.errors import inside, LandmarkNavError, shown
from landmark_nav.geometry.camera import INTRINSICS
from landmark_nav.geometry.patches import PatchView
from landmark_nav.image_codec import encode_image
from landmark_nav.storage.atomic_io import atomic_folder, left_over
from landmark_nav.storage.reading import Entry, read_image, read_yaml_mapping
from landmark_nav.storage.setup_files import wall_entry, walls_of
from landmark_nav.types import ImageArray, Landmark, LandmarkMap, PoseEstimate

# Greatest magnitude of a negative eigenvalue of the covariance without the shared errors, relative
# to the norm of the covariance: numbers written by hand are rounded.
_ROUNDING = 1e-6
# Greatest number of pixels of one patch and of a map, which bound memory. A patch has some 1,000.
_MAX_PATCH_PIXELS, _MAX_MAP_PIXELS = 1_000_000, 100_000_000
# Patch of a landmark of size 0 x 0: a point with a bearing but without texture.
_NO_PATCH: ImageArray = np.zeros((0, 0), dtype=np.uint8)


def listed(values: Any) -> list[Any]:
    """Nested lists of plain numbers, with the shape of an array."""
    listed: list[Any] = np.asarray(values, dtype=np.float64).tolist()
    return listed


def calibration_entry(known: Calibration) -> dict[str, Any]:
    """Entry of a calibration: values and covariance, in the order of its `names`."""
    optional = {'shared_loading': known.by_map, 'intrinsics': known.intrinsics}
    return {
        'names': list(NAMES),
        'values': listed(known.values),
        'covariance': listed(known.covariance),
    } | {key: listed(values) for key, values in optional.items() if values is not None}


def _calibration(document: dict[str, Any], key: str, where: str) -> Calibration | None:
    """Calibration of an optional entry; it lacks the names of frames and joints of the robot."""
    if document.get(key) is None:
        return None
    entry = Entry(document[key], f'{where}: {key}')
    names = entry.list_of('names')
    if not names or [name for name in NAMES if name in names] != names:
        raise entry.refused(f'names must be {", ".join(NAMES)}')
    covariance = entry.covariance(len(names))
    # An older map lacks quantities that were added since.
    rows = np.array([NAMES.index(name) for name in names], dtype=np.intp)
    every, spread = np.zeros(len(NAMES)), np.diag(DEFAULT_SIGMAS**2)
    every[rows], spread[np.ix_(rows, rows)] = entry.array('values', (len(names),)), covariance
    shared = intrinsics = None
    if 'shared_loading' in entry:
        given = entry.array('shared_loading', (len(names), None))
        shared = np.zeros((len(NAMES), given.shape[1]))
        shared[rows] = given
    if 'intrinsics' in entry:
        intrinsics = entry.array('intrinsics', (INTRINSICS,))
    with inside(entry.where):
        return Calibration(every, spread, by_map=shared, intrinsics=intrinsics)


def patch_name(identity: int) -> str:
    """Name of the patch of a landmark in the map folder."""
    return f'patches/{identity:03d}.png'


def view_name(identity: int, number: int) -> str:
    """Name of the view `number` (from 0) of a landmark in the map folder; files count from 1."""
    return f'views/{identity:03d}_{number + 1}.png'


def described(landmark: Landmark) -> dict[str, Any]:
    """Entry of a landmark."""
    views = [listed(view.viewpoint) for view in landmark.views]
    return {
        'id': int(landmark.id),
        'wall': landmark.wall_id,
        'position': listed(landmark.position),
        'normal': listed(landmark.normal),
        'size': [float(landmark.width_m), float(landmark.height_m)],
        'viewpoint': listed(landmark.viewpoint),
        'threshold': float(landmark.threshold),
        'quality': float(landmark.saliency),
        'covariance': listed(landmark.covariance),
        'shared_loading': listed(landmark.shared_loading),
    } | ({'views': views} if views else {})


def _landmark(entry: Entry, patch_of: Callable[[str], ImageArray]) -> Landmark:
    """Landmark of an entry; `patch_of` reads its images."""
    identity = entry.integer('id')
    entry.where += f' (id {identity})'
    width, height = entry.array('size', (2,))
    point = width == height == 0.0
    if min(width, height) <= 0.0 and not point:
        raise entry.refused(f'size is {width:g} x {height:g}: it must be positive')
    normal = entry.array('normal', (3,))
    if abs(np.linalg.norm(normal) - 1.0) > 1e-3 or abs(normal[2]) > 1e-3:
        raise entry.refused('normal is not horizontal and of length 1')
    covariance, loading = entry.covariance(3), entry.array('shared_loading', (3, None))
    own = np.linalg.eigvalsh(covariance - loading @ loading.T)
    if own[0] < -_ROUNDING * np.linalg.norm(covariance, 2):
        raise entry.refused(
            'covariance is less than what shared_loading makes of it: learn the map again, or set '
            'both to zero for an exact place'
        )
    # Maps of older versions have no views.
    viewpoints = entry.array('views', (None, 3)) if 'views' in entry else ()
    return Landmark(
        id=identity,
        position=entry.array('position', (3,)),
        covariance=covariance,
        shared_loading=loading,
        normal=normal,
        width_m=float(width),
        height_m=float(height),
        patch=_NO_PATCH if point else patch_of(patch_name(identity)),
        viewpoint=entry.array('viewpoint', (3,)),
        threshold=entry.number('threshold'),
        wall_id=entry.name('wall', blank=True),
        saliency=entry.number('quality'),
        views=tuple(
            PatchView(viewpoint, patch_of(view_name(identity, k)))
            for k, viewpoint in enumerate(viewpoints)
        ),
    )


def patch_reader(folder: Path) -> Callable[[str], ImageArray]:
    """
    Return a function that reads the grey pixels (h, w) of a patch by its name in a map folder.

    The function raises `LandmarkNavError` if the file is absent or no image, or if all patches
    together have too many pixels.
    """
    pixels = 0

    def patch_of(name: str) -> ImageArray:
        nonlocal pixels
        file = folder / name
        if not file.exists():
            remedy = 'the map is incomplete: copy it again or learn anew'
            raise LandmarkNavError(f'{file}: not there: {remedy}')
        patch = read_image(file, cv2.IMREAD_GRAYSCALE, _MAX_PATCH_PIXELS)
        pixels += patch.size
        if pixels > _MAX_MAP_PIXELS:
            many = f'over {_MAX_MAP_PIXELS / 1e6:g} million pixels'
            raise LandmarkNavError(f'{folder}: the patches have {many}')
        return patch

    return patch_of


SCHEMA_VERSION = 2
# Versions that can be read; version 1 has no calibration.
_READ = (1, SCHEMA_VERSION)

# Patterns of the files in a map folder, for `atomic_folder`: the map, and its figures.
MAP_DATA = ('map.yaml', 'patches', 'views')
MAP_FILES = (*MAP_DATA, 'map.png', 'panorama_*.png')


class _Dumper(getattr(yaml, 'CSafeDumper', yaml.SafeDumper)):  # type: ignore[misc]
    """YAML dumper that writes lists of numbers in one line, and all else in block style."""


def _represent_list(dumper: yaml.SafeDumper, values: list[Any]) -> yaml.Node:
    flow = all(isinstance(value, int | float) for value in values)
    return dumper.represent_sequence('tag:yaml.org,2002:seq', values, flow_style=flow)


_Dumper.add_representer(list, _represent_list)


def save_map(landmarks: LandmarkMap, folder: Path | str, overwrite: bool = True) -> None:
    """
    Write a map folder atomically; an existing one is replaced if `overwrite`.

    Raises `LandmarkNavError`: `folder` holds other files, or a map although `overwrite` is false,
    or cannot be written.
    """
    with atomic_folder(Path(folder), MAP_FILES, overwrite) as growing:
        write_map(landmarks, growing)


def write_map(landmarks: LandmarkMap, folder: Path) -> None:
    """Write the files of a map into an existing folder."""
    document = {
        'schema_version': SCHEMA_VERSION,
        'frame_id': landmarks.frame_id,
        # Names of files may hold bytes that are not UTF-8.
        'provenance': {
            key: value.encode('utf-8', 'backslashreplace').decode()
            for key, value in landmarks.provenance.items()
        },
        'walls': [wall_entry(wall) for wall in landmarks.walls],
        'panorama_poses': [
            {'stamp_ns': int(k.stamp_ns)}
            | {'pose': listed(k.pose), 'covariance': listed(k.covariance)}
            for k in landmarks.panorama_poses
        ],
        'landmarks': [described(landmark) for landmark in landmarks.landmarks],
    }
    for name in ('prior', 'calibration'):
        known = getattr(landmarks, name)
        if known is not None:
            document[name] = calibration_entry(known)
    text = yaml.dump(document, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=1000)
    (folder / 'map.yaml').write_text(text, encoding='utf-8')
    images = {
        patch_name(k.id): k.patch
        for k in landmarks.landmarks
        if k.width_m or k.height_m  # a point, such as a surveyed beacon, has no patch
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

    Raises `LandmarkNavError`: there is no map, its schema version is not supported, or a value is
    invalid.
    """
    folder = Path(folder)
    path = folder / 'map.yaml'
    if not path.is_file():
        raise LandmarkNavError(f'{folder}: {_no_map(folder)}')
    document = read_yaml_mapping(path)
    top = Entry(document, str(path))
    version = top.field('schema_version')
    if version not in _READ or isinstance(version, bool):
        newer = isinstance(version, int) and version > SCHEMA_VERSION
        remedy = 'update landmark_nav' if newer else 'learn the map again'
        raise top.refused(
            f'schema version {shown(version)}, this landmark_nav reads {SCHEMA_VERSION}: {remedy}'
        )
    patch_of = patch_reader(folder)
    landmarks = tuple(_landmark(entry, patch_of) for entry in top.entries('landmarks'))
    counts = Counter(landmark.id for landmark in landmarks)
    doubled = sorted(k for k, count in counts.items() if count > 1)
    if doubled:
        raise top.refused(f'landmark id {doubled[0]} is there twice: rename one')
    provenance = document.get('provenance') or {}
    if not isinstance(provenance, dict):
        raise top.refused(f'provenance is {shown(provenance)}, not a mapping')
    sigma = provenance.get('scale_sigma', 0.0)
    try:
        known = 0.0 <= float(sigma) < float('inf')
    except (TypeError, ValueError):
        known = False
    if not known:
        raise top.refused(f'scale_sigma is {shown(sigma)}, not a number from 0 on')
    places = tuple(
        PoseEstimate(place.integer('stamp_ns'), place.array('pose', (3,)), place.covariance(3))
        for place in top.entries('panorama_poses')
    )
    frame_id, walls = top.name('frame_id'), walls_of(top)
    made = {str(key): str(value) for key, value in provenance.items()}
    prior, learned = (_calibration(document, name, top.where) for name in ('prior', 'calibration'))
    factors = landmarks[0].shared_loading.shape[1] if landmarks else 0
    if learned is not None and learned.by_map is not None and learned.by_map.shape[1] < factors:
        # An older map without a plan lacks the factor of the pan zero, which is the last one.
        lacking = factors - learned.by_map.shape[1]
        learned = replace(learned, by_map=np.pad(learned.by_map, ((0, 0), (0, lacking))))
    with inside(path):
        return LandmarkMap(landmarks, frame_id, walls, places, made, prior, learned)


def _no_map(folder: Path) -> str:
    if folder.is_file():
        return f'is a file: a map is a folder, {folder.parent} perhaps'
    left = left_over(folder)
    if left is not None:
        return f'no map there: it was being replaced when that was ended; rename {left} to it'
    return (
        'no map there (no map.yaml): make one with `landmark-nav learn` out of a bag, or call '
        'learn_landmarks, then save_map'
    )
