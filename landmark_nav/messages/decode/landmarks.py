"""The landmark map: points and an atlas of patches."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.errors import inside, LandmarkNavError
from landmark_nav.geometry.camera import INTRINSICS
from landmark_nav.geometry.patches import PatchView
from landmark_nav.geometry.walls import Wall
from landmark_nav.messages.clouds import LANDMARKS, unpack_cloud
from landmark_nav.messages.decode import headers
from landmark_nav.messages.decode.images import image
from landmark_nav.messages.decode.poses import FARTHEST_M
from landmark_nav.types import FloatArray, ImageArray, Landmark, LandmarkMap

# Largest side of a patch, and largest threshold, saliency or loading.
_MAX_PATCH_M, _MAX_VALUE = 100.0, 1e3
# Smallest length and height of a wall; tolerance for rounding of normals in float32.
_MIN_WALL_M, _ROUNDING = 1e-3, 1e-3


def landmark_map(landmarks_msg: Any, atlas_msg: Any) -> LandmarkMap:
    """
    Map out of ``landmarks`` and ``landmarks/atlas``; of its provenance they hold the scale only.

    Raises `LandmarkNavError`: fields are missing, values are not numbers, or a patch lies outside
    the atlas.
    """
    points = unpack_cloud(landmarks_msg, LANDMARKS)
    frame_id = str(landmarks_msg.header.frame_id)
    if not len(points):
        return LandmarkMap((), frame_id)
    stamp = headers.stamp_ns(landmarks_msg.header)
    if headers.stamp_ns(atlas_msg.header) != stamp:
        raise LandmarkNavError('landmarks and landmarks/atlas belong to different maps')
    ids = headers.landmark_ids(points['id'], 'landmarks')
    walls = _walls(points, stamp)
    names = {index: wall.id for index, wall in enumerate(walls)}
    atlas = image(atlas_msg)
    _check_area(points, atlas)

    def values(*names: str, within: float, least: float | None = None) -> FloatArray:
        found = np.stack([points[name] for name in names], -1)
        return headers.finite(found, f'landmark {names[0]}', stamp, within, least=least)

    positions = values('x', 'y', 'z', within=FARTHEST_M)
    normals = values('normal_x', 'normal_y', 'normal_z', within=1.0 + _ROUNDING)
    viewpoints = values('viewpoint_x', 'viewpoint_y', 'viewpoint_z', within=FARTHEST_M)
    sizes = values('width', 'height', within=_MAX_PATCH_M, least=0.0)
    if (np.abs(np.hypot(*normals.T[:2]) - 1.0) > _ROUNDING).any():
        raise LandmarkNavError('a normal of landmarks is not horizontal, or not of length 1')
    if (sizes.any(-1) != sizes.all(-1)).any():
        raise LandmarkNavError('a patch of landmarks has a width and no height, or the reverse')
    thresholds, saliencies = values('threshold', 'saliency', within=_MAX_VALUE).T
    covariance = headers.covariances(points['covariance'], 'landmark covariance', stamp, 3)
    shared = headers.finite(points['shared_loading'], 'shared loading', stamp, _MAX_VALUE)
    loadings = shared.reshape(len(points), 3, -1)
    own = covariance - loadings @ loadings.transpose(0, 2, 1)
    largest = np.linalg.norm(covariance, 2, axis=(1, 2))
    if (np.linalg.eigvalsh(own)[:, 0] < -_ROUNDING * largest).any():
        raise LandmarkNavError('a covariance of landmarks is less than what all of them share')
    provenance, prior, calibration = _learned(points, loadings.shape[2], stamp)
    return LandmarkMap(
        tuple(
            Landmark(
                id=int(ids[k]),
                position=positions[k],
                covariance=covariance[k],
                shared_loading=loadings[k],
                normal=normals[k],
                width_m=float(sizes[k, 0]),
                height_m=float(sizes[k, 1]),
                patch=_patch(atlas, points[k]),
                viewpoint=viewpoints[k],
                threshold=float(thresholds[k]),
                wall_id=names.get(int(points['wall'][k]), ''),
                saliency=float(saliencies[k]),
                views=_views(atlas, points[k], stamp),
            )
            for k in range(len(points))
        ),
        frame_id,
        walls,
        provenance=provenance,
        prior=prior,
        calibration=calibration,
    )


def _learned(
    points: npt.NDArray[np.void], factors: int, stamp: int
) -> tuple[dict[str, str], Calibration | None, Calibration | None]:
    """
    Provenance, and the calibrations before and after learning; `factors` are those of the map.

    Raises `LandmarkNavError`: another number of values, or one that is out of bounds.
    """
    flat, n = points['learned'].ravel(), len(NAMES)
    flat = headers.finite(flat[~np.isnan(flat)], 'calibration', stamp, _MAX_VALUE)
    parts = np.split(flat, np.cumsum([1, n, n, n, n * n, INTRINSICS]))
    count = 1 + n * (n + 3) + INTRINSICS
    if len(flat) not in (0, 1, count, count + n * factors):
        raise LandmarkNavError(f'landmarks have a calibration of {len(flat)} numbers')
    # A map in the metres of a plan has no uncertain scale.
    provenance = {'scale_sigma': str(abs(flat[0]))} if flat[:1].any() else {}
    if len(flat) < 2:
        return provenance, None, None
    given, sigmas, values, matrix, intrinsics, loading = parts[1:]
    covariance = headers.covariances(matrix[None], 'covariance of the calibration', stamp, n)[0]
    by_map = loading.reshape(n, -1) if len(loading) else None
    with inside('landmarks'):
        lens = intrinsics if intrinsics.any() else None
        known = Calibration(values, covariance, by_map=by_map, intrinsics=lens)
        return provenance, Calibration(given, np.diag(sigmas**2)), known


def _check_area(points: npt.NDArray[np.void], atlas: ImageArray) -> None:
    """Raise `LandmarkNavError` if patches overlap: each is copied, which could fill the memory."""
    views = points['views'].reshape(len(points), -1, 4)
    sides = [(points['atlas_width'], points['atlas_height']), (views[..., 2], views[..., 3])]
    area = sum(float((width.astype(float) * height).sum()) for width, height in sides)
    if area > atlas.size:
        raise LandmarkNavError(f'patches of {area:g} pixels do not fit an atlas of {atlas.size}')


def _patch(atlas: ImageArray, point: np.void) -> ImageArray:
    if point['width'] == point['height'] == 0.0:  # a landmark without texture
        return np.zeros((0, 0), dtype=np.uint8)
    names = ('atlas_x', 'atlas_y', 'atlas_width', 'atlas_height')
    return _cut(atlas, point, *(int(point[name]) for name in names))


def _views(atlas: ImageArray, point: np.void, stamp: int) -> tuple[PatchView, ...]:
    """Views of a landmark in other panoramas."""
    viewpoints = headers.finite(point['viewpoints'], 'viewpoint', stamp, FARTHEST_M).reshape(-1, 3)
    places = point['views'].reshape(-1, 4).tolist()
    if len(places) != len(viewpoints):
        raise LandmarkNavError(
            f'landmark {point["id"]} has {len(places)} views from {len(viewpoints)} places'
        )
    return tuple(
        PatchView(viewpoint, _cut(atlas, point, *place))
        for viewpoint, place in zip(viewpoints, places, strict=True)
        if place[2]
    )


def _cut(atlas: ImageArray, point: np.void, x: int, y: int, width: int, height: int) -> ImageArray:
    if atlas.ndim != 2 or min(x, y, width - 1, height - 1) < 0:
        raise LandmarkNavError(f'landmark {point["id"]} has no patch in a grey atlas')
    if x + width > atlas.shape[1] or y + height > atlas.shape[0]:
        raise LandmarkNavError(
            f'the patch of landmark {point["id"]} lies outside the atlas of '
            f'{atlas.shape[1]} x {atlas.shape[0]}'
        )
    return np.array(atlas[y : y + height, x : x + width])


def _walls(points: npt.NDArray[np.void], stamp: int) -> tuple[Wall, ...]:
    outlines = headers.finite(points['walls'][0], 'wall', stamp, FARTHEST_M).reshape(-1, 5)
    if not len(outlines):
        return ()
    letters = points['wall_names'][0].astype(np.uint8).tobytes()
    names = letters.decode('utf-8', 'replace').split('\n')
    if len(names) != len(outlines):
        raise LandmarkNavError(f'landmarks name {len(names)} walls and draw {len(outlines)}')
    walls = tuple(
        Wall(name, (x0, y0), (x1, y1), height)
        for name, (x0, y0, x1, y1, height) in zip(names, outlines.tolist(), strict=True)
    )
    if any(wall.length < _MIN_WALL_M or wall.height < _MIN_WALL_M for wall in walls):
        raise LandmarkNavError('a wall of landmarks has no length or no height')
    return walls
