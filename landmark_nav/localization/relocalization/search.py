"""
Finding the robot's place without a prior: from one sweep, or from a few seconds of driving.

Detections of all landmarks without a prior -> poses that explain them -> for each pose, the
landmarks that should be seen from there are looked for -> the place, if it is unique.

A wide prior made narrow by the image itself.

A wide prior leaves open at which scale and slant landmarks appear. So all that may be in view are
searched at all scales and slants that the prior allows. Several detections that agree on a pose
give a narrow prior, with which landmarks are looked for as usual.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri, erfc

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import squared_distance, transform_points
from landmark_nav.localization.relocalization.candidate_detections import (
    CandidateDetections,
    find_candidate_detections,
)
from landmark_nav.localization.relocalization.config import RelocalizationConfig
from landmark_nav.localization.relocalization.hypotheses import DISTINCT_M, DISTINCT_RAD, propose
from landmark_nav.localization.relocalization.verification import (
    CarriedFrames,
    PlaceVerifier,
    Verification,
)
from landmark_nav.types import CameraFrame, FloatArray, PoseEstimate, Refusal, RefusalCode

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
    proposed = propose(CandidateDetections.joined(moved), verifier.landmark_map)
    if not len(proposed.poses):
        return nothing_recognised('no two detections agree on a place')
    poses, count, places = proposed.poses, len(proposed.poses), list[Verification]()
    for some in poses[:CANDIDATES], poses[CANDIDATES:_ALL_CANDIDATES]:
        places = verified_places(some, carried, verifier, places)
        judged = _judged(best_place(places, count), config)
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
    offsets = [place.estimate.pose - other.estimate.pose for other in others]
    return any(
        np.hypot(*offset[:2]) < 0.5 * DISTINCT_M and abs(wrap_rad(offset[2])) < 0.5 * DISTINCT_RAD
        for offset in offsets
    )


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
    if found < config.min_landmarks:
        return Refusal('too little seen', f'{found} landmarks support {where}')
    spread = _span(best.bearing_rad)
    if spread < _MIN_SPREAD_RAD:
        return Refusal(
            'too little seen',
            f'all {found} landmarks lie within {np.degrees(spread):.0f} deg: look around',
        )
    sigma = float(np.sqrt(np.trace(best.estimate.covariance[:2, :2])))
    sigma_turn = float(np.sqrt(best.estimate.covariance[2, 2]))
    if sigma > config.max_sigma_m or sigma_turn > config.max_sigma_rad:
        return Refusal(
            'too little seen',
            f'at {where} sigma is {sigma:.3f} m and {np.degrees(sigma_turn):.2f} deg: look around',
        )
    risk = _risks(best, config.max_sigma_m)
    if risk.sum() > _MOST_RISK:
        decides = int(np.argmax(risk))
        return Refusal(
            'too little seen',
            f'at {where} landmark {best.ids[decides]} decides, without it sigma is '
            f'{best.sigma_without_m[decides]:.3f} m: look around',
        )
    return best


def _risks(place: Verification, max_sigma_m: float) -> FloatArray:
    """
    Chance that a place is far off because a landmark was mistaken, for each landmark found, (n,).

    The fewer of those expected are found, the likelier is each of them something else; the place
    then is as uncertain as without it.
    """
    found, expected = len(place.ids), place.expected
    gone = (expected - found + 1.0) / (expected + 2.0)
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
    poses = propose(detections, landmark_map).poses
    rough = np.diag(np.square(_PROPOSED_SIGMA))
    likely = poses[[_allows(prior, pose, rough) for pose in poses]]
    still = CarriedFrames(frame.stamp_ns, [frame], np.zeros((1, 3)), np.zeros((1, 3)))
    places = [
        place
        for place in verified_places(likely[:CANDIDATES], still, verifier)
        if _allows(prior, place.estimate.pose, place.estimate.covariance)
    ]
    return best_place(places, len(likely))


def _allows(prior: PoseEstimate, pose: FloatArray, covariance: FloatArray) -> bool:
    """Whether a prior allows a pose (3,) with this covariance."""
    distance = squared_distance(pose, prior.pose, prior.covariance + covariance)
    return distance < float(chdtri(3, _EXCLUDED))
