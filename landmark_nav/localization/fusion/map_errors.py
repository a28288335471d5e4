"""
What the map may be off by: considered, and in part estimated.

A landmark is off by what all of them share (factors of unit variance) and by an error of its own.
Seen from nearly the same place it is also found off by nearly the same fraction of a pixel in
image after image: its repeated error. Before anything is seen all these are independent.

What is estimated is forgotten as the robot moves on: what a landmark seems to be off by depends on
where it is seen from. So what all share must not be estimated along with it, or the pose would in
time claim more than the map allows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from landmark_nav.arrays import IndexArray
from landmark_nav.types import FloatArray, LandmarkMap

__all__ = ['Influence', 'MapErrors', 'Told']

# What was not seen for so long that less than this share of it is kept is forgotten.
_STALE = 0.05


class Influence(NamedTuple):
    """
    How m bearings depend on the errors of a map.

    Parameters
    ----------
    columns : ndarray of int, shape (m,)
        Landmarks that are seen.
    numbers : ndarray of int, shape (F + 3m,)
        Which of the errors matter.
    by_errors : ndarray, shape (m, F + 3m)
        By how much an error moves the pan axis off, as bearings see it: the derivative of what is
        measured, with the opposite sign.

    """

    columns: IndexArray
    numbers: IndexArray
    by_errors: FloatArray


class Told(NamedTuple):
    """
    What was seen of the errors of a map.

    Parameters
    ----------
    which : ndarray of int, shape (a,)
        Of which errors: the F factors, then those of some landmarks.
    slots : ndarray of int, shape (F + 3n,)
        Where each error is among `which`, or -1.
    less : ndarray, shape (a, a)
        Their covariance before anything was seen minus what it is now.
    fresh : ndarray, shape (a,)
        Share of each that is still kept since it was seen last.

    """

    which: IndexArray
    slots: IndexArray
    less: FloatArray
    fresh: FloatArray


@dataclass(frozen=True, eq=False)
class MapErrors:
    """
    Errors of a map: F factors, then of each landmark its own x and y and its repeated error.

    Parameters
    ----------
    landmarks : ndarray, shape (n, 2)
        Places of the landmarks in map as learned, metres.
    loadings : ndarray, shape (n, 2, F)
        By how much a unit of each factor moves them, metres.
    own : ndarray, shape (n, 2, 2)
        Covariance of what each is off by itself, m^2.
    estimate : ndarray, shape (F + 3n,)
        Of the errors: factors and repeated errors in units of their sigmas, the others in metres.
    told : Told or None
        What was seen of them; None where nothing is estimated.

    """

    landmarks: FloatArray
    loadings: FloatArray
    own: FloatArray
    estimate: FloatArray
    told: Told | None = None

    @staticmethod
    def of(landmark_map: LandmarkMap) -> MapErrors:
        """Return those of a map of which nothing was seen yet."""
        loadings = landmark_map.shared_loadings[:, :2]
        own = landmark_map.covariances[:, :2, :2] - loadings @ loadings.swapaxes(1, 2)
        count, _, factors = loadings.shape
        nothing = np.zeros(factors + 3 * count)
        return MapErrors(landmark_map.positions[:, :2], loadings, own, nothing)

    def are_of(self, landmark_map: LandmarkMap) -> bool:
        """Whether they are those of a map, whatever was seen of them."""
        other = MapErrors.of(landmark_map)
        return (
            np.array_equal(self.landmarks, other.landmarks)
            and np.array_equal(self.loadings, other.loadings)
            and np.array_equal(self.own, other.own)
        )

    def places(self, columns: IndexArray) -> FloatArray:
        """Where landmarks `columns` (m,) are in map as far as is known, (m, 2), metres."""
        shared = self.loadings[columns] @ self.estimate[: self._factors]
        return np.asarray(self.landmarks[columns] + shared + self._single[columns, :2])

    def repeated(self, columns: IndexArray) -> FloatArray:
        """Repeated errors (m,) of landmarks `columns` (m,), in units of their sigmas."""
        return np.asarray(self._single[columns, 2])

    def with_places(self, cross: FloatArray) -> FloatArray:
        """Turn covariances (k, F + 3n) with all errors into those (k, 2n) with x and y."""
        own = cross[:, self._factors :].reshape(len(cross), -1, 3)[..., :2]
        shared = np.tensordot(cross[:, : self._factors], self.loadings, (1, 2))
        return np.asarray((own + shared).reshape(len(cross), -1))

    def influence(
        self, columns: IndexArray, gradient: FloatArray, repeated_sigma: FloatArray
    ) -> Influence:
        """
        Return how bearings of landmarks `columns` (m,) depend on the errors.

        `gradient` (m, 2) is the derivative of each by the place of the pan axis, `repeated_sigma`
        (m,) the sigma of the repeated error, radians.
        """
        count, factors = len(columns), self._factors
        own = factors + 3 * columns[:, None] + [0, 1, 2]
        by_errors = np.zeros((count, factors + 3 * count))
        by_errors[:, :factors] = (gradient[:, None] @ self.loadings[columns])[:, 0]
        row, first = np.arange(count), factors + 3 * np.arange(count)
        by_errors[row, first], by_errors[row, first + 1] = gradient.T
        by_errors[row, first + 2] = -repeated_sigma
        return Influence(columns, np.concatenate([np.arange(factors), own.ravel()]), by_errors)

    def covariance_with(self, seen: Influence) -> FloatArray:
        """Covariance (F + 3n, m) of the errors with what they move bearings by."""
        count, factors = len(seen.columns), self._factors
        row = np.arange(count)
        own = seen.by_errors[:, factors:].reshape(count, count, 3)[row, row]
        with_errors = np.zeros((len(self.estimate), count))
        with_errors[:factors] = seen.by_errors[:, :factors].T
        numbers = seen.numbers[factors:].reshape(count, 3)
        moved = (self.own[seen.columns] @ own[:, :2, None])[..., 0]
        with_errors[numbers[:, :2], row[:, None]] = moved
        with_errors[numbers[:, 2], row] = own[:, 2]
        if self.told is not None:
            slots = self.told.slots[seen.numbers]
            known = slots >= 0
            less = self.told.less[:, slots[known]] @ seen.by_errors[:, known].T
            with_errors[self.told.which] -= less
        return with_errors

    def refined(
        self,
        columns: IndexArray,
        with_innovation: FloatArray,
        covariance: FloatArray,
        innovation: FloatArray,
        shared: bool,
    ) -> MapErrors:
        """
        Return the errors after a Kalman step.

        Parameters
        ----------
        columns : ndarray of int, shape (m,)
            Landmarks that were seen.
        with_innovation : ndarray, shape (F + 3n, m)
            Covariance of the errors with the innovation.
        covariance : ndarray, shape (m, m)
            Covariance of the innovation.
        innovation : ndarray, shape (m,)
            Measured minus expected.
        shared : bool
            Estimate the factors as well. Otherwise they are considered: the step moves what each
            landmark is off by itself, a partial update.

        """
        which, slots, less, fresh = self.told or self._nothing_told()
        factors = self._factors
        new = np.flatnonzero((slots < 0) & with_innovation.any(axis=1))
        if len(new):
            slots = slots.copy()
            slots[new] = len(which) + np.arange(len(new))
            which, fresh = np.concatenate([which, new]), np.append(fresh, np.ones(len(new)))
        seen = with_innovation[which]
        gain = np.linalg.solve(covariance, seen.T)
        step, told = innovation @ gain, seen @ gain
        if not shared:
            step[:factors], told[:factors, :factors] = 0.0, 0.0
        told[: len(less), : len(less)] += less
        # What is not symmetric would grow with each step.
        told = 0.5 * (told + told.T)
        estimate, fresh = self.estimate.copy(), fresh.copy()
        estimate[which] += step
        fresh[slots[factors + 3 * columns[:, None] + [0, 1, 2]]] = 1.0
        return replace(self, estimate=estimate, told=Told(which, slots, told, fresh))

    def moved_on(self, known: float, again: float) -> tuple[MapErrors, FloatArray]:
        """
        Return the errors when the robot has moved on, and the share (F + 3n,) kept of each.

        That is `again` of repeated errors and `known` of what was seen of each landmark's own; the
        rest is as if they were drawn anew. It is kept of their covariance with the pose, too.
        """
        shares = np.ones(len(self.estimate))
        if self.told is not None:
            shares[self.told.which[self._factors :]] = known
        shares[self._factors + 2 :: 3] = again
        return self._kept(shares)

    def forgotten(self) -> tuple[MapErrors, FloatArray]:
        """Return them without what was seen of single landmarks, and the share kept of each."""
        shares = np.ones(len(self.estimate))
        if self.told is None or len(self.told.which) == self._factors:
            return self, shares
        shares[self.told.which[self._factors :]] = 0.0
        return self._kept(shares)

    @property
    def _factors(self) -> int:
        return int(self.loadings.shape[2])

    @property
    def _single(self) -> FloatArray:
        """Of each landmark its own x and y and its repeated error, (n, 3)."""
        return self.estimate[self._factors :].reshape(-1, 3)

    def _kept(self, shares: FloatArray) -> tuple[MapErrors, FloatArray]:
        """Keep these shares (F + 3n,), none of what is stale."""
        if self.told is None:
            return self, shares
        which, slots, less, fresh = self.told
        fresh = fresh * shares[which]
        stale = fresh < _STALE
        if stale.any():
            shares = shares.copy()
            shares[which[stale]] = 0.0
            left = np.flatnonzero(~stale)
            which, fresh, less = which[left], fresh[left], less[np.ix_(left, left)]
            slots = np.full_like(slots, -1)
            slots[which] = np.arange(len(which))
        kept = shares[which]
        told = Told(which, slots, kept[:, None] * less * kept, fresh)
        return replace(self, estimate=shares * self.estimate, told=told), shares

    def _nothing_told(self) -> Told:
        factors = np.arange(self._factors)
        slots = np.full(len(self.estimate), -1, dtype=np.intp)
        slots[factors] = factors
        return Told(factors, slots, np.zeros((len(factors),) * 2), np.ones(len(factors)))
