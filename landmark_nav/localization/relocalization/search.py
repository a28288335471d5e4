"""
Finding the robot's place without a prior: from one sweep, or from a few seconds of driving.

Detections of all landmarks without a prior -> poses that explain them -> for each pose, the
landmarks that should be seen from there are looked for -> the place, if it is unique.

Most detections are false: each pair of them proposes a pose, all vote. Two detections with ranges
are two points relative to the robot; with the positions of the two landmarks they determine a
pose. The score of a pose is the number of landmarks that it explains.

A wide prior leaves open at which scale and slant landmarks appear: all that it allows are searched
in the image, and several detections that agree on a pose give a narrow prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri, erfc

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import squared_distance, transform_points
from landmark_nav.localization.relocalization.candidate_detections import (
    CandidateDetections,
    find_candidate_detections,
)
from landmark_nav.localization.relocalization.verification import (
    CarriedFrames,
    PlaceVerifier,
    Verification,
)
from landmark_nav.parameters import Config, parameter
from landmark_nav.types import (
    CameraFrame,
    FloatArray,
    LandmarkMap,
    PoseEstimate,
    Refusal,
    RefusalCode,
)

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


def propose(detections: CandidateDetections, landmark_map: LandmarkMap) -> FloatArray:
    """Distinct poses (n, 3) that detections, all in one base frame, support, the best first."""
    votes = _Votes(detections, landmark_map)
    poses = votes.of_pairs()
    if landmark_map.room is not None:
        poses = poses[landmark_map.room.contains(poses[:, :2])]
    poses = _distinct(poses, votes.support(poses, _ROUGH_RAD))
    # Refine poses of pairs by all detections that agree, with decreasing tolerance.
    for tolerance_rad in (_ROUGH_RAD, 0.5 * (_ROUGH_RAD + _FINE_RAD), _FINE_RAD):
        poses = votes.refined(poses, tolerance_rad)
    return _distinct(poses, votes.support(poses, _FINE_RAD))


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

    def _fit(
        self, poses: FloatArray, tolerance_rad: float
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, npt.NDArray[np.bool_]]:
        """
        Compare detections (s,) with poses (h, 3): arrays (h, s).

        Returns x and y of the landmarks in the frame of each pose, from the optical centre; errors
        of bearing and relative range; and whether bearing, range and direction of the patch fit.
        """
        cos, sin = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
        dx, dy = self.place[:, 0] - poses[:, :1], self.place[:, 1] - poses[:, 1:2]
        x = cos * dx + sin * dy - self.center[:, 0]
        y = cos * dy - sin * dx - self.center[:, 1]
        ahead = self.direction[:, 0] * x + self.direction[:, 1] * y
        aside = self.direction[:, 0] * y - self.direction[:, 1] * x
        bearing, relative = np.arctan2(aside, ahead), np.log(self.range / np.hypot(x, y))
        normal_x = cos * self.normal[:, 0] + sin * self.normal[:, 1]
        normal_y = cos * self.normal[:, 1] - sin * self.normal[:, 0]
        fits = normal_x * x + normal_y * y < 0.0
        fits &= np.abs(relative) < 3.0 * self.range_sigma + tolerance_rad
        return x, y, bearing, relative, fits & (np.abs(bearing) < tolerance_rad)

    def support(self, poses: FloatArray, tolerance_rad: float) -> npt.NDArray[np.intp]:
        """Number of landmarks that each pose explains, (h,)."""
        count = np.zeros(len(poses), dtype=np.intp)
        for start in range(0, len(poses), _BLOCK):
            block = slice(start, start + _BLOCK)
            *_, fits = self._fit(poses[block], tolerance_rad)
            count[block] = np.logical_or.reduceat(fits, self.first, axis=1).sum(axis=1)
        return count

    def refined(self, poses: FloatArray, tolerance_rad: float) -> FloatArray:
        """Poses after a Gauss-Newton step on the bearings and ranges that agree with each."""
        x, y, bearing, relative, fits = self._fit(poses, tolerance_rad)
        square = (x**2 + y**2)[..., None]
        # Derivatives of the expected bearing and the log of the expected range by a shift of the
        # base in its own frame and a turn about its origin.
        turned_x, turned_y = y + self.center[:, 1], -(x + self.center[:, 0])
        by_bearing = np.stack([y, -x, x * turned_y - y * turned_x], -1) / square
        by_range = np.stack([-x, -y, x * turned_x + y * turned_y], -1) / square
        weight_bearing = fits / (0.3 * tolerance_rad) ** 2
        weight_range = fits / self.range_sigma**2
        normal = np.einsum('hs,hsi,hsj->hij', weight_bearing, by_bearing, by_bearing)
        normal += np.einsum('hs,hsi,hsj->hij', weight_range, by_range, by_range)
        # Measured minus expected: `bearing` is expected minus measured.
        right = np.einsum('hs,hsi,hs->hi', -weight_bearing, by_bearing, bearing)
        right += np.einsum('hs,hsi,hs->hi', weight_range, by_range, relative)
        step = np.linalg.solve(normal + 1e-6 * np.eye(3), right[..., None])[..., 0]
        cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        moved_x = cos * step[:, 0] - sin * step[:, 1]
        moved_y = sin * step[:, 0] + cos * step[:, 1]
        return np.asarray(poses + np.stack([moved_x, moved_y, step[:, 2]], -1))


def _distinct(poses: FloatArray, support: npt.NDArray[np.intp]) -> FloatArray:
    """Poses with enough support, best first, without those close to a better one."""
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
    return poses[kept]


@dataclass(frozen=True)
class RelocalizationConfig(Config):
    """
    How the pose is found without a prior, and when it is accepted.

    The values are chosen by hand; docs/decisions.md (localization) has comparisons.
    """

    when_lost: bool = parameter(True, 'relocalize automatically while the pose is lost')
    search_s: float = parameter(
        15.0, 'how long a call of relocalize may look around', minimum=0.1, maximum=3600.0
    )
    # Time without any landmark in the images after which the robot also relocalizes, s: where no
    # landmark is expected, nothing contradicts a wrong pose.
    unseen_s: float = 2.0
    # Fewest landmarks that must support a pose.
    min_landmarks: int = 6
    # Largest predicted position sigma (root of the trace), m.
    max_sigma_m: float = 0.03
    # Largest predicted heading sigma, rad.
    max_sigma_rad: float = 0.008
    # Sigma of tilt and roll in a second search, if the first recognises nothing, rad; 0 disables
    # it, so that only a small roll is found.
    tilt_sigma_rad: float = 0.02


# Least share of the landmarks expected at a place that must be found there.
_MIN_FOUND_SHARE = 0.4
# Most landmarks that another place may have, as a share of those of the best. What the map lacks
# there is no evidence: nor may as many be found of those that are expected, up to this share.
_MAX_RIVAL_SHARE, _ALIKE = 0.5, 0.75
# So many proposed places are verified, and so many before one is accepted.
CANDIDATES, _ALL_CANDIDATES = 4, 16
# So many landmarks at a place are not found by chance.
_LEAST_LANDMARKS = 4
# Share of landmarks that are gone for which something else is taken (4 % of 220 that were given
# other textures), and the most chance that a place is off by over three times the limit of sigma
# because one landmark was.
_TAKEN_SHARE, _MOST_RISK, _OFF_SIGMAS = 0.05, 1e-3, 3.0
# The landmarks found must span this angle.
_MIN_SPREAD_RAD = 0.6


def locate(
    carried: CarriedFrames,
    detections: Sequence[CandidateDetections],
    verifier: PlaceVerifier,
    config: RelocalizationConfig,
) -> Verification | Refusal:
    """
    Find the robot's place without any prior.

    Parameters
    ----------
    carried : CarriedFrames
        Images, and the poses of the base at each by odometry.
    detections : sequence of Detections
        Possible detections in each image, found without a prior.

    Returns
    -------
    Verification or Refusal
        The pose of the base at the last image with its evidence; or ``not unique`` if another
        place explains the images nearly as well, ``nothing recognised`` if none does, and ``too
        little seen`` if there is not enough evidence.
    """
    moved = [
        replace(
            seen,
            azimuth_rad=seen.azimuth_rad + pose[2],
            center=transform_points(pose, seen.center),
        )
        for seen, pose in zip(detections, carried.poses_last_base, strict=True)
    ]
    poses = propose(CandidateDetections.joined(moved), verifier.landmark_map)
    if not len(poses):
        return nothing_recognised('no two detections agree on a place')
    places: list[Verification] = []
    for some in poses[:CANDIDATES], poses[CANDIDATES:_ALL_CANDIDATES]:
        places = verified_places(some, carried, verifier, places)
        judged = _judged(best_place(places, len(poses)), config)
        if isinstance(judged, Refusal):
            break
    return judged


def verified_places(
    poses: FloatArray,
    carried: CarriedFrames,
    verifier: PlaceVerifier,
    known: Sequence[Verification] = (),
) -> list[Verification]:
    """Verify poses (n, 3); return them with those `known`, if different, most landmarks first."""
    places = list(known)
    for pose in poses:
        outcome = verifier.verify(pose, carried)
        if isinstance(outcome, Verification) and not _known(outcome, places):
            places.append(outcome)
    return sorted(places, key=lambda place: -len(place.ids))


def _known(place: Verification, others: Sequence[Verification]) -> bool:
    """Whether a place is the same as one of the others."""
    apart = np.array([place.estimate.pose - k.estimate.pose for k in others]).reshape(-1, 3)
    near = np.hypot(apart[:, 0], apart[:, 1]) < 0.5 * DISTINCT_M
    return bool(np.any(near & (np.abs(wrap_rad(apart[:, 2])) < 0.5 * DISTINCT_RAD)))


def best_place(places: Sequence[Verification], proposed: int) -> Verification | Refusal:
    """
    Take the first place, unless it has a rival or too few of its expected landmarks were found.

    Parameters
    ----------
    places : sequence of Verification
        Different places, the one with most landmarks first.
    proposed : int
        How many poses were proposed, for the message.
    """
    if not places:
        return nothing_recognised(f'none of {proposed} places shows what is to be seen there')
    best, *others = places
    found = len(best.ids)
    for other in others:
        many = len(other.ids) > _MAX_RIVAL_SHARE * found
        if many or (len(other.ids) >= _LEAST_LANDMARKS and other.share > _ALIKE * best.share):
            return Refusal(
                'not unique',
                f'{found} of {best.expected} landmarks are found at {_where(best)}, '
                f'{len(other.ids)} of {other.expected} at {_where(other)}',
            )
    if best.share < _MIN_FOUND_SHARE:
        return nothing_recognised(
            f'at {_where(best)} only {found} of {best.expected} landmarks are found'
        )
    return best


def nothing_recognised(detail: str) -> Refusal:
    """No pose shows what should be seen from it."""
    return Refusal('nothing recognised', detail, RefusalCode.UNRECOGNISED)


def _where(place: Verification) -> str:
    x, y, heading = place.estimate.pose
    return f'({x:.2f}, {y:.2f}) m, {np.degrees(heading):.0f} deg'


def _judged(best: Verification | Refusal, config: RelocalizationConfig) -> Verification | Refusal:
    """Return the best place if there is enough evidence for it."""
    if isinstance(best, Refusal):
        return best
    found, where = len(best.ids), _where(best)
    spread = _span(best.bearing_rad)
    sigma = float(np.sqrt(np.trace(best.estimate.covariance[:2, :2])))
    sigma_turn = float(np.sqrt(best.estimate.covariance[2, 2]))
    risk = _risks(best, config.max_sigma_m)
    if found < config.min_landmarks:
        why = f'{found} landmarks support {where}'
    elif spread < _MIN_SPREAD_RAD:
        why = f'all {found} landmarks lie within {np.degrees(spread):.0f} deg: look around'
    elif sigma > config.max_sigma_m or sigma_turn > config.max_sigma_rad:
        turn = f'{np.degrees(sigma_turn):.2f} deg'
        why = f'at {where} sigma is {sigma:.3f} m and {turn}: look around'
    elif risk.sum() > _MOST_RISK:
        decides = int(np.argmax(risk))
        without = f'without it sigma is {best.sigma_without_m[decides]:.3f} m'
        why = f'at {where} landmark {best.ids[decides]} decides, {without}: look around'
    else:
        return best
    return Refusal('too little seen', why)


def _risks(place: Verification, max_sigma_m: float) -> FloatArray:
    """Chance (n,) that a place is far off because a landmark that was found was mistaken."""
    # The fewer of those expected are found, the likelier is each of them something else; the place
    # then is as uncertain as without it.
    gone = (place.expected - len(place.ids) + 1.0) / (place.expected + 2.0)
    mistaken = gone * _TAKEN_SHARE / (gone * _TAKEN_SHARE + 1.0 - gone)
    far = _OFF_SIGMAS * max_sigma_m / place.sigma_without_m
    return np.asarray(mistaken * erfc(far / np.sqrt(2.0)))


def _span(bearing_rad: FloatArray) -> float:
    """Angle of the smallest sector that holds all bearings, radians."""
    ordered = np.sort(wrap_rad(bearing_rad))
    gaps = np.diff(ordered, append=ordered[0] + 2.0 * np.pi)
    return float(2.0 * np.pi - gaps.max())


# A pose is excluded if the prior leaves it less than this probability.
_EXCLUDED = 0.001
# Least sigmas of a prior, which may be singular, and those of a proposed pose, m and rad.
_LEAST_SIGMA, _PROPOSED_SIGMA = (1e-3, 1e-3, 1e-3), (0.1, 0.1, 0.035)


def localize_within_prior(
    frame: CameraFrame, prior: PoseEstimate, verifier: PlaceVerifier
) -> Verification | Refusal:
    """Find the pose of the base within a wide prior by one image, or why there is none."""
    prior = replace(prior, covariance=prior.covariance + np.diag(np.square(_LEAST_SIGMA)))
    landmark_map = verifier.landmark_map
    detections = find_candidate_detections(frame, landmark_map, verifier.mount, prior)
    poses = propose(detections, landmark_map)
    rough = np.diag(np.square(_PROPOSED_SIGMA))
    likely = poses[[_allows(prior, pose, rough) for pose in poses]]
    still = CarriedFrames(frame.stamp_ns, [frame], np.zeros((1, 3)), np.zeros((1, 3)))
    places = verified_places(likely[:CANDIDATES], still, verifier)
    possible = [k for k in places if _allows(prior, k.estimate.pose, k.estimate.covariance)]
    return best_place(possible, len(likely))


def _allows(prior: PoseEstimate, pose: FloatArray, covariance: FloatArray) -> bool:
    """Whether a prior allows a pose (3,) with this covariance."""
    distance = squared_distance(pose, prior.pose, prior.covariance + covariance)
    return distance < float(chdtri(3, _EXCLUDED))
