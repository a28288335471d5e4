"""Late stamps of the joint states, and the error of the pan that they cause."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.pan_track import PanTrack
from landmark_nav.types import CameraFrame, JointSample

__all__ = [
    'DELAY_BOUND_S',
    'STILL',
    'JointDelay',
    'PanError',
    'PanMotion',
    'in_time',
]

# Over a shorter time the slope of the pan is mostly noise.
_LEAST_STEP_S = 0.02
# A delay is known with this sigma: half a degree at a fast 2 rad/s.
_KNOWN_S = 0.005
# Sigma of a delay that nothing tells, for headings that are found while the pan turns.
DELAY_BOUND_S = 0.1
# A delay is corrected if it is more than so many sigmas, and more than does no harm.
_SIGNIFICANT, _LEAST_DELAY_S = 4.0, 5e-4


class PanError(NamedTuple):
    """
    Pan at the true time of an image minus the pan that the image was given.

    `shift_rad` is that difference, `rate_rad_s` its derivative by the delay, taken over the sigma
    of the delay, and `bend_rad` how far it deviates from that slope there.
    """

    shift_rad: float
    rate_rad_s: float
    bend_rad: float


STILL = PanError(0.0, 0.0, 0.0)


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

    def lag(self, rate_rad_s: float, track: PanTrack | None, given_s: float = 0.0) -> PanError:
        """
        Error of an image's pan that was interpolated for a delay of `given_s`.

        Parameters
        ----------
        rate_rad_s : float
            Rate of the pan, which is used if there is no track.
        track : PanTrack or None
            Pan over time about the image's stamp.
        given_s : float
            Delay for which the pan was interpolated.

        """
        if track is None or not (self.delay_s or self.sigma_s or given_s):
            return PanError(rate_rad_s * (self.delay_s - given_s), rate_rad_s, 0.0)
        step = max(self.sigma_s, _LEAST_STEP_S)
        times = [given_s, self.delay_s - step, self.delay_s, self.delay_s + step]
        given, before, at, after = track.at(times).tolist()
        return PanError(at - given, 0.5 * (after - before) / step, 0.5 * (after + before) - at)


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
    lag = JointDelay(delay_s).lag(frame.pan_rate_rad_s, frame.pan_track)
    return replace(frame, pan_rad=frame.pan_rad + lag.shift_rad)
