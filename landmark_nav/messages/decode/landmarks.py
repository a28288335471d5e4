"""The landmark map: points and an atlas of patches."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.patches import PatchView
from landmark_nav.geometry.walls import Wall
from landmark_nav.messages.clouds import unpack_cloud
from landmark_nav.messages.decode.headers import finite, stamp_ns
from landmark_nav.messages.decode.images import image
from landmark_nav.messages.layouts import LANDMARK_FIELDS
from landmark_nav.types import FloatArray, ImageArray, Landmark, LandmarkMap

__all__ = ['landmark_map']


def landmark_map(landmarks_msg: Any, atlas_msg: Any) -> LandmarkMap:
    """
    Map out of ``landmarks`` and ``landmarks/atlas``; provenance does not travel.

    Raises
    ------
    LandmarkNavError
        Fields are missing, values are not numbers, or a patch lies outside the atlas.

    """
    points = unpack_cloud(landmarks_msg, [field[0] for field in LANDMARK_FIELDS])
    frame_id = str(landmarks_msg.header.frame_id)
    if not len(points):
        return LandmarkMap((), frame_id)
    stamp = stamp_ns(landmarks_msg.header)
    if stamp_ns(atlas_msg.header) != stamp:
        raise LandmarkNavError('landmarks and landmarks/atlas belong to different maps')
    walls = _walls(points)
    names = {index: wall.id for index, wall in enumerate(walls)}
    atlas = image(atlas_msg)

    def values(*names: str) -> FloatArray:
        return finite(np.stack([points[name] for name in names], -1), 'landmark', stamp)

    positions = values('x', 'y', 'z')
    normals = values('normal_x', 'normal_y', 'normal_z')
    viewpoints = values('viewpoint_x', 'viewpoint_y', 'viewpoint_z')
    scalars = values('width', 'height', 'threshold', 'saliency')
    covariances = finite(points['covariance'], 'landmark covariance', stamp).reshape(-1, 3, 3)
    loadings = np.zeros((len(points), 3, 0))
    if 'shared_loading' in (points.dtype.names or ()):
        shared = finite(points['shared_loading'], 'shared loading', stamp)
        loadings = shared.reshape(len(points), 3, -1)
    return LandmarkMap(
        tuple(
            Landmark(
                id=int(points['id'][k]),
                position=positions[k],
                covariance=covariances[k],
                shared_loading=loadings[k],
                normal=normals[k],
                width_m=float(scalars[k, 0]),
                height_m=float(scalars[k, 1]),
                patch=_patch(atlas, points[k]),
                viewpoint=viewpoints[k],
                threshold=float(scalars[k, 2]),
                wall_id=names.get(int(points['wall'][k]), ''),
                saliency=float(scalars[k, 3]),
                views=_views(atlas, points[k], stamp),
            )
            for k in range(len(points))
        ),
        frame_id,
        walls,
    )


def _patch(atlas: ImageArray, point: np.void) -> ImageArray:
    if point['width'] == point['height'] == 0.0:  # a point, known by its bearing alone
        return np.zeros((0, 0), dtype=np.uint8)
    names = ('atlas_x', 'atlas_y', 'atlas_width', 'atlas_height')
    return _cut(atlas, point, *(int(point[name]) for name in names))


def _views(atlas: ImageArray, point: np.void, stamp: int) -> tuple[PatchView, ...]:
    """What other panoramas show of it; publishers of before do not say."""
    if not {'viewpoints', 'views'} <= set(point.dtype.names or ()):
        return ()
    viewpoints = finite(point['viewpoints'], 'viewpoint', stamp).reshape(-1, 3)
    places = point['views'].reshape(-1, 4).tolist()
    return tuple(
        PatchView(viewpoint, _cut(atlas, point, *place))
        for viewpoint, place in zip(viewpoints, places, strict=True)
        if place[2]
    )


def _cut(atlas: ImageArray, point: np.void, x: int, y: int, width: int, height: int) -> ImageArray:
    if atlas.ndim != 2 or not width or not height:
        raise LandmarkNavError(f'landmark {point["id"]} has no patch in a grey atlas')
    if x + width > atlas.shape[1] or y + height > atlas.shape[0]:
        raise LandmarkNavError(
            f'the patch of landmark {point["id"]} lies outside the atlas of '
            f'{atlas.shape[1]} x {atlas.shape[0]}'
        )
    return np.array(atlas[y : y + height, x : x + width])


def _walls(points: npt.NDArray[np.void]) -> tuple[Wall, ...]:
    if not {'walls', 'wall_names'} <= set(points.dtype.names or ()):
        return ()
    names = points['wall_names'][0].tobytes().decode('utf-8', 'replace').split('\n')
    outlines = points['walls'][0].reshape(-1, 5).astype(np.float64)
    if len(names) != len(outlines):
        raise LandmarkNavError(f'landmarks name {len(names)} walls and draw {len(outlines)}')
    return tuple(
        Wall(name, (float(x0), float(y0)), (float(x1), float(y1)), float(height))
        for name, (x0, y0, x1, y1, height) in zip(names, outlines, strict=True)
    )
