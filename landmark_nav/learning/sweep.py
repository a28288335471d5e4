"""A sweep out of what was recorded: measured angles on one hand, stamped pictures on the other."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.types import CameraFrame, ImageArray, JointSample, PoseEstimate, Sweep

__all__ = ['assemble_sweep', 'missing_frames']

# Angles that a message names at most.
_LISTED = 12


def missing_frames(
    trajectory: Sequence[JointSample], stamps_ns: Collection[int]
) -> tuple[JointSample, ...]:
    """Samples of a trajectory whose stamp is not among `stamps_ns`."""
    return tuple(sample for sample in trajectory if sample.stamp_ns not in stamps_ns)


def assemble_sweep(
    trajectory: Sequence[JointSample],
    pictures: Mapping[int, tuple[ImageArray, CameraModel]],
    pose_map_base: PoseEstimate | None = None,
) -> Sweep:
    """
    Join angles and pictures by their stamps.

    Parameters
    ----------
    trajectory : sequence of JointSample
        One for each frame that was kept.
    pictures : mapping
        Stamp in nanoseconds -> picture and camera; others than those of the trajectory are left
        aside.
    pose_map_base : PoseEstimate, optional
        Where it was taken, if that is known.

    Raises
    ------
    LandmarkNavError
        No angles at all, or a frame is missing; the message names its angle.

    """
    if not trajectory:
        raise LandmarkNavError('the sweep has no frames: take it again')
    missing = missing_frames(trajectory, pictures)
    if missing:
        angles = ', '.join(f'{np.degrees(s.pan_rad):.1f}' for s in missing[:_LISTED])
        angles += ', ...' if len(missing) > _LISTED else ''
        raise LandmarkNavError(
            f'the sweep of {trajectory[0].stamp_ns * 1e-9:.3f} s lacks {len(missing)} of its '
            f'{len(trajectory)} frames, at pan {angles} deg: take it again'
        )
    frames = [
        CameraFrame(sample.stamp_ns, *pictures[sample.stamp_ns], sample.pan_rad, sample.tilt_rad)
        for sample in sorted(trajectory, key=lambda sample: sample.stamp_ns)
    ]
    return Sweep(trajectory[0].stamp_ns, tuple(frames), pose_map_base)
