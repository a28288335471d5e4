"""Landmarks as entries of ``map.yaml``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.patches import PatchView
from landmark_nav.storage.fields import (
    array_field,
    covariance_field,
    field,
    integer_field,
    number_field,
)
from landmark_nav.types import FloatArray, ImageArray, Landmark

__all__ = ['described', 'landmark_of', 'listed', 'patch_name', 'view_name']

# Numbers written by hand may miss what they stand for by this share of the largest one.
_ROUNDING = 1e-6
# Of a landmark of size 0 x 0: a point that has a bearing but no texture.
_NO_PATCH: ImageArray = np.zeros((0, 0), dtype=np.uint8)


def listed(values: Any) -> list[Any]:
    """Plain numbers, nested as the array is."""
    listed: list[Any] = np.asarray(values, dtype=np.float64).tolist()
    return listed


def patch_name(identity: int) -> str:
    """Of its picture, in the map folder."""
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


def landmark_of(entry: Any, folder: Path, where: str) -> Landmark:
    """Landmark of an entry, with its pictures; `where` begins what is said of a bad one."""
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
        patch=_NO_PATCH if point else _patch(folder / patch_name(identity), where),
        viewpoint=array_field(entry, 'viewpoint', (3,), where),
        threshold=number_field(entry, 'threshold', where),
        wall_id=str(field(entry, 'wall', where)),
        saliency=number_field(entry, 'quality', where),
        views=tuple(
            PatchView(viewpoint, _patch(folder / view_name(identity, k), where))
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
