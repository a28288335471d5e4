"""
Triplet selection: the three landmarks that are expected to give the most certain pose for the time
they take.

Madsen and Andersen, Optimal landmark selection for triangulation of robot position, Robotics and
Autonomous Systems 23(4), 1998: propagate the measurement noise through the triangulation for every
triplet that fits one view. Here the map's errors count too, those that landmarks share as such; so
do the prior's spread, the chance that all three are found, and the time to turn to them.

The score is variance x time / chance: the inverse of the information to be expected in a second.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import BoolArray, IndexArray
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.localization.triangulation.model import base_from_axis
from landmark_nav.localization.triplet.planning_scene import CameraState, PlanningScene, Tours
from landmark_nav.localization.triplet.ranking import LandmarkVisibility, Ranking
from landmark_nav.localization.triplet.search import (
    best_triplets,
    first_of_each,
    fix_covariances,
    mean_variance,
    pair_tables,
    PairTables,
)
from landmark_nav.localization.triplet.visibility import TripletConfig
from landmark_nav.types import Detections, FloatArray, LandmarkMap, PoseEstimate, Refusal, Triplet

# How many of the best triplets are looked at more closely, at first.
_SHORTLIST = 24
# A spread of that share of the nearest landmark's range changes variances by its square.
_SMALL = 0.05
# How many are reported.
_RANKED = 8


def rank_triplets(
    prior: PoseEstimate,
    landmark_map: LandmarkMap,
    camera: CameraModel,
    mount: PanTiltMount,
    config: TripletConfig,
    camera_state: CameraState | None = None,
    previous: Triplet | None = None,
    found_rate: npt.ArrayLike | None = None,
) -> Ranking:
    """
    Compare all triplets that can be seen and choose one.

    Parameters
    ----------
    prior : PoseEstimate
        Of the base in map; its spread widens the margins and averages the expected covariance.
    config : TripletConfig
        What counts as visible, and what time costs.
    camera_state : CameraState, optional
        Where the camera looks and how far it turns; a full turn at no cost by default.
    previous : Triplet, optional
        What is being looked at; kept unless another is better by `config.hysteresis`.
    found_rate : array_like, shape (n,), optional
        How often each landmark of the map was found when looked for, (0, 1].

    Returns
    -------
    Ranking
        Of the chosen triplet `sigma_rad` is the spread of the expected bearings by prior and map,
        `covariance` that of the base's pose, and `pan_rad` where to look.
    """
    scene = PlanningScene(
        prior, landmark_map, camera, mount, config, camera_state or CameraState()
    )
    visibility = scene.visibility()
    index = np.flatnonzero(visibility == LandmarkVisibility.USABLE)
    if len(index) < 3:
        detail = f'{len(index)} of {len(visibility)}'
        return Ranking.none(Refusal('fewer than three landmarks are visible', detail), visibility)
    chance = np.ones(len(visibility)) if found_rate is None else np.asarray(found_rate)
    return _TripletSearch(scene, index, chance[index]).judge(previous, visibility)


class _TripletSearch:
    """Triplets of the landmarks `index` (n,), by the windows of pan that see them."""

    def __init__(self, scene: PlanningScene, index: IndexArray, chance: FloatArray) -> None:
        self._scene, self._map, self._config = scene, scene.landmark_map, scene.config
        self._windows = scene.windows(index)
        # From here on a landmark counts once for each turn of the axis that sees it.
        self._index, self._chance = index[self._windows.place], chance[self._windows.place]
        self._corners = self._map.corners[self._index]
        delta = self._map.positions[self._index, :2] - scene.axis.pose[:2]
        points = _viewpoints(scene.axis, float(np.hypot(*delta.T).min()))
        sigma = self._config.bearing_sigma_rad
        self._tables: PairTables = pair_tables(points, self._map, self._index, sigma)

    def judge(self, previous: Triplet | None, visibility: npt.NDArray[np.int8]) -> Ranking:
        """Find the best and compare it with what is being looked at."""
        triplets, tours, score = self._best(self._windows_of(previous))
        favoured = score.copy()
        favoured[self._are(previous, triplets)] /= 1.0 + self._config.hysteresis
        order = np.argsort(favoured, kind='stable')
        order = order[np.isfinite(score[order])]
        # Each once, in its best turn of the axis.
        once = first_of_each(np.sort(self._index[triplets[order]]))
        order = order[np.sort(once)[:_RANKED]]
        if not len(order):
            reason = Refusal('fewer than three landmarks fit one view', 'of those visible')
            return Ranking.none(reason, visibility)
        tours = Tours(*(part[order] for part in tours))
        return self._ranking(triplets[order], tours, score[order], visibility)

    def _best(self, kept: IndexArray) -> tuple[IndexArray, Tours, FloatArray]:
        """
        Return triplets (t, 3) that hold the best one beside those `kept`, tours and scores.

        The search does not look whether patches are whole; it is asked for more until what it
        has not given must be worse than the best there is.
        """
        factor, cost = 1.0 / self._chance, self._windows.costs()
        count = _SHORTLIST
        while True:
            floor, found = best_triplets(self._tables, factor, cost, count)
            triplets = np.concatenate([kept, found])
            tours = self._tours(triplets)
            score = self._scores(triplets, tours)
            if len(floor) < count or np.min(score) <= floor[-1]:
                return triplets, tours, score
            count *= 8

    def _tours(self, triplets: IndexArray) -> Tours:
        """Tours of triplets (t, 3) that show all patches whole."""
        tours = self._windows.tours(triplets)
        corners = self._corners[triplets].reshape(-1, 4, 3)
        whole = self._scene.whole(corners, np.repeat(tours.pan_rad, 3))
        good = whole.reshape(-1, 3).all(axis=1)
        return tours._replace(cost=np.where(good, tours.cost, np.inf))

    def _scores(self, triplets: IndexArray, tours: Tours) -> FloatArray:
        if not len(triplets):
            return np.empty(0)
        chance = np.prod(self._chance[triplets], axis=-1)
        variance = mean_variance(self._tables, triplets)
        return np.asarray(variance / chance * tours.cost)

    def _windows_of(self, previous: Triplet | None) -> IndexArray:
        """The previous triplet (t, 3) in all turns of the axis that see it; none if one can't."""
        if previous is None:
            return np.empty((0, 3), dtype=np.intp)
        ids = self._map.ids[self._index]
        return np.array(
            list(product(*(np.flatnonzero(ids == k) for k in previous.ids))), dtype=np.intp
        ).reshape(-1, 3)

    def _are(self, previous: Triplet | None, triplets: IndexArray) -> npt.NDArray[np.bool_]:
        """Whether triplets (t, 3) are the previous one."""
        if previous is None:
            return np.zeros(len(triplets), dtype=np.bool_)
        ids = np.sort(self._map.ids[self._index[triplets]], axis=-1)
        return np.asarray((ids == np.sort(previous.ids)).all(axis=-1))

    def _ranking(
        self,
        triplets: IndexArray,
        tours: Tours,
        score: FloatArray,
        visibility: npt.NDArray[np.int8],
    ) -> Ranking:
        """Report triplets (m, 3) in order, the chosen one first."""
        axis = self._scene.axis
        chosen = self._index[triplets]
        covariance = fix_covariances(
            axis.pose[:2], self._map, chosen, self._config.bearing_sigma_rad
        )
        sigma_m = np.sqrt(np.trace(covariance[:, :2, :2], axis1=1, axis2=2))
        pan, seconds = tours.pan_rad, (tours.cost - 1.0) * self._config.dwell_time_s
        best: Triplet | Refusal
        if sigma_m[0] > self._config.max_sigma_m:
            detail = f'the best expects {sigma_m[0]:.2f} m'
            best = Refusal('no triplet is accurate enough', detail)
        else:
            bearing, sigma = self._scene.expected_bearings(chosen[0])
            fix = PoseEstimate(axis.stamp_ns, axis.pose, covariance[0])
            best = Triplet(
                axis.stamp_ns,
                self._map.ids[chosen[0]],
                bearing,
                sigma,
                base_from_axis(fix, self._scene.mount).covariance,
                float(pan[0]),
            )
        return Ranking(
            best,
            visibility,
            self._map.ids[chosen],
            covariance,
            np.prod(self._chance[triplets], axis=-1),
            seconds,
            pan,
            score,
        )


def _viewpoints(axis: PoseEstimate, nearest_m: float) -> FloatArray:
    """Positions (p, 2) that stand for the prior's spread; the middle alone where it is small."""
    value, vector = np.linalg.eigh(axis.covariance[:2, :2])
    steps = (vector * np.sqrt(2.0 * np.maximum(value, 0.0))).T
    if np.hypot(*steps[1]) < _SMALL * nearest_m:
        return np.asarray(axis.pose[None, :2])
    return np.asarray(axis.pose[:2] + np.concatenate([steps, -steps]))


# A landmark begins as if it had been found so often, and in so many looks.
_FOUND_BEFORE = 4.0
_LOOKED_BEFORE = 4.2
# A look counts so much less after each later one: posters are exchanged and come back.
_MEMORY = 0.98


class FoundRecord:
    """How often each of n landmarks was found when it should have been in view."""

    def __init__(self, n: int) -> None:
        self._found = np.full(n, _FOUND_BEFORE)
        self._looked = np.full(n, _LOOKED_BEFORE)

    @property
    def rate(self) -> FloatArray:
        """Of each landmark, (n,), in (0, 1)."""
        return np.asarray(self._found / self._looked)

    def note(self, missed: BoolArray, found: BoolArray) -> None:
        """Count an image: whether each (n,) was missed or found in it."""
        looked = missed | found
        self._found[looked] = _MEMORY * self._found[looked] + found[looked]
        self._looked[looked] = _MEMORY * self._looked[looked] + 1.0


class ActiveCamera:
    """Chooses triplets, one after the other, and the pan for each moment."""

    def __init__(
        self, landmark_map: LandmarkMap, mount: PanTiltMount, config: TripletConfig
    ) -> None:
        self._map, self._config = landmark_map, config
        # As far as it is known by now: whoever learns it sets it.
        self.mount = mount
        self.record = FoundRecord(len(landmark_map.landmarks))
        self._chosen: Triplet | None = None

    def saw(self, detections: Detections) -> None:
        """Take note of what was found in an image, and what was missed."""
        missed, found = (
            (self._map.ids[:, None] == ids).any(axis=1)
            for ids in (detections.missed, detections.ids)
        )
        self.record.note(missed, found)

    def choose(
        self, prior: PoseEstimate, camera: CameraModel, camera_state: CameraState
    ) -> Ranking:
        """Decide what to look at now."""
        ranking = rank_triplets(
            prior, self._map, camera, self.mount, self._config, camera_state, self._chosen,
            self.record.rate,
        )  # fmt: skip
        self._chosen = ranking.chosen if isinstance(ranking.chosen, Triplet) else None
        return ranking
