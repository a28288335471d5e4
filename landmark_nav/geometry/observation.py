"""
Observation area of a wall patch: from where it looks enough like it did when it was learned.

A patch keeps its looks while its horizontal and its vertical sampling stay within a factor of
two of the reference view's (Livatino and Madsen). In plan that is the annulus
``rho0 / 2 <= rho <= 2 rho0`` between the two circles that touch the wall at the patch and have
the diameters ``rho0 / (2 cos beta0)`` and ``2 rho0 / cos beta0``: closed form, no search.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import FloatArray

__all__ = ['observed_well', 'relative_sampling']


def relative_sampling(
    points: npt.ArrayLike,
    normals: npt.ArrayLike,
    viewpoints: npt.ArrayLike,
    viewers: npt.ArrayLike,
) -> tuple[FloatArray, FloatArray]:
    """
    Sampling of wall patches as a viewer sees them, relative to the view they were learned from.

    Both views are taken on upright cylinders, so ranges and incidences are those of the plan:
    ``s_v = rho0 / rho`` and ``s_h = s_v cos(beta) / cos(beta0)``.

    Parameters
    ----------
    points, normals, viewpoints : array_like, shape (n, 3)
        Patch centres, unit normals into the room and reference viewpoints, map frame, metres.
    viewers : array_like, shape (..., 3)
        Where one looks from.

    Returns
    -------
    horizontal, vertical : ndarray, shape (..., n)
        1 is the sampling of the reference view; `horizontal` is negative from behind the wall.

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
    Whether viewers stand inside the patches' observation areas; arguments as above.

    Parameters
    ----------
    minimum, maximum : float
        Accepted relative sampling, horizontal and vertical.

    Returns
    -------
    ndarray of bool, shape (..., n)
        False from behind the wall and on the wall itself.

    """
    horizontal, vertical = relative_sampling(points, normals, viewpoints, viewers)
    return np.asarray(
        (horizontal >= minimum)
        & (horizontal <= maximum)
        & (vertical >= minimum)
        & (vertical <= maximum)
    )
