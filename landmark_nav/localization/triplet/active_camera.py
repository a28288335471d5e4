"""Where to look: the chosen triplet, the views it takes, and what came of earlier looks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from landmark_nav.arrays import BoolArray, IntArray
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.localization.triplet.ranking import Ranking
from landmark_nav.localization.triplet.selection import CameraState, rank_triplets, TripletConfig
from landmark_nav.types import Detections, FloatArray, LandmarkMap, PoseEstimate, Triplet

__all__ = ['ActiveCamera', 'FoundRecord']


# A landmark begins as if it had been found so often, and in so many looks.
_FOUND_BEFORE = 4.0
_LOOKED_BEFORE = 4.2
# A look counts so much less after each later one: posters are exchanged and come back.
_MEMORY = 0.98
# A view is given up after so many images without its landmark.
_PATIENCE = 4


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
    """
    Chooses triplets, one after the other, and the pan for each moment.

    With several views a triplet is kept until all its landmarks were found, or looked for in
    vain, or `fix_window_s` are over; the camera goes on to the nearest that is left.
    """

    def __init__(
        self, landmark_map: LandmarkMap, mount: PanTiltMount, config: TripletConfig
    ) -> None:
        self._map, self._mount, self._config = landmark_map, mount, config
        self.record = FoundRecord(len(landmark_map.landmarks))
        self._chosen: Triplet | None = None
        self._pending: dict[int, int] = {}  # failed looks at what is still to be seen
        self._aimed: set[int] = set()  # what the view shows that was chosen last

    def saw(self, detections: Detections) -> None:
        """Take note of what was found in an image, and what was missed."""
        missed, found = (
            (self._map.ids[:, None] == ids).any(axis=1)
            for ids in (detections.missed, detections.ids)
        )
        self.record.note(missed, found)
        for k in detections.ids.tolist():
            self._pending.pop(k, None)
        for k in set(detections.missed.tolist()) & set(self._pending):
            self._pending[k] += 1
            if self._pending[k] >= _PATIENCE:
                del self._pending[k]

    @property
    def done_here(self) -> bool:
        """Whether the view that was chosen last has shown what it was for, and another is next."""
        several = self._config.views == 'several' and self._chosen is not None
        return several and not self._aimed & set(self._pending)

    def choose(
        self, prior: PoseEstimate, camera: CameraModel, camera_state: CameraState
    ) -> Ranking:
        """
        Decide what to look at now.

        Returns
        -------
        Ranking
            The chosen triplet's `pan_rad` is that of the next view.

        """
        several, tour = self._config.views == 'several', self._chosen
        if several and self._pending and tour is not None:
            if 0 <= prior.stamp_ns - tour.stamp_ns <= 1e9 * self._config.fix_window_s:
                ranking = self._rank(prior, camera, camera_state, among=tour.ids)
                if isinstance(ranking.chosen, Triplet):
                    return self._towards_pending(ranking, camera_state)
            else:
                # Something holds the camera; without a mark the same would be chosen again.
                missed = np.isin(self._map.ids, list(self._aimed & set(self._pending)))
                self.record.note(missed, np.zeros_like(missed))
        ranking = self._rank(prior, camera, camera_state)
        self._chosen, self._pending = None, {}
        if isinstance(ranking.chosen, Triplet):
            self._chosen = ranking.chosen
            self._pending = dict.fromkeys(map(int, ranking.chosen.ids), 0)
        return self._towards_pending(ranking, camera_state)

    def _rank(
        self,
        prior: PoseEstimate,
        camera: CameraModel,
        camera_state: CameraState,
        among: IntArray | None = None,
    ) -> Ranking:
        # A tour that is done has no claim to be made again; a view is rather kept.
        kept = self._chosen if self._config.views == 'one' else None
        rate, config = self.record.rate, self._config
        return rank_triplets(
            prior, self._map, camera, self._mount, config, camera_state, kept, rate, among
        )

    def _towards_pending(self, ranking: Ranking, camera_state: CameraState) -> Ranking:
        chosen = ranking.chosen
        self._aimed = set(self._pending)
        if not isinstance(chosen, Triplet) or self._config.views == 'one':
            return ranking
        pending = np.isin(ranking.ids[0], list(self._pending))
        if camera_state.pan_rad is None or not pending.any():
            return ranking
        away = np.where(pending, np.abs(ranking.pan_rad[0] - camera_state.pan_rad), np.inf)
        nearest = ranking.pan_rad[0][np.argmin(away)]
        self._aimed = set(ranking.ids[0][ranking.pan_rad[0] == nearest].tolist())
        return replace(ranking, chosen=replace(chosen, pan_rad=float(nearest)))
