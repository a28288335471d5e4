"""Whether the frames of a sweep close the turn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.storage.bags.reader import Bag
from landmark_nav.types import CameraFrame, JointSample

__all__ = ['check_coverage']

_LISTED = 12


def check_coverage(
    bag: Bag,
    start_ns: int,
    frames: Sequence[CameraFrame],
    missing: Sequence[JointSample],
    *,
    cut_off: bool,
) -> bool:
    """
    Say which angles a sweep lacks.

    Parameters
    ----------
    bag : Bag
        Where it comes from; what can be lived with goes to its `warn`.
    start_ns : int
        Its start.
    frames : sequence of CameraFrame
        What there is, by time.
    missing : sequence of JointSample
        Where the trajectory says that a frame was taken, but there is none.
    cut_off : bool
        Whether the recording broke off in this sweep: then it is given up, not the whole bag.

    Returns
    -------
    bool
        Whether the sweep can be used.

    Raises
    ------
    LandmarkNavError
        Frames are missing, or there is a hole that no frame covers.

    """
    where = f'{bag.path}: the sweep of {start_ns * 1e-9:.1f} s'
    holes, at_its_ends = _holes(frames)
    if missing:
        what = f'lacks {len(missing)} frames, at pan {_angles(missing)} deg'
    else:
        what = 'has no frame ' + ' and '.join(f'from pan {a:.0f} to {b:.0f} deg' for a, b in holes)
    if (holes or missing) and cut_off:
        bag.warn(f'{where} was cut off, it {what}: left out')
        return False
    if missing or (holes and not at_its_ends):
        raise LandmarkNavError(f'{where} {what}: take it again')
    if holes:
        bag.warn(f'{where} {what}')
    return True


def _holes(frames: Sequence[CameraFrame]) -> tuple[list[tuple[float, float]], bool]:
    """
    Find gaps between neighbouring pans that are wider than the field of view, degrees.

    The second value tells whether they only lie between the last and the first frame, as in a
    sweep of a joint that cannot make a full turn.
    """
    if not frames:
        return [(-180.0, 180.0)], False
    pans = np.array([frame.pan_rad for frame in frames])
    order = np.argsort(np.mod(pans, 2.0 * np.pi))
    ahead = np.roll(order, -1)
    steps = np.mod(pans[ahead] - pans[order], 2.0 * np.pi)
    if len(frames) == 1:
        steps = np.array([2.0 * np.pi])
    wide = np.flatnonzero(steps > 2.0 * frames[0].camera.half_fov_rad)
    ends = {0, len(frames) - 1}
    at_its_ends = all({int(order[k]), int(ahead[k])} == ends for k in wide)
    return [
        (float(np.degrees(pans[order[k]])), float(np.degrees(pans[order[k]] + steps[k])))
        for k in wide
    ], at_its_ends


def _angles(missing: Sequence[JointSample]) -> str:
    degrees = [f'{np.degrees(sample.pan_rad):.0f}' for sample in missing]
    return ', '.join(degrees[:_LISTED]) + (', ...' if len(degrees) > _LISTED else '')
