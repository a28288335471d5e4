"""State of the estimator, errors of the map, and the result of an update."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import pinvh

from landmark_nav.arrays import IndexArray
from landmark_nav.localization.estimator.factors import CALIBRATION, ImagePoints, STATES
from landmark_nav.localization.estimator.noise import NoiseScales
from landmark_nav.types import FloatArray, LandmarkMap

# Detections of less weight are outliers.
OUTLIER = 0.1
# Eigenvalues of a correlation matrix below this are rounding.
_ROUNDING = 1e-12


def information_of(covariance: FloatArray) -> FloatArray:
    """Inverse (n, n) of a covariance; 0 for what is exact."""
    # In units of sigmas.
    sigmas = np.sqrt(np.diag(covariance))
    scale = np.where(sigmas > 0.0, 1.0 / np.maximum(sigmas, 1e-300), 0.0)
    alike = pinvh(scale[:, None] * covariance * scale, rtol=_ROUNDING)
    return np.asarray(scale[:, None] * alike * scale)


class MapErrors(NamedTuple):
    """
    Landmarks of a map and their errors.

    `positions` (n, 3) and `own` (n, 3, 3), the covariance of each landmark by itself, are in map;
    `loadings` (n, 3, f) are those of the shared factors; `objects` (n, m) says which are on each
    of the objects that may have been moved since learning.
    """

    positions: FloatArray
    own: FloatArray
    loadings: FloatArray
    objects: npt.NDArray[np.bool_]

    @classmethod
    def of(cls, landmark_map: LandmarkMap, movable: bool = True) -> MapErrors:
        """Return those of a map, in which objects may have been moved or not."""
        loadings = landmark_map.shared_loadings
        own = landmark_map.covariances - loadings @ loadings.swapaxes(1, 2)
        objects = landmark_map.objects if movable else np.zeros((len(own), 0), dtype=np.bool_)
        return cls(landmark_map.positions, own, loadings, objects)

    @property
    def end(self) -> int:
        """Where the shared factors end in the state, and displacements of objects begin."""
        return STATES + int(self.loadings.shape[2])


@dataclass(frozen=True, eq=False)
class State:
    """The state; arrays are never changed in place, so that copies are cheap."""

    stamp_ns: int
    mean: FloatArray
    covariance: FloatArray
    by_noise: FloatArray
    scales: NoiseScales
    # Columns of the landmarks with own errors in the state, and the way since each was seen.
    landmarks: IndexArray
    unseen_m: FloatArray
    # Numbers of the objects (k,) that they are on, in order, and the inverse prior covariance
    # (k, 2, 2) of the displacement of each since learning; which (n, k) landmarks are on each.
    objects: IndexArray
    still: FloatArray
    on: npt.NDArray[np.bool_]
    # Whether the pose was found by images: then it shares the displacements of what they show.
    found: bool = False
    way_m: float = 0.0
    seconds: float = 0.0
    # Pose of the base when an image of this time was taken, in the base at this time.
    moved_back: FloatArray = field(default_factory=lambda: np.zeros(3))
    # Speeds of the base by odometry, ahead, to the left and turning.
    speeds: FloatArray = field(default_factory=lambda: np.zeros(3))
    # Derivative of pose, tilt of the floor and odometry by those after the last image.
    carried: FloatArray = field(default_factory=lambda: np.eye(CALIBRATION))
    # Sum (2, 17) of the corrections of the calibration by images, and of their variances.
    corrections: FloatArray = field(default_factory=lambda: np.zeros((2, STATES - CALIBRATION)))

    def corrected_from(self, prior: State) -> State:
        """Return the state after an image, with its correction of the calibration added."""
        which = np.arange(CALIBRATION, STATES)
        shift = self.mean[which] - prior.mean[which]
        variance = prior.covariance[which, which] - self.covariance[which, which]
        return replace(self, corrections=prior.corrections + np.stack([shift, variance]))

    @property
    def first_own(self) -> int:
        """Where own errors of landmarks begin, after the displacements of objects."""
        return len(self.mean) - 3 * len(self.landmarks)

    def displacements(self, objects: IndexArray) -> IndexArray:
        """Where (m, 2) the displacements of these objects are in the state."""
        first = self.first_own - 2 * len(self.objects)
        return first + 2 * np.searchsorted(self.objects, objects)[:, None] + np.arange(2)

    def rows(self, kept: npt.NDArray[np.bool_]) -> IndexArray:
        """Where the state with some of its landmarks, `kept` (n,), and their objects is."""
        left = self.on[kept].any(axis=0)
        fixed = np.ones(self.first_own - 2 * len(self.objects), np.bool_)
        return np.flatnonzero(np.concatenate([fixed, np.repeat(left, 2), np.repeat(kept, 3)]))

    def only(self, kept: npt.NDArray[np.bool_]) -> State:
        """Return the state with some of its landmarks, `kept` (n,), and their objects."""
        if kept.all():
            return self
        left, rows = self.on[kept].any(axis=0), self.rows(kept)
        return replace(
            self,
            mean=self.mean[rows],
            covariance=self.covariance[np.ix_(rows, rows)],
            landmarks=self.landmarks[kept],
            unseen_m=self.unseen_m[kept],
            on=self.on[np.ix_(kept, left)],
            objects=self.objects[left],
            still=self.still[left],
        )


class Update(NamedTuple):
    """
    Result of an update by an image.

    Parameters
    ----------
    stamp_ns : int
        Time of the image.
    columns : ndarray of int, shape (m,)
        Landmarks that were used.
    residual : ndarray, shape (m, d)
        Measured minus predicted, given the prior and the other detections of the image.
    covariance : ndarray, shape (m, d, d)
        Covariance of each residual, with the nominal noise of the detection.
    weight : ndarray, shape (m,)
        1 for an inlier, near 0 for an outlier.
    log_ratios : ndarray, shape (m,)
        Log likelihood ratio of each residual: right pose against wrong pose.
    log_evidence : float
        Log density of the image given all before.
    surprising : bool
        Whether the image as a whole is unlikely given the prediction.
    stepped : bool
        Whether a sudden change of camera or base before the image was assumed.
    separation : ndarray, shape (m, 3)
        Change of the pose if a landmark is left out.
    without : ndarray, shape (m, 3, 3)
        Increase of the covariance of the pose then.
    """

    stamp_ns: int
    columns: IndexArray
    residual: FloatArray
    covariance: FloatArray
    weight: FloatArray
    log_ratios: FloatArray
    log_evidence: float
    surprising: bool
    stepped: bool
    separation: FloatArray
    without: FloatArray

    @classmethod
    def of_nothing(cls, seen: ImagePoints) -> Update:
        """Return the result of an image without landmarks."""
        rows = 2 if seen.rows else 1
        none = np.empty(0)
        return cls(
            seen.stamp_ns,
            seen.columns,
            none.reshape(0, rows),
            none.reshape(0, rows, rows),
            none,
            none,
            0.0,
            False,
            False,
            none.reshape(0, 3),
            none.reshape(0, 3, 3),
        )

    @property
    def used(self) -> IndexArray:
        """Landmarks of the image that are not outliers."""
        return self.columns[self.weight > OUTLIER]

    @property
    def unused(self) -> Update:
        """The result of the same image if it is not used."""
        return self._replace(
            weight=np.zeros_like(self.weight),
            separation=np.zeros_like(self.separation),
            without=np.zeros_like(self.without),
        )
