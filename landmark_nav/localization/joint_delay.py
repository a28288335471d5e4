"""Stamps of the joints that are late: what that makes of the pan in a picture."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import hypot
from typing import NamedTuple

from landmark_nav.geometry.pan_track import PanTrack
from landmark_nav.types import CameraFrame, Detections

__all__ = ['STILL', 'JointDelay', 'Lag', 'in_time', 'seen_in_time']

# A slope of the pan over less than that is its noise.
_LEAST_STEP_S = 0.02
# At the rate of a fast pan, 2 rad/s, half a degree.
_KNOWN_S = 0.005


class Lag(NamedTuple):
    """
    Pan at the true time of a picture minus the one it was given.

    `rate_rad_s` is how that grows with the lateness of the stamps, within its sigma, and
    `bend_rad` what this slope leaves out.
    """

    shift_rad: float
    rate_rad_s: float
    bend_rad: float


STILL = Lag(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class JointDelay:
    """By how much joint states are stamped later than pictures of the same moment, s."""

    delay_s: float = 0.0
    sigma_s: float = 0.0

    @property
    def is_known(self) -> bool:
        """Whether it is known as well as is of use."""
        return self.sigma_s < _KNOWN_S

    def lag(self, rate_rad_s: float, track: PanTrack | None, given_s: float = 0.0) -> Lag:
        """
        What a lateness makes of the pan of a picture that was given that of a delay `given_s`.

        Parameters
        ----------
        rate_rad_s : float
            Of the pan: all that is known without a track.
        track : PanTrack or None
            Pan about the picture's stamp.
        given_s : float
            By how much the stamps were taken to be late.

        """
        if track is None or not (self.delay_s or self.sigma_s or given_s):
            return Lag(rate_rad_s * (self.delay_s - given_s), rate_rad_s, 0.0)
        step = max(self.sigma_s, _LEAST_STEP_S)
        times = [given_s, self.delay_s - step, self.delay_s, self.delay_s + step]
        given, before, at, after = track.at(times).tolist()
        return Lag(at - given, 0.5 * (after - before) / step, 0.5 * (after + before) - at)


def in_time(frame: CameraFrame, late: JointDelay) -> tuple[CameraFrame, float]:
    """Return a picture with the pan that joint states so late tell, and the sigma of that, rad."""
    if not (late.delay_s or late.sigma_s):
        return frame, frame.pan_sigma_rad
    lag = late.lag(frame.pan_rate_rad_s, frame.pan_track)
    sigma = hypot(frame.pan_sigma_rad, lag.rate_rad_s * late.sigma_s, lag.bend_rad)
    return replace(frame, pan_rad=frame.pan_rad + lag.shift_rad), sigma


def seen_in_time(seen: Detections, late: JointDelay) -> Detections:
    """Return bearings of the pan that joint states so late tell, whatever was thought before."""
    lag = late.lag(seen.pan_rate_rad_s, seen.pan_track, seen.pan_delay_s)
    return replace(seen, bearing_rad=seen.bearing_rad + lag.shift_rad, pan_delay_s=late.delay_s)
