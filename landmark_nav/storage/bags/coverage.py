"""What the frames of a recorded sweep see, and whether that will do."""

from __future__ import annotations

from collections.abc import Sequence

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.coverage import describe_coverage
from landmark_nav.storage.bags.reader import Bag
from landmark_nav.types import CameraFrame, JointSample

__all__ = ['check_coverage']


def check_coverage(
    bag: Bag,
    start_ns: int,
    frames: Sequence[CameraFrame],
    missing: Sequence[JointSample],
    *,
    cut_off: bool,
) -> bool:
    """
    Say which angles a sweep lacks, through the `warn` of its bag.

    Parameters
    ----------
    bag : Bag
        Where it comes from.
    start_ns : int
        Its start.
    frames : sequence of CameraFrame
        What there is, by time.
    missing : sequence of JointSample
        Where the trajectory says that a frame was taken, but there is none.
    cut_off : bool
        Whether the recording broke off in this sweep.

    Returns
    -------
    bool
        Whether the sweep can be used; one that was cut off cannot, unless it is whole.

    Raises
    ------
    LandmarkNavError
        There is no frame at all.

    """
    where = f'{bag.path}: the sweep of {start_ns * 1e-9:.1f} s'
    pans = [frame.pan_rad for frame in frames]
    half_fov = frames[0].camera.half_fov_rad if frames else 0.0
    lacks = describe_coverage(pans, half_fov, [sample.pan_rad for sample in missing])
    if lacks and cut_off:
        bag.warn(f'{where} was cut off, {lacks}: left out')
        return False
    if not frames:
        raise LandmarkNavError(f'{where} has no frames, {lacks}: record sweep/image')
    if lacks:
        bag.warn(f'{where} is incomplete: {lacks}')
    return True
