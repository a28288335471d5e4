"""Errors of a map, estimated: as a dense filter over all of them would."""

from __future__ import annotations

from fusion_drives import landmark_map
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
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

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.mean = np.zeros(2 + FACTORS + 3 * COUNT)
        self.joint = block_diag(POSE**2, prior_covariance())
        self.errors, self.pose, self.cross = ERRORS, POSE**2, np.zeros((2, len(self.mean) - 2))

    def look(self) -> None:
        """See some landmarks."""
        columns = self.rng.choice(COUNT, 3, replace=False)
        gradient, sigma = self.rng.normal(0.0, 0.3, (3, 2)), 1e-3
        measured, noise = self.rng.normal(0.0, 1e-2, 3), sigma**2 * np.eye(3)

        rows = np.hstack([gradient, -dense_influence(columns, gradient, sigma)])
        covariance = rows @ self.joint @ rows.T + noise
        gain = np.linalg.solve(covariance, rows @ self.joint).T
        innovation = measured - rows @ self.mean
        self.mean = self.mean + gain @ innovation
        self.joint = self.joint - gain @ rows @ self.joint

        through = self.errors.influence(columns, gradient, np.full(3, sigma))
        with_pose = self.pose @ gradient.T
        with_pose -= self.cross[:, through.numbers] @ through.by_errors.T
        with_errors = self.cross.T @ gradient.T - self.errors.covariance_with(through)
        spread = gradient @ with_pose - through.by_errors @ with_errors[through.numbers] + noise
        np.testing.assert_allclose(spread, covariance, atol=1e-12)
        gain = np.linalg.solve(spread, with_pose.T).T
        self.pose = self.pose - gain @ with_pose.T
        self.cross = self.cross - gain @ with_errors.T
        self.errors = self.errors.refined(columns, with_errors, spread, innovation)

    def move(self, known: float, again: float) -> None:
        """Forget some of it."""
        kept = self.errors.kept(known, again)
        self.errors, self.cross = self.errors.moved_on(kept, known), kept * self.cross
        self.mean[2:] *= kept
        self.joint[:2, 2:] *= kept
        self.joint[2:, :2] *= kept[:, None]
        both = np.outer(kept, kept)
        prior = prior_covariance()
        self.joint[2:, 2:] = prior - both * (prior - self.joint[2:, 2:])

    def covariance(self) -> FloatArray:
        """Of place and errors, as `MapErrors` has it."""
        errors, told = prior_covariance(), self.errors.told
        if told is not None:
            errors[np.ix_(told.which, told.which)] -= told.less
        return np.block([[self.pose, self.cross], [self.cross.T, errors]])


@given(
    st.integers(0, 1000),
    st.lists(st.tuples(st.integers(1, 4), st.floats(0.02, 1.0), st.floats(0.0, 1.0)), max_size=5),
)
def test_as_a_filter_of_all_errors(seed: int, course: list[tuple[int, float, float]]) -> None:
    both = Both(seed)
    for pictures, known, again in course:
        for _ in range(pictures):
            both.look()
        both.move(known, min(known, again))
    np.testing.assert_allclose(both.errors.estimate, both.mean[2:], atol=1e-9)
    np.testing.assert_allclose(both.covariance(), both.joint, atol=1e-9)
    assert np.linalg.eigvalsh(both.covariance())[0] > -1e-10


def test_after_a_long_drive() -> None:
    both = Both(5)
    for _ in range(500):
        both.look()
        both.move(0.98, 0.8)
    assert np.linalg.eigvalsh(both.covariance())[0] > -1e-10
    np.testing.assert_allclose(both.covariance(), both.covariance().T, atol=1e-15)


def test_places_and_what_goes_with_them() -> None:
    both = Both(3)
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


def test_what_was_not_seen_for_long_is_as_it_was_learned() -> None:
    both = Both(4)
    both.look()
    both.move(0.01, 0.01)
    told = both.errors.told
    assert told is not None
    assert (told.which < FACTORS).all()
    assert np.abs(both.cross[:, FACTORS:]).max() == 0.0
    again = both.errors.as_learned()
    assert not again.estimate.any()
    assert again.told is None


def test_two_sightings_of_one_landmark_in_a_picture() -> None:
    """They repeat its error."""
    columns, gradient = np.array([2, 2]), np.array([[0.3, 0.0], [0.3, 0.0]])
    through = ERRORS.influence(columns, gradient, np.full(2, 1e-3))
    with_errors = ERRORS.covariance_with(through)
    spread = through.by_errors @ with_errors[through.numbers]
    dense = dense_influence(columns, gradient, 1e-3)
    np.testing.assert_allclose(spread, dense @ prior_covariance() @ dense.T, atol=1e-12)
