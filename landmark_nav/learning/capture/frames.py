"""
Frames of a sweep: which are refused at sight, which are less sharp than their neighbours.

How sharp an image is beside others that show the same part of the room.

Sharpness alone shows nothing: a blank wall has none. So gradients are kept by direction, and two
images are compared where both look, whatever is there.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.learning.capture.config import CaptureConfig
from landmark_nav.learning.capture.joints import JointTrack
from landmark_nav.types import FloatArray, ImageArray, JointSample

_BIN_RAD = float(np.radians(1.0))
# Common directions that a comparison needs.
_LEAST_BINS = 4
# An image whose grey levels span no more shows nothing: covered, dark, or overexposed.
_FLAT_LEVELS = 2
# Energy that counts as little: what noise of two or three grey levels makes.
_NOTHING = 5e-3


@dataclass(frozen=True, eq=False)
class Look:
    """
    What an image shows, as far as its quality goes.

    `azimuth_rad` (n,) rises evenly and is relative to the pan; `energy` (2, n) is the mean squared
    gradient there, across and down, over the squared mean brightness; `flat` says that there is no
    contrast at all.
    """

    azimuth_rad: FloatArray
    energy: FloatArray
    flat: bool


def look_at(image: ImageArray, camera: CameraModel, camera_roll_rad: float = 0.0) -> Look:
    """
    Measure an image, BGR (height, width, 3) or grey (height, width), of a camera that is rolled.

    The gradient is Sobel's, as in Tenenbaum's measure of focus (Krotkov, IJCV 1, 1987).
    """
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    low, high = cv2.minMaxLoc(grey)[:2]
    slopes = [cv2.Sobel(grey, cv2.CV_32F, *axes) for axes in ((1, 0), (0, 1))]
    columns = [cv2.reduce(slope * slope, 0, cv2.REDUCE_AVG).ravel() for slope in slopes]
    brightness = cv2.reduce(grey, 0, cv2.REDUCE_AVG, dtype=cv2.CV_32F).ravel()

    pixels = np.stack([np.arange(camera.width), np.full(camera.width, camera.cy)], -1)
    # About the pan axis, however that is mounted.
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
    Gradient energy of one image over that of another in the directions that both show.

    Across or down, whichever is less: a shaken camera blurs one way only. Each is the median over
    directions, by how much there is to see there: people who pass hardly count.

    Parameters
    ----------
    turned_rad : float
        Pan of the first less that of the other.

    Returns
    -------
    float or None
        About 1 if both are equally sharp; None if they have too little in common.
    """
    at = look.azimuth_rad + turned_rad
    both = (at >= other.azimuth_rad[0]) & (at <= other.azimuth_rad[-1])
    if np.count_nonzero(both) < _LEAST_BINS:
        return None
    ratios = []
    for own, its in zip(look.energy, other.energy, strict=True):
        here, there = own[both] + _NOTHING, np.interp(at[both], other.azimuth_rad, its) + _NOTHING
        ratios.append(_weighted_median(here / there, np.sqrt(here * there)))
    return min(ratios)


def _weighted_median(values: FloatArray, weights: npt.NDArray[np.float64]) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])


FrameT = TypeVar('FrameT')

# Frames whose content is remembered.
_REMEMBERED = 5000
_NEIGHBOURS = 4
# Gradient energy, relative to that of neighbours in what both show, below which a frame counts as
# blurred: chosen by hand.
_LEAST_SHARPNESS = 0.75


@dataclass(frozen=True)
class Shot(Generic[FrameT]):
    """A frame that came; `digest` is the same for the same image, and only for that."""

    frame: FrameT
    stamp_ns: int
    digest: bytes


@dataclass(frozen=True, eq=False)
class KeptFrame(Generic[FrameT]):
    """A frame of the sweep with the angles measured at its stamp."""

    frame: FrameT
    joints: JointSample
    look: Look
    digest: bytes


class FrameLog:
    """Stamps and contents of all frames that came."""

    def __init__(self, config: CaptureConfig) -> None:
        self._config = config
        self._last_ns = -1
        # When the last one came, and how old it was.
        self._came: tuple[int, float] | None = None
        self._first: dict[bytes, tuple[int, tuple[float, float] | None]] = {}

    def untimely(self, stamp_ns: int, joints_ns: int, now_ns: int) -> str:
        """Why a stamp cannot be right; nothing if it can. `joints_ns` is the newest joint's."""
        self._came = now_ns, (joints_ns - stamp_ns) * 1e-9
        ahead_s, after_s = (stamp_ns - joints_ns) * 1e-9, (stamp_ns - self._last_ns) * 1e-9
        if ahead_s > self._config.stamp_gap_s:
            return f'badly timed: stamp {ahead_s:.3f} s ahead of joint_states'
        self._last_ns = max(stamp_ns, self._last_ns)
        if after_s < 0.0:
            return f'badly timed: stamp {-after_s:.3f} s before the last one'
        return 'duplicated: the same stamp again' if after_s == 0.0 else ''

    def why_none(self, now_ns: int) -> str:
        """Why there is no image to be taken, most likely."""
        if self._came is None:
            return 'no image came: is the camera on?'
        came_ns, age_s = self._came
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
        """Whether no other image has come before this one."""
        return next(iter(self._first)) == digest

    def remember(self, digest: bytes, stamp_ns: int, pans_rad: tuple[float, float] | None) -> None:
        """Take an image that came, with the least and greatest pan it may have had, if known."""
        self._first[digest] = (stamp_ns, pans_rad)
        if len(self._first) > _REMEMBERED:
            del self._first[next(iter(self._first))]

    def seen_elsewhere(self, digest: bytes, stamp_ns: int, track: JointTrack) -> bool:
        """Whether this very image came at another pan; remembers it."""
        pans_rad = track.around(stamp_ns)
        first_ns, first_rad = self._first.get(digest, (stamp_ns, None))
        # It may have come before the joint state of its time.
        first_rad = track.around(first_ns) or first_rad
        if first_rad is None:
            # The joint states of its time never came, or not yet.
            self.remember(digest, stamp_ns, pans_rad)
            return False
        self.remember(digest, first_ns, first_rad)
        if pans_rad is None:
            newest = track.last
            if newest is None or stamp_ns < newest.stamp_ns:
                return False
            # It came before the joint state of its time; the unit stands when that matters.
            pans_rad = newest.pan_rad, newest.pan_rad
        apart = max(pans_rad[0] - first_rad[1], first_rad[0] - pans_rad[1])
        return apart > self._config.arrival_tolerance_rad


class Album(Generic[FrameT]):
    """
    The frames kept so far, by step.

    `suspect` holds the steps whose frame is to be taken again.
    """

    def __init__(self) -> None:
        self.frames: dict[int, KeptFrame[FrameT]] = {}
        self.suspect: set[int] = set()

    def keep(self, step: int, frame: KeptFrame[FrameT]) -> bool:
        """Keep a frame; False if it was there before."""
        is_new = self.frames.get(step) is not frame
        self.frames[step] = frame
        self.suspect.discard(step)
        return is_new

    def distrust(self, digest: bytes) -> None:
        """Forget the frame with that image: nobody knows where it was taken."""
        for step in [k for k, kept in self.frames.items() if kept.digest == digest]:
            del self.frames[step]
            self.suspect.discard(step)

    def blurred(self, step: int, frame: KeptFrame[FrameT]) -> str | None:
        """Why a frame counts as blurred, or somebody passes; None if that is not known."""
        ratio = self._sharpness(step, frame)
        if ratio is None or ratio >= _LEAST_SHARPNESS:
            return None if ratio is None else ''
        return f'blurred or covered: {ratio:.2f} of the texture that its neighbours show'

    def review(self) -> list[tuple[KeptFrame[FrameT], str]]:
        """Suspect what is less sharp than its neighbours, once there are some on both sides."""
        found = []
        for step, kept in self.frames.items():
            if reason := self.blurred(step, kept):
                self.suspect.add(step)
                found.append((kept, reason))
        return found

    def _sharpness(self, step: int, frame: KeptFrame[FrameT]) -> float | None:
        """Sharpness relative to the nearest frames that show the same; None if none does."""
        pan_rad = frame.joints.pan_rad
        others = [kept for k, kept in self.frames.items() if k != step]
        turned = [(float(wrap_rad(pan_rad - kept.joints.pan_rad)), kept) for kept in others]
        turned.sort(key=lambda pair: abs(pair[0]))
        nearest = turned[:_NEIGHBOURS]
        ratios = [relative_sharpness(frame.look, kept.look, turn) for turn, kept in nearest]
        known = [ratio for ratio in ratios if ratio is not None]
        return float(np.median(known)) if known else None


def sharpest(shots: list[KeptFrame[FrameT]]) -> tuple[KeptFrame[FrameT], float]:
    """Sharpest of frames of one direction, and how much the last three differ, relative."""
    ratios = [relative_sharpness(shot.look, shots[0].look, 0.0) or 0.0 for shot in shots]
    last = ratios[-3:]
    return shots[int(np.argmax(ratios))], float(np.ptp(last) / max(np.max(last), 1e-9))


class Phase(Enum):
    """What a step waits for."""

    SETTLING = 'the pan joint to stand at the commanded angle'
    EXPOSING = 'an image'
    CONFIRMING = 'a joint sample later than the image'


@dataclass
class Step(Generic[FrameT]):
    """
    The step under way; stamps are the robot's, other times the caller's.

    `number` is None while nothing is left but to see that the joint can still move.
    """

    number: int | None
    target_rad: float
    shots: list[KeptFrame[FrameT]]
    progress_ns: int
    begin_stamp_ns: int | None
    progress_stamp_ns: int
    phase: Phase = Phase.SETTLING
    pending: Shot[FrameT] | None = None
    refusals: int = 0
    commanded_ns: int | None = None
    settled_stamp_ns: int = 0
    again_ns: int = 0
    distance_rad: float = float(np.inf)
