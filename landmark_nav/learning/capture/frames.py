"""
Frames of a sweep: checks of their stamps and content, and their sharpness.

The sharpness of an image is relative to others of the same part of the room: its absolute value
says nothing, since a blank wall has no gradients. So gradients are kept by azimuth, and two images
are compared where they overlap.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.learning.capture.config import CaptureConfig
from landmark_nav.learning.capture.joints import JointTrack
from landmark_nav.types import FloatArray, ImageArray, JointSample

_BIN_RAD = float(np.radians(1.0))
# Smallest overlap for a comparison, bins of azimuth.
_MIN_BINS = 4
# Largest range of grey levels of an image without content: covered, dark, or overexposed.
_FLAT_LEVELS = 2
# Gradient energy caused by noise of two to three grey levels.
_NOISE_ENERGY = 5e-3


@dataclass(frozen=True, eq=False)
class Look:
    """
    Gradients of an image by azimuth, for the comparison of sharpness.

    `azimuth_rad` (n,) are evenly spaced azimuths relative to the pan; `energy` (2, n) is the mean
    squared gradient there, across and down, relative to the squared mean brightness; `flat` means
    that there is no contrast at all.
    """

    azimuth_rad: FloatArray
    energy: FloatArray
    flat: bool


def look_at(image: ImageArray, camera: CameraModel, camera_roll_rad: float = 0.0) -> Look:
    """
    Measure the gradients of an image, BGR (height, width, 3) or grey (height, width).

    The gradient is Sobel's, as in Tenenbaum's measure of focus (Krotkov, IJCV 1, 1987).
    """
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    low, high = cv2.minMaxLoc(grey)[:2]
    slopes = [cv2.Sobel(grey, cv2.CV_32F, *axes) for axes in ((1, 0), (0, 1))]
    columns = [cv2.reduce(slope * slope, 0, cv2.REDUCE_AVG).ravel() for slope in slopes]
    brightness = cv2.reduce(grey, 0, cv2.REDUCE_AVG, dtype=cv2.CV_32F).ravel()

    pixels = np.stack([np.arange(camera.width), np.full(camera.width, camera.cy)], -1)
    # In the frame of the pan axis, independent of how that is mounted.
    turn, _ = PanTiltMount(camera_roll_rad=camera_roll_rad).camera_pose_base(0.0)
    rays = camera.unproject(pixels) @ turn.T
    azimuth = np.unwrap(np.arctan2(rays[:, 1], rays[:, 0]))
    bins = np.floor(azimuth / _BIN_RAD).astype(int)
    first, count = bins.min(), np.bincount(bins - bins.min())
    across, down, light = (
        np.bincount(bins - first, values) / np.maximum(count, 1)
        for values in (*columns, brightness)
    )
    return Look(
        (first + np.arange(len(count)) + 0.5) * _BIN_RAD,
        np.stack([across, down]) / np.maximum(light, 1.0) ** 2,
        bool(high - low <= _FLAT_LEVELS),
    )


def relative_sharpness(look: Look, other: Look, turned_rad: float) -> float | None:
    """
    Gradient energy of one image relative to another at common azimuths, about 1 if equally sharp.

    It is the smaller of the ratios across and down: a shaking camera blurs along one axis only.
    Each ratio is a median over azimuths, weighted by gradient energy, so that people who walk by
    have little influence. It is None if they overlap too little. `turned_rad` is the pan of the
    first minus that of the other.
    """
    at = look.azimuth_rad + turned_rad
    both = (at >= other.azimuth_rad[0]) & (at <= other.azimuth_rad[-1])
    if np.count_nonzero(both) < _MIN_BINS:
        return None
    ratios = []
    for own, its in zip(look.energy, other.energy, strict=True):
        here = own[both] + _NOISE_ENERGY
        there = np.interp(at[both], other.azimuth_rad, its) + _NOISE_ENERGY
        order = np.argsort(here / there)
        total = np.cumsum(np.sqrt(here * there)[order])
        ratios.append(float((here / there)[order][np.searchsorted(total, 0.5 * total[-1])]))
    return min(ratios)


# Number of frames whose digest is kept.
_REMEMBERED = 5000
# Number of nearest frames with which the sharpness is compared.
_NEIGHBOURS = 4
# Smallest sharpness relative to neighbours; below, a frame counts as blurred. Chosen by hand.
_MIN_SHARPNESS = 0.75


@dataclass(frozen=True)
class Shot:
    """A frame that arrived; `digest` identifies the content of its image."""

    frame: Any
    stamp_ns: int
    digest: bytes


@dataclass(frozen=True, eq=False)
class KeptFrame:
    """A frame of the sweep with the angles measured at its stamp."""

    frame: Any
    joints: JointSample
    look: Look
    digest: bytes


class FrameLog:
    """Stamps and digests of all frames that arrived."""

    def __init__(self, config: CaptureConfig) -> None:
        self._config = config
        self._last_ns = -1
        # Time when the last frame arrived, and its age then.
        self._last_arrival: tuple[int, float] | None = None
        self._first: dict[bytes, tuple[int, tuple[float, float] | None]] = {}

    def stamp_error(self, stamp_ns: int, joints_ns: int, now_ns: int) -> str:
        """Why a stamp is wrong, or ''. `joints_ns` is the stamp of the newest joint sample."""
        self._last_arrival = now_ns, (joints_ns - stamp_ns) * 1e-9
        ahead_s, after_s = (stamp_ns - joints_ns) * 1e-9, (stamp_ns - self._last_ns) * 1e-9
        if ahead_s > self._config.stamp_gap_s:
            return f'badly timed: stamp {ahead_s:.3f} s ahead of joint_states'
        self._last_ns = max(stamp_ns, self._last_ns)
        if after_s < 0.0:
            return f'badly timed: stamp {-after_s:.3f} s before the last one'
        return 'duplicated: the same stamp again' if after_s == 0.0 else ''

    def no_image_reason(self, now_ns: int) -> str:
        """The most likely reason why no usable image arrives."""
        if self._last_arrival is None:
            return 'no image came: is the camera on?'
        came_ns, age_s = self._last_arrival
        since_s = (now_ns - came_ns) * 1e-9
        if since_s > 0.5 * self._config.step_timeout_s:
            return (
                f'the last image came {since_s:.1f} s ago: is the camera on, or are large '
                'images lost on their way (image_transport: compressed)?'
            )
        return (
            f'the last image was {age_s:.2f} s old: are its stamps on the clock of joint_states?'
        )

    def is_first(self, digest: bytes) -> bool:
        """Whether the image with this digest was the first of all."""
        return next(iter(self._first)) == digest

    def remember(self, digest: bytes, stamp_ns: int, pans_rad: tuple[float, float] | None) -> None:
        """Store an image with the range of pan in which it was taken, if that is known."""
        self._first[digest] = (stamp_ns, pans_rad)
        if len(self._first) > _REMEMBERED:
            del self._first[next(iter(self._first))]

    def seen_at_other_pan(self, digest: bytes, stamp_ns: int, track: JointTrack) -> bool:
        """Whether the same image arrived at another pan before; stores it."""
        pans_rad = track.around(stamp_ns)
        first_ns, first_rad = self._first.get(digest, (stamp_ns, None))
        # The image may have arrived before the joint states of its time.
        first_rad = track.around(first_ns) or first_rad
        if first_rad is None:
            # The joint states of its time are missing, or have not arrived yet.
            self.remember(digest, stamp_ns, pans_rad)
            return False
        self.remember(digest, first_ns, first_rad)
        if pans_rad is None:
            newest = track.last
            if newest is None or stamp_ns < newest.stamp_ns:
                return False
            # It arrived before the joint states of its time; the unit stands still by then.
            pans_rad = newest.pan_rad, newest.pan_rad
        apart = max(pans_rad[0] - first_rad[1], first_rad[0] - pans_rad[1])
        return apart > self._config.arrival_tolerance_rad


class Album:
    """The frames kept so far, by step; those of `suspect` steps will be taken again."""

    def __init__(self) -> None:
        self.frames: dict[int, KeptFrame] = {}
        self.suspect: set[int] = set()

    def keep(self, step: int, frame: KeptFrame) -> bool:
        """Keep a frame; return False if it was kept before."""
        is_new = self.frames.get(step) is not frame
        self.frames[step] = frame
        self.suspect.discard(step)
        return is_new

    def remove(self, digest: bytes) -> None:
        """Remove the frames with this image: the pan at which it was taken is unknown."""
        for step in [k for k, kept in self.frames.items() if kept.digest == digest]:
            del self.frames[step]
            self.suspect.discard(step)

    def blurred(self, step: int, frame: KeptFrame) -> str | None:
        """Why a frame counts as blurred or covered, '' if it is sharp, None if that is unknown."""
        pan_rad = frame.joints.pan_rad
        others = [kept for k, kept in self.frames.items() if k != step]
        turned = [(float(wrap_rad(pan_rad - kept.joints.pan_rad)), kept) for kept in others]
        turned.sort(key=lambda pair: abs(pair[0]))
        nearest = turned[:_NEIGHBOURS]
        ratios = [relative_sharpness(frame.look, kept.look, turn) for turn, kept in nearest]
        known = [ratio for ratio in ratios if ratio is not None]
        if not known:
            return None
        if (ratio := float(np.median(known))) >= _MIN_SHARPNESS:
            return ''
        return f'blurred or covered: {ratio:.2f} of the texture that its neighbours show'

    def review(self) -> list[tuple[KeptFrame, str]]:
        """Mark frames that are less sharp than their neighbours, when all steps have a frame."""
        found = []
        for step, kept in self.frames.items():
            if reason := self.blurred(step, kept):
                self.suspect.add(step)
                found.append((kept, reason))
        return found


def sharpest(shots: list[KeptFrame]) -> tuple[KeptFrame, float]:
    """Sharpest of frames at one pan, and the relative range of sharpness of the last three."""
    ratios = [relative_sharpness(shot.look, shots[0].look, 0.0) or 0.0 for shot in shots]
    last = ratios[-3:]
    return shots[int(np.argmax(ratios))], float(np.ptp(last) / max(np.max(last), 1e-9))
