"""
Three bearings in closed form: the power centre of the three circles of constant angle.

Pierlot and Van Droogenbroeck, A New Three Object Triangulation Algorithm for Mobile Robot
Positioning, IEEE T-RO 30(3), 2014, eqs. 21 to 34. Their cotangents become infinite where two
landmarks lie at 0 or 180 degrees from each other. Here each circle is multiplied by the sine of
its angle instead, so its centre is a homogeneous point and that case is like any other.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.types import FloatArray

__all__ = ['triangulate_three']

# Triplets worked on at a time: their intermediate arrays stay in the cache.
_BLOCK = 8192


def triangulate_three(positions: npt.ArrayLike, bearings: npt.ArrayLike) -> FloatArray:
    """
    Poses out of three bearings each.

    Parameters
    ----------
    positions : array_like, shape (..., 3, 2)
        Landmarks in map, metres.
    bearings : array_like, shape (..., 3)
        Their bearings, counter-clockwise from the robot's heading, radians.

    Returns
    -------
    ndarray, shape (..., 3)
        x, y [m] and heading [rad]. On the circle through the landmarks nothing is determined: not
        finite there or, by rounding, anything (`danger_distance`). The equations hold for a
        landmark's opposite direction too: check `bearing_residuals` before use.

    """
    position = np.asarray(positions, dtype=np.float64)
    bearing = np.asarray(bearings, dtype=np.float64)
    shape = np.broadcast_shapes(position.shape[:-2], bearing.shape[:-1])
    position = np.broadcast_to(position, (*shape, 3, 2)).reshape(-1, 3, 2)
    bearing = np.broadcast_to(bearing, (*shape, 3)).reshape(-1, 3)
    poses = np.empty((len(bearing), 3))
    for start in range(0, len(bearing), _BLOCK):
        block = slice(start, start + _BLOCK)
        poses[block] = _power_center(position[block], bearing[block])
    return poses.reshape((*shape, 3))


def _power_center(position: FloatArray, bearing: FloatArray) -> FloatArray:
    """Poses (m, 3) of landmarks (m, 3, 2) and bearings (m, 3)."""
    (x1, y1), (x2, y2), (x3, y3) = (np.ascontiguousarray(p.T) for p in np.moveaxis(position, 1, 0))
    b1, b2, b3 = np.ascontiguousarray(bearing.T)
    b12, b23 = b2 - b1, b3 - b2
    c12, s12, c23, s23 = np.cos(b12), np.sin(b12), np.cos(b23), np.sin(b23)
    c31, s31 = c12 * c23 - s12 * s23, -(s12 * c23 + c12 * s23)

    # Landmarks 1 and 3 as seen from 2, the circles' homogeneous centres, and the power k31.
    xa, ya, xc, yc = x1 - x2, y1 - y2, x3 - x2, y3 - y2
    x12, y12 = s12 * xa + c12 * ya, s12 * ya - c12 * xa
    x23, y23 = s23 * xc - c23 * yc, s23 * yc + c23 * xc
    x31 = s31 * (xc + xa) + c31 * (yc - ya)
    y31 = s31 * (yc + ya) - c31 * (xc - xa)
    k31 = s31 * (xa * xc + ya * yc) + c31 * (xa * yc - xc * ya)

    normal_x, normal_y = y12 * s23 - y23 * s12, x23 * s12 - x12 * s23
    determinant = x31 * normal_x + y31 * normal_y + s31 * (x12 * y23 - x23 * y12)
    poses = np.empty((len(bearing), 3))
    with np.errstate(divide='ignore', invalid='ignore'):
        scale = k31 / determinant
        x, y = scale * normal_x, scale * normal_y
        # Heading: direction of the sum of range * exp(i (azimuth - bearing)), bearings counted
        # from the second. What is far away shows more of it.
        xa -= x
        ya -= y
        xc -= x
        yc -= y
        real = xa * c12 - ya * s12 - x + xc * c23 + yc * s23
        imaginary = ya * c12 + xa * s12 - y + yc * c23 - xc * s23
        poses[:, 0], poses[:, 1] = x + x2, y + y2
        poses[:, 2] = wrap_rad(np.arctan2(imaginary, real) - b2)
    return poses
