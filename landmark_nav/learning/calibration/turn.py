"""
Check of a sweep's pan angles against its images: sign and scale of the rotation.

Neighbouring frames are shifted by the rotation of the camera. Its ratio to the change of the pan
is 1; it is -1 if the sign of the pan is reversed, 0 if another camera turns, and otherwise the
error of the focal length or of the pan. A full turn distinguishes these two, as its end shows the
same as its start.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import check_one_turn
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.learning.panorama.projection import frame_slab, grey_frame, sweep_cylinder
from landmark_nav.types import FloatArray, Sweep

# Resolution of the comparison.
_PX_PER_RAD = 80.0
# Pairs of frames that are compared, and fewest that must correlate.
_PAIRS, _LEAST_PAIRS = 16, 5
# Steps of the pan that are compared: least, rad, and greatest, relative to the field of view.
_LEAST_STEP_RAD, _MOST_STEP = np.radians(0.7), 0.55
# Least overlap, relative to the columns, and least correlation of two frames.
_LEAST_OVERLAP, _ALIKE = 0.3, 0.5
# Greatest scatter of the ratios of one sweep (median absolute deviation), and greatest error.
_MOST_SCATTER, _MOST_OFF = 0.08, 0.15
# A pan with a smaller span, rad, or fewer values, does not turn.
_LEAST_SPAN_RAD, _LEAST_PANS = np.radians(8.0), 3
# Least mean square gradient of a strip.
_LEAST_CONTRAST = 1.0
# Pans that differ by less are equal, rad.
_SAME_PAN_RAD = np.radians(0.1)

PAN_REVERSED = (
    'the sign of the pan is reversed: the images turn the other way than the pan of '
    'sweep/trajectory; turn its sign in the driver, or roll pan_axis by pi in robot.yaml'
)


def check_turn(sweep: Sweep, mount: PanTiltMount) -> None:
    """
    Check that a sweep turns as its pan angles say.

    Raises `LandmarkNavError`: angles are in degrees, the pan stands still or is reversed, or focal
    length or pan have a larger error than calibration corrects.
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
    ratio, full_turn = measure_turn(sweep, mount)
    if ratio is None or abs(ratio - 1.0) < _MOST_OFF:
        return
    if abs(ratio + 1.0) < _MOST_OFF:
        raise LandmarkNavError(PAN_REVERSED)
    if abs(ratio) < _MOST_OFF:
        raise LandmarkNavError(
            'the images do not turn while the pan does: check that joint_states and images are '
            'of the same camera'
        )
    camera = sweep.frames[0].camera
    focal = (
        f'camera_info gives a focal length of {camera.fx:.0f} px, the images turn as with about '
        f'{camera.fx * abs(ratio):.0f} px'
    )
    scale = f'the camera turns by {ratio:.2f} times the pan that is reported'
    if full_turn is None:
        raise LandmarkNavError(f'{focal}, or else {scale}: check image size, ROI, binning, joint')
    if abs(full_turn - 1.0) < _MOST_OFF:
        raise LandmarkNavError(f'{focal}: check its size, ROI and binning')
    raise LandmarkNavError(f'{scale}: fix the scale of the joint')


def measure_turn(sweep: Sweep, mount: PanTiltMount) -> tuple[float | None, float | None]:
    """
    Measure the rotation of the images of a sweep; its frames are in the order of time.

    Returns
    -------
    ratio : float or None
        Rotation relative to that of the pan; None if too few frames overlap.
    full_turn : float or None
        Change of the pan, in turns, after which the images repeat; None if they never do.
    """
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
        return None, None
    ratio = float(np.median(ratios))
    if float(np.median(np.abs(np.array(ratios) - ratio))) > _MOST_SCATTER * max(1.0, abs(ratio)):
        return None, None
    return ratio, _full_turn(looks, pans, ratio)


def _full_turn(looks: _Looks, pans: FloatArray, ratio: float) -> float | None:
    """Change of the pan, in turns, after which the images repeat."""
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
        """Rotation of the camera to the left between two frames; None if they do not match."""
        (one, start), (other, begin) = self._strip(first), self._strip(second)
        most = int((1.0 - _LEAST_OVERLAP) * min(one.shape[1], other.shape[1]))
        shifts = np.arange(-most, most + 1)
        scores = np.array([_correlation(one, other, int(shift)) for shift in shifts])
        best = int(np.argmax(scores))
        if scores[best] < _ALIKE or best in (0, len(shifts) - 1):
            return None
        before, here, after = scores[best - 1 : best + 2]
        peak = 0.5 * (before - after) / min(before - 2.0 * here + after, -1e-9)
        # Columns increase clockwise; both strips are relative to their optical axes.
        return float((start - begin - shifts[best] - peak) / self._cylinder.fx)

    def _strip(self, k: int) -> tuple[Float32Array, float]:
        """Horizontal gradients of a frame at pan 0, and the column of its optical axis."""
        if k not in self._strips:
            frame = replace(grey_frame(self._sweep.frames[k]), pan_rad=0.0)
            slab = frame_slab(frame, self._mount, self._cylinder)
            covered = slab.inside.all(axis=0)
            rows = slab.inside[:, covered].all(axis=1) if covered.any() else slab.inside.any(1)
            # Ceiling and floor look alike in all directions: horizontal gradients show the turn.
            across = cv2.Sobel(cv2.blur(slab.image, (3, 3)), cv2.CV_32F, 1, 0)
            slopes = np.where(slab.inside > 0, across, np.float32(0.0))[rows]
            self._strips[k] = slopes.astype(np.float32), slab.middle - slab.start
        return self._strips[k]


def _correlation(one: Float32Array, other: Float32Array, shift: int) -> float:
    """Correlation of two strips, the other one shifted by some columns to the right."""
    rows = min(len(one), len(other))
    low, high = max(0, shift), min(one.shape[1], other.shape[1] + shift)
    a, b = one[:rows, low:high], other[:rows, low - shift : high - shift]
    size = float(np.sqrt(np.sum(a * a) * np.sum(b * b)))
    return float(np.sum(a * b)) / size if size > _LEAST_CONTRAST * a.size else 0.0
