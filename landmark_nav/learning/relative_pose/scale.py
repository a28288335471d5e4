"""
Sources of the scale: given poses, odometry, sheets of a known size.

Each source contributes rows to the adjustment; its scale is computed from these rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import combinations
import logging

import numpy as np
from scipy.special import chdtri

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import relative
from landmark_nav.learning.least_squares import root_of
from landmark_nav.learning.relative_pose.epipolar import center, STATE
from landmark_nav.learning.relative_pose.sheet_tracks import sheet_misses, SheetTrack
from landmark_nav.types import FloatArray, PlaceChain

_LOG = logging.getLogger(__name__)

# Significance at which given poses misfit the shape by the panoramas: their variances are then
# inflated. They are refused if the relative sigma of the scale exceeds the second value.
_CHANCE, MOST_SCALE_SIGMA = 1e-2, 0.15
# Scales that differ by the first number of sigmas cause a warning, by the second a refusal. Poses
# of sweep/pose, which define the frame, are refused at the third: no noise explains that.
_APART_SIGMAS, _MOST_SIGMAS, _NEVER_SIGMAS = 2.0, 3.0, 5.0

# What to check of sources that are no sheets.
_SUSPECTS = {'odom': 'whether the wheels slipped'}

Rows = tuple[FloatArray, FloatArray]


@dataclass(frozen=True)
class ScaleShare:
    """
    The scale by one source.

    `scale` is relative to that by all sources together, with the sigma `sigma`. `inflation` is the
    factor on its variances, `sheets` the number of its sheets. `slip` is the sigma by slips along
    the ways, which panoramas do not show: these explain no contradiction to another source.
    `misfit` says where it contradicts the panoramas, if it does so significantly.
    """

    name: str
    scale: float
    sigma: float
    inflation: float = 1.0
    sheets: int = 0
    slip: float = 0.0
    misfit: str = ''

    def check(self) -> None:
        """
        Report a contradiction to the panoramas.

        Raises `LandmarkNavError`: it defines the frame, and its sigmas do not explain it.
        """
        if self.misfit and self.name == 'sweep/pose' and self.inflation > _NEVER_SIGMAS**2:
            raise LandmarkNavError(self.misfit)
        if self.misfit:
            _LOG.warning('%s', self.misfit)


@dataclass(eq=False)
class PlaceSource:
    """Given poses of the pan axis with their covariance."""

    places: PlaceChain
    inflation: float = field(default=1.0, init=False)

    @property
    def name(self) -> str:
        """Name of the source."""
        return self.places.source

    def rows(self, states: FloatArray) -> Rows:
        """Residuals (m,) in sigmas and their derivatives (m, 6 v)."""
        return self._rows(states, self.places.slip_m)

    def _rows(self, states: FloatArray, slip_m: float) -> Rows:
        """Rows of all poses but the first, which defines the frame, with slips of this sigma."""
        count = len(states)
        off = states[1:, :3] - self.places.poses[1:]
        off[:, 2] = wrap_rad(off[:, 2])
        slips = slip_m * self._by_slip(count)
        covariance = self.inflation * self.places.covariance[3:, 3:] + slips @ slips.T
        whiten = np.linalg.inv(root_of(covariance))
        jacobian = np.zeros((len(whiten), count, STATE))
        jacobian[:, 1:, :3] = whiten.reshape(-1, count - 1, 3)
        return whiten @ off.ravel(), jacobian.reshape(-1, count * STATE)

    @staticmethod
    def _by_slip(count: int) -> FloatArray:
        """Change of all poses but the first by slips of the ways: one moves all later poses."""
        return np.asarray(np.kron(np.tri(count - 1), np.eye(3)[:, :2]), dtype=np.float64)

    def share(self, states: FloatArray, shared_errors: FloatArray) -> ScaleShare:
        """Scale by this source; `shared_errors` (6 v, q) are errors of the states."""
        scale, _, by_states = _scale_by(self.rows(states), states)
        by_places = by_states.reshape(-1, STATE)[1:, :3].ravel()
        slip = self.places.slip_m * float(np.linalg.norm(by_places @ self._by_slip(len(states))))
        own = self.inflation * by_places @ self.places.covariance[3:, 3:] @ by_places
        sigma = float(np.sqrt(own + np.sum((by_states @ shared_errors) ** 2)))
        misfit = self._contradiction(states) if self.inflation > 1.0 else ''
        return ScaleShare(self.name, scale, sigma, self.inflation, slip=slip, misfit=misfit)

    def inflate(self, states: FloatArray) -> None:
        """
        Inflate variances by the misfit, without that of the scale, if it is significant.

        Raises `LandmarkNavError`: the poses contradict the panoramas.
        """
        # Slips are rare: what they would explain is not taken for granted.
        self.inflation = 1.0
        rows = self._rows(states, 0.0)
        self.inflation = _inflation(rows, states, len(rows[0]) - 1)
        if (
            self.inflation > 1.0
            and _scale_by(self._rows(states, 0.0), states)[1] > MOST_SCALE_SIGMA
        ):
            raise LandmarkNavError(self._contradiction(states))

    def _contradiction(self, states: FloatArray) -> str:
        """Message that names the sweeps between which the disagreement is largest."""
        turns = []
        for k in range(len(states) - 1):
            seen = relative(states[k, :3], states[k + 1, :3])
            known = relative(self.places.poses[k], self.places.poses[k + 1])
            course = np.arctan2(seen[1], seen[0]) - np.arctan2(known[1], known[0])
            turns.append(np.degrees(wrap_rad(np.array([seen[2] - known[2], course]))))
        worst = int(np.argmax([np.abs(t).max() for t in turns]))
        heading, course = turns[worst]
        # No wheels slip by a right angle.
        if np.abs(turns[worst]).max() > 90.0:
            remedy = f'the room may look alike on several sides, or else fix {self.name}'
        elif self.name == 'odom':
            remedy = 'drive without slipping, fix odom'
        else:
            remedy = f'fix {self.name}, its covariance'
        return (
            f'{self.name} and panoramas disagree from sweep {worst + 1} to {worst + 2} by '
            f'{heading:+.1f} deg in heading, {course:+.1f} in direction, '
            f'{self.inflation**0.5:.1f} sigma: {remedy} or pan_axis (xyz, zero) in robot.yaml'
        )


@dataclass(eq=False)
class SheetSource:
    """Sheets of one kind, which share errors of their size and of edges in images."""

    name: str
    tracks: Sequence[SheetTrack]
    inflation: float = field(default=1.0, init=False)

    @classmethod
    def of_kinds(cls, tracks: Sequence[SheetTrack]) -> list[SheetSource]:
        """One for each kind of sheets."""
        kinds = sorted({track.kind for track in tracks})
        return [cls(kind, [t for t in tracks if t.kind == kind]) for kind in kinds]

    def agreeing(self, states: FloatArray) -> SheetSource:
        """Leave out sheets whose scale contradicts that of most others: they have another size."""
        single = [SheetSource(self.name, [track]).rows(states) for track in self.tracks]
        scale, sigma = np.array([_scale_by(rows, states)[:2] for rows in single]).T
        apart = np.abs(scale - scale[:, None]) > _MOST_SIGMAS * np.hypot(sigma, sigma[:, None])
        alike = (~apart).sum(axis=0)
        kept = ~apart[int(np.lexsort((sigma, -alike))[0])]
        if 2 * np.count_nonzero(kept) <= len(kept):
            return self
        return SheetSource(self.name, [t for t, k in zip(self.tracks, kept, strict=True) if k])

    def rows(self, states: FloatArray) -> Rows:
        """Rows as in `PlaceSource`; shared errors, each with a prior, are eliminated."""
        found = [sheet_misses(states, track) for track in self.tracks]
        off, jacobian, shared = (np.concatenate(part) for part in zip(*found, strict=True))
        count = shared.shape[1]
        basis, _ = np.linalg.qr(np.vstack([shared, np.eye(count)]))
        rows = np.column_stack([off, jacobian.reshape(len(off), -1)])
        rows = np.vstack([rows, np.zeros((count, rows.shape[1]))])
        rows -= basis @ (basis.T @ rows)
        rows /= np.sqrt(self.inflation)
        return rows[:, 0], rows[:, 1:]

    def share(self, states: FloatArray, shared_errors: FloatArray) -> ScaleShare:
        """Scale by these sheets, as that of `PlaceSource`."""
        scale, sigma, by_states = _scale_by(self.rows(states), states)
        sigma = float(np.hypot(sigma, np.linalg.norm(by_states @ shared_errors)))
        return ScaleShare(self.name, scale, sigma, self.inflation, len(self.tracks))

    def inflate(self, states: FloatArray) -> None:
        """
        Inflate variances by the misfit as in `PlaceSource`.

        Raises `LandmarkNavError`: the sheets contradict the panoramas.
        """
        self.inflation = 1.0
        freedom = 3 * sum(len(track.views) - 1 for track in self.tracks) - 1
        self.inflation = _inflation(self.rows(states), states, freedom)
        if self.inflation > 1.0 and _scale_by(self.rows(states), states)[1] > MOST_SCALE_SIGMA:
            raise LandmarkNavError(
                f'{self.name} contradict each other or the panoramas: other things may look like '
                'sheets, or the size is wrong: hang more sheets of it, or check the size given'
            )


Source = PlaceSource | SheetSource


def _scale_by(rows: Rows, states: FloatArray) -> tuple[float, float, FloatArray]:
    """Best factor on all baselines for a fixed shape, its sigma, derivatives (6 v,) by states."""
    off, jacobian = rows
    slope = jacobian @ _growth(states)
    information = float(slope @ slope)
    by_states = slope @ jacobian / information
    return 1.0 - float(slope @ off) / information, information**-0.5, by_states


def _inflation(rows: Rows, states: FloatArray, freedom: int) -> float:
    """Factor on the variances by the misfit, without that of the scale; 1 if by chance."""
    scale, sigma, _ = _scale_by(rows, states)
    misfit = float(rows[0] @ rows[0]) - ((scale - 1.0) / sigma) ** 2
    return misfit / freedom if misfit > chdtri(freedom, _CHANCE) else 1.0


def _growth(states: FloatArray) -> FloatArray:
    """Derivative (6 v,) of states by a factor on all baselines."""
    growth = np.zeros_like(states)
    growth[:, [0, 1, 3]] = center(states - states[0])
    return growth.ravel()


def stacked(sources: Sequence[Source]) -> Callable[[FloatArray], Rows]:
    """Rows of all sources."""

    def rows(states: FloatArray) -> Rows:
        parts = [source.rows(states) for source in sources]
        return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])

    return rows


def odd_source(shares: Sequence[ScaleShare]) -> str:
    """Name of the only source that contradicts others, which agree; empty if there is none."""
    pairs = [
        {one.name, other.name}
        for one, other in combinations(shares, 2)
        if _sigmas_apart(one, other) > _MOST_SIGMAS
    ]
    odd = set.intersection(*pairs) if pairs and len(shares) > 2 else set()
    return odd.pop() if len(odd) == 1 else ''


def _sigmas_apart(one: ScaleShare, other: ScaleShare) -> float:
    return float(abs(one.scale - other.scale) / np.hypot(one.sigma, other.sigma))


def contradiction(one: ScaleShare, other: ScaleShare) -> str:
    """Text that compares the scales by two sources."""
    longer, shorter = sorted((one, other), key=lambda share: -share.scale)
    suspects = [
        f'the size of {share.name}' if share.sheets else _SUSPECTS.get(share.name, share.name)
        for share in (longer, shorter)
    ]
    return (
        f'by {longer.name} the sweeps are {100.0 * (longer.scale / shorter.scale - 1.0):.1f} '
        f'% farther apart than by {shorter.name} ({_sigmas_apart(one, other):.1f} sigma): check '
        f'{" and ".join(suspects)}'
    )


def scale_sigma(shares: Sequence[ScaleShare]) -> float:
    """
    Relative sigma of the scale by all sources.

    It is at least that by the changes of the scale without each source (jackknife): one may be
    wrong by more than it states, as a paper of another size is.

    Raises `LandmarkNavError`: two sources contradict each other.
    """
    for one, other in combinations(shares, 2):
        sigmas = _sigmas_apart(one, other)
        if sigmas > _MOST_SIGMAS:
            raise LandmarkNavError(f'{contradiction(one, other)}; leave out what is wrong')
        if sigmas > _APART_SIGMAS:
            _LOG.warning('%s', contradiction(one, other))
    scales = np.array([k.scale for k in shares])
    weights = np.array([1.0 / (k.sigma**2 + k.slip**2) for k in shares])
    variance, count = 1.0 / weights.sum(), len(shares)
    if count > 1:
        without = (weights @ scales - weights * scales) / (weights.sum() - weights)
        changes = without - np.average(scales, weights=weights)
        variance = max(variance, (count - 1) / count * float(changes @ changes))
    return float(np.sqrt(variance))
