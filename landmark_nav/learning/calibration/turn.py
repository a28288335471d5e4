"""
Whether a sweep turns as its pan angles say: sign and size of the turn, seen in its own images.

Neighbouring frames show the same things, shifted by what the camera turned. That over the change
of the pan is 1; it is -1 where the sign of the pan is reversed, 0 where something else than this
camera turns, and where it is another number the focal length is off by that, or the pan is. A full
turn distinguishes these two: its end shows what its start shows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import check_one_turn
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.learning.panorama.projection import frame_slab, sweep_cylinder
from landmark_nav.types import FloatArray, Sweep

# Columns per radian that are enough.
_PX_PER_RAD = 80.0
# Pairs of frames that are compared, and the least that must be alike.
_PAIRS, _LEAST_PAIRS = 16, 5
# Steps of the pan that are compared, radians, and as a share of the field of view.
_LEAST_STEP_RAD, _MOST_STEP = np.radians(0.7), 0.55
# Least overlap, as a share of the columns, and least correlation of frames that are alike.
_LEAST_OVERLAP, _ALIKE = 0.3, 0.5
# How much ratios of one sweep may scatter (median absolute deviation), and be off.
_MOST_SCATTER, _MOST_OFF = 0.08, 0.15
# A pan within that, radians, or that takes fewer values, does not turn.
_LEAST_SPAN_RAD, _LEAST_PANS = np.radians(8.0), 3
# Slope, squared, that a strip has at least.
_LEAST_CONTRAST = 1.0
# Pans that differ by less are one, radians.
_SAME_PAN_RAD = np.radians(0.1)

PAN_REVERSED = (
    'the sign of the pan is reversed: the images turn the other way than the pan of '
    'sweep/trajectory; turn its sign in the driver, or roll pan_axis by pi in robot.yaml'
)


@dataclass(frozen=True)
class SweepTurn:
    """
    How far the images of a sweep turn when the pan turns by 1.

    `ratio` is None where too few frames overlap to say; `full_turn` is by how many turns the pan
    changes until the images show again what they did first, None where they never do.
    """

    ratio: float | None
    full_turn: float | None


def check_turn(sweep: Sweep, mount: PanTiltMount) -> None:
    """
    Check that a sweep turns, and as its pan angles say.

    Raises `LandmarkNavError`: angles in degrees, a pan that stands still or is reversed, a focal
    length or pan that is off by more than calibration mends.
    """
    pans = np.array([frame.pan_rad for frame in sweep.frames])
    if len(pans) < _LEAST_PANS:
        return
    check_one_turn(pans, 'the sweep')
    values = 1 + int(np.sum(np.diff(np.sort(pans)) > _SAME_PAN_RAD))
    span = float(np.ptp(pans))
    if values < _LEAST_PANS or span < _LEAST_SPAN_RAD:
        raise LandmarkNavError(
            f'the pan does not turn: {len(pans)} frames have {values} pan angles within '
            f'{np.degrees(span):.1f} deg; check that joint_states reports the pan of this camera'
        )
    turn = measure_turn(sweep, mount)
    if turn.ratio is None or abs(turn.ratio - 1.0) < _MOST_OFF:
        return
    if abs(turn.ratio + 1.0) < _MOST_OFF:
        raise LandmarkNavError(PAN_REVERSED)
    if abs(turn.ratio) < _MOST_OFF:
        raise LandmarkNavError(
            'the images do not turn while the pan does: check that joint_states and images are '
            'of the same camera'
        )
    camera = sweep.frames[0].camera
    focal = (
        f'camera_info gives a focal length of {camera.fx:.0f} px, the images turn as with about '
        f'{camera.fx * abs(turn.ratio):.0f} px'
    )
    scale = f'the camera turns by {turn.ratio:.2f} times the pan that is reported'
    if turn.full_turn is None:
        raise LandmarkNavError(f'{focal}, or else {scale}: check image size, ROI, binning, joint')
    if abs(turn.full_turn - 1.0) < _MOST_OFF:
        raise LandmarkNavError(f'{focal}: check its image size, ROI and binning, or calibrate')
    raise LandmarkNavError(f'{scale}: mend the scale of the joint')


def measure_turn(sweep: Sweep, mount: PanTiltMount) -> SweepTurn:
    """Measure how far the images of a sweep turn, frames in the order of time."""
    looks = _Looks(sweep, mount)
    pans = np.array([frame.pan_rad for frame in sweep.frames])
    steps = np.diff(pans)
    usable = np.flatnonzero(
        (np.abs(steps) > _LEAST_STEP_RAD) & (np.abs(steps) < _MOST_STEP * looks.field_rad)
    )
    if len(usable) > _PAIRS:
        usable = usable[np.linspace(0, len(usable) - 1, _PAIRS).astype(int)]
    ratios = []
    for k in usable:
        turned = looks.turned_rad(int(k), int(k) + 1)
        if turned is not None:
            ratios.append(mount.pan_sense * turned / steps[k])
    if len(ratios) < _LEAST_PAIRS:
        return SweepTurn(None, None)
    ratio = float(np.median(ratios))
    if float(np.median(np.abs(np.array(ratios) - ratio))) > _MOST_SCATTER * max(1.0, abs(ratio)):
        return SweepTurn(None, None)
    return SweepTurn(ratio, _full_turn(looks, pans, ratio))


def _full_turn(looks: _Looks, pans: FloatArray, ratio: float) -> float | None:
    """By how many turns the pan changes until the images show again what they did first."""
    if abs(ratio) < _MOST_OFF:
        return None
    away = pans - pans[0]
    found = []
    for turns in (1.0, 1.0 / abs(ratio)):
        left = np.abs(np.abs(away) - 2.0 * np.pi * turns)
        nearest = int(np.argmin(left))
        turned = looks.turned_rad(0, nearest) if left[nearest] < 0.5 * looks.field_rad else None
        if turned is not None:
            found.append(float(abs(away[nearest] - turned / ratio) / (2.0 * np.pi)))
    return min(found, key=lambda turns: abs(turns - 1.0), default=None)


class _Looks:
    """Frames of a sweep as strips of a small cylinder, compared on demand."""

    def __init__(self, sweep: Sweep, mount: PanTiltMount) -> None:
        self._sweep, self._mount = sweep, mount
        self._cylinder = sweep_cylinder(sweep, mount, px_per_rad=_PX_PER_RAD)
        self._strips: dict[int, tuple[Float32Array, float]] = {}
        self.field_rad = 2.0 * sweep.frames[0].camera.half_fov_rad

    def turned_rad(self, first: int, second: int) -> float | None:
        """By how much the camera turned to the left between two frames; None if they differ."""
        (one, start), (other, begin) = self._strip(first), self._strip(second)
        most = int((1.0 - _LEAST_OVERLAP) * min(one.shape[1], other.shape[1]))
        shifts = np.arange(-most, most + 1)
        scores = np.array([_correlation(one, other, int(shift)) for shift in shifts])
        best = int(np.argmax(scores))
        if scores[best] < _ALIKE or best in (0, len(shifts) - 1):
            return None
        before, here, after = scores[best - 1 : best + 2]
        peak = 0.5 * (before - after) / min(before - 2.0 * here + after, -1e-9)
        # Columns grow clockwise; both strips are counted from their optical axes.
        return float((start - begin - shifts[best] - peak) / self._cylinder.fx)

    def _strip(self, k: int) -> tuple[Float32Array, float]:
        """Slopes across a frame as if it looked along pan 0, and its optical axis' column."""
        if k not in self._strips:
            frame = self._sweep.frames[k]
            if frame.image.ndim == 3:
                grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
                frame = replace(frame, image=np.asarray(grey, dtype=np.uint8))
            slab = frame_slab(replace(frame, pan_rad=0.0), self._mount, self._cylinder)
            covered = slab.inside.all(axis=0)
            rows = slab.inside[:, covered].all(axis=1) if covered.any() else slab.inside.any(1)
            # Ceiling and floor look alike in all directions: what changes across shows the turn.
            across = cv2.Sobel(cv2.blur(slab.image, (3, 3)), cv2.CV_32F, 1, 0)
            slopes = np.where(slab.inside > 0, across, np.float32(0.0))[rows]
            self._strips[k] = slopes.astype(np.float32), slab.middle - slab.start
        return self._strips[k]


def _correlation(one: Float32Array, other: Float32Array, shift: int) -> float:
    """Correlation of what two strips show, the other one by so many columns to the right."""
    rows = min(len(one), len(other))
    low, high = max(0, shift), min(one.shape[1], other.shape[1] + shift)
    a, b = one[:rows, low:high], other[:rows, low - shift : high - shift]
    size = float(np.sqrt(np.sum(a * a) * np.sum(b * b)))
    return float(np.sum(a * b)) / size if size > _LEAST_CONTRAST * a.size else 0.0
