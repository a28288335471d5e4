"""
Triplet selection: the three landmarks expected to give the most information in the least time.

Madsen and Andersen, Optimal landmark selection for triangulation of robot position, Robotics and
Autonomous Systems 23(4), 1998: propagate the measurement noise through the triangulation for every
triplet that fits one view. Here the errors of the map count too, with those that landmarks share;
so do the covariance of the prior, the probability that all three are found, and the time to turn.

The score is variance x time / chance: the inverse of the expected information per second.
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

# Number of best triplets whose patches are checked for being whole, at first.
_SHORTLIST = 24
# A prior narrower than this share of the nearest range counts as a point: the variance changes by
# the square of the share only.
_SMALL = 0.05
# Number of triplets in a ranking.
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
        Pose of the base in map; its covariance widens the margins, and the expected covariance is
        averaged over it.
    config : TripletConfig
        What counts as visible, and what time costs.
    camera_state : CameraState, optional
        Where the camera looks and how far it turns; a full turn at no cost by default.
    previous : Triplet, optional
        The triplet looked at now; kept unless another is better by `config.hysteresis`.
    found_rate : array_like, shape (n,), optional
        Share of attempts in which each landmark of the map was found, (0, 1].

    Returns
    -------
    Ranking
        In the chosen triplet, `sigma_rad` are the sigmas of the expected bearings by prior and
        map, `covariance` is that of the base's pose, and `pan_rad` where to look.
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
    """Search among triplets of the landmarks `index` (n,) and the pans at which they are seen."""

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
        """Find the best triplet and compare it with the one looked at now."""
        kept = np.empty((0, 3), dtype=np.intp)
        if previous is not None:
            # The previous triplet in all pan turns that see it.
            ids = self._map.ids[self._index]
            seen = product(*(np.flatnonzero(ids == k) for k in previous.ids))
            kept = np.array(list(seen), dtype=np.intp).reshape(-1, 3)
        triplets, tours, score = self._best(kept)
        liked = score.copy()
        if previous is not None:
            ids = np.sort(self._map.ids[self._index[triplets]], axis=-1)
            liked[(ids == np.sort(previous.ids)).all(axis=-1)] /= 1.0 + self._config.hysteresis
        order = np.argsort(liked, kind='stable')
        order = order[np.isfinite(score[order])]
        # Each triplet once, with the pan turn that costs least.
        once = first_of_each(np.sort(self._index[triplets[order]]))
        order = order[np.sort(once)[:_RANKED]]
        if not len(order):
            reason = Refusal('fewer than three landmarks fit one view', 'of those visible')
            return Ranking.none(reason, visibility)
        tours = Tours(*(part[order] for part in tours))
        return self._ranking(triplets[order], tours, score[order], visibility)

    def _best(self, kept: IndexArray) -> tuple[IndexArray, Tours, FloatArray]:
        """Return triplets (t, 3), with the best one and those `kept`; their tours and scores."""
        factor, cost = 1.0 / self._chance, self._windows.costs()
        count = _SHORTLIST
        while True:
            floor, found = best_triplets(self._tables, factor, cost, count)
            triplets = np.concatenate([kept, found])
            tours = self._windows.tours(triplets)
            corners = self._corners[triplets].reshape(-1, 4, 3)
            whole = self._scene.whole(corners, np.repeat(tours.pan_rad, 3)).reshape(-1, 3)
            tours = tours._replace(cost=np.where(whole.all(axis=1), tours.cost, np.inf))
            chance = np.prod(self._chance[triplets], axis=-1)
            score = mean_variance(self._tables, triplets) / chance * tours.cost
            # The search does not check whether patches are whole in view. It is repeated for more
            # until all that it left out must be worse than the best one found.
            if len(floor) < count or np.min(score) <= floor[-1]:
                return triplets, tours, score
            count *= 8

    def _ranking(
        self,
        triplets: IndexArray,
        tours: Tours,
        score: FloatArray,
        visibility: npt.NDArray[np.int8],
    ) -> Ranking:
        """Return the ranking of triplets (m, 3), which are in order."""
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
    """Positions (p, 2) that represent the prior; its mean alone where its covariance is small."""
    value, vector = np.linalg.eigh(axis.covariance[:2, :2])
    steps = (vector * np.sqrt(2.0 * np.maximum(value, 0.0))).T
    if np.hypot(*steps[1]) < _SMALL * nearest_m:
        return np.asarray(axis.pose[None, :2])
    return np.asarray(axis.pose[:2] + np.concatenate([steps, -steps]))


# Prior of a landmark's rate of detection, in images in which it was found, and should have been.
_FOUND_BEFORE = 4.0
_LOOKED_BEFORE = 4.2
# Weight of an image relative to the next one: posters are exchanged and come back.
_MEMORY = 0.98


class FoundRecord:
    """Rate at which each of n landmarks is found when it should be in view."""

    def __init__(self, n: int) -> None:
        self._found = np.full(n, _FOUND_BEFORE)
        self._looked = np.full(n, _LOOKED_BEFORE)

    @property
    def rate(self) -> FloatArray:
        """Rate of each landmark (n,), in (0, 1)."""
        return np.asarray(self._found / self._looked)

    def note(self, missed: BoolArray, found: BoolArray) -> None:
        """Count an image in which landmarks (n,) were missed or found."""
        looked = missed | found
        self._found[looked] = _MEMORY * self._found[looked] + found[looked]
        self._looked[looked] = _MEMORY * self._looked[looked] + 1.0


class ActiveCamera:
    """Chooses one triplet after the other, and the pan that shows it."""

    def __init__(
        self, landmark_map: LandmarkMap, mount: PanTiltMount, config: TripletConfig
    ) -> None:
        self._map, self._config = landmark_map, config
        # The current estimate; the caller updates it.
        self.mount = mount
        self.record = FoundRecord(len(landmark_map.landmarks))
        self._chosen: Triplet | None = None

    def saw(self, detections: Detections) -> None:
        """Count what was found in an image, and what was missed."""
        missed, found = (
            np.isin(self._map.ids, ids) for ids in (detections.missed, detections.ids)
        )
        self.record.note(missed, found)

    def choose(
        self, prior: PoseEstimate, camera: CameraModel, camera_state: CameraState
    ) -> Ranking:
        """Choose what to look at now."""
        ranking = rank_triplets(
            prior, self._map, camera, self.mount, self._config, camera_state, self._chosen,
            self.record.rate,
        )  # fmt: skip
        self._chosen = ranking.chosen if isinstance(ranking.chosen, Triplet) else None
        return ranking
