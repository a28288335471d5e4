"""
A pose that is believed again after a doubt is compared with where odometry alone leads.

Landmarks do not tell a camera that was turned against the base from a base that was turned against
its odometry, and while the pose was in doubt either may have happened. Dead reckoning from the
last pose that was sure can tell. So can the direction in which the robot drives: wheels slip to
either side, but a robot that seems to drive aside all the time has a camera that is turned.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.fusion.history import History
from landmark_nav.localization.fusion.noise import SLIP
from landmark_nav.localization.fusion.start import is_headed
from landmark_nav.localization.fusion.state import BORESIGHT, FilterState, HEADING, STATES
from landmark_nav.localization.fusion.turn import KNOCKED
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.types import FloatArray

__all__ = ['Recovery']

# Headings that are further apart than so many sigmas differ. Positions that are further apart,
# with `_NEAR_M` added to their sigmas, mean that the robot was carried.
_SURPRISE, _NEAR_M = 3.0, 0.1
# Angles beyond this multiple of `turn_sigma_rad` mean that the robot was turned by hand: cameras
# are not displaced so far.
_CARRIED = 3.0
# A robot that drives aside by this angle and so many sigmas of its slip, averaged over this way,
# is not just slipping. That angle is less than the one by which the camera is turned, which is
# doubted by so many times as much.
_CRAB_RAD, _CRAB_SIGMAS, _CRAB_WAY_M, _CRAB_DOUBT = 0.017, 2.5, 2.5, 3.0


class Recovery:
    """
    Whether the pose is in doubt, and what odometry says once it is believed again.

    Parameters
    ----------
    history : History
        States of the filter; those found to be turned are widened there.
    lever : ndarray, shape (2,)
        Pan axis in the base frame, metres.
    most_rad : float
        How far heading and boresight are doubted at most.
    odometry : OdometryNoiseConfig
        How far it is to be trusted, before anything is learned.

    """

    def __init__(
        self,
        history: History,
        lever: FloatArray,
        most_rad: float,
        odometry: OdometryNoiseConfig,
    ) -> None:
        self._history, self._lever, self._most_rad = history, lever, most_rad
        self._slip_sigma, self._slip_length_m = odometry.slip_sigma, odometry.slip_length_m
        self._in_doubt = False
        self._crab_rad, self._crab_ns = 0.0, 0

    def restart(self) -> None:
        """Begin anew at another pose, which is compared with odometry."""
        self._in_doubt, self._crab_rad = True, 0.0

    def doubt(self) -> None:
        """Compare with odometry when the pose is believed the next time."""
        self._in_doubt = True

    def confirm(self, stamp_ns: int, turned_rad: float, sure: bool) -> float:
        """
        Take note of a measurement that agrees with the pose.

        Parameters
        ----------
        stamp_ns : int
            Its time.
        turned_rad : float
            Angle by which all its bearings were off, if that is known to the filter already.
        sure : bool
            Whether dead reckoning may start from the pose.

        Returns
        -------
        float
            Angle by which all bearings are off, radians; 0 if they are not.

        """
        if turned_rad:
            self._in_doubt = False
        elif self._in_doubt:
            turned_rad = self._compare(stamp_ns)
        if sure and not self._in_doubt:
            self._history.trust(stamp_ns)
        return turned_rad or self._crab(stamp_ns)

    def _crab(self, stamp_ns: int) -> float:
        """Angle by which the robot drives aside all the time, radians; 0 if it does not."""
        found = self._history.at(stamp_ns)
        # The slip of now tells no more than of the way that it is correlated over.
        way_m = min(self._history.way_m(self._crab_ns, stamp_ns), self._slip_length_m)
        kept, self._crab_ns = np.exp(-way_m / _CRAB_WAY_M), stamp_ns
        self._crab_rad = kept * self._crab_rad + (1.0 - kept) * found.side_slip
        crab_rad = self._crab_rad
        slip_rad = self._slip_sigma * np.sqrt(
            found.scales.factors[SLIP] / (1.0 + _CRAB_WAY_M / self._slip_length_m)
        )
        is_open = found.covariance[BORESIGHT, BORESIGHT] > crab_rad**2
        limit_rad = max(_CRAB_RAD, _CRAB_SIGMAS * slip_rad)
        if is_open or abs(crab_rad) < limit_rad or self._most_rad == 0.0:
            return 0.0
        self._crab_rad = 0.0
        self._turn(stamp_ns, crab_rad, _CRAB_DOUBT * abs(crab_rad))
        return crab_rad

    def _compare(self, stamp_ns: int) -> float:
        """Compare with dead reckoning as soon as the heading is known; the angle, radians."""
        found = self._history.at(stamp_ns)
        self._in_doubt = not is_headed(found)
        reckoned = self._history.dead_reckoned(stamp_ns)
        if self._in_doubt or reckoned is None:
            return 0.0
        turn_rad = _turned_since(found, reckoned, _CARRIED * self._most_rad)
        if turn_rad:
            self._turn(stamp_ns, turn_rad, min(abs(turn_rad), self._most_rad))
        return turn_rad

    def _turn(self, stamp_ns: int, turn_rad: float, sigma_rad: float) -> None:
        turned = partial(_turned, turn_rad=turn_rad, lever=self._lever, sigma_rad=sigma_rad)
        self._history.change(stamp_ns, turned)


def _turned_since(found: FilterState, reckoned: FilterState, most_rad: float) -> float:
    """
    Angle by which all bearings are off, radians.

    That is the heading by dead reckoning, `reckoned`, minus the one by landmarks, `found`. It is 0
    where both agree, and where the robot was carried or turned by more than `most_rad`, which
    tells nothing of the camera.
    """
    away = reckoned.mean[:3] - found.mean[:3]
    angle = float(wrap_rad(away[HEADING]))
    spread = found.covariance[:3, :3] + reckoned.covariance[:3, :3]
    near = away[:2] @ np.linalg.solve(spread[:2, :2] + _NEAR_M**2 * np.eye(2), away[:2])
    least = _SURPRISE * np.sqrt(spread[HEADING, HEADING])
    return angle if near < _SURPRISE**2 and least < abs(angle) < most_rad else 0.0


def _turned(
    found: FilterState, turn_rad: float, lever: FloatArray, sigma_rad: float
) -> FilterState:
    """
    Attribute part of `turn_rad` to the boresight, and widen what cannot be distinguished.

    Expected bearings stay the same if heading and boresight change by the same angle while the pan
    axis stays in place. The mean moves along that direction by the camera's share of the angle,
    and the covariance grows along it, by `sigma_rad` for the whole angle.
    """
    forward, left = lever
    cosine, sine = np.cos(found.mean[HEADING]), np.sin(found.mean[HEADING])
    by_turn = np.zeros(STATES)
    by_turn[:2] = cosine * left + sine * forward, sine * left - cosine * forward
    by_turn[[HEADING, BORESIGHT]] = 1.0
    camera_share = KNOCKED**2 / (1.0 + KNOCKED**2)
    mean = found.mean + camera_share * turn_rad * by_turn
    mean[HEADING] = wrap_rad(mean[HEADING])
    variance = camera_share * sigma_rad**2
    covariance = found.covariance + variance * np.outer(by_turn, by_turn)
    return replace(found, mean=mean, covariance=covariance)
