"""What the robot sensed on a drive, out of a bag."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages import decode
from landmark_nav.storage.bags.reader import Bag, BagMessage
from landmark_nav.storage.bags.timelines import CameraInfos, JointHistory, naming
from landmark_nav.types import (
    CameraFrame,
    Detections,
    OdometrySample,
    PoseEstimate,
    Refusal,
)

__all__ = ['SensorEvent', 'sensor_events']

SensorEvent = CameraFrame | Detections | OdometrySample | PoseEstimate

_PICTURES = ('camera/image_raw', 'camera/image_raw/compressed')


def sensor_events(
    bag: Bag, mount: PanTiltMount, joint_delay_s: float = 0.0
) -> Iterator[SensorEvent]:
    """
    What a drive's bag holds, in the order it was recorded.

    Of one moment the pictures come last, as nodes wait for what belongs to them. They are grey,
    with pan and tilt interpolated at their stamps; those of joint states are late by
    `joint_delay_s`. Ground truth, if there is any, comes as `PoseEstimate`. Pictures that cannot
    be used are left out and reported through ``bag.warn``. A bag without pictures may bring
    ``detections`` instead, of this package or another sensor.

    Raises
    ------
    LandmarkNavError
        A topic is missing, a value is not a number, or no picture can be used.

    """
    if not any(bag.find(name) for name in _PICTURES) and bag.find('detections'):
        yield from _detections_and_motion(bag)
        return
    images = bag.require(*_PICTURES)
    odometry = bag.require('odom')
    cameras = CameraInfos.read(bag, 'camera/camera_info')
    joints = JointHistory.read(bag, mount)
    truth = bag.find('ground_truth/odom')
    topics = [t for t in (images, odometry, truth) if t is not None]
    complaints: list[str] = []
    used = 0
    for entry in _pictures_last(bag.messages(topics), images):
        if entry.topic == images:
            try:
                yield _frame(bag, entry, cameras, joints, round(joint_delay_s * 1e9))
                used += 1
            except _UnusableFrameError as error:
                complaints.append(str(error))
            continue
        with naming(bag, entry.topic):
            if entry.topic == odometry:
                yield decode.odometry(entry.message)
            else:
                yield decode.pose_estimate(entry.message)
    if complaints and not used:
        raise LandmarkNavError(complaints[0])
    if complaints:
        bag.warn(
            f'{len(complaints)} of {used + len(complaints)} pictures left out: {complaints[0]}'
        )


def _pictures_last(messages: Iterable[BagMessage], images: str) -> Iterator[BagMessage]:
    """Messages with those on the topic `images` behind others that were recorded with them."""
    held: list[BagMessage] = []
    for entry in messages:
        if held and entry.stamp_ns > held[-1].stamp_ns:
            yield from held
            held.clear()
        if entry.topic == images:
            held.append(entry)
        else:
            yield entry
    yield from held


def _detections_and_motion(bag: Bag) -> Iterator[SensorEvent]:
    """Bearings that somebody else found in pictures that are not kept."""
    decoders: dict[str, Callable[[Any], SensorEvent]] = {
        bag.require('detections'): decode.detections,
        bag.require('odom'): decode.odometry,
    }
    if truth := bag.find('ground_truth/odom'):
        decoders[truth] = decode.pose_estimate
    for entry in bag.messages(decoders):
        with naming(bag, entry.topic):
            yield decoders[entry.topic](entry.message)


class _UnusableFrameError(Exception):
    """One picture that has to be left out."""


def _frame(
    bag: Bag, entry: BagMessage, cameras: CameraInfos, joints: JointHistory, delay_ns: int
) -> CameraFrame:
    stamp = decode.stamp_ns(entry.message.header)
    try:
        with naming(bag, entry.topic):
            picture = decode.image(entry.message, grey=True)
    except LandmarkNavError as error:
        raise _UnusableFrameError(str(error)) from error
    sample = joints.at(stamp + delay_ns)
    if isinstance(sample, Refusal):
        raise _UnusableFrameError(
            f'{bag.path}: {entry.topic} at {stamp * 1e-9:.3f} s has no joint state near it '
            f'({sample}): record joint_states at 10 Hz at least, on the same clock'
        )
    with naming(bag, entry.topic):
        camera = cameras.for_picture(stamp, picture.shape)
    return CameraFrame(
        stamp,
        picture,
        camera,
        sample.pan_rad,
        sample.tilt_rad,
        pan_rate_rad_s=sample.pan_rate_rad_s,
        pan_sigma_rad=sample.pan_sigma_rad,
    )
