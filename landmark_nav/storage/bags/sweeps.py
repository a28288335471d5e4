"""The sweeps in a bag: kept frames and the pan each was taken at."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from itertools import chain

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.messages import decode
from landmark_nav.storage.bags.coverage import check_coverage
from landmark_nav.storage.bags.reader import Bag, BagMessage, once
from landmark_nav.storage.bags.sieve import naming, Sieve
from landmark_nav.storage.bags.timelines import CameraInfos, JointHistory
from landmark_nav.types import CameraFrame, ImageArray, JointSample, PoseEstimate, Sweep

__all__ = ['read_sweeps']

_SAME_FRAME_NS = 5_000_000

# Without a trajectory, a pause this many times the usual one begins another sweep.
_PAUSE = 5.0


@dataclass(frozen=True)
class _Plan:
    """Where the camera looked in one sweep, frame by frame, and the stamps of those recorded."""

    samples: tuple[JointSample, ...]
    stamps: tuple[int | None, ...]

    @property
    def start_ns(self) -> int:
        return self.samples[0].stamp_ns


@dataclass(eq=False)
class _Images:
    """Decoded images of a sweep by stamp, with cameras and bit depths."""

    missing: set[int]
    views: dict[int, tuple[ImageArray, CameraModel, int]] = field(default_factory=dict)


def read_sweeps(bag: Bag, mount: PanTiltMount) -> Iterator[Sweep]:
    """
    Read the sweeps of a bag, one at a time, in the order of their start.

    The pan of a frame is the one that ``sweep/trajectory`` measured for it. That comes when a
    sweep ends: where there is none, or the bag was cut off before it, ``joint_states`` tell.

    Parameters
    ----------
    bag : Bag
        Holds ``sweep/image`` or its compressed form and ``sweep/camera_info``; may hold
        ``sweep/trajectory``, ``sweep/pose`` and ``joint_states``.
    mount : PanTiltMount
        Names of the joints.

    Yields
    ------
    Sweep
        Frames by time.

    Raises
    ------
    LandmarkNavError
        A topic is missing, a sweep has no frames at all, or a picture or angle cannot be read.
        Frames that are missing, and directions that nothing sees, go to the bag's `warn`.

    """
    topic = bag.require('sweep/image', 'sweep/image/compressed')
    cameras = CameraInfos.read(bag, 'sweep/camera_info', 'camera/camera_info')
    stamps = {decode.stamp_ns(entry.message.header) for entry in bag.messages([topic])}
    plans = _plans(bag, mount, stamps)
    poses = _poses(bag, plans)
    images = [_Images({stamp for stamp in plan.stamps if stamp is not None}) for plan in plans]
    sweep_of = {stamp: kept for kept in images for stamp in kept.missing}
    depth, sieve = decode.BitDepth(), Sieve(bag, topic, 'frames')

    def view(entry: BagMessage) -> tuple[ImageArray, CameraModel, int]:
        stamp = decode.stamp_ns(entry.message.header)
        try:
            pixels, camera = decode.camera_image(entry.message, cameras.at(stamp), depth=depth)
        except LandmarkNavError as error:
            raise LandmarkNavError(f'frame of {1e-9 * stamp:.3f} s: {error}') from error
        return pixels, camera, depth.bits

    # Sweeps follow each other: the images of one are held, unless they lie out of order.
    waiting = deque(zip(plans, images, poses, strict=True))
    for entry in chain(bag.messages([topic]), (None,)):
        stamp = decode.stamp_ns(entry.message.header) if entry else 0
        kept = sweep_of.pop(stamp, None)
        if entry and kept:
            kept.missing.remove(stamp)
            if (found := sieve.take(view, entry)) is not None:
                kept.views[stamp] = found
        while waiting and not waiting[0][1].missing:
            plan, kept, pose = waiting.popleft()
            if not kept.views:
                sieve.tell()
            frames, missing = _frames(plan, kept, depth)
            cut_off = not waiting and not bag.complete
            if check_coverage(bag, plan.start_ns, frames, missing, cut_off=cut_off):
                yield Sweep(plan.start_ns, frames, pose)
    sieve.tell()


def _frames(
    plan: _Plan, images: _Images, depth: decode.BitDepth
) -> tuple[tuple[CameraFrame, ...], list[JointSample]]:
    """Frames of a sweep by time, all at the depth of their stream, and where there are none."""
    frames, missing = [], []
    for sample, stamp in zip(plan.samples, plan.stamps, strict=True):
        if stamp not in images.views:
            missing.append(sample)
            continue
        pixels, camera, bits = images.views.pop(stamp)
        frames.append(
            CameraFrame(
                sample.stamp_ns,
                depth.lowered(pixels, bits),
                camera,
                sample.pan_rad,
                sample.tilt_rad,
            )
        )
    return tuple(frames), missing


def _plans(bag: Bag, mount: PanTiltMount, stamps: Collection[int]) -> list[_Plan]:
    """Sweeps by trajectory, then those that only the joint states give, by start."""
    left = set(stamps)
    plans = []
    if trajectory := bag.find('sweep/trajectory'):
        for entry in once(bag.messages([trajectory])):
            with naming(bag, trajectory):
                samples = decode.sweep_trajectory(entry.message, mount)
            if samples:
                ordered = tuple(sorted(samples, key=lambda sample: sample.stamp_ns))
                plans.append(_Plan(ordered, _take(ordered, left)))
    after = plans[-1].samples[-1].stamp_ns if plans else 0
    untold = sorted(stamp for stamp in left if stamp > after)
    if untold and (not plans or not bag.complete):
        bag.warn(
            f'{bag.path}: {len(untold)} frames have no sweep/trajectory: '
            'their angles are taken from joint_states'
        )
        plans.extend(_plans_by_joints(JointHistory.read(bag, mount), untold, left))
    if left:
        bag.warn(f'{bag.path}: {len(left)} frames belong to no sweep/trajectory: left out')
    if not plans:
        raise LandmarkNavError(f'{bag.path}: no frame of a sweep has a known pan')
    return sorted(plans, key=lambda plan: plan.start_ns)


def _take(samples: tuple[JointSample, ...], left: set[int]) -> tuple[int | None, ...]:
    """Stamps of the images of `samples`, taken out of `left`; None where there is none."""
    taken: list[int | None] = []
    for sample in samples:
        nearest = min(left, key=lambda stamp: (abs(stamp - sample.stamp_ns), stamp), default=None)
        if nearest is not None and abs(nearest - sample.stamp_ns) > _SAME_FRAME_NS:
            nearest = None
        taken.append(nearest)
        left.discard(nearest)
    return tuple(taken)


def _plans_by_joints(joints: JointHistory, stamps: list[int], left: set[int]) -> list[_Plan]:
    """Split `stamps` into sweeps at the pauses; angles from the joint states."""
    steps = np.diff(stamps)
    usual = np.median(steps) if len(steps) else 0.0
    pauses = np.flatnonzero(steps > _PAUSE * usual) + 1
    plans = []
    for group in np.split(np.asarray(stamps, dtype=np.int64), pauses):
        told = (joints.at(int(stamp)) for stamp in group)
        samples = tuple(sample for sample in told if isinstance(sample, JointSample))
        if samples:
            plans.append(_Plan(samples, _take(samples, left)))
    return plans


def _poses(bag: Bag, plans: list[_Plan]) -> list[PoseEstimate | None]:
    """Known pose of each sweep: the last one told before its end and after the one before."""
    found: list[PoseEstimate | None] = [None] * len(plans)
    topic = bag.find('sweep/pose')
    if topic is None:
        return found
    ends = [plan.samples[-1].stamp_ns for plan in plans]
    for entry in bag.messages([topic]):
        with naming(bag, topic):
            pose = decode.pose_estimate(entry.message)
        index = int(np.searchsorted(ends, pose.stamp_ns))
        if index < len(plans):
            found[index] = pose
        elif found[-1] is None:
            found[-1] = pose
    return found
