"""A room that shares one wall with the map: its place is never reported as certain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from place_scenes import MAP, MOUNT, ROOM, SCENE, sweep
import pytest
from scenes import textured_room

from landmark_nav.calibration import Calibration
from landmark_nav.localization.localizer import LocalizationConfig, LocalizationUpdate, Localizer
from landmark_nav.types import CameraFrame, OdometrySample, PoseEstimate

OTHER = textured_room(ROOM, seed=23, feature_m=0.045)
POSE = (2.4, 1.9, 0.4)


def reported(frames: list[CameraFrame]) -> tuple[list[str], int]:
    """What the state says with each image of a robot that turns its camera, and places found."""
    localizer = Localizer(MAP, Calibration.exact(MOUNT), LocalizationConfig())
    statuses, places = [], 0
    for k, frame in enumerate(frames):
        for tick in range(4):
            stamp_ns = 200_000_000 * k + 50_000_000 * tick
            localizer.add_odometry(OdometrySample(stamp_ns, np.zeros(3)))
        frame = replace(frame, stamp_ns=200_000_000 * k)
        update = localizer.add_frame(frame)
        found = update.search if isinstance(update, LocalizationUpdate) else update
        places += isinstance(found, PoseEstimate)
        statuses.append(localizer.status[0])
    return statuses, places


@pytest.mark.xfail(
    strict=True, reason='tracking in 5 of 18 images, where the camera looks at the shared wall'
)
def test_one_known_wall_in_a_foreign_room_is_not_the_room() -> None:
    boards = (SCENE.boards[0], *OTHER.boards[1:])
    pans = np.radians(np.arange(-180, 360, 30))
    statuses, places = reported(sweep(replace(OTHER, boards=boards), POSE, pans))
    assert places
    assert 'tracking' not in statuses


def test_the_room_itself_is_sure_when_two_walls_were_seen() -> None:
    statuses, places = reported(sweep(SCENE, POSE, np.radians(np.arange(-180, 180, 30))))
    assert places == 1
    assert statuses[-1] == 'tracking'
    assert 'lost' not in statuses[statuses.index('tracking') :]
