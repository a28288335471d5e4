"""Heights of matches in the picture: a free test, as bearings alone tell the place."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.types import FloatArray

__all__ = ['LEAST_HEIGHTS', 'RowModel', 'wrong_heights']

# Fewer tell a wrong height from a wrong tilt no better than the search window does.
LEAST_HEIGHTS = 3
# Sigmas beyond which a match is at a wrong height, given the others.
_WRONG = 4.0


class RowModel(NamedTuple):
    """
    Rows of points (n,) of the picture, differentiated.

    `by_pose` (n, 3) by the pose of the base, px/m and px/rad; `by_height` (n,) by the point's own
    height, px/m; `aside` (n,) is x/z in the optical frame.
    """

    by_pose: FloatArray
    by_height: FloatArray
    aside: FloatArray

    @classmethod
    def of(
        cls,
        points_map: FloatArray,
        pose_map_base: FloatArray,
        rotation: FloatArray,
        center: FloatArray,
        fy: float,
    ) -> RowModel:
        """Of points (n, 3), a camera at `center` (3,) turned by `rotation` optical -> map."""
        x, y, z = ((points_map - center) @ rotation).T
        by_point = fy * (rotation[:, 1] - (y / z)[:, None] * rotation[:, 2]) / z[:, None]
        away = points_map - [*pose_map_base[:2], 0.0]
        by_turn = by_point[:, 0] * away[:, 1] - by_point[:, 1] * away[:, 0]
        by_pose = np.column_stack([-by_point[:, :2], by_turn])
        return cls(by_pose, by_point[:, 2], x / z)

    def covariance(self, pose_covariance: FloatArray, lean_px: float) -> FloatArray:
        """What all rows share (n, n): the pose, and a floor that leans ahead and aside."""
        lean = lean_px * np.column_stack([np.ones(len(self.aside)), self.aside])
        return np.asarray(self.by_pose @ pose_covariance @ self.by_pose.T + lean @ lean.T)


def wrong_heights(off_px: FloatArray, covariance: FloatArray) -> npt.NDArray[np.bool_]:
    """
    Find the matches whose height in the picture contradicts the others'.

    A wrong pose, tilt and roll move all of them in a way that `covariance` knows; what is left of
    one beside the others is its own. The worst is taken out as long as it is too bad (Baarda,
    A Testing Procedure for Use in Geodetic Networks, 1968).

    Parameters
    ----------
    off_px : ndarray, shape (n,)
        Rows found minus rows expected.
    covariance : ndarray, shape (n, n)
        Of those.

    Returns
    -------
    ndarray of bool, shape (n,)

    """
    wrong = np.zeros(len(off_px), dtype=np.bool_)
    left = np.arange(len(off_px))
    while len(left) >= LEAST_HEIGHTS:
        inverse = np.linalg.inv(covariance[np.ix_(left, left)])
        sigmas = np.abs(inverse @ off_px[left]) / np.sqrt(np.diag(inverse))
        worst = int(np.argmax(sigmas))
        if sigmas[worst] < _WRONG:
            break
        wrong[left[worst]] = True
        left = np.delete(left, worst)
    return wrong
