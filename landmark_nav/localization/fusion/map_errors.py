"""
What the map may be off by: considered always, and estimated where nothing is in doubt.

A landmark is off by what all of them share (factors of unit variance) and by an error of its own.
Seen from nearly the same place it is also found off by nearly the same fraction of a pixel in
picture after picture: its repeated error. Before anything is seen all these are independent.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from landmark_nav.arrays import IndexArray
from landmark_nav.types import FloatArray, LandmarkMap

__all__ = ['Influence', 'MapErrors', 'Told']

# Of a landmark that was not seen for so long that less than this share is kept nothing is kept.
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
        Of which errors.
    slots : ndarray of int, shape (F + 3n,)
        Where each error is among `which`, or -1.
    less : ndarray, shape (a, a)
        How much smaller their covariance has become.
    fresh : ndarray, shape (n,)
        How much is still known of each landmark since it was seen last, from 0 to 1.

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

    def as_learned(self) -> MapErrors:
        """Return those of the map as if nothing had been seen."""
        return replace(self, estimate=np.zeros_like(self.estimate), told=None)

    def places(self, columns: IndexArray) -> FloatArray:
        """Where landmarks `columns` (m,) are in map as far as is known, (m, 2), metres."""
        nominal = self.landmarks[columns]
        if self.told is None:
            return nominal
        factors = self.loadings.shape[2]
        own = self.estimate[factors:].reshape(-1, 3)[columns, :2]
        return np.asarray(nominal + own + self.loadings[columns] @ self.estimate[:factors])

    def repeated(self, columns: IndexArray) -> FloatArray:
        """Repeated errors (m,) of landmarks `columns` (m,), in units of their sigmas."""
        own = self.estimate[self.loadings.shape[2] :].reshape(-1, 3)
        return np.asarray(own[columns, 2])

    def with_places(self, cross: FloatArray) -> FloatArray:
        """Turn covariances (k, F + 3n) with all errors into those (k, 2n) with x and y."""
        factors = self.loadings.shape[2]
        own = cross[:, factors:].reshape(len(cross), -1, 3)[..., :2]
        shared = np.tensordot(cross[:, :factors], self.loadings, (1, 2))
        return np.asarray((own + shared).reshape(len(cross), -1))

    def influence(
        self, columns: IndexArray, gradient: FloatArray, repeated_sigma: FloatArray
    ) -> Influence:
        """
        Return how bearings of landmarks `columns` (m,) depend on the errors.

        `gradient` (m, 2) is the derivative of each by the place of the pan axis, `repeated_sigma`
        (m,) the sigma of the repeated error, radians.
        """
        count, factors = len(columns), self.loadings.shape[2]
        own = factors + 3 * columns[:, None] + [0, 1, 2]
        by_errors = np.zeros((count, factors + 3 * count))
        by_errors[:, :factors] = (gradient[:, None] @ self.loadings[columns])[:, 0]
        row, first = np.arange(count), factors + 3 * np.arange(count)
        by_errors[row, first], by_errors[row, first + 1] = gradient.T
        by_errors[row, first + 2] = -repeated_sigma
        return Influence(columns, np.concatenate([np.arange(factors), own.ravel()]), by_errors)

    def covariance_with(self, seen: Influence) -> FloatArray:
        """Covariance (F + 3n, m) of the errors with what they move bearings by."""
        count, factors = len(seen.columns), self.loadings.shape[2]
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

        """
        which, slots, less, fresh = self.told or self._nothing_told()
        new = np.flatnonzero((slots < 0) & with_innovation.any(axis=1))
        if len(new):
            slots = slots.copy()
            slots[new] = len(which) + np.arange(len(new))
            which = np.concatenate([which, new])
        seen = with_innovation[which]
        gain = np.linalg.solve(covariance, seen.T)
        estimate, fresh, told = self.estimate.copy(), fresh.copy(), seen @ gain
        estimate[which] += innovation @ gain
        told[: len(less), : len(less)] += less
        # What is not symmetric would grow with each step.
        told = 0.5 * (told + told.T)
        fresh[columns] = 1.0
        return replace(self, estimate=estimate, told=Told(which, slots, told, fresh))

    def kept(self, known: float, again: float) -> FloatArray:
        """
        Return the share (F + 3n,) of each error that is kept when the robot moves on.

        That is `again` of repeated errors, `known` of what was seen of the others.
        """
        factors = self.loadings.shape[2]
        kept = np.ones(len(self.estimate))
        own = kept[factors:].reshape(-1, 3)
        if self.told is not None:
            kept *= known
            own[self.told.fresh * known < _STALE] = 0.0
        own[:, 2] *= again
        return kept

    def moved_on(self, kept: FloatArray, known: float) -> MapErrors:
        """Return the errors of which shares are `kept` (F + 3n,), and `known` of the others."""
        if self.told is None:
            return self
        which, slots, less, fresh = self.told
        shares = kept[which]
        if not shares.all():
            left = np.flatnonzero(shares)
            which, shares, less = which[left], shares[left], less[np.ix_(left, left)]
            slots = np.full_like(slots, -1)
            slots[which] = np.arange(len(which))
        told = Told(which, slots, np.outer(shares, shares) * less, fresh * known)
        return replace(self, estimate=kept * self.estimate, told=told)

    def _nothing_told(self) -> Told:
        none = np.empty(0, dtype=np.intp)
        slots = np.full(len(self.estimate), -1, dtype=np.intp)
        return Told(none, slots, np.empty((0, 0)), np.ones(len(self.landmarks)))
