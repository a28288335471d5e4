"""Several states of one time: merged by their moments, weighed by what they expected."""

from __future__ import annotations

from dataclasses import replace

from fusion_drives import landmark_map, start_estimate
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.fusion.measurement import bearing_model, correct, refined
from landmark_nav.localization.fusion.mixture import Mixture, Outcome, weighed
from landmark_nav.localization.fusion.state import (
    FilterState,
    HEADING,
    initial_state,
    STATES,
)
from landmark_nav.localization.fusion.update import FusionUpdate
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.types import FloatArray

MAP = landmark_map(4)


def state(seed: int, heading_rad: float = 0.0) -> FilterState:
    """Return a state with some mean and covariance."""
    rng = np.random.default_rng(seed)
    root = rng.normal(0.0, 0.1, (STATES, STATES))
    mean = rng.normal(0.0, 0.5, STATES)
    mean[HEADING] = heading_rad
    start = initial_state(start_estimate(), MAP, OdometryNoiseConfig(), 0.0)
    return replace(
        start,
        mean=mean,
        covariance=root @ root.T,
        cross=rng.normal(0.0, 0.01, start.cross.shape),
    )


def found(one: FilterState, log_likelihood: float) -> Outcome:
    """Return what a measurement makes of a state."""
    return Outcome(one, FusionUpdate(one.stamp_ns, log_likelihood=log_likelihood))


@given(st.floats(0.05, 0.95), st.integers(0, 50))
def test_merged_states_have_the_moments_of_what_is_drawn_from_them(
    weight: float, seed: int
) -> None:
    states, weights = (state(seed), state(seed + 1, 0.3)), np.array([weight, 1.0 - weight])
    together = Mixture(states, weights).merged()
    mean = sum(w * s.mean for w, s in zip(weights, states, strict=True))
    second = sum(
        w * (s.covariance + np.outer(s.mean, s.mean)) for w, s in zip(weights, states, strict=True)
    )
    np.testing.assert_allclose(together.mean, mean, atol=1e-12)
    np.testing.assert_allclose(together.covariance, second - np.outer(mean, mean), atol=1e-12)
    assert np.linalg.eigvalsh(together.covariance)[0] > -1e-12


def test_headings_are_merged_across_the_half_turn() -> None:
    """Of 179 and -177 degrees the mean is -179, not 1."""
    east, west = np.radians([179.0, -177.0])
    together = Mixture((state(1, east), state(1, west)), np.array([0.5, 0.5])).merged()
    assert np.degrees(together.mean[HEADING]) == pytest.approx(-179.0)
    spread = together.covariance[HEADING, HEADING] - state(1).covariance[HEADING, HEADING]
    assert np.degrees(np.sqrt(spread)) == pytest.approx(2.0)


def test_one_state_stays_as_it_is() -> None:
    one = state(3)
    assert Mixture((one,)).merged() is one


def test_weights_follow_from_what_each_expected() -> None:
    """Bayes: before times likelihood."""
    states = state(1), state(2)
    densities = dict(zip(map(id, states), [0.0, np.log(3.0)], strict=True))

    def outcomes(one: FilterState) -> list[Outcome]:
        return [found(one, densities[id(one)])]

    after, update = weighed(Mixture(states, np.array([0.6, 0.4])), outcomes)
    np.testing.assert_allclose(after.weights, [1.2 / 1.8, 0.6 / 1.8])
    assert after.states == states[::-1]
    assert update.log_likelihood == pytest.approx(np.log(3.0))


def test_what_is_unlikely_did_not_happen() -> None:
    likely, unlikely = state(1), state(2)
    outcomes = [found(likely, 0.0), found(unlikely, -5.0)]
    after, _ = weighed(Mixture((likely,)), lambda _: outcomes)
    assert after.states == (likely,)
    np.testing.assert_allclose(after.weights, [1.0])


@given(st.integers(0, 50), st.lists(st.floats(0.1, 1.0), min_size=4, max_size=4))
def test_what_is_alike_is_merged_and_the_whole_stays_as_it_is(
    seed: int, shares: list[float]
) -> None:
    one, other = state(seed, 2.9), state(seed + 1, 5e-4 - np.pi)
    close = replace(one, mean=one.mean + 0.1 * np.sqrt(np.diag(one.covariance)))
    behind = replace(other, mean=other.mean.copy())
    behind.mean[HEADING] = np.pi - 5e-4
    weights = -np.sort(-np.array(shares)) / sum(shares)
    whole = Mixture((one, other, close, behind), weights)
    reduced = whole.reduced()
    np.testing.assert_allclose(
        np.sort(reduced.weights), np.sort([weights[0] + weights[2], weights[1] + weights[3]])
    )
    assert np.all(np.diff(reduced.weights) <= 0.0)
    before, after = whole.merged(), reduced.merged()
    np.testing.assert_allclose(after.covariance, before.covariance, atol=1e-9)
    np.testing.assert_allclose(np.delete(after.mean - before.mean, HEADING), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * (after.mean - before.mean)[HEADING]), 1.0, atol=1e-9)


def test_states_that_go_on_otherwise_are_not_merged() -> None:
    one = state(0)
    assert (
        len(Mixture((one, replace(one, hangs=True)), np.array([0.6, 0.4])).reduced().states) == 2
    )


def measured_once(prior: FilterState, seed: int) -> Outcome:
    """Return what bearings of three landmarks make of a state."""
    columns, off = np.arange(3), np.random.default_rng(seed).normal(0.0, 1e-3, 3)
    nothing, sigma = np.zeros(2), np.full(3, 1e-3)
    expected = np.arctan2(*(MAP.positions[columns, :2] - prior.mean[:2]).T[::-1])
    bearings = wrap_rad(expected - prior.mean[HEADING] + off)
    seen = bearing_model(prior, prior, columns, bearings, sigma**2, sigma, 0.0, nothing)
    return found(correct(prior, seen), 0.0)._replace(model=seen)


def known_state(*sigmas: float) -> FilterState:
    start = start_estimate(np.array(sigmas))
    return initial_state(start, MAP, OdometryNoiseConfig(), 0.0)


def refine(outcomes: list[Outcome], prior: FilterState, landmarks: str = 'refine') -> FloatArray:
    """Estimates of the errors of the map, (hypotheses, F + 3n)."""
    after, _ = weighed(Mixture((prior,)), lambda _: outcomes, landmarks)
    return np.array([state.map_errors.estimate for state in after.states])


def seen_before(prior: FilterState) -> Outcome:
    """Return what bearings make of a state that has seen them before."""
    one = measured_once(prior, 0)
    assert one.model is not None
    return one._replace(state=refined(one.state, one.model, shared=False))


def test_landmarks_are_refined_where_nothing_is_uncertain() -> None:
    prior = known_state(0.01, 0.01, 0.005)
    one = measured_once(prior, 0)
    assert not refine([one], prior, 'consider').any()
    (shared,), (own,) = refine([one], prior, 'estimate'), refine([one], prior)
    assert shared[:3].any()
    assert not own[:3].any()
    assert own[3:].any()


def test_uncertain_what_was_seen_of_landmarks_is_forgotten() -> None:
    prior = known_state(0.01, 0.01, 0.005)
    before = seen_before(prior)
    assert not refine([before, before], prior).any()
    # As of an image whose bearings had to turn.
    used = replace(before.update, degrees=3)
    assert not refine([before._replace(update=used, model=None)], prior).any()
    against = replace(before.update, contradicts=True)
    assert not refine([before._replace(update=against, model=None)], prior).any()
    # Nothing seen is no uncertainty.
    assert refine([before._replace(model=None)], prior).any()


def test_a_pose_known_to_decimetres_does_not_refine_landmarks() -> None:
    wide = known_state(0.1, 0.1, 0.05)
    assert not refine([measured_once(wide, 0)], wide).any()
