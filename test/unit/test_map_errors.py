"""Errors of a map, estimated: as a dense filter over all of them would."""

from __future__ import annotations

from fusion_drives import landmark_map
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.linalg import block_diag

from landmark_nav.localization.fusion.map_errors import MapErrors
from landmark_nav.types import FloatArray

COUNT = 6
MAP = landmark_map(COUNT, own=0.003)
ERRORS = MapErrors.of(MAP)
FACTORS = MAP.shared_loadings.shape[2]
POSE = np.diag([0.02, 0.03])


def prior_covariance() -> FloatArray:
    """Of all errors, before anything is seen."""
    return block_diag(np.eye(FACTORS), *(block_diag(own, 1.0) for own in ERRORS.own))


def dense_influence(columns: FloatArray, gradient: FloatArray, sigma: float) -> FloatArray:
    """How bearings depend on all errors, (m, F + 3n)."""
    rows = np.zeros((len(columns), FACTORS + 3 * COUNT))
    for row, k, by_place in zip(rows, columns, gradient, strict=True):
        row[:FACTORS] = by_place @ MAP.shared_loadings[k, :2]
        first = FACTORS + 3 * k
        row[first : first + 2], row[first + 2] = by_place, -sigma
    return rows


class Both:
    """The same measurements of a place (2,) and a map, in a dense filter and by `MapErrors`."""

    def __init__(self, seed: int, shared: bool) -> None:
        self.rng, self.shared = np.random.default_rng(seed), shared
        self.mean = np.zeros(2 + FACTORS + 3 * COUNT)
        self.joint = block_diag(POSE**2, prior_covariance())
        # Share of each error that is still kept since it was seen; 0 of what nothing is given of.
        self.fresh = np.zeros(FACTORS + 3 * COUNT)
        self.errors, self.pose, self.cross = ERRORS, POSE**2, np.zeros((2, len(self.fresh)))

    def look(self) -> None:
        """See some landmarks."""
        columns = self.rng.choice(COUNT, 3, replace=False)
        gradient, sigma = self.rng.normal(0.0, 0.3, (3, 2)), 1e-3
        measured, noise = self.rng.normal(0.0, 1e-2, 3), sigma**2 * np.eye(3)

        rows = np.hstack([gradient, -dense_influence(columns, gradient, sigma)])
        covariance = rows @ self.joint @ rows.T + noise
        gain = np.linalg.solve(covariance, rows @ self.joint).T
        if not self.shared:
            gain[2 : 2 + FACTORS] = 0.0
        innovation = measured - rows @ self.mean
        self.mean = self.mean + gain @ innovation
        # Joseph's form holds for any gain.
        left = np.eye(len(self.mean)) - gain @ rows
        self.joint = left @ self.joint @ left.T + gain @ noise @ gain.T
        for k in columns:
            self.fresh[FACTORS + 3 * k : FACTORS + 3 * k + 3] = 1.0

        through = self.errors.influence(columns, gradient, np.full(3, sigma))
        with_pose = self.pose @ gradient.T
        with_pose -= self.cross[:, through.numbers] @ through.by_errors.T
        with_errors = self.cross.T @ gradient.T - self.errors.covariance_with(through)
        spread = gradient @ with_pose - through.by_errors @ with_errors[through.numbers] + noise
        np.testing.assert_allclose(spread, covariance, atol=1e-12)
        gain = np.linalg.solve(spread, with_pose.T).T
        self.pose = self.pose - gain @ with_pose.T
        self.cross = self.cross - gain @ with_errors.T
        self.errors = self.errors.refined(columns, with_errors, spread, innovation, self.shared)

    def move(self, known: float, again: float) -> None:
        """Forget some of what was seen of single landmarks, all of what was not seen for long."""
        self.errors, kept = self.errors.moved_on(known, again)
        self.cross = kept * self.cross
        shares, own = np.ones(len(self.fresh)), self.fresh > 0.0
        shares[own] = known
        shares[FACTORS + 2 :: 3] = again
        self.fresh *= shares
        shares[own & (self.fresh < 0.05)] = 0.0
        self.fresh[self.fresh < 0.05] = 0.0
        np.testing.assert_allclose(kept, shares, atol=1e-12)
        self.keep(shares)

    def keep(self, shares: FloatArray) -> None:
        """The rest of each error is drawn anew."""
        self.mean[2:] *= shares
        self.joint[:2, 2:] *= shares
        self.joint[2:, :2] *= shares[:, None]
        both, prior = np.outer(shares, shares), prior_covariance()
        self.joint[2:, 2:] = prior - both * (prior - self.joint[2:, 2:])

    def covariance(self) -> FloatArray:
        """Of place and errors, as `MapErrors` has it."""
        errors, reported = prior_covariance(), self.errors.told
        if reported is not None:
            errors[np.ix_(reported.which, reported.which)] -= reported.less
        return np.block([[self.pose, self.cross], [self.cross.T, errors]])


COURSES = st.lists(
    st.tuples(st.integers(1, 4), st.floats(0.02, 1.0), st.floats(0.0, 1.0)), max_size=5
)


@given(st.integers(0, 1000), st.booleans(), COURSES)
def test_as_a_filter_of_all_errors(
    seed: int, shared: bool, course: list[tuple[int, float, float]]
) -> None:
    both = Both(seed, shared)
    for images, known, again in course:
        for _ in range(images):
            both.look()
        both.move(known, again)
    np.testing.assert_allclose(both.errors.estimate, both.mean[2:], atol=1e-9)
    np.testing.assert_allclose(both.covariance(), both.joint, atol=1e-9)
    assert np.linalg.eigvalsh(both.covariance())[0] > -1e-10


def test_what_all_share_is_estimated_on_request_alone() -> None:
    for shared in (True, False):
        both = Both(2, shared)
        both.look()
        assert both.errors.estimate[:FACTORS].any() == shared
        # Estimated or not, it is as certain as before, or more so.
        certain = np.diag(both.covariance())[2 : 2 + FACTORS] < 1.0 - 1e-9
        assert certain.all() == shared


@pytest.mark.parametrize('shared', [True, False])
def test_after_a_long_drive(shared: bool) -> None:
    both = Both(5, shared)
    for _ in range(500):
        both.look()
        both.move(0.98, 0.8)
    assert np.linalg.eigvalsh(both.covariance())[0] > -1e-10
    np.testing.assert_allclose(both.covariance(), both.covariance().T, atol=1e-15)


def test_places_and_what_goes_with_them() -> None:
    both = Both(3, shared=True)
    for _ in range(3):
        both.look()
    shared = MAP.shared_loadings[:, :2] @ both.mean[2 : 2 + FACTORS]
    own = both.mean[2 + FACTORS :].reshape(-1, 3)[:, :2]
    all_of_them = np.arange(COUNT)
    np.testing.assert_allclose(
        both.errors.places(all_of_them), MAP.positions[:, :2] + shared + own, atol=1e-9
    )
    by_errors = np.vstack(
        [dense_influence(all_of_them, np.eye(2)[[k] * COUNT], 0.0) for k in (0, 1)]
    )
    by_errors = by_errors.reshape(2, COUNT, -1).swapaxes(0, 1).reshape(2 * COUNT, -1)
    np.testing.assert_allclose(
        both.errors.with_places(both.cross), both.joint[:2, 2:] @ by_errors.T, atol=1e-9
    )


def test_what_was_seen_of_single_landmarks_is_forgotten_as_a_whole() -> None:
    both = Both(4, shared=True)
    for _ in range(3):
        both.look()
    both.errors, kept = both.errors.forgotten()
    both.cross = kept * both.cross
    both.keep(np.repeat([1.0, 0.0], [FACTORS, 3 * COUNT]))
    np.testing.assert_allclose(both.covariance(), both.joint, atol=1e-9)
    assert not both.errors.estimate[FACTORS:].any()
    again, kept = both.errors.forgotten()
    assert again is both.errors
    assert kept.all()


def test_two_detections_of_one_landmark_in_an_image() -> None:
    """They repeat its error."""
    columns, gradient = np.array([2, 2]), np.array([[0.3, 0.0], [0.3, 0.0]])
    through = ERRORS.influence(columns, gradient, np.full(2, 1e-3))
    with_errors = ERRORS.covariance_with(through)
    spread = through.by_errors @ with_errors[through.numbers]
    dense = dense_influence(columns, gradient, 1e-3)
    np.testing.assert_allclose(spread, dense @ prior_covariance() @ dense.T, atol=1e-12)
