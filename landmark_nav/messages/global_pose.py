"""What ``global_localization/pose`` says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from landmark_nav.types import PoseEstimate

__all__ = ['GlobalPose']


@dataclass(frozen=True, eq=False)
class GlobalPose(PoseEstimate):
    """
    A pose that images gave, without any prior.

    It is the pose of the base at the last of them if its joint states are in time; `ids` (m,) are
    the landmarks it was found from. The rate of the pan there is `pan_rate_rad_s`, to the
    left; `joint_delay_s` is that of `Detections`.
    """

    ids: npt.NDArray[np.int64]
    pan_rate_rad_s: float = 0.0
    joint_delay_s: float = 0.0
