"""
Errors that the poses of sweeps share, as all of them are measured from the same papers.

The measurements are the four edges of each paper, as in `fit`, with the same uncertain values
(height, tilt, size of papers, position of each), to first order.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import eigh

from landmark_nav.arrays import BoolArray
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.least_squares import covariance_of, root_of, solve_root
from landmark_nav.learning.reference_area.markers import LEAST_MARKERS
from landmark_nav.learning.reference_area.model import (
    linearized,
    MEASURED,
    OF_PAPER,
    PaperPlaces,
)
from landmark_nav.learning.reference_area.search import LEAST_PAPERS, papers_in_view
from landmark_nav.types import FloatArray, Panorama

# Sigma of an edge by its tens of profiles, without the error that its points share.
_PROFILES_PX = 0.03
# x, y, heading, height, two tilts, size of papers; then two values of each paper.
_SIZE, _PAPERS = 6, 7
# Share of the variance in height that sweeps have in common; largest share of any other variance.
_COMMON, _MOST = 0.9, 0.99
_X_Y_HEIGHT = [0, 1, 3]  # of these states
_X_Y_HEADING = [0, 1, 3]  # of x, y, z, heading
_PLAN = np.ix_(_X_Y_HEADING, _X_Y_HEADING)


def least_in_view(room: Room) -> int:
    """Fewest papers or markers that give the pose of a sweep; 0 if there are none."""
    return LEAST_PAPERS if room.papers else LEAST_MARKERS if room.markers else 0


def pose_errors(
    eye: FloatArray,
    room: Room,
    focal_px: float,
    seen: BoolArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """
    Covariance of viewpoints measured from papers or markers, and loadings of what they share.

    Parameters
    ----------
    eye : ndarray, shape (p, 3)
        Viewpoints, m.
    seen : ndarray of bool, shape (p, k), optional
        Those in view, `least_in_view` or more; by default all.

    Returns
    -------
    covariance : ndarray, shape (p, 3, 3)
        Covariance of x, y, heading.
    by_papers : ndarray, shape (p, 3, 1 + 2 k)
        Loadings of factors with unit variance that all viewpoints share: the size of the papers,
        and the errors of each along its wall and upwards.
    """
    sizes = [(sheet.width, sheet.height) for sheet in room.anchors]
    places = PaperPlaces.hung(room, [sheet.center for sheet in room.anchors], sizes)
    papers = len(places.center)

    def outlines(states: FloatArray) -> FloatArray:
        errors = np.zeros((*states.shape[:-1], papers, len(OF_PAPER)))
        errors[..., :2] = states[..., _PAPERS:].reshape(*errors.shape[:-1], 2)
        outlines = places.outlines(
            states[..., None, :3], states[..., None, 3:_SIZE], errors, states[..., _SIZE, None]
        )
        return outlines.reshape(*states.shape[:-1], 4 * papers)

    states = np.zeros((len(eye), _PAPERS + 2 * papers))
    states[:, _X_Y_HEIGHT] = eye
    _, jacobian = linearized(outlines, states)
    if seen is not None:
        jacobian *= np.repeat(seen, 4, axis=1)[:, None]
    sigma = np.hypot(_PROFILES_PX, MEASURED.edge_sigma_px) / focal_px
    jacobian /= sigma
    given = [MEASURED.height_sigma_m, *[MEASURED.horizon_sigma_rad] * 2]
    given += [MEASURED.paper_size_sigma, *[MEASURED.paper_sigma_m] * (2 * papers)]
    prior = np.array([np.inf] * 3 + given)
    information = jacobian @ np.swapaxes(jacobian, -1, -2) + np.diag(prior**-2.0)
    covariance = np.linalg.inv(information)
    # The error of an estimate is its gain times the error of the prior.
    by_papers = covariance[:, :3, _SIZE:] / prior[_SIZE:]
    return np.asarray(covariance[:, :3, :3]), np.asarray(by_papers)


def joint_covariance(panoramas: Sequence[Panorama], room: Room) -> FloatArray:
    """
    Joint covariance (4 v, 4 v) of x, y, z, heading of v sweeps that were estimated separately.

    A misplaced paper or marker moves all of them, and the height of the camera is the same
    everywhere: the largest possible part of its error is common. Without these they share their
    height only.
    """
    alone = [p.covariance + 1e-12 * np.eye(4) for p in panoramas]
    loading = [_loading(p, c, room) for p, c in zip(panoramas, alone, strict=True)]
    rest = [c - part @ part.T for c, part in zip(alone, loading, strict=True)]
    height = _COMMON * min(1.0 / covariance_of(c)[2, 2] for c in rest)
    up = np.sqrt(height) * np.array([[0.0], [0.0], [1.0], [0.0]])
    return joined(np.stack(alone), np.stack([np.hstack([part, up]) for part in loading]))


def joined(alone: FloatArray, loading: FloatArray) -> FloatArray:
    """
    Joint covariance (v d, v d) of v vectors with covariances (v, d, d).

    These include the part by shared factors of unit variance with `loading` (v, d, m).
    """
    count, size, factors = loading.shape
    shared = loading.reshape(count * size, factors)
    joint = shared @ shared.T
    own = np.arange(count)
    joint.reshape(count, size, count, size)[own, :, own] = alone
    return np.asarray(joint)


def _loading(panorama: Panorama, covariance: FloatArray, room: Room) -> FloatArray:
    """Loadings of a sweep by the shared factors: mount (c), papers (1 + 2 k)."""
    mounted = np.zeros((4, 0))
    if panorama.by_calibration is not None and panorama.calibration is not None:
        mounted = panorama.by_calibration @ root_of(panorama.calibration.covariance)
    loading = np.hstack([mounted, _by_papers(panorama, covariance, room)])
    half = solve_root(root_of(covariance), loading)
    share = float(np.linalg.norm(half, 2) ** 2)
    return np.asarray(loading * np.sqrt(_MOST / max(share, _MOST)))


def _by_papers(panorama: Panorama, covariance: FloatArray, room: Room) -> FloatArray:
    """How papers that hang elsewhere move a panorama, (4, 1 + 2 k)."""
    loading = np.zeros((4, 1 + 2 * len(room.anchors)))
    least = least_in_view(room)
    if not room.anchors or len(room.anchors) < least:
        return loading
    eye = panorama.center_map[None]
    seen = papers_in_view(eye[:, :2], room)
    if seen.sum() >= least:
        given, by_papers = pose_errors(eye, room, panorama.cylinder.fy, seen)
        # A pose that is better known than papers would give it comes from something else.
        ratio = eigh(covariance[_PLAN], given[0], eigvals_only=True)[-1]
        loading[_X_Y_HEADING] = min(1.0, ratio) * by_papers[0]
    return loading
