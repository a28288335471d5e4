"""Landmarks as entries of ``map.yaml``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.patches import PatchView
from landmark_nav.storage.fields import (
    array_field,
    covariance_field,
    integer_field,
    name_field,
    number_field,
)
from landmark_nav.storage.reading import read_image
from landmark_nav.types import FloatArray, ImageArray, Landmark

__all__ = ['described', 'landmark_of', 'listed', 'patch_name', 'patch_reader', 'view_name']

# Numbers written by hand may miss what they stand for by this share of the largest one.
_ROUNDING = 1e-6
# A patch has some 1,000 pixels; these bounds are those of memory, of one and of a whole map.
_MAX_PATCH_PIXELS, _MAX_MAP_PIXELS = 1_000_000, 100_000_000
# Of a landmark of size 0 x 0: a point that has a bearing but no texture.
_NO_PATCH: ImageArray = np.zeros((0, 0), dtype=np.uint8)


def listed(values: Any) -> list[Any]:
    """Plain numbers, nested as the array is."""
    listed: list[Any] = np.asarray(values, dtype=np.float64).tolist()
    return listed


def patch_name(identity: int) -> str:
    """Of its image, in the map folder."""
    return f'patches/{identity:03d}.png'


def view_name(identity: int, number: int) -> str:
    """Of what another panorama shows of it; the file counts from 1."""
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


def landmark_of(entry: Any, patch_of: Callable[[str], ImageArray], where: str) -> Landmark:
    """Landmark of an entry; `patch_of` reads its images, `where` begins an error's line."""
    identity = integer_field(entry, 'id', where)
    where = f'{where} (id {identity})'
    width, height = array_field(entry, 'size', (2,), where)
    point = width == height == 0.0
    if min(width, height) <= 0.0 and not point:
        raise LandmarkNavError(f'{where}: size is {width:g} x {height:g}: it must be positive')
    normal = array_field(entry, 'normal', (3,), where)
    if abs(np.linalg.norm(normal) - 1.0) > 1e-3 or abs(normal[2]) > 1e-3:
        raise LandmarkNavError(f'{where}: normal is not horizontal and of length 1')
    covariance = covariance_field(entry, 'covariance', 3, where)
    loading = array_field(entry, 'shared_loading', (3, None), where)
    own = np.linalg.eigvalsh(covariance - loading @ loading.T)
    if own[0] < -_ROUNDING * np.linalg.norm(covariance, 2):
        raise LandmarkNavError(
            f'{where}: covariance is less than what shared_loading makes of it: learn the map '
            'again, or set both to zero for an exact place'
        )
    return Landmark(
        id=identity,
        position=array_field(entry, 'position', (3,), where),
        covariance=covariance,
        shared_loading=loading,
        normal=normal,
        width_m=float(width),
        height_m=float(height),
        patch=_NO_PATCH if point else patch_of(patch_name(identity)),
        viewpoint=array_field(entry, 'viewpoint', (3,), where),
        threshold=number_field(entry, 'threshold', where),
        wall_id=name_field(entry, 'wall', where, blank=True),
        saliency=number_field(entry, 'quality', where),
        views=tuple(
            PatchView(viewpoint, patch_of(view_name(identity, k)))
            for k, viewpoint in enumerate(_viewpoints(entry, where))
        ),
    )


def _viewpoints(entry: Any, where: str) -> FloatArray:
    """Where other panoramas saw a landmark from (m, 3); maps of before do not say."""
    if 'views' not in entry:
        return np.empty((0, 3))
    return array_field(entry, 'views', (None, 3), where)


def patch_reader(folder: Path) -> Callable[[str], ImageArray]:
    """
    Function from the name of a patch in a map folder to its grey pixels (h, w).

    It raises `LandmarkNavError` where that is no image, and where all together are too large.
    """
    pixels = 0

    def patch_of(name: str) -> ImageArray:
        nonlocal pixels
        patch = read_image(folder / name, cv2.IMREAD_GRAYSCALE, _MAX_PATCH_PIXELS)
        pixels += patch.size
        if pixels > _MAX_MAP_PIXELS:
            raise LandmarkNavError(
                f'{folder}: the patches have over {_MAX_MAP_PIXELS / 1e6:g} million pixels'
            )
        return patch

    return patch_of
