"""
Check of a sweep's pan angles against its images: sign and scale of the rotation.

Neighbouring frames are shifted by the rotation of the camera. Its ratio to the change of the pan
is 1; it is -1 if the sign of the pan is reversed, 0 if another camera turns, and otherwise the
error of the focal length or of the pan. A full turn distinguishes these two, as its end shows the
same as its start.
"""

from __future__ import annotations

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import check_one_turn
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.learning.panorama.synthesis import grey_frame, sweep_cylinder
from landmark_nav.matching.strips import StripView, without_cover
from landmark_nav.types import Sweep

# Pairs of frames that are compared, and fewest that must correlate.
_PAIRS, _LEAST_PAIRS = 16, 5
# Steps of the pan that are compared: least, rad, and greatest, relative to the field of view.
_LEAST_STEP_RAD, _MOST_STEP = np.radians(0.7), 0.55
# Greatest scatter of the ratios of one sweep (median absolute deviation), and greatest error.
_MOST_SCATTER, _MOST_OFF = 0.08, 0.15
# A pan with a smaller span, rad, or fewer values, does not turn.
_LEAST_SPAN_RAD, _LEAST_PANS = np.radians(8.0), 3
# Pans that differ by less are equal, rad.
_SAME_PAN_RAD = np.radians(0.1)
PAN_REVERSED = (
    'the sign of the pan is reversed: the images turn the other way than the pan of '
    'sweep/trajectory; turn its sign in the driver, or roll pan_axis by pi in robot.yaml'
)


def check_turn(sweep: Sweep, mount: PanTiltMount) -> None:
    """
    Check that a sweep turns as its pan angles say.

    Raises `LandmarkNavError`: angles are in degrees, the pan stands still or is reversed, the
    camera sees no walls, or focal length or pan have a larger error than calibration corrects.
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
    sweep_cylinder(sweep, mount)  # refuses a camera that looks far up or down
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

    Returned are the rotation relative to that of the pan, None if too few frames overlap, and the
    change of the pan, in turns, after which the images repeat, None if they never do.
    """
    camera = sweep.frames[0].camera
    view, field_rad = StripView(camera, mount, sweep.frames[0].tilt_rad), 2.0 * camera.half_fov_rad
    strips = without_cover([view.strip(grey_frame(frame).image) for frame in sweep.frames])

    def turned(first: int, second: int) -> float:
        return view.turn(strips[first], strips[second])[0]

    pans = np.array([frame.pan_rad for frame in sweep.frames])
    steps = np.diff(pans)
    usable = np.flatnonzero(
        (np.abs(steps) > _LEAST_STEP_RAD) & (np.abs(steps) < _MOST_STEP * field_rad)
    )
    if len(usable) > _PAIRS:
        usable = usable[np.linspace(0, len(usable) - 1, _PAIRS).astype(int)]
    ratios = np.array([mount.pan_sense * turned(k, k + 1) / steps[k] for k in usable.tolist()])
    ratios = ratios[np.isfinite(ratios)]
    if len(ratios) < _LEAST_PAIRS:
        return None, None
    ratio = float(np.median(ratios))
    if float(np.median(np.abs(ratios - ratio))) > _MOST_SCATTER * max(1.0, abs(ratio)):
        return None, None
    if abs(ratio) < _MOST_OFF:
        return ratio, None
    away, found = pans - pans[0], []
    for turns in (1.0, 1.0 / abs(ratio)):
        left = np.abs(np.abs(away) - 2.0 * np.pi * turns)
        nearest = int(np.argmin(left))
        if left[nearest] < 0.5 * field_rad and np.isfinite(off := turned(0, nearest)):
            found.append(float(abs(away[nearest] - off / ratio) / (2.0 * np.pi)))
    return ratio, min(found, key=lambda turns: abs(turns - 1.0), default=None)
