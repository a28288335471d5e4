"""Small bags: sweeps and drives of a camera that sees grey levels."""

from contextlib import contextmanager

from mcap.writer import Writer as RawWriter
import numpy as np

from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.messages import encode
from landmark_nav.messages.factory import rosbag_factory
from landmark_nav.storage.bags import BagWriter
from landmark_nav.types import JointSample, OdometrySample

FACTORY = rosbag_factory()
MOUNT = PanTiltMount()
CAMERA = CameraModel(64, 48, 60.0, 60.0, 31.5, 23.5)
SECOND = 1_000_000_000
START = 1000 * SECOND


def camera_image(value):
    return np.full((48, 64), value % 256, np.uint8)


def odometry(stamp, pose, **frames):
    return encode.odometry(FACTORY, OdometrySample(stamp, np.asarray(pose, float)), **frames)


def write_sweep(
    bag, start, pans, *, keep=None, trajectory=True, damaged=(), change=lambda message: None
):
    samples = [JointSample(start + k * SECOND, float(p)) for k, p in enumerate(pans)]
    for k, sample in enumerate(samples):
        stamp = sample.stamp_ns
        if keep is None or keep(k):
            image = encode.image(FACTORY, camera_image(k), stamp, 'cam')
            if k in damaged:
                image.data = image.data[:100]
            bag.write('sweep/image', image, stamp)
            info = encode.camera_info(FACTORY, CAMERA, stamp, 'cam')
            bag.write('sweep/camera_info', info, stamp)
        bag.write('joint_states', encode.joint_state(FACTORY, sample, MOUNT), stamp)
    if trajectory:
        end = samples[-1].stamp_ns
        message = encode.sweep_trajectory(FACTORY, samples, MOUNT)
        change(message)
        bag.write('sweep/trajectory', message, end)


def full_turn(count=24):
    return -np.pi + 2 * np.pi / count * np.arange(count)


def write_drive(
    path,
    *,
    frames=10,
    damaged=(),
    info=True,
    bad=lambda topic, k: False,
    late_joints=False,
    set_back=lambda k: 0,
    lone_tilt=None,
):
    """
    Pan turns at 0.3 rad/s; joint states at 20 Hz, images at 5 Hz between two of them.

    `bad` gives which messages hold no number, `set_back` by how much the clock is behind,
    `lone_tilt` the tilt, where it has messages of its own, 10 ms before those of the pan.
    """
    with BagWriter(path) as bag:
        for k in range(frames * 4):
            log = START + k * 50_000_000
            stamp = log - set_back(k)
            x = np.nan if bad('odom', k) else 0.01 * k
            bag.write('odom', odometry(stamp, [x, 0.0, 0.0]), log)
            joints_stamp = stamp + (9 * SECOND if late_joints else 0)
            pan = np.nan if bad('joint_states', k) else 0.3 * k * 0.05
            sample = JointSample(joints_stamp, pan)
            joints = encode.joint_state(FACTORY, sample, MOUNT)
            if lone_tilt is not None:
                before = stamp - 10_000_000
                tilted = JointSample(before, 0.0, lone_tilt(k - 0.2))
                alone = encode.joint_state(FACTORY, tilted, MOUNT)
                alone.name, alone.position = alone.name[1:], alone.position[1:]
                bag.write('joint_states', alone, log - 10_000_000)
                joints.name, joints.position = joints.name[:1], joints.position[:1]
            bag.write('joint_states', joints, log)
            bag.write('ground_truth/odom', odometry(stamp, [1.0, 2.0, 0.0], frame_id='map'), log)
            if k % 4 == 0:
                shot, log = stamp + 20_000_000, log + 20_000_000
                message = encode.compressed_image(FACTORY, camera_image(k), shot, 'cam')
                if k // 4 in damaged:
                    message.data = message.data[:30]
                bag.write('camera/image_raw/compressed', message, log)
                if info:
                    calibration = encode.camera_info(FACTORY, CAMERA, shot, 'cam')
                    if bad('camera/camera_info', k):
                        calibration.k[:] = np.nan
                    bag.write('camera/camera_info', calibration, log)
    return path


@contextmanager
def foreign_bag(path, **options):
    """MCAP file of other hands; takes topic, schema, encoding and the bytes of messages."""
    with path.open('wb') as stream:
        writer = RawWriter(stream, **options)
        writer.start()

        def add(topic, schema, encoding, messages):
            channel = writer.register_channel(topic, encoding, writer.register_schema(*schema))
            for stamp, data in enumerate(messages, 1):
                writer.add_message(channel, stamp, data, stamp)

        yield add
        writer.finish()
