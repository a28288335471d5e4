"""Greedy choice of the landmarks in a view that add most information on the pose."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from landmark_nav.localization.triangulation.model import bearing_gradients
from landmark_nav.types import FloatArray, LandmarkMap, PoseEstimate

__all__ = ['most_informative']


def most_informative(
    axis: PoseEstimate,
    landmark_map: LandmarkMap,
    index: npt.NDArray[np.intp],
    bearing_sigma: float,
    count: int,
    novelty: FloatArray | None = None,
) -> npt.NDArray[np.intp]:
    """
    Choose landmarks greedily by what each adds to the information on the pose.

    A bearing of variance r and derivative h multiplies the determinant of the information by
    ``1 + h P h^T / r``; r holds the landmark's own error. Greedy choice gains at least 63 % of
    what the best choice would (Krause, Singh and Guestrin, JMLR 9, 2008).

    Parameters
    ----------
    axis : PoseEstimate
        Expected pose of the pan axis.
    index : ndarray of int, shape (n,)
        Places in the map to choose from.
    bearing_sigma : float
        Expected measurement sigma, radians.
    count : int
        How many to choose.
    novelty : ndarray, shape (landmarks of the map,), optional
        Factor on the gain of each landmark: seen again, it repeats the error of the map.

    Returns
    -------
    ndarray of int, shape (min(n, count),)
        In the order of the map.

    """
    if len(index) <= count:
        return index
    gradient = bearing_gradients(axis.pose, landmark_map.positions[index, :2])
    own = landmark_map.covariances[index, :2, :2]
    variance = bearing_sigma**2 + np.sum((gradient[:, None] @ own)[:, 0] * gradient, -1)
    rows = np.column_stack([gradient, np.full(len(index), -1.0)]) / np.sqrt(variance)[:, None]
    covariance: FloatArray = axis.covariance
    gain = np.sum(rows @ covariance * rows, -1)
    left = np.ones(len(index), dtype=np.bool_)
    news = np.ones(len(index)) if novelty is None else novelty[index]
    for _ in range(count):
        best = int(np.argmax(np.where(left, news * gain, -np.inf)))
        left[best] = False
        spread = covariance @ rows[best] / np.sqrt(1.0 + gain[best])
        covariance = covariance - np.outer(spread, spread)
        gain -= (rows @ spread) ** 2
    return np.asarray(index[~left], dtype=np.intp)
