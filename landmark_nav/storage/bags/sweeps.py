"""Reader of the sweeps of a bag, or of a folder of images: frames with their pans."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import csv
from dataclasses import dataclass, field, replace
from io import StringIO
from pathlib import Path

import numpy as np

from landmark_nav.errors import inside, LandmarkNavError, shown
from landmark_nav.geometry.angles import check_one_turn
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.cylinder import describe_coverage, unseen_arcs
from landmark_nav.messages import decode
from landmark_nav.storage.bags.definitions import SWEEP_IMAGES
from landmark_nav.storage.bags.reader import Bag, BagMessage, decoded, MessageFilter, naming, once
from landmark_nav.storage.bags.timelines import CameraInfos, JointHistory
from landmark_nav.storage.reading import read_image, read_text
from landmark_nav.types import CameraFrame, JointSample, PoseEstimate, Sweep

# Greatest difference of the stamps of a frame and of its sample in the trajectory.
_SAME_FRAME_NS = 5_000_000

# Greatest rounding error of a sum of unseen arcs.
_SAME_ARC_RAD = 1e-6

# Least pause between sweeps without a trajectory, relative to the median interval of frames.
_PAUSE = 5.0


@dataclass
class _Plan:
    """Angles of the camera for each frame of one sweep, and the recorded images."""

    samples: tuple[JointSample, ...]
    # Stamp of the image of each sample; None if it is missing.
    stamps_ns: tuple[int | None, ...]
    # Decoded frames, and the bit depth at which each was decoded, by the stamp of the image.
    frames: dict[int, tuple[CameraFrame, int]] = field(default_factory=dict)
    # Errors of images that cannot be used, by stamp.
    unusable: dict[int, str] = field(default_factory=dict)

    @property
    def start_ns(self) -> int:
        return self.samples[0].stamp_ns

    @property
    def is_complete(self) -> bool:
        known = {*self.frames, *self.unusable}
        return all(stamp is None or stamp in known for stamp in self.stamps_ns)


def read_sweeps(bag: Bag, mount: PanTiltMount) -> Iterator[Sweep]:
    """
    Read the sweeps of a bag, one at a time, in the order of their start.

    The bag holds ``sweep/image`` or its compressed form, and ``sweep/camera_info``. The pan of a
    frame is measured in ``sweep/trajectory``, which is published at the end of a sweep. If there
    is none, if it cannot be used, or if the bag ends before it, ``joint_states`` give the pan.
    Images that cannot be decoded are left out if other frames cover their arcs.

    Raises `LandmarkNavError`: a topic is missing, a sweep has no frames, the loss of a damaged
    frame leaves a gap, or an angle cannot be read. Missing frames and unseen directions are
    reported by the `warn` of the bag.
    """
    topic = bag.require(*SWEEP_IMAGES)
    cameras = CameraInfos.read(bag, 'sweep/camera_info', 'camera/camera_info')
    message_filter = MessageFilter(bag, topic, 'images')
    stamps = [
        message_filter.take(lambda entry: decode.stamp_ns(entry.message.header), entry)
        for entry in bag.messages([topic])
    ]
    message_filter.report()
    # Images are counted from 1.
    numbers = {stamp: number for number, stamp in enumerate(stamps, 1) if stamp is not None}
    plans = _plans(bag, mount, set(numbers))
    poses = _poses(bag, plans)
    at = {stamp: (plan, k) for plan in plans for k, stamp in enumerate(plan.stamps_ns)}
    entries = bag.messages([topic])
    depth = decode.BitDepth()
    for plan, pose in zip(plans, poses, strict=True):
        # Only the images of one sweep are held in memory.
        while not plan.is_complete and (entry := next(entries, None)) is not None:
            _add(bag, entry, cameras, depth, at)
        last = plan is plans[-1]
        frames = [
            replace(one, image=depth.lowered(one.image, bits))
            for _, (one, bits) in sorted(plan.frames.items())
        ]
        if plan.unusable:
            _check_unusable(bag, topic, plan, numbers, frames)
        if _covers(bag, plan, frames, cut_off=last and not bag.complete):
            yield Sweep(plan.start_ns, tuple(frames), pose)
        plan.frames.clear()
        frames.clear()


def _add(
    bag: Bag,
    entry: BagMessage,
    cameras: CameraInfos,
    depth: decode.BitDepth,
    at: Mapping[int | None, tuple[_Plan, int]],
) -> None:
    """Decode an image for its sweep; damaged messages were reported before."""
    try:
        with naming(bag, entry.topic):
            stamp = decode.stamp_ns(entry.message.header)
    except LandmarkNavError:
        return
    if stamp not in at or stamp in at[stamp][0].frames:
        return
    plan, k = at[stamp]
    try:
        image, camera = decode.camera_image(entry.message, cameras.at(stamp), depth=depth)
    except LandmarkNavError as error:
        plan.unusable[stamp] = str(error)
        return
    sample = plan.samples[k]
    plan.unusable.pop(stamp, None)
    frame = CameraFrame(sample.stamp_ns, image, camera, sample.pan_rad, sample.tilt_rad)
    plan.frames[stamp] = frame, depth.bits


def _check_unusable(
    bag: Bag, topic: str, plan: _Plan, numbers: Mapping[int, int], frames: Sequence[CameraFrame]
) -> None:
    """Report the images of a sweep that are left out; refuse the sweep if they leave a gap."""
    first = min(plan.unusable)
    if not frames:
        raise LandmarkNavError(
            f'{bag.path}: {topic}: no usable image: image {numbers[first]}, at '
            f'{1e-9 * first:.3f} s: {plan.unusable[first]}'
        )
    count = len(plan.unusable)
    which = (
        f'{topic}: {count} of {len(plan.samples)} frames of the sweep of '
        f'{1e-9 * plan.start_ns:.1f} s left out: image {numbers[first]}, at {1e-9 * first:.3f} s'
    )
    reason = plan.unusable[first]
    pans = [frame.pan_rad for frame in frames]
    recorded = zip(plan.samples, plan.stamps_ns, strict=True)
    whole = [sample.pan_rad for sample, stamp in recorded if stamp is not None]
    half_fov = frames[0].camera.half_fov_rad
    unseen, unseen_anyway = (
        sum(end - begin for begin, end in unseen_arcs(angles, half_fov))
        for angles in (pans, whole)
    )
    if unseen > unseen_anyway + _SAME_ARC_RAD:
        gap = describe_coverage(pans, half_fov)
        raise LandmarkNavError(f'{bag.path}: {which}, and then {gap}: record it again')
    bag.warn(f'{bag.path}: {which}: {reason}')


def _covers(bag: Bag, plan: _Plan, frames: Sequence[CameraFrame], *, cut_off: bool) -> bool:
    """Report the angles that a sweep lacks; is it usable? One that is `cut_off` must be whole."""
    where = f'{bag.path}: the sweep of {plan.start_ns * 1e-9:.1f} s'
    pans = [frame.pan_rad for frame in frames]
    half_fov = frames[0].camera.half_fov_rad if frames else 0.0
    samples = zip(plan.samples, plan.stamps_ns, strict=True)
    missing = [sample.pan_rad for sample, stamp in samples if stamp is None]
    lacks = describe_coverage(pans, half_fov, missing)
    if lacks and cut_off:
        bag.warn(f'{where} was cut off, {lacks}: left out')
        return False
    if not frames:
        raise LandmarkNavError(f'{where} has no frames, {lacks}: record sweep/image')
    if lacks:
        bag.warn(f'{where} is incomplete: {lacks}')
    return True


def _plans(bag: Bag, mount: PanTiltMount, left: set[int]) -> list[_Plan]:
    """Sweeps by their trajectories, and the others by joint states, in order of their start."""
    measured = [*measured_pans(bag, mount)]
    plans = [_Plan(samples, _take(samples, left)) for samples in measured if samples]
    lost = bag.damaged or not all(measured)
    after = plans[-1].samples[-1].stamp_ns if plans and not lost else 0
    alone = sorted(stamp for stamp in left if stamp > after)
    if alone and (lost or not plans or not bag.complete):
        bag.warn(
            f'{bag.path}: {len(alone)} frames have no sweep/trajectory: '
            'their angles are taken from joint_states'
        )
        plans.extend(_plans_by_joints(JointHistory.read(bag, mount), alone, left))
    if left:
        bag.warn(f'{bag.path}: {len(left)} frames belong to no sweep/trajectory: left out')
    if not plans:
        raise LandmarkNavError(f'{bag.path}: no frame of a sweep has a known pan')
    return sorted(plans, key=lambda plan: plan.start_ns)


def measured_pans(bag: Bag, mount: PanTiltMount) -> Iterator[tuple[JointSample, ...]]:
    """Yield the samples of each trajectory by time; none, and a report, if it cannot be used."""
    topic = bag.find('sweep/trajectory')
    logged = bag.stamps_ns.get(bag.require(*SWEEP_IMAGES), np.empty((0, 2), np.int64))
    images_ns = np.sort(logged[:, 1])
    for entry in once(bag.messages([topic])) if topic else ():
        dropped: list[LandmarkNavError] = []
        try:
            if not entry.header_ns:
                raise LandmarkNavError('a trajectory has no stamp, that of its first frame')
            samples = decode.sweep_trajectory(entry.message, mount, dropped.append)
            sampled_ns = np.array([sample.stamp_ns for sample in samples], dtype=np.int64)
            first = np.searchsorted(images_ns, sampled_ns - _SAME_FRAME_NS)
            after = np.searchsorted(images_ns, sampled_ns + _SAME_FRAME_NS, 'right')
            if not (first < after).any():
                raise LandmarkNavError(
                    f'that of {1e-9 * entry.header_ns:.1f} s has no image at its times: stamp '
                    'both by one clock'
                )
        except LandmarkNavError as error:
            bag.inform(f'{topic}: left out: {error}')
            samples = ()
        if dropped:
            count = f'{len(dropped)} of {len(dropped) + len(samples)} points'
            bag.inform(f'{topic}: {count} left out: {dropped[0]}')
        yield tuple(sorted(samples, key=lambda sample: sample.stamp_ns))


def _take(samples: tuple[JointSample, ...], left: set[int]) -> tuple[int | None, ...]:
    """Stamps of the images of `samples`, which are removed from `left`; None for missing ones."""
    taken = []
    for sample in samples:
        nearest = min(left, key=lambda stamp: abs(stamp - sample.stamp_ns), default=None)
        if nearest is not None and abs(nearest - sample.stamp_ns) > _SAME_FRAME_NS:
            nearest = None
        left.discard(nearest if nearest is not None else -1)
        taken.append(nearest)
    return tuple(taken)


def _plans_by_joints(joints: JointHistory, stamps: list[int], left: set[int]) -> list[_Plan]:
    """Split `stamps` into sweeps at pauses, with angles by the joint states."""
    steps = np.diff(stamps)
    usual = np.median(steps) if len(steps) else 0.0
    pauses = np.flatnonzero(steps > _PAUSE * usual) + 1
    plans = []
    for group in np.split(np.asarray(stamps, dtype=np.int64), pauses):
        known = (joints.at(int(stamp)) for stamp in group)
        samples = tuple(sample for sample in known if isinstance(sample, JointSample))
        if samples:
            plans.append(_Plan(samples, _take(samples, left)))
    return plans


def _poses(bag: Bag, plans: list[_Plan]) -> list[PoseEstimate | None]:
    """Given pose of each sweep: the last one between the end of the previous sweep and its own."""
    found: list[PoseEstimate | None] = [None] * len(plans)
    topic = bag.find('sweep/pose')
    if topic is None:
        return found
    ends = [plan.samples[-1].stamp_ns for plan in plans]
    poses = decoded(bag, topic, lambda entry: decode.pose_estimate(entry.message), needed=False)
    for pose in poses:
        index = int(np.searchsorted(ends, pose.stamp_ns))
        if index < len(plans):
            found[index] = pose
        elif found[-1] is None:
            found[-1] = pose
    return found


_COLUMNS = ('file', 'pan_rad', 'focal_px', 'width', 'height')
# Greatest size of a list, and greatest number of pixels of all its images (36 of 8 million).
_MAX_LIST_BYTES, _MAX_SWEEP_PIXELS = 1_000_000, 300_000_000


def read_sweep_folder(folder: Path | str) -> Sweep:
    """
    Read the images listed in ``frames.csv`` (`file,pan_rad,focal_px,width,height`).

    The principal point is the centre of the image. Stamps are the numbers of the rows.

    Raises `LandmarkNavError`: the list or an image is missing, or a value is invalid.
    """
    folder = Path(folder)
    path = folder / 'frames.csv'
    try:
        lines = StringIO(read_text(path, _MAX_LIST_BYTES), newline='')
        rows = list(csv.DictReader(lines, skipinitialspace=True))
    except csv.Error as error:
        raise LandmarkNavError(f'{path}: cannot be read: {error}') from error
    missing = [name for name in _COLUMNS if not rows or rows[0].get(name) is None]
    if missing:
        raise LandmarkNavError(
            f'{path}: {"lists no image" if not rows else "lacks " + ", ".join(missing)}: '
            f'it needs the columns {",".join(_COLUMNS)}'
        )
    frames: list[CameraFrame] = []
    pixels = 0
    for k, row in enumerate(rows):
        where = f'{path}: line {k + 2}'
        frames.append(_frame(folder, row, k, where))
        pixels += frames[-1].camera.width * frames[-1].camera.height
        if pixels > _MAX_SWEEP_PIXELS:
            raise LandmarkNavError(
                f'{where}: the images up to here have over {_MAX_SWEEP_PIXELS / 1e6:.0f} million '
                'pixels: reduce them'
            )
    check_one_turn([frame.pan_rad for frame in frames], f'{path}: pan_rad')
    return Sweep(frames[0].stamp_ns, tuple(frames))


def _frame(folder: Path, row: dict[str, str], number: int, where: str) -> CameraFrame:
    pan, focal = (_number(row, name, where) for name in ('pan_rad', 'focal_px'))
    width, height = (int(_number(row, name, where)) for name in ('width', 'height'))
    file = row['file'] or ''
    with inside(where):
        image = read_image(folder / file)
    # For a camera in portrait orientation the list often has the size of the sensor; that of the
    # image is used.
    if sorted(image.shape[:2]) != sorted((height, width)):
        raise LandmarkNavError(
            f'{where}: {shown(file)} is {image.shape[1]} x {image.shape[0]}, '
            f'not {width} x {height}'
        )
    height, width = image.shape[:2]
    with inside(where):
        camera = CameraModel(width, height, focal, focal, (width - 1) / 2.0, (height - 1) / 2.0)
    return CameraFrame(number, image, camera, pan)


def _number(row: dict[str, str], name: str, where: str) -> float:
    try:
        value = float(row[name])
    except (TypeError, ValueError):
        value = np.nan
    if not np.isfinite(value):
        raise LandmarkNavError(f'{where}: {name} is {shown(row[name])}, not a number')
    return value
