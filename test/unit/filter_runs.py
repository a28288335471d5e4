"""A filter among ten landmarks, and drives of it."""

from __future__ import annotations

from fusion_drives import (
    detections,
    drive,
    landmark_map,
    Moment,
    MOUNT,
    start_estimate,
)
import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.fusion import FusionConfig, PoseFilter
from landmark_nav.localization.fusion.update import FusionUpdate
from landmark_nav.types import Detections, LandmarkMap

MAP = landmark_map(10)


EXACT = landmark_map(10, shared=1e-9, own=1e-9)


SIGMA = 5e-4


EVERY = 4


def started(
    config: FusionConfig | None = None,
    true_map: LandmarkMap = MAP,
    offset: npt.ArrayLike = 0.0,
    mount: PanTiltMount = MOUNT,
) -> PoseFilter:
    fused = PoseFilter(true_map, mount, config)
    fused.initialize(start_estimate(offset=offset))
    return fused


def measurement(moment: Moment, k: int, noise: npt.ArrayLike = 0.0) -> Detections:
    places = (k + np.array([0, 1, 3, 4])) % 10
    return detections(MAP, moment.pose, moment.odometry.stamp_ns, places, SIGMA, np.asarray(noise))


def run(fused: PoseFilter, steps: int, first: int = 0) -> tuple[Moment, list[FusionUpdate]]:
    """Drive on with perfect odometry and bearings; the last moment and what became of each."""
    updates = []
    for k, moment in enumerate(drive(steps)):
        if k < first:
            continue
        fused.add_odometry(moment.odometry)
        if k % EVERY == 0:
            updates.append(fused.add_detections(measurement(moment, k)))
    return moment, updates
