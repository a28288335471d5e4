"""Reader of the sensor data of a drive from a bag."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from math import inf

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages import decode
from landmark_nav.storage.bags.definitions import DRIVE_IMAGES, SWEEP_IMAGES
from landmark_nav.storage.bags.reader import Bag, BagMessage, MessageFilter, once
from landmark_nav.storage.bags.timelines import CameraInfos, JointLog
from landmark_nav.types import CameraFrame, Detections, OdometrySample, PoseEstimate, Refusal

# Topics whose clock is compared with that of the ground truth; the first available one is used.
_BESIDE = ('odom', 'joint_states', *DRIVE_IMAGES, *SWEEP_IMAGES)
# Least offset of another clock, which exceeds delays of transport, and greatest median deviation
# from it.
_OTHER_CLOCK_NS, _STEADY_NS = 500_000_000, 50_000_000


def truth_decoder(bag: Bag, topic: str) -> Callable[[BagMessage], PoseEstimate]:
    """
    Return a decoder of the messages of a topic with the ground truth.

    If its stamps are of another clock than those of the sensors, by comparison with log times,
    they are corrected to the clock of the sensors, and the bag reports it.
    """
    shift_ns = _shift_ns(bag, topic)

    def pose(entry: BagMessage) -> PoseEstimate:
        truth = decode.pose_estimate(entry.message)
        return PoseEstimate(truth.stamp_ns + shift_ns, truth.pose, truth.covariance)

    return pose


def _shift_ns(bag: Bag, topic: str) -> int:
    names = (topic for name in _BESIDE for topic in bag.candidates(name)[:1])
    beside = next((name for name in names if name in bag.stamps_ns), None)
    if beside is None or topic not in bag.stamps_ns:
        return 0
    (log_ns, stamp_ns), (logged_ns, stamped_ns) = bag.stamps_ns[topic].T, bag.stamps_ns[beside].T
    near = np.clip(np.searchsorted(logged_ns, log_ns), 0, len(logged_ns) - 1)
    behind = (stamped_ns - logged_ns)[near] - (stamp_ns - log_ns)
    shift_ns = int(np.median(behind))
    spread_ns = float(np.median(np.abs(behind - shift_ns)))
    if abs(shift_ns) < _OTHER_CLOCK_NS or spread_ns > _STEADY_NS:
        return 0
    bag.inform(
        f'{topic} is on another clock, {-1e-9 * shift_ns:+.3f} s off that of {beside}: its errors '
        'are taken with that put right'
    )
    return shift_ns


SensorEvent = CameraFrame | Detections | OdometrySample | PoseEstimate


def sensor_events(
    bag: Bag,
    mount: PanTiltMount,
    joint_delay_s: float = 0.0,
    image_delay_s: float = 0.0,
    odometry_delay_s: float = 0.0,
) -> Iterator[SensorEvent]:
    """
    Yield the sensor data of a drive, by log time.

    Images follow other data of the same log time, but newer odometry, as nodes wait for the data
    that belong to an image. Images are grey, with pan and tilt interpolated at their stamps.
    Stamps of joint states, images and odometry are corrected by their known delays. The ground
    truth, if there is one, is yielded as `PoseEstimate`. Messages that cannot be used, such as
    those with a value that is not a number, are left out and reported by ``bag.warn``. A bag
    without images may hold ``detections`` instead, of this package or another sensor.

    Raises `LandmarkNavError`: a topic is missing, or none of its messages can be used.
    """
    has_images = bool(bag.find(*DRIVE_IMAGES)) or not bag.find('detections')
    seen = bag.require(*DRIVE_IMAGES) if has_images else bag.require('detections')
    odometry, truth = bag.require('odom'), bag.find('ground_truth/odom')
    late_odometry = round(1e9 * odometry_delay_s)

    def moved(entry: BagMessage) -> OdometrySample:
        sample = decode.odometry(entry.message)
        return replace(sample, stamp_ns=sample.stamp_ns - late_odometry)

    decoders: dict[str, Callable[[BagMessage], SensorEvent]] = {
        seen: _frame_decoder(bag, mount, joint_delay_s, image_delay_s)
        if has_images
        else lambda entry: decode.detections(entry.message),
        odometry: moved,
    }
    if truth is not None:
        decoders[truth] = truth_decoder(bag, truth)
    kinds = dict.fromkeys(decoders, 'messages') | ({seen: 'images'} if has_images else {})
    filters = {
        topic: MessageFilter(bag, topic, kind, needed=topic != truth)
        for topic, kind in kinds.items()
    }
    messages = once(bag.messages(decoders))
    for entry in _images_last(messages, seen, odometry) if has_images else messages:
        event = filters[entry.topic].take(decoders[entry.topic], entry)
        if event is not None:
            yield event
    for message_filter in filters.values():
        message_filter.report()


def _frame_decoder(
    bag: Bag, mount: PanTiltMount, joint_delay_s: float, image_delay_s: float
) -> Callable[[BagMessage], CameraFrame]:
    """Return a decoder of images, with pan and tilt at their corrected stamps."""
    cameras = CameraInfos.read(bag, 'camera/camera_info')
    joints = JointLog.read(bag, mount)
    late_joints, late_image = (round(1e9 * delay_s) for delay_s in (joint_delay_s, image_delay_s))
    depth = decode.BitDepth()

    def frame(entry: BagMessage) -> CameraFrame:
        stamped = decode.stamp_ns(entry.message.header)
        stamp = stamped - late_image
        pixels, camera = decode.camera_image(entry.message, cameras.at(stamped), True, depth)
        sample = joints.at(stamp + late_joints, entry.stamp_ns)
        if isinstance(sample, Refusal):
            raise LandmarkNavError(
                f'{bag.path}: {entry.topic} at {stamp * 1e-9:.3f} s has no joint state near it '
                f'({sample}): record joint_states at 10 Hz at least, on the same clock'
            )
        return CameraFrame(image=pixels, camera=camera, **(vars(sample) | {'stamp_ns': stamp}))

    return frame


def _images_last(
    messages: Iterable[BagMessage], images: str, odometry: str
) -> Iterator[BagMessage]:
    """Yield messages by log time; an image follows others of its log time, but newer odometry."""
    held: deque[BagMessage] = deque()
    for entry in messages:
        while held and (
            entry.stamp_ns > held[0].stamp_ns
            # The truth may have another clock.
            or (entry.topic == odometry and _stamp(entry) > _stamp(held[0]))
        ):
            yield held.popleft()
        if entry.topic == images:
            held.append(entry)
        else:
            yield entry
    yield from held


def _stamp(entry: BagMessage) -> float:
    """Stamp of a message, ns; infinite if it cannot be read."""
    try:
        return decode.stamp_ns(entry.message.header)
    except LandmarkNavError:
        return inf
