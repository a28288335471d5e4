from __future__ import annotations

import numpy as np
from triplet_room import CAMERA, CONFIG, MOUNT, PRIOR, random_map

from landmark_nav.localization.triplet import CameraState
from landmark_nav.localization.triplet.selection import ActiveCamera
from landmark_nav.types import Detections, Triplet


def camera_image(found: list[int], missed: list[int] | None = None) -> Detections:
    n = len(found)
    return Detections(
        0,
        np.array(found, dtype=np.int64),
        np.zeros(n),
        np.full(n, 1e-6),
        np.ones(n),
        np.zeros((n, 2)),
        missed=np.array(missed or [], dtype=np.int64),
    )


class TestOneView:
    def test_an_image_that_hangs_no_more_is_given_up(self) -> None:
        camera = ActiveCamera(random_map(40), MOUNT, CONFIG)
        first = camera.choose(PRIOR, CAMERA, CameraState(0.0)).chosen
        assert isinstance(first, Triplet)
        gone = int(first.ids[0])
        for _ in range(60):
            camera.saw(camera_image([], [gone]))
        later = camera.choose(PRIOR, CAMERA, CameraState(0.0)).chosen
        assert isinstance(later, Triplet)
        assert gone not in later.ids
