"""The landmark map: points and an atlas of patches."""

from __future__ import annotations

from typing import Any

import numpy as np

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.errors import inside, LandmarkNavError
from landmark_nav.geometry.camera import INTRINSICS
from landmark_nav.geometry.patches import PatchView
from landmark_nav.geometry.walls import Wall
from landmark_nav.messages.clouds import LANDMARKS
from landmark_nav.messages.decode.headers import covariances, finite, nonzero, Points, stamp_ns
from landmark_nav.messages.decode.images import image
from landmark_nav.types import ImageArray, Landmark, LandmarkMap

# Smallest length and height of a wall; tolerance for rounding of normals in float32.
_MIN_WALL_M, _ROUNDING = 1e-3, 1e-3


def landmark_map(landmarks_msg: Any, atlas_msg: Any) -> LandmarkMap:
    """Map out of ``landmarks`` and ``landmarks/atlas``; of its provenance only the scale."""
    points = Points(landmarks_msg, LANDMARKS)
    frame_id = str(landmarks_msg.header.frame_id)
    if not len(points):
        return LandmarkMap((), frame_id)
    if stamp_ns(atlas_msg.header) != points.stamp:
        raise LandmarkNavError('landmarks and landmarks/atlas belong to different maps')
    ids = points.ids()
    walls = _walls(points)
    names = {index: wall.id for index, wall in enumerate(walls)}
    patches, views = _images(image(atlas_msg), points)
    positions = points('x', 'y', 'z')
    normals = points('normal_x', 'normal_y', 'normal_z')
    viewpoints = points('viewpoint_x', 'viewpoint_y', 'viewpoint_z')
    sizes = points('width', 'height')
    if (np.abs(np.hypot(*normals.T[:2]) - 1.0) > _ROUNDING).any():
        raise LandmarkNavError('a normal of landmarks is not horizontal, or not of length 1')
    if (sizes.any(-1) != sizes.all(-1)).any():
        raise LandmarkNavError('a patch of landmarks has a width and no height, or the reverse')
    thresholds, saliencies = points('threshold', 'saliency').T
    covariance = points('covariance')
    loadings = points('shared_loading').reshape(len(points), 3, -1)
    own = covariance - loadings @ loadings.transpose(0, 2, 1)
    largest = np.linalg.norm(covariance, 2, axis=(1, 2))
    if (np.linalg.eigvalsh(own)[:, 0] < -_ROUNDING * largest).any():
        raise LandmarkNavError('a covariance of landmarks is less than what all of them share')
    provenance, prior, calibration = _learned(points, loadings.shape[2])
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
                patch=patches[k],
                viewpoint=viewpoints[k],
                threshold=float(thresholds[k]),
                wall_id=names.get(int(points.raw['wall'][k]), ''),
                saliency=float(saliencies[k]),
                views=views[k],
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
    points: Points, factors: int
) -> tuple[dict[str, str], Calibration | None, Calibration | None]:
    """Provenance, and the calibrations before and after learning; `factors` are of the map."""
    flat, n = points.raw['learned'].ravel(), len(NAMES)
    flat = finite(
        flat[~np.isnan(flat)], 'calibration', points.stamp, LANDMARKS.bounds['learned'][1]
    )
    count = 1 + n * (n + 3) + INTRINSICS
    if len(flat) not in (0, 1, count, count + n * factors):
        raise LandmarkNavError(f'landmarks have a calibration of {len(flat)} numbers')
    # A map in the metres of a plan has no uncertain scale.
    provenance = {'scale_sigma': str(abs(flat[0]))} if flat[:1].any() else {}
    if len(flat) < 2:
        return provenance, None, None
    parts = np.split(flat, np.cumsum([1, n, n, n, n * n, INTRINSICS]))
    given, sigmas, values, matrix, intrinsics, loading = parts[1:]
    covariance = covariances(matrix, 'covariance of the calibration', points.stamp, n)[0]
    with inside('landmarks'):
        known = Calibration(
            values,
            covariance,
            by_map=loading.reshape(n, -1) if len(loading) else None,
            intrinsics=nonzero(intrinsics),
        )
        return provenance, Calibration(given, np.diag(sigmas**2)), known


def _images(
    atlas: ImageArray, points: Points
) -> tuple[list[ImageArray], list[tuple[PatchView, ...]]]:
    """Patches of the landmarks, and their views in other panoramas."""
    raw = points.raw
    # x, y, width, height in the atlas.
    own = np.stack([raw[f'atlas_{name}'] for name in ('x', 'y', 'width', 'height')], -1)
    others = raw['views'].reshape(len(points), -1, 4)
    viewpoints = points('viewpoints').reshape(len(points), -1, 3)
    if others.shape[1] != viewpoints.shape[1]:
        raise LandmarkNavError(
            f'landmarks have {others.shape[1]} views from {viewpoints.shape[1]} places'
        )
    # Each patch is copied, so that patches that overlap could fill the memory.
    sizes = [np.maximum(one[..., 2:], 0.0) for one in (own, others)]
    area = sum(float(np.prod(size, -1).sum()) for size in sizes)
    if area > atlas.size:
        raise LandmarkNavError(f'patches of {area:g} pixels do not fit an atlas of {atlas.size}')

    def cut(k: int, x: int, y: int, width: int, height: int) -> ImageArray:
        if atlas.ndim != 2 or min(x, y, width - 1, height - 1) < 0:
            raise LandmarkNavError(f'landmark {raw["id"][k]} has no patch in a grey atlas')
        if x + width > atlas.shape[1] or y + height > atlas.shape[0]:
            raise LandmarkNavError(
                f'the patch of landmark {raw["id"][k]} lies outside the atlas of '
                f'{atlas.shape[1]} x {atlas.shape[0]}'
            )
        return np.array(atlas[y : y + height, x : x + width])

    textured = (raw['width'] != 0.0) | (raw['height'] != 0.0)
    patches = [
        cut(k, *own[k].tolist()) if textured[k] else np.zeros((0, 0), dtype=np.uint8)
        for k in range(len(points))
    ]
    views = [
        tuple(
            PatchView(viewpoint, cut(k, *place))
            for viewpoint, place in zip(viewpoints[k], others[k].tolist(), strict=True)
            if place[2]
        )
        for k in range(len(points))
    ]
    return patches, views


def _walls(points: Points) -> tuple[Wall, ...]:
    outlines = points('walls')[0].reshape(-1, 5)
    if not len(outlines):
        return ()
    letters = points.raw['wall_names'][0].astype(np.uint8).tobytes()
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
