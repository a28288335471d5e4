"""Where to look: the chosen triplet, and what came of earlier looks."""

from __future__ import annotations

import numpy as np

from landmark_nav.arrays import BoolArray
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.localization.triplet.planning_scene import CameraState
from landmark_nav.localization.triplet.ranking import Ranking
from landmark_nav.localization.triplet.selection import rank_triplets
from landmark_nav.localization.triplet.visibility import TripletConfig
from landmark_nav.types import Detections, FloatArray, LandmarkMap, PoseEstimate, Triplet

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
