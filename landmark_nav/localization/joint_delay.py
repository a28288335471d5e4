"""Delay of the joint states' stamps, and the pan of an image corrected by it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

from landmark_nav.geometry.angles import PanTrack
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.types import CameraFrame, JointSample

# Sigma below which a delay is known: half a degree at 2 rad/s.
_KNOWN_S = 0.005
# Sigma of an unknown delay, for headings found while the pan turns.
DELAY_BOUND_S = 0.1
# A delay is corrected if it exceeds this number of sigmas and this harmless value.
_SIGNIFICANT, _LEAST_DELAY_S = 4.0, 5e-4


@dataclass(frozen=True)
class JointDelay:
    """Stamp of joint states minus stamp of an image taken at the same time."""

    delay_s: float = 0.0
    sigma_s: float = 0.0

    @property
    def is_known(self) -> bool:
        """Whether the delay is known well enough."""
        return self.sigma_s < _KNOWN_S

    @property
    def matters(self) -> bool:
        """Whether the delay is significant, and large enough to do harm."""
        return abs(self.delay_s) > max(_SIGNIFICANT * self.sigma_s, _LEAST_DELAY_S)


class PanMotion(NamedTuple):
    """Rate and track of the camera's azimuth in ``base_link``."""

    rate_rad_s: float
    track: PanTrack | None

    @classmethod
    def of(cls, joints: CameraFrame | JointSample, mount: PanTiltMount) -> PanMotion:
        """Motion at an image, or at joint states."""
        track = joints.pan_track
        return cls(
            mount.pan_sense * joints.pan_rate_rad_s,
            track and PanTrack(track.seconds, mount.azimuth_base_rad(track.pans_rad)),
        )


def in_time(frame: CameraFrame, delay_s: float) -> CameraFrame:
    """Return an image with its pan corrected for a delay of the joint states."""
    track = frame.pan_track
    if track is None:
        return replace(frame, pan_rad=frame.pan_rad + frame.pan_rate_rad_s * delay_s)
    given, lagged = track.at([0.0, delay_s]).tolist()
    return replace(frame, pan_rad=frame.pan_rad + lagged - given)
