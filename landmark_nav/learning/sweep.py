"""Assembly of a recorded sweep from measured angles and stamped images."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
import logging

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import check_one_turn
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.geometry.cylinder import describe_coverage
from landmark_nav.types import CameraFrame, ImageArray, JointSample, PoseEstimate, Sweep

_LOG = logging.getLogger(__name__)


def missing_frames(
    trajectory: Sequence[JointSample], stamps_ns: Collection[int]
) -> tuple[JointSample, ...]:
    """Samples of a trajectory whose stamp is not among `stamps_ns`."""
    return tuple(sample for sample in trajectory if sample.stamp_ns not in stamps_ns)


def assemble_sweep(
    trajectory: Sequence[JointSample],
    images: Mapping[int, tuple[ImageArray, CameraModel]],
    pose_map_base: PoseEstimate | None = None,
) -> Sweep:
    """
    Join angles and images by their stamps; missing frames and gaps are logged.

    Raises `LandmarkNavError`: no angles, or no images.

    `trajectory` has one sample for each kept frame. `images` are by stamp, ns, with their cameras;
    those with other stamps are ignored. `pose_map_base` is the pose of the base, if known.
    """
    if not trajectory:
        raise LandmarkNavError('the sweep has no frames: take it again')
    frames = [
        CameraFrame(sample.stamp_ns, *images[sample.stamp_ns], sample.pan_rad, sample.tilt_rad)
        for sample in sorted(trajectory, key=lambda sample: sample.stamp_ns)
        if sample.stamp_ns in images
    ]
    which = f'the sweep of {trajectory[0].stamp_ns * 1e-9:.3f} s'
    if not frames:
        raise LandmarkNavError(
            f'{which} lacks all of its {len(trajectory)} frames: is sweep/image connected, with '
            'sweep/camera_info?'
        )
    check_one_turn([frame.pan_rad for frame in frames], which)
    missing = missing_frames(trajectory, images)
    lacks = describe_coverage(
        [frame.pan_rad for frame in frames],
        frames[0].camera.half_fov_rad,
        [sample.pan_rad for sample in missing],
    )
    if lacks:
        _LOG.warning('%s is incomplete: %s', which, lacks)
    return Sweep(trajectory[0].stamp_ns, tuple(frames), pose_map_base)
