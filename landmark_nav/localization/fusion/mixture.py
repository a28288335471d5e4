"""
Several hypotheses of what happened, each a state with its weight.

A Gaussian sum (Alspach and Sorenson, Nonlinear Bayesian Estimation Using Gaussian Sum
Approximations, 1972). Nearly always it has one state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from landmark_nav.arrays import IndexArray
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.fusion.measurement import MeasurementModel, refined
from landmark_nav.localization.fusion.state import FilterState, HEADING, unrefined
from landmark_nav.localization.fusion.update import FusionUpdate
from landmark_nav.localization.prior_uncertainty import is_prior_uncertain
from landmark_nav.types import FloatArray

__all__ = ['MOST', 'Mixture', 'Outcome', 'weighed']

# Hypotheses less likely than this, relative to the likeliest, are dropped, and all beyond so many.
_UNLIKELY, MOST = 0.01, 12
# Hypotheses are merged if each number of their means differs by less than this part of its sigma.
_ALIKE = 0.5
_CERTAIN = np.ones(1)


class Outcome(NamedTuple):
    """
    A hypothesis after a measurement, and the logarithm of its prior probability.

    `model` is that of the bearings that were used, if the landmarks may be estimated by them.
    """

    state: FilterState
    update: FusionUpdate
    model: MeasurementModel | None = None
    log_prior: float = 0.0


@dataclass(frozen=True, eq=False)
class Mixture:
    """
    States of one time, the likeliest first, and their weights.

    All have the same `map_errors`.

    Parameters
    ----------
    states : tuple of FilterState
        One for each hypothesis.
    weights : ndarray, shape (len(states),)
        Probabilities, which add up to one.

    """

    states: tuple[FilterState, ...]
    weights: FloatArray = field(default_factory=lambda: _CERTAIN)

    @property
    def stamp_ns(self) -> int:
        """Time of all states."""
        return self.states[0].stamp_ns

    def each(self, change: Callable[[FilterState], FilterState]) -> Mixture:
        """Return the mixture with `change` made to each state."""
        return Mixture(tuple(change(state) for state in self.states), self.weights)

    def merged(self) -> FilterState:
        """Return one state with the mean and covariance of all; the rest is the likeliest's."""
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

    def reduced(self) -> Mixture:
        """Return the likeliest hypotheses, with those that are alike merged."""
        if len(self.states) == 1:
            return self
        means = np.array([state.mean for state in self.states])
        hangs = np.array([state.hangs for state in self.states])
        left = np.arange(len(means))
        groups: list[IndexArray] = []
        while len(left) and len(groups) < MOST:
            away = np.abs(means[left] - means[left[0]])
            away[:, HEADING] = np.abs(wrap_rad(away[:, HEADING]))
            sigmas = np.sqrt(np.diag(self.states[left[0]].covariance))
            alike = (away <= _ALIKE * sigmas).all(axis=1) & (hangs[left] == hangs[left[0]])
            groups.append(left[alike])
            left = left[~alike]
        weights = np.array([self.weights[group].sum() for group in groups])
        order = np.argsort(-weights, kind='stable')
        states = (self._chosen(groups[k]).merged() for k in order)
        return Mixture(tuple(states), weights[order] / weights.sum())

    def _chosen(self, which: IndexArray) -> Mixture:
        weights = self.weights[which]
        return Mixture(tuple(self.states[k] for k in which), weights / weights.sum())


def weighed(
    prior: Mixture,
    outcomes_of: Callable[[FilterState], list[Outcome]],
    landmarks: str = 'consider',
) -> tuple[Mixture, FusionUpdate]:
    """
    Return the mixture after a measurement, and the update of its likeliest hypothesis.

    Parameters
    ----------
    prior : Mixture
        Before the measurement.
    outcomes_of : callable
        From a state to all hypotheses of what the measurement makes of it.
    landmarks : str
        What is done about their errors, as in `FusionConfig`. Where there is doubt (several
        hypotheses, an outcome without a model, a pose hardly known) nothing is estimated,
        and what was is forgotten.

    """
    found = [
        outcome._replace(log_prior=outcome.log_prior + float(np.log(weight)))
        for state, weight in zip(prior.states, prior.weights, strict=True)
        for outcome in outcomes_of(state)
    ]
    if len(found) == 1:
        state, update, model, _ = found[0]
        if landmarks != 'consider':
            if model is not None and not is_prior_uncertain(prior.states[0].covariance[:3, :3]):
                state = refined(state, model, shared=landmarks == 'estimate')
            elif update.degrees or update.contradicts:
                state = unrefined(state)
        return Mixture((state,)), update
    logs = np.array([outcome.log_prior + outcome.update.log_likelihood for outcome in found])
    weights = np.exp(logs - logs.max())
    kept = np.argsort(-weights, kind='stable')
    kept = kept[weights[kept] >= _UNLIKELY]
    after = Mixture(tuple(found[k].state for k in kept), weights[kept] / weights[kept].sum())
    return after.reduced().each(unrefined), found[kept[0]].update
