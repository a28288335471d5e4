"""
Sheets of a known size in several panoramas: points with a measured range.

The correspondence of candidates is unknown, and some are not sheets. Two views of one sheet give
the length of the baseline; the likeliest is taken, or one scale of all baselines.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.se2 import rot_z
from landmark_nav.learning.relative_pose.epipolar import center, STATE, turned
from landmark_nav.learning.relative_pose.two_views import TwoViews
from landmark_nav.learning.sheets import SheetView
from landmark_nav.types import FloatArray

# Sigma of relative poses before and after the fit, rad; times the range it is the residual between
# two views of a sheet.
ROUGH, FINE = 0.006, 0.0015
# Significance at which two views show different sheets; greatest difference of equal lengths, in
# sigmas; greatest relative sigma of a useful length.
_CHANCE, _SAME_SIGMAS, _MOST_SIGMA = 1e-3, 3.0, 0.1
# By chance, a scale is anywhere within a factor of ten to either side: the width of its logarithm.
# Odds by which a scale must be likelier than another, beyond two sigmas of their noise.
_BY_CHANCE, _ODDS = 2.0 * np.log(10.0), 3.0
# Number of directions that a sheet may face, which are tried.
_SLANTS = 2881


# A view and the number of a sheet in it; two of these that are one sheet.
_Seen = tuple[int, int]
_Link = tuple[_Seen, _Seen]


@dataclass(frozen=True, eq=False)
class SheetTrack:
    """
    One sheet in `views` (m,).

    `positions` (m, 3), `covariance` (m, 3, 3) and `shared` (m, 3, q) are as in `SheetView`.
    """

    kind: str
    name: str
    views: tuple[int, ...]
    positions: FloatArray
    covariance: FloatArray
    shared: FloatArray


class Length(NamedTuple):
    """Length of a baseline, and logarithm of its odds to another length."""

    length_m: float
    lead: float


@dataclass(frozen=True)
class _Pair:
    """One sheet in two views: logarithm of the scale of their baseline by it, and its sigma."""

    one: _Seen
    other: _Seen
    scale: float
    sigma: float


def _gains(pairs: Sequence[_Pair], scale: float) -> FloatArray:
    """Logarithms (n,) of the likelihood ratio of a scale to chance, by each pair."""
    scales, sigmas = np.array([(pair.scale, pair.sigma) for pair in pairs]).reshape(-1, 2).T
    peaks = np.log(_BY_CHANCE / (np.sqrt(2.0 * np.pi) * sigmas))
    return np.asarray(peaks - 0.5 * ((scales - scale) / sigmas) ** 2)


@dataclass(frozen=True)
class _Group:
    """Pairs that agree on a scale."""

    pairs: tuple[_Pair, ...] = ()

    @cached_property
    def _information(self) -> FloatArray:
        return np.asarray(1.0 / np.square([pair.sigma for pair in self.pairs]))

    @cached_property
    def scale(self) -> float:
        """Weighted mean of the logarithm of the scale."""
        return float(np.average([pair.scale for pair in self.pairs], weights=self._information))

    @cached_property
    def evidence(self) -> float:
        """Logarithm of the likelihood ratio to chance, over all scales: 0 for a single pair."""
        if not self.pairs:
            return 0.0
        sigma = np.sqrt(2.0 * np.pi / self._information.sum())
        return float(_gains(self.pairs, self.scale).sum() + np.log(sigma / _BY_CHANCE))

    @property
    def noise(self) -> float:
        """Variance of the evidence: the p pairs of a sheet in m views have m - 1 own errors."""
        ones = [pair.one for pair in self.pairs]
        sheets = _groups([(pair.one, pair.other) for pair in self.pairs])
        # Half of a chi-square of m - 1 degrees of freedom, p / (m - 1) times as large.
        return sum(0.5 * sum(map(ones.count, seen)) ** 2 / (len(seen) - 1) for seen in sheets)


def sheet_tracks(
    sheets: Sequence[Sequence[SheetView]],
    found: Mapping[tuple[int, int], TwoViews],
    pose_sigma_rad: float,
    baselines_m: Mapping[tuple[int, int], float] | None = None,
) -> tuple[list[SheetTrack], dict[tuple[int, int], Length]]:
    """
    Find which views show the same sheets.

    Pairs of views whose sheets support two lengths alike are left out. With the baselines of all,
    which then have one scale, all sheets of a kind support the same.

    Raises `LandmarkNavError`: nothing else gives a length.

    Parameters
    ----------
    sheets : sequence of sequence of SheetView
        Candidates for sheets of each view.
    found : mapping
        Relative poses of pairs of views.
    pose_sigma_rad : float
        Sigma of these poses.
    baselines_m : mapping, optional
        Baselines of these pairs by the poses of all views, for one scale; horizontal, m.

    Returns
    -------
    tracks : list of SheetTrack
    lengths : dict
        Baselines of pairs that share sheets.
    """
    links: list[_Link] = []
    lengths, undecided = dict[tuple[int, int], Length](), list[str]()
    kinds = sorted({seen.kind for view in sheets for seen in view})
    # Kinds whose given sizes contradict each other are compared once the poses are fitted.
    together = [[pair] for pair in found] if baselines_m is None else [list(found)]
    for pairs, kind in product(together, kinds):
        units = {pair: 1.0 if baselines_m is None else baselines_m[pair] for pair in pairs}
        ways = [
            way
            for pair, unit in units.items()
            for way in _ways(kind, sheets, pair, found[pair], unit, pose_sigma_rad)
        ]
        best, rival = _agreed(ways)
        lead = best.evidence - rival.evidence
        if rival.pairs and lead < np.log(_ODDS) + 2.0 * np.sqrt(best.noise + rival.noise):
            i, j = best.pairs[0].one[0], best.pairs[0].other[0]
            apart = [f'{np.exp(group.scale) * units[i, j]:.2f} m' for group in (best, rival)]
            undecided.append(
                f'sheets that sweeps {i + 1} and {j + 1} both show say that these are '
                f'{" and ".join(apart)} apart: other things look like sheets, or the size is '
                'wrong: hang more sheets, or check the size given'
            )
            continue
        links += [(way.one, way.other) for way in best.pairs]
        for i, j in {(way.one[0], way.other[0]) for way in best.pairs}:
            if (i, j) not in lengths or lead > lengths[i, j].lead:
                lengths[i, j] = Length(float(np.exp(best.scale)) * units[i, j], lead)
    if undecided and not lengths:
        raise LandmarkNavError(undecided[0])
    tracks = []
    for group in _groups(links):
        views = tuple(view for view, _ in group)
        if len(set(views)) < len(views):
            continue  # two sheets that one view shows apart
        seen = [sheets[view][k] for view, k in group]
        measured = (
            np.array([getattr(s, what) for s in seen])
            for what in ('position', 'covariance', 'shared')
        )
        tracks.append(SheetTrack(seen[0].kind, seen[0].name, views, *measured))
    return tracks, lengths


def _agreed(pairs: Sequence[_Pair]) -> tuple[_Group, _Group]:
    """Views of sheets that agree on the likeliest scale, and on the likeliest other scale."""

    def likeliest(among: Sequence[_Pair]) -> _Group:
        groups = [_distinct(_likely(among, q.scale)) for q in among]
        return max(groups, key=lambda group: group.evidence, default=_Group())

    best = likeliest(pairs)
    return best, likeliest([p for p in pairs if not any(_same(p, q) for q in best.pairs)])


def _likely(pairs: Sequence[_Pair], scale: float) -> list[_Pair]:
    """Pairs that are likelier at a scale than by chance."""
    return [p for p, gain in zip(pairs, _gains(pairs, scale), strict=True) if gain > 0.0]


def _ways(
    kind: str,
    sheets: Sequence[Sequence[SheetView]],
    views: tuple[int, int],
    pose: TwoViews,
    unit: float,
    pose_sigma_rad: float,
) -> Iterator[_Pair]:
    """Yield what may be one sheet in two views, and the scale of their baseline by it."""
    i, j = views
    state = np.array([0.0, 0.0, pose.heading_rad, 0.0, *pose.tilt_rad])
    rotation = rot_z(pose.heading_rad)
    along = np.array([np.cos(pose.direction_rad), np.sin(pose.direction_rad), pose.slope])
    for (a, first), (b, second) in product(enumerate(sheets[i]), enumerate(sheets[j])):
        if not first.kind == second.kind == kind or first.name != second.name:
            continue
        there = turned(state, second.position[None])[0]
        reach = np.array([np.linalg.norm(s.position) for s in (first, second)])
        rough = pose_sigma_rad**2 * np.sum(reach**2)
        covariance = first.covariance + rotation @ second.covariance @ rotation.T
        information = np.linalg.inv(covariance + rough * np.eye(3))
        way = first.position - there
        variance = 1.0 / (along @ information @ along)
        length = float(variance * (along @ information @ way))
        left = way - length * along
        sigma = float(np.sqrt(variance))
        if (
            left @ information @ left < chdtri(2, _CHANCE)
            and _hidden(first, second, there) < chdtri(1, _CHANCE)
            and length > 0.0
            and sigma < _MOST_SIGMA * length
        ):
            yield _Pair((i, a), (j, b), float(np.log(length / unit)), sigma / length)


def _hidden(first: SheetView, second: SheetView, there: FloatArray) -> float:
    """
    Chi-square of the widths of a sheet in two views: no slant explains one that is partly hidden.

    `there` (3,) is the direction of the second view along the axes of the first.
    """
    slants = np.linspace(-np.pi, np.pi, _SLANTS)[:, None]
    azimuths = np.arctan2([first.position[1], there[1]], [first.position[0], there[0]])
    expected = np.cos(slants - azimuths)
    views = np.array([[v.foreshortening, v.foreshortening_sigma] for v in (first, second)])
    squares = np.sum(((expected - views[:, 0]) / views[:, 1]) ** 2, axis=1)
    return float(squares.min())


def _same(one: _Pair, other: _Pair) -> bool:
    apart = abs(one.scale - other.scale)
    return bool(apart < _SAME_SIGMAS * np.hypot(one.sigma, other.sigma))


def _distinct(pairs: Sequence[_Pair]) -> _Group:
    """The most certain of the pairs that share a view of a sheet with the same other view."""
    kept: list[_Pair] = []
    taken = set[tuple[_Seen, int]]()
    for pair in sorted(pairs, key=lambda p: p.sigma):
        ends = {(pair.one, pair.other[0]), (pair.other, pair.one[0])}
        if not ends & taken:
            kept.append(pair)
            taken |= ends
    return _Group(tuple(kept))


def _groups(
    links: Sequence[_Link],
) -> list[list[_Seen]]:
    """What is linked, directly or over others."""
    groups: list[set[_Seen]] = []
    for link in links:
        joined = set(link).union(*(g for g in groups if g & set(link)))
        groups = [g for g in groups if not g & joined] + [joined]
    return [sorted(group) for group in groups]


def sheet_misses(
    states: FloatArray, track: SheetTrack
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    How far the views of a sheet miss each other, in standard deviations.

    The sheet itself is eliminated: what remains is off its best location.

    Parameters
    ----------
    states : ndarray, shape (v, 6)
        Of the sweeps.

    Returns
    -------
    misses : ndarray, shape (3 m,)
    jacobian : ndarray, shape (3 m, v, 6)
        By the states.
    by_shared : ndarray, shape (3 m, q)
        By the errors that all sheets of the kind share.
    """
    count = len(track.views)
    off, weight = np.empty((count, 3)), np.zeros((count, 3, 3))
    jacobian = np.zeros((count, 3, len(states), STATE))
    by_shared = np.empty_like(track.shared)
    for k, (view, seen) in enumerate(zip(track.views, track.positions, strict=True)):
        state, rotation = states[view], rot_z(states[view, 2])
        root = np.linalg.cholesky(rotation @ track.covariance[k] @ rotation.T)
        weight[k] = np.linalg.inv(root)
        reach = turned(state, seen[None])[0]
        by_shared[k] = rotation @ track.shared[k]
        off[k] = center(state) + reach
        slope = jacobian[k, :, view]
        slope[0, 0] = slope[1, 1] = slope[2, 3] = 1.0
        slope[:2, 2] = -reach[1], reach[0]
        slope[:, 4] = rotation @ [0.0, -seen[2], seen[1]]
        slope[:, 5] = rotation @ [seen[2], 0.0, -seen[0]]
    design = weight.reshape(3 * count, 3)
    left = np.eye(3 * count) - design @ np.linalg.pinv(design)

    def whitened(rows: FloatArray) -> FloatArray:
        flat = np.einsum('kij,kj...->ki...', weight, rows).reshape(3 * count, -1)
        return np.asarray(left @ flat)

    by_states = whitened(jacobian).reshape(3 * count, len(states), STATE)
    return whitened(off)[:, 0], by_states, whitened(by_shared)
