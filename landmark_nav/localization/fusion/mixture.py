"""
What may have happened, each a state with its weight.

A Gaussian sum (Alspach and Sorenson, Nonlinear Bayesian Estimation Using Gaussian Sum
Approximations, 1972). Nearly always it has one state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.fusion.state import FilterState, HEADING
from landmark_nav.localization.fusion.update import FusionUpdate
from landmark_nav.types import FloatArray

__all__ = ['Mixture', 'Outcome', 'weighed']

# What is less likely than this beside the likeliest did not happen.
_UNLIKELY = 0.01
_CERTAIN = np.ones(1)


class Outcome(NamedTuple):
    """What became of a state by a measurement, and the logarithm of how likely that was before."""

    state: FilterState
    update: FusionUpdate
    log_prior: float = 0.0


@dataclass(frozen=True, eq=False)
class Mixture:
    """
    States of one time, the likeliest first, and their weights, which add up to one.

    All have the landmarks at the same places.

    Parameters
    ----------
    states : tuple of FilterState
        Each with what it takes to have happened.
    weights : ndarray, shape (len(states),)
        Probabilities.

    """

    states: tuple[FilterState, ...]
    weights: FloatArray = field(default_factory=lambda: _CERTAIN)

    @property
    def stamp_ns(self) -> int:
        """Time of all states."""
        return self.states[0].stamp_ns

    def each(self, change: Callable[[FilterState], FilterState]) -> Mixture:
        """Return the same possibilities, each changed."""
        return Mixture(tuple(change(state) for state in self.states), self.weights)

    def merged(self) -> FilterState:
        """Return one state of the same mean and covariance; noise is that of the likeliest."""
        likeliest = self.states[0]
        if len(self.states) == 1:
            return likeliest
        away = np.array([state.mean - likeliest.mean for state in self.states])
        away[:, HEADING] = wrap_rad(away[:, HEADING])
        shift = self.weights @ away
        away -= shift
        mean = likeliest.mean + shift
        mean[HEADING] = wrap_rad(mean[HEADING])

        def average(values: Iterable[FloatArray]) -> FloatArray:
            return np.tensordot(self.weights, np.array(list(values)), 1)

        spread = (self.weights * away.T) @ away
        return replace(
            likeliest,
            mean=mean,
            covariance=average(state.covariance for state in self.states) + spread,
            cross=average(state.cross for state in self.states),
            by_noise=average(state.by_noise for state in self.states),
        )


def weighed(
    prior: Mixture, outcomes_of: Callable[[FilterState], list[Outcome]]
) -> tuple[Mixture, FusionUpdate]:
    """
    Return what may have happened after a measurement, and what became of it in the likeliest.

    Parameters
    ----------
    prior : Mixture
        Before it.
    outcomes_of : callable
        Of a state: all that it may have come to.

    """
    found = [
        outcome._replace(log_prior=outcome.log_prior + float(np.log(weight)))
        for state, weight in zip(prior.states, prior.weights, strict=True)
        for outcome in outcomes_of(state)
    ]
    if len(found) == 1:
        return Mixture((found[0].state,)), found[0].update
    logs = np.array([outcome.log_prior + outcome.update.log_likelihood for outcome in found])
    weights = np.exp(logs - logs.max())
    kept = [k for k in np.argsort(-weights, kind='stable') if weights[k] >= _UNLIKELY]
    states = tuple(found[k].state for k in kept)
    return Mixture(states, weights[kept] / weights[kept].sum()), found[kept[0]].update
