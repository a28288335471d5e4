"""Constant errors of the camera that a run shows: late joint stamps, an offset of the pan."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from landmark_nav.evaluation.replay import Replay
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.fusion import PoseFilter
from landmark_nav.localization.fusion.state import BORESIGHT, DELAY
from landmark_nav.localization.joint_delay import JointDelay
from landmark_nav.localization.pipeline import LocalizationConfig
from landmark_nav.types import LandmarkMap

__all__ = ['CameraOffsets', 'camera_offsets']

# Prior sigmas.
_DELAY_SIGMA_S = 0.05
_BORESIGHT_SIGMA_RAD = 0.03


@dataclass(frozen=True)
class CameraOffsets:
    """
    Constant errors of the camera's direction, each with its sigma.

    `delay_s` is by how much joint states are stamped later than images of the same moment,
    `boresight_rad` the direction of the camera at pan 0, counter-clockwise from ahead.
    """

    delay_s: float
    delay_sigma_s: float
    boresight_rad: float
    boresight_sigma_rad: float

    @property
    def delay_matters(self) -> bool:
        """Whether the delay is more than chance and worth a correction."""
        return JointDelay(self.delay_s, self.delay_sigma_s).matters

    def report(self) -> dict[str, Any]:
        """Figures for ``evaluate --json``."""
        return {
            'joint_delay_s': self.delay_s,
            'joint_delay_sigma_s': self.delay_sigma_s,
            'boresight_deg': float(np.degrees(self.boresight_rad)),
            'boresight_sigma_deg': float(np.degrees(self.boresight_sigma_rad)),
        }


def camera_offsets(
    run: Replay, landmark_map: LandmarkMap, mount: PanTiltMount, config: LocalizationConfig
) -> CameraOffsets:
    """
    Estimate the offsets from the bearings and the odometry of a run, together with its poses.

    While the camera turns, late stamps shift all bearings by rate times delay. An offset of the
    pan shows in the direction in which the robot drives.
    """
    fusion = replace(
        config.fusion,
        mode='bearings',
        boresight_sigma_rad=_BORESIGHT_SIGMA_RAD,
        delay_sigma_s=_DELAY_SIGMA_S,
    )
    fused = PoseFilter(landmark_map, mount, fusion, config.odometry, config.health)
    fused.initialize(run.start)
    moved = 0
    for update in run.updates:
        while moved < len(run.samples) and run.samples[moved].stamp_ns <= update.stamp_ns:
            fused.add_odometry(run.samples[moved])
            moved += 1
        fused.add_detections(update.observation.detections)
    state = fused.state
    assert state is not None, 'it was initialized'
    sigma = np.sqrt(np.diag(state.covariance))
    return CameraOffsets(
        float(state.mean[DELAY]),
        float(sigma[DELAY]),
        float(state.mean[BORESIGHT]),
        float(sigma[BORESIGHT]),
    )
