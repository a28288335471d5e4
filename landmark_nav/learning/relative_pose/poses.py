"""
Poses of all sweeps: the shape from the panoramas, the scale from other sources.

Pairs of panoramas give headings and directions. These give initial poses of all sweeps, which are
then fitted to all matches at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import combinations
import logging

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.learning.least_squares import covariance_of, solve_positive
from landmark_nav.learning.relative_pose.epipolar import (
    DIRECTION_SIGMA_RAD,
    EpipolarFit,
    FEATURE_SIGMA_RAD,
    fit_poses,
    misses,
    RayPairs,
    residuals,
    RISE_SIGMA_M,
    STATE,
    TAIL,
    TILT_SIGMA_RAD,
)
from landmark_nav.learning.relative_pose.features import (
    alike_along,
    Features,
    like_pairs,
    LikePairs,
    matches_along,
    WIDE_BAND,
)
from landmark_nav.learning.relative_pose.pairs import by_likeness, Directions, Pair
from landmark_nav.learning.relative_pose.placing import placed
from landmark_nav.learning.relative_pose.rigid_sets import rigid_set, RigidSet
from landmark_nav.learning.relative_pose.scale import (
    contradiction,
    MOST_SCALE_SIGMA,
    odd_source,
    PlaceSource,
    scale_sigma,
    ScaleShare,
    SheetSource,
    Source,
    stacked,
)
from landmark_nav.learning.relative_pose.sheet_tracks import (
    FINE,
    Length,
    ROUGH,
    sheet_tracks,
)
from landmark_nav.learning.relative_pose.two_views import (
    along_curves,
    BY_CHANCE,
    hypotheses,
    MIN_MATCHES,
    states_of,
    turn_support,
    two_views_of,
    TwoViews,
)
from landmark_nav.learning.sheets import SheetView
from landmark_nav.types import FloatArray, PlaceChain

_LOG = logging.getLogger(__name__)

# A pose is accepted if it is these factors more likely than chance and than any other pose, and if
# the evidence of others is a smaller share of its own: matches are not quite independent.
_ODDS_OF_CHANCE, _ODDS_OF_RIVALS, _SHARE_OF_RIVALS = 1e5, 1e3, 0.7
# Half width of the band in which features are kept for matching, in sigmas: the first poses may be
# wrong by degrees.
_KEPT_BAND = 48.0
# There is no baseline if a rotation alone explains this share of the inliers.
_NO_BASELINE = 0.8
# Prior sigmas of x, y, heading (m, m, rad): of the first sweep, which defines the frame, and of
# the others.
_FIXED_SIGMA = 1e-6
_UNKNOWN_SIGMA = (10.0, 10.0, 3.0)
_ROUNDS = 3
# Least error of a heading by things that moved that is reported.
_WORTH_REPORTING_RAD = 1e-3
# Greatest sigma of the heading of a sweep by errors that matches share: half of the greatest error
# of a relative heading, 0.4 deg.
_MAX_HEADING_SIGMA_RAD = 0.0035
_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True, eq=False)
class RelativePoses:
    """
    Sweeps in the frame of the first one.

    Parameters
    ----------
    states : ndarray, shape (v, 6)
        x, y of the pan axis, heading of the base, height of the viewpoint, tilt about x and y.
    covariance : ndarray, shape (3 v, 3 v)
        Covariance of x, y, heading by the sources of the scale alone, without the panoramas.
    pairs : tuple of RayPairs
        Inlier matches.
    scales : tuple of ScaleShare
        Scale by each source.
    scale_sigma : float
        Relative sigma of the scale by all sources.
    wave_sigma_rad : float
        Sigma of directions of panoramas beyond the noise of features.
    shared_errors : ndarray, shape (6 v, q)
        Errors of the states that many matches share, as things of one wall moved or look alike.
    """

    states: FloatArray
    covariance: FloatArray
    pairs: tuple[RayPairs, ...]
    scales: tuple[ScaleShare, ...]
    scale_sigma: float
    wave_sigma_rad: float
    shared_errors: FloatArray

    def check(self) -> None:
        """
        Report that errors of headings or of the scale may be large, and what sources contradict.

        Raises `LandmarkNavError`: they may be too large.
        """
        for share in self.scales:
            share.check()
        if self.scale_sigma > MOST_SCALE_SIGMA:
            _LOG.warning(
                'the lengths of the map are good to %.0f %% only (sigma): sweep farther apart, or '
                'hang sheets of a known size (--paper-size)',
                100.0 * self.scale_sigma,
            )
        turns = np.linalg.norm(self.shared_errors[2::STATE], axis=1)
        worst, sigma = int(np.argmax(turns)) + 1, float(np.degrees(turns.max()))
        if turns.max() > _MAX_HEADING_SIGMA_RAD:
            raise LandmarkNavError(
                f'panoramas leave the heading of sweep {worst} uncertain by {sigma:.1f} deg '
                '(sigma): take a sweep between it and the others that sees more sides of the room'
            )
        if turns.max() > _WORTH_REPORTING_RAD:
            _LOG.warning(
                'parts of the panoramas agree on the heading of sweep %d to %.2f deg only: '
                'if things moved between the sweeps, sweep again',
                worst,
                sigma,
            )


def relative_poses(
    features: Sequence[Features],
    known: Sequence[PlaceChain],
    lever: FloatArray,
    sheets: Sequence[Sequence[SheetView]] = (),
    before: RelativePoses | None = None,
) -> RelativePoses:
    """
    Find the poses of sweeps from their panoramas, and the scale from all sources.

    Raises `LandmarkNavError`: panoramas share too little or have no baseline, nothing gives the
    scale, or sources contradict the panoramas or each other.

    Parameters
    ----------
    features : sequence of Features
        Features of the panorama of each sweep.
    known : sequence of PlaceChain
        Poses of the pan axis by each source; the first source defines the frame.
    lever : ndarray, shape (3,)
        Viewpoint in the base frame, m: that of the first sweep in map, if no source gives it.
    sheets : sequence of sequence of SheetView
        Candidates for sheets of a known size, of each sweep.
    before : RelativePoses, optional
        Poses found before the panoramas were levelled by them.
    """
    if before is None:
        start, pairs = _found(features, known, lever, sheets)
    else:
        start = before.states * np.array([1.0, 1.0, 1.0, 1.0, 0.0, 0.0])
        pairs = {(p.one, p.other): _alike(p.one, p.other, features, start) for p in before.pairs}
    fit, sources, pairs_along, shared_errors = _fitted(start, pairs, known, sheets)
    shares = tuple(source.share(fit.states, shared_errors) for source in sources)
    # Given poses are not left out: they define the frame.
    if (odd := odd_source(shares)) and odd != 'sweep/pose':
        wrong, *others = sorted(shares, key=lambda share: share.name != odd)
        right = max(others, key=lambda share: abs(share.scale - wrong.scale) / share.sigma)
        _LOG.warning('%s; %s is not used', contradiction(wrong, right), odd)
        known = [chain for chain in known if chain.source != odd]
        sheets = [[sheet for sheet in views if sheet.kind != odd] for views in sheets]
        fit, sources, pairs_along, shared_errors = _fitted(start, pairs, known, sheets)
        shares = tuple(source.share(fit.states, shared_errors) for source in sources)
    return RelativePoses(
        fit.states,
        _known_covariance(fit.states, sources),
        tuple(p.chosen(which) for p, which in zip(pairs_along, fit.agrees, strict=True)),
        shares,
        scale_sigma(shares),
        _wave_sigma(fit.states, pairs_along),
        shared_errors,
    )


def _wave_sigma(states: FloatArray, pairs: Sequence[RayPairs]) -> float:
    """Sigma of the residuals of matches beyond the noise of features."""
    off = [residuals(states, p, DIRECTION_SIGMA_RAD)[0] for p in pairs]
    seen = _MAD_TO_SIGMA * float(np.median(np.abs(np.concatenate(off))))
    variance = (seen * DIRECTION_SIGMA_RAD) ** 2 - FEATURE_SIGMA_RAD**2
    return float(np.sqrt(max(variance, 0.0)))


def _found(
    features: Sequence[Features],
    known: Sequence[PlaceChain],
    lever: FloatArray,
    sheets: Sequence[Sequence[SheetView]],
) -> tuple[FloatArray, dict[Pair, LikePairs]]:
    """Initial states (v, 6) by matches of pairs of panoramas, and the pairs that share enough."""
    found: dict[Pair, TwoViews] = {}
    ambiguous: dict[Pair, list[TwoViews]] = {}
    kept: dict[Pair, LikePairs] = {}
    alone = list[Pair]()
    pairs, partners = by_likeness(features)
    known_ways = Directions(len(features))
    for i, j in pairs:
        if (i, j) not in partners and not known_ways.lack((i, j)):
            continue
        alike = like_pairs(features[i], features[j])
        rays = RayPairs(i, j, *alike.distinct())
        ranked = hypotheses(rays)
        turn = turn_support(rays, DIRECTION_SIGMA_RAD)
        agreed = ranked[0].support if ranked else 0
        if turn >= max(MIN_MATCHES, _NO_BASELINE * agreed):
            alone.append((i, j))
            continue
        ranked = along_curves(ranked, alike)
        if not ranked or ranked[0].evidence < BY_CHANCE + np.log(_ODDS_OF_CHANCE):
            continue
        best = ranked[0].evidence
        least = min(best - np.log(_ODDS_OF_RIVALS), _SHARE_OF_RIVALS * best)
        rivals = [pose for pose in ranked if pose.evidence > least]
        if len(rivals) == 1:
            found[i, j] = rivals[0]
            known_ways.add((i, j))
            kept[i, j] = alike_along(0, 1, states_of(rivals[0]), alike, _KEPT_BAND)
        else:
            ambiguous[i, j] = rivals
    lengths: dict[Pair, Length] = {}
    with suppress(LandmarkNavError):  # what no pair decides, all together may
        lengths = sheet_tracks(sheets, found, ROUGH)[1]
    if known:
        eyes = known[0].poses[:, :2]
        lengths = {(i, j): Length(float(np.hypot(*(eyes[j] - eyes[i]))), np.inf) for i, j in found}
    if any(sheets) and found and not lengths:
        # All sheets together give the scale once all sweeps are placed.
        lengths = {max(found, key=lambda pair: found[pair].support): Length(1.0, 0.0)}
    first = np.zeros(STATE)
    first[:3] = known[0].poses[0] if known else [*lever[:2], 0.0]
    first[3] = lever[2]
    states = placed(len(features), found, ambiguous, alone, lengths, first)
    for i, j in ambiguous:
        kept[i, j] = _alike(i, j, features, states)
    return states, kept


def _alike(i: int, j: int, features: Sequence[Features], states: FloatArray) -> LikePairs:
    """Pairs of features that may be matches by the states; all of them take much memory."""
    alike = like_pairs(features[i], features[j])
    return alike_along(i, j, states, alike, _KEPT_BAND)


def _fitted(
    start: FloatArray,
    matched: Mapping[Pair, LikePairs],
    known: Sequence[PlaceChain],
    sheets: Sequence[Sequence[SheetView]],
) -> tuple[EpipolarFit, list[Source], list[RayPairs], FloatArray]:
    """Fit to all matches and sources of the scale; the last are shared errors (6 v, q)."""
    prior = np.zeros_like(start)
    prior[0, :3], prior[:, 3] = start[0, :3], start[0, 3]
    covariance, states = _prior_covariance(len(start)), start
    places = [PlaceSource(chain) for chain in known]
    # Before the first fit, too: wrong poses would move the panoramas to matches that fit them.
    for place in places:
        place.inflate(states)
    fitted = partial(fit_poses, prior=prior, prior_covariance=covariance)
    rigid: list[RigidSet] = []
    precise = FEATURE_SIGMA_RAD
    for number in range(_ROUNDS):
        # Also pairs whose features were not compared may show a sheet.
        every = list(combinations(range(len(states)), 2))
        poses = {pair: two_views_of(states, *pair) for pair in every}
        ways = {(i, j): float(np.hypot(*(states[j] - states[i])[:2])) for i, j in every}
        rough = FINE if number else ROUGH
        tracks = sheet_tracks(sheets, poses, rough, ways)[0] if sheets else []
        seen = SheetSource.of_kinds(tracks)
        sources: list[Source] = [*places, *(k.agreeing(states) if number else k for k in seen)]
        if number:
            for source in sources:
                source.inflate(states)
        if not sources:
            raise LandmarkNavError(
                'nothing gives the scale: no two sweeps show a sheet of the size given at one '
                'place: hang more of them where several sweeps see them, or record odom'
            )
        pairs = [matches_along(*p, states, alike) for p, alike in matched.items()]
        others = stacked(sources)
        if number:
            fit = fitted(states, pairs, precise, others=others, first_width=TAIL)
        else:
            states = fitted(states, pairs, DIRECTION_SIGMA_RAD, others=others).states
            wide = [matches_along(*p, states, alike, WIDE_BAND) for p, alike in matched.items()]
            rigid = [rigid_set(states, p) for p in wide]
            precise = max(k.sigma_rad for k in rigid)
            pairs = [p.chosen(k.agrees) for p, k in zip(wide, rigid, strict=True)]
            fit = fitted(states, pairs, precise, others=others)
        states = fit.states
    for source in sources:
        source.inflate(states)
    return fit, sources, pairs, _shared_errors(fit, pairs, rigid, sources, precise)


def _shared_errors(
    fit: EpipolarFit,
    pairs: Sequence[RayPairs],
    rigid: Sequence[RigidSet],
    sources: Sequence[Source],
    sigma_rad: float,
) -> FloatArray:
    """Errors (6 v, q) of all states by those of pairs, which share the sections of the room."""
    size = fit.states.size
    # Panoramas show no scale: without its sources it would be unknown.
    _, known = stacked(sources)(fit.states)
    information = solve_positive(_prior_covariance(len(fit.states)), np.eye(size))
    information += known.T @ known
    pull = np.zeros((size, rigid[0].loading.shape[1]))
    for p, agrees, found in zip(pairs, fit.agrees, rigid, strict=True):
        inliers = p.chosen(agrees)
        _, slopes, _ = misses(fit.states, inliers, sigma_rad)
        jacobian = np.zeros((len(slopes), len(fit.states), STATE))
        jacobian[:, p.one], jacobian[:, p.other] = slopes[:, 0], slopes[:, 1]
        flat = jacobian.reshape(len(slopes), size)
        information += flat.T @ flat
        pull += flat.T @ (slopes[:, 1] @ found.loading)
    return np.asarray(solve_positive(information, pull))


def _prior_covariance(count: int) -> FloatArray:
    """Prior covariance (6 v, 6 v) of the states."""
    rise, tilt = RISE_SIGMA_M, TILT_SIGMA_RAD
    sigma = np.tile([*_UNKNOWN_SIGMA, rise, tilt, tilt], (count, 1))
    sigma[0, :4] = _FIXED_SIGMA
    return np.diag(sigma.ravel() ** 2)


def _known_covariance(states: FloatArray, sources: Sequence[Source]) -> FloatArray:
    """Covariance (3 v, 3 v) of x, y, heading by the sources alone."""
    count = len(states)
    _, jacobian = stacked(sources)(states)
    information = jacobian.T @ jacobian + np.linalg.inv(_prior_covariance(count))
    joint = covariance_of(information).reshape(count, STATE, count, STATE)
    return np.asarray(joint[:, :3, :, :3].reshape(3 * count, 3 * count))
