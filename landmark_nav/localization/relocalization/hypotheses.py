"""
Pose hypotheses from detections, most of which are false: each pair proposes a pose, all vote.

Two detections with ranges are two points relative to the robot; with the positions of the two
landmarks they determine a pose. The score of a pose is the number of landmarks that it explains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.walls import Room
from landmark_nav.localization.relocalization.candidate_detections import CandidateDetections
from landmark_nav.types import FloatArray, LandmarkMap

# Poses scored at a time, which bounds the memory for residuals.
_BLOCK = 2048
# Number of best detections of each landmark that are used.
_PER_LANDMARK = 4
# Tolerated bearing errors: for a pose of two detections, and for one of all that agree.
_ROUGH_RAD, _FINE_RAD = 0.07, 0.02
# Fewest landmarks that a pose must explain, and most poses returned.
_MIN_SUPPORT = 4
_PLACES = 60
# Poses that differ by less than both are one place.
DISTINCT_M, DISTINCT_RAD = 0.4, 0.2


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Poses (n, 3) of the base in map, and the number of landmarks each explains, descending."""

    poses: FloatArray
    support: npt.NDArray[np.intp]


def propose(detections: CandidateDetections, landmark_map: LandmarkMap) -> Hypotheses:
    """
    Find the poses that detections support.

    Parameters
    ----------
    detections : Detections
        All in one base frame.

    Returns
    -------
    Hypotheses
        Distinct poses; may be empty.
    """
    votes = _Votes(detections, landmark_map)
    poses = votes.of_pairs()
    if landmark_map.walls:
        poses = poses[Room(landmark_map.walls).contains(poses[:, :2])]
    support = votes.support(poses, _ROUGH_RAD)
    kept = _distinct(poses, support)
    # Refine poses of pairs by all detections that agree, with decreasing tolerance.
    poses = votes.refined(poses[kept], _ROUGH_RAD)
    poses = votes.refined(poses, 0.5 * (_ROUGH_RAD + _FINE_RAD))
    poses = votes.refined(poses, _FINE_RAD)
    support = votes.support(poses, _FINE_RAD)
    kept = _distinct(poses, support)
    return Hypotheses(poses[kept], support[kept])


class _Votes:
    """The best detections of each landmark, sorted by landmark, as arrays."""

    def __init__(self, detections: CandidateDetections, landmark_map: LandmarkMap) -> None:
        order = np.lexsort((-detections.score, detections.landmark))
        landmark = detections.landmark[order]
        first = np.searchsorted(landmark, landmark)
        order = order[np.arange(len(order)) - first < _PER_LANDMARK]
        self.landmark = detections.landmark[order]
        self.azimuth = detections.azimuth_rad[order]
        self.range = detections.range_m[order]
        self.range_sigma = detections.range_sigma[order]
        self.center = detections.center[order]
        self.place = landmark_map.positions[self.landmark, :2]
        self.normal = landmark_map.normals[self.landmark, :2]
        self.direction = np.stack([np.cos(self.azimuth), np.sin(self.azimuth)], -1)
        self.first = np.flatnonzero(np.diff(self.landmark, prepend=-1))

    def of_pairs(self) -> FloatArray:
        """Poses (m, 3) of all pairs of different landmarks whose distance agrees."""
        i, j = np.triu_indices(len(self.landmark), 1)
        point = self.center + self.range[:, None] * self.direction
        seen, true = point[j] - point[i], self.place[j] - self.place[i]
        length, true_length = np.hypot(*seen.T), np.hypot(*true.T)
        spread = (self.range * self.range_sigma) ** 2
        # Share of each range's error along the line between both points.
        with np.errstate(divide='ignore', invalid='ignore'):
            along = seen / length[:, None]
        share_i = np.sum(along * self.direction[i], -1) ** 2
        share_j = np.sum(along * self.direction[j], -1) ** 2
        sigma = np.sqrt(share_i * spread[i] + share_j * spread[j] + 0.03**2)
        good = (self.landmark[i] != self.landmark[j]) & (true_length > 0.3) & (length > 0.3)
        good &= np.abs(length - true_length) < 2.5 * sigma
        i, j, seen, true = i[good], j[good], seen[good], true[good]
        heading = np.arctan2(true[:, 1], true[:, 0]) - np.arctan2(seen[:, 1], seen[:, 0])
        # The position is that of both points, weighted by the precision of their ranges.
        weight = (spread[j] / (spread[i] + spread[j]))[:, None]
        turn = np.exp(1j * heading)
        anchor = weight * point[i] + (1.0 - weight) * point[j]
        turned = turn * (anchor[:, 0] + 1j * anchor[:, 1])
        at = weight * self.place[i] + (1.0 - weight) * self.place[j]
        position = at - np.stack([turned.real, turned.imag], -1)
        return np.column_stack([position, wrap_rad(heading)])

    def _residuals(self, poses: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Landmarks (h, s, 2) relative to each pose; bearing and relative range errors (h, s)."""
        cos, sin = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
        dx = self.place[:, 0] - poses[:, :1]
        dy = self.place[:, 1] - poses[:, 1:2]
        x = cos * dx + sin * dy - self.center[:, 0]
        y = cos * dy - sin * dx - self.center[:, 1]
        ahead = self.direction[:, 0] * x + self.direction[:, 1] * y
        aside = self.direction[:, 0] * y - self.direction[:, 1] * x
        bearing = np.arctan2(aside, ahead)
        relative = np.log(self.range / np.hypot(x, y))
        return np.stack([x, y], -1), bearing, relative

    def _agree(
        self,
        poses: FloatArray,
        points: FloatArray,
        bearing: FloatArray,
        relative: FloatArray,
        tolerance_rad: float,
    ) -> npt.NDArray[np.bool_]:
        """Whether detections fit poses (h, s): bearing, range, and facing the camera."""
        cos, sin = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
        normal_x = cos * self.normal[:, 0] + sin * self.normal[:, 1]
        normal_y = cos * self.normal[:, 1] - sin * self.normal[:, 0]
        facing = normal_x * points[..., 0] + normal_y * points[..., 1] < 0.0
        near = np.abs(relative) < 3.0 * self.range_sigma + tolerance_rad
        return np.asarray(facing & near & (np.abs(bearing) < tolerance_rad))

    def support(self, poses: FloatArray, tolerance_rad: float) -> npt.NDArray[np.intp]:
        """Number of landmarks that each pose explains, (h,)."""
        count = np.zeros(len(poses), dtype=np.intp)
        for start in range(0, len(poses), _BLOCK):
            block = slice(start, start + _BLOCK)
            fits = self._agree(poses[block], *self._residuals(poses[block]), tolerance_rad)
            count[block] = np.logical_or.reduceat(fits, self.first, axis=1).sum(axis=1)
        return count

    def refined(self, poses: FloatArray, tolerance_rad: float) -> FloatArray:
        """Poses after a Gauss-Newton step on the bearings and ranges that agree with each."""
        points, bearing, relative = self._residuals(poses)
        fits = self._agree(poses, points, bearing, relative, tolerance_rad)
        x, y = points[..., 0], points[..., 1]
        square = x**2 + y**2
        cos, sin = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
        # Derivatives of the expected bearing and the log of the expected range by a shift of the
        # base in its own frame and a turn about its origin.
        from_base_x, from_base_y = x + self.center[:, 0], y + self.center[:, 1]
        by_turn = np.stack([from_base_y, -from_base_x], -1)
        by_bearing = np.stack(
            [y / square, -x / square, (x * by_turn[..., 1] - y * by_turn[..., 0]) / square], -1
        )
        by_range = np.stack(
            [-x / square, -y / square, (x * by_turn[..., 0] + y * by_turn[..., 1]) / square], -1
        )
        weight_bearing = fits / (0.3 * tolerance_rad) ** 2
        weight_range = fits / self.range_sigma**2
        normal = np.einsum('hs,hsi,hsj->hij', weight_bearing, by_bearing, by_bearing)
        normal += np.einsum('hs,hsi,hsj->hij', weight_range, by_range, by_range)
        # Measured minus expected: `bearing` is expected minus measured.
        right = np.einsum('hs,hsi,hs->hi', -weight_bearing, by_bearing, bearing)
        right += np.einsum('hs,hsi,hs->hi', weight_range, by_range, relative)
        step = np.linalg.solve(normal + 1e-6 * np.eye(3), right[..., None])[..., 0]
        moved_x = cos[:, 0] * step[:, 0] - sin[:, 0] * step[:, 1]
        moved_y = sin[:, 0] * step[:, 0] + cos[:, 0] * step[:, 1]
        return np.asarray(poses + np.stack([moved_x, moved_y, step[:, 2]], -1))


def _distinct(poses: FloatArray, support: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """Indices of the poses, best first, without those close to a better one."""
    left = support.astype(np.float64)
    left[support < _MIN_SUPPORT] = -1.0
    kept: list[int] = []
    while len(kept) < _PLACES and len(left):
        best = int(np.argmax(left))
        if left[best] < 0.0:
            break
        kept.append(best)
        offset = poses - poses[best]
        near = np.hypot(offset[:, 0], offset[:, 1]) < DISTINCT_M
        near &= np.abs(wrap_rad(offset[:, 2])) < DISTINCT_RAD
        left[near] = -1.0
    return np.array(kept, dtype=np.intp)
