"""Late stamps of the joint states, and the pan that an image had by them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

from landmark_nav.geometry.angles import PanTrack
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.types import CameraFrame, JointSample

# A delay is known with this sigma: half a degree at a fast 2 rad/s.
_KNOWN_S = 0.005
# Sigma of a delay that nothing tells, for headings that are found while the pan turns.
DELAY_BOUND_S = 0.1
# A delay is corrected if it is more than so many sigmas, and more than does no harm.
_SIGNIFICANT, _LEAST_DELAY_S = 4.0, 5e-4


@dataclass(frozen=True)
class JointDelay:
    """By how much joint states are stamped later than images taken at the same moment."""

    delay_s: float = 0.0
    sigma_s: float = 0.0

    @property
    def is_known(self) -> bool:
        """Whether the delay is known well enough."""
        return self.sigma_s < _KNOWN_S

    @property
    def matters(self) -> bool:
        """Whether the delay is more than chance, and does harm."""
        return abs(self.delay_s) > max(_SIGNIFICANT * self.sigma_s, _LEAST_DELAY_S)


class PanMotion(NamedTuple):
    """Rate and track of the azimuth in ``base_link`` where a camera looks."""

    rate_rad_s: float
    track: PanTrack | None

    @classmethod
    def of(cls, joints: CameraFrame | JointSample, mount: PanTiltMount) -> PanMotion:
        """Of an image, or of joint states."""
        track = joints.pan_track
        return cls(
            mount.pan_sense * joints.pan_rate_rad_s,
            track and PanTrack(track.seconds, mount.azimuth_base_rad(track.pans_rad)),
        )


def in_time(frame: CameraFrame, delay_s: float) -> CameraFrame:
    """Return an image with the pan that it had if joint states are stamped so much later."""
    track = frame.pan_track
    if track is None:
        return replace(frame, pan_rad=frame.pan_rad + frame.pan_rate_rad_s * delay_s)
    given, lagged = track.at([0.0, delay_s]).tolist()
    return replace(frame, pan_rad=frame.pan_rad + lagged - given)
