"""
Flat patches on vertical walls: axes, corners, homographies and observation areas.

The observation area is the floor from where a patch looks similar to its reference view: where its
horizontal and vertical sampling are within a factor of two of those of that view (Livatino and
Madsen). In plan that is the annulus ``rho0 / 2 <= rho <= 2 rho0`` between the two circles that
touch the wall at the patch and have the diameters ``rho0 / (2 cos beta0)`` and
``2 rho0 / cos beta0``.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import FloatArray

# Signs of the corners to the right and down, clockwise from the upper left.
_SIDES = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


@dataclass(frozen=True, eq=False)
class PatchView:
    """
    The texture of a patch in one panorama.

    `patch` (rows, columns) is the grey texture in wall coordinates, uint8, in the resolution of
    that panorama; `viewpoint` (3,) is the viewpoint of the panorama in map.
    """

    viewpoint: FloatArray
    patch: npt.NDArray[np.uint8]


# Gaussian blur against noise, px.
_BLUR_PX = 0.8
# Shift along an edge, relative to the height of a patch, and least correlation after it.
_ALONG, _UNCHANGED = 0.2, 0.9
# Greatest slope of an upright edge: its column then depends little on the row.
_UPRIGHT = 0.1


def overlap(apart: FloatArray, size: FloatArray, other_size: FloatArray) -> FloatArray:
    """Overlap of rectangles (..., 2) with centers `apart` (..., 2), relative to the smaller."""
    common = np.clip((size + other_size) / 2.0 - apart, 0.0, np.minimum(size, other_size))
    return np.asarray(np.prod(common, -1) / np.minimum(np.prod(size, -1), np.prod(other_size, -1)))


def is_upright_edge(patch: npt.NDArray[np.uint8]) -> bool:
    """
    Whether a patch (rows, columns) is certain across only: an upright edge.

    Its correlation does not show a shift along the edge (the aperture problem; Shi and Tomasi,
    Good Features to Track, CVPR 1994).
    """
    shift = round(_ALONG * patch.shape[0])
    if not shift or not np.ptp(patch[shift:-shift]):
        return False
    image = cv2.GaussianBlur(patch.astype(np.float32), (0, 0), _BLUR_PX)
    inner = np.ascontiguousarray(image[shift:-shift])
    if cv2.matchTemplate(image, inner, cv2.TM_CCOEFF_NORMED).min() < _UNCHANGED:
        return False
    down, across = np.gradient(image)
    # Direction of the edge, by the structure tensor.
    turned = np.arctan2(2.0 * np.sum(across * down), np.sum(across**2) - np.sum(down**2))
    return bool(abs(np.tan(0.5 * turned)) < _UPRIGHT)


def patch_axes(normals: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """
    Unit vectors to the right and down, seen from inside the room, of patches on upright walls.

    Parameters
    ----------
    normals : array_like, shape (..., 3)
        Unit normals into the room.

    Returns
    -------
    right, down : ndarray, shape (..., 3)
    """
    n = np.asarray(normals, dtype=np.float64)
    right, down = np.zeros(n.shape), np.zeros(n.shape)
    right[..., 0], right[..., 1] = -n[..., 1], n[..., 0]
    down[..., 2] = -1.0
    return right, down


def patch_corners(positions: FloatArray, normals: FloatArray, sizes_m: FloatArray) -> FloatArray:
    """Corners (n, 4, 3) in map of patches by their centres and normals (n, 3) and sizes (n, 2)."""
    right, down = patch_axes(normals)
    half = 0.5 * sizes_m[:, None]
    sideways = _SIDES[:, :1] * half[..., :1] * right[:, None]
    downward = _SIDES[:, 1:] * half[..., 1:] * down[:, None]
    return np.asarray(positions[:, None] + (sideways + downward))


def rays_to_patch(
    positions: npt.ArrayLike,
    normals: npt.ArrayLike,
    rotation_map_camera: npt.ArrayLike,
    center_map: npt.ArrayLike,
) -> FloatArray:
    """
    Homographies from rays of a camera to metres on patches.

    A ray (x, y, 1) of the optical frame meets patch k at ``H[k] @ ray``, homogeneous
    coordinates of metres to the right and down from its centre (Hartley and Zisserman, Multiple
    View Geometry, 2004, section 13.1).

    Parameters
    ----------
    positions, normals : array_like, shape (n, 3)
        Patch centres and normals in map.
    rotation_map_camera : array_like, shape (3, 3)
        Optical frame -> map.
    center_map : array_like, shape (3,)
        Optical centre in map.

    Returns
    -------
    ndarray, shape (n, 3, 3)
    """
    right, down = patch_axes(normals)
    offset = np.asarray(positions, dtype=np.float64) - np.asarray(center_map, dtype=np.float64)
    plane = np.stack([right, down, offset], -1)
    return np.linalg.inv(np.asarray(rotation_map_camera).T @ plane)


def relative_sampling(
    points: npt.ArrayLike,
    normals: npt.ArrayLike,
    viewpoints: npt.ArrayLike,
    viewers: npt.ArrayLike,
) -> tuple[FloatArray, FloatArray]:
    """
    Sampling of wall patches from a viewpoint, relative to their reference view.

    Both images are upright cylinders, so ranges and angles of incidence are those in plan:
    ``s_v = rho0 / rho`` and ``s_h = s_v cos(beta) / cos(beta0)``.

    Parameters
    ----------
    points, normals, viewpoints : array_like, shape (n, 3)
        Patch centres, unit normals into the room and reference viewpoints, map frame, metres.
    viewers : array_like, shape (..., 3)
        Viewpoints, map frame, metres.

    Returns
    -------
    horizontal, vertical : ndarray, shape (..., n)
        Relative sampling, 1 in the reference view; `horizontal` is negative behind the wall.
    """
    point = np.asarray(points, dtype=np.float64)[:, :2]
    normal = np.asarray(normals, dtype=np.float64)[:, :2]
    reference = np.asarray(viewpoints, dtype=np.float64)[:, :2] - point
    view = np.asarray(viewers, dtype=np.float64)[..., None, :2] - point
    range_reference = np.hypot(reference[:, 0], reference[:, 1])
    cos_reference = np.abs(np.sum(reference * normal, -1)) / range_reference
    with np.errstate(divide='ignore', invalid='ignore'):
        range_view = np.hypot(view[..., 0], view[..., 1])
        vertical = range_reference / range_view
        horizontal = vertical * (np.sum(view * normal, -1) / range_view) / cos_reference
    return horizontal, vertical


def observed_well(
    points: npt.ArrayLike,
    normals: npt.ArrayLike,
    viewpoints: npt.ArrayLike,
    viewers: npt.ArrayLike,
    minimum: float = 0.5,
    maximum: float = 2.0,
) -> npt.NDArray[np.bool_]:
    """
    Whether viewpoints are inside the observation areas of patches.

    Parameters
    ----------
    points, normals, viewpoints, viewers
        See `relative_sampling`.
    minimum, maximum : float
        Accepted relative sampling, horizontal and vertical.

    Returns
    -------
    ndarray of bool, shape (..., n)
        False behind the wall and on the wall itself.
    """
    sampling = np.stack(relative_sampling(points, normals, viewpoints, viewers))
    return np.asarray(((sampling >= minimum) & (sampling <= maximum)).all(axis=0))
