"""Rooms, maps, panoramas and detections without images: what tests share to build them."""

from typing import Any

import numpy as np

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.patches import patch_axes
from landmark_nav.geometry.walls import Wall
from landmark_nav.types import Detections, Landmark, LandmarkMap, Panorama, PatchView, PoseEstimate


def walls_of(corners, names=None, height=2.5, sigma_m=None):
    """Walls from each corner to the next; called by their numbers unless they have names."""
    points = [(float(x), float(y)) for x, y in corners]
    ends = points[1:] + points[:1]
    called = names or map(str, range(len(points)))
    return tuple(
        Wall(name, start, end, height, sigma_m)
        for name, start, end in zip(called, points, ends, strict=True)
    )


def bare_landmark(number, position, covariance, **given):
    """Landmark without an image, independent of others; `given` sets further fields."""
    fields: dict[str, Any] = {
        'shared_loading': np.zeros((3, 0)),
        'normal': np.array([1.0, 0.0, 0.0]),
        'width_m': 0.2,
        'height_m': 0.2,
        'patch': np.zeros((8, 8), np.uint8),
        'viewpoint': np.zeros(3),
        'threshold': 0.7,
    }
    return Landmark(number, np.asarray(position, float), covariance, **(fields | given))


def random_map(seed, count, factors, walls, widest_px=40, **given):
    """Landmarks of random numbers of many sizes, with patches of noise and up to two views."""
    rng = np.random.default_rng(seed)

    def image():
        return rng.integers(0, 256, rng.integers(5, (40, widest_px))).astype(np.uint8)

    landmarks = []
    for k in range(count):
        root = rng.normal(size=(3, 3)) * 10.0 ** rng.uniform(-3, 0)
        loading, angle = rng.normal(size=(3, factors)) * 1e-3, rng.uniform(-np.pi, np.pi)
        landmarks.append(
            bare_landmark(
                7 * k, rng.normal(size=3) * 10.0 ** rng.uniform(-5, 3),
                root @ root.T + loading @ loading.T + 1e-6 * np.eye(3), shared_loading=loading,
                normal=np.array([np.cos(angle), np.sin(angle), 0.0]),
                width_m=float(rng.uniform(0.05, 1.0)), height_m=float(rng.uniform(0.05, 1.0)),
                patch=image(), viewpoint=rng.normal(size=3), saliency=float(rng.random()),
                threshold=float(rng.uniform(0.3, 0.95)), wall_id=walls[k % len(walls)].id,
                views=tuple(PatchView(rng.normal(size=3), image()) for _ in range((2 - k) % 3)),
            )
        )  # fmt: skip
    return LandmarkMap(tuple(landmarks), 'map', walls, **given)


def patch_points(position, normal, shape, texel_m):
    """Points (rows, columns, 3) in map of the texels of a patch centred on `position`."""
    right, down = patch_axes(normal)
    column = (np.arange(shape[1]) - (shape[1] - 1) / 2.0) * texel_m
    row = (np.arange(shape[0]) - (shape[0] - 1) / 2.0) * texel_m
    return np.asarray(
        np.asarray(position) + column[None, :, None] * right + row[:, None, None] * down
    )


def panorama_of(image, cylinder, **given):
    """Panorama of an image that is covered everywhere, at the origin unless `given` otherwise."""
    fields: dict[str, Any] = {
        'stamp_ns': 0,
        'mask': np.ones(image.shape[:2], np.bool_),
        'center_map': np.zeros(3),
        'heading_rad': 0.0,
        'covariance': np.eye(4),
    }
    return Panorama(image=image, cylinder=cylinder, **(fields | given))


def detections_of(stamp_ns, ids=(), bearings=(), **given):
    """Detections at the centre of an image, with bearings known to a milliradian."""
    numbers, count = np.array(ids, np.int64), np.size(ids)
    fields = {
        'variance_rad2': np.full(count, 1e-6),
        'score': np.full(count, 0.9),
        'uv_px': np.zeros((count, 2)),
    }
    return Detections(stamp_ns, numbers, np.array(bearings, float), **(fields | given))


def pose_error(found, true):
    """x, y and heading (..., 3) found minus true."""
    pose = found.pose if isinstance(found, PoseEstimate) else found
    error = np.array(pose - np.asarray(true), float)
    error[..., 2] = wrap_rad(error[..., 2])
    return error


def nees(error, covariance):
    """Squared errors (...,) in units of their covariances."""
    weighted = np.linalg.solve(covariance, error[..., None])[..., 0]
    return np.asarray(np.sum(error * weighted, axis=-1))
