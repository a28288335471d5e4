"""Small bags: sweeps and drives of a camera that sees grey levels, in any format."""

from contextlib import contextmanager

from mcap.writer import Writer as RawWriter
import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.messages import encode
from landmark_nav.messages.factory import default_typestore, rosbag_factory
from landmark_nav.storage.bags import Bag, BagWriter
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


def write_drive(path):
    """Pan turns at 0.3 rad/s; joint states at 20 Hz, images at 5 Hz between two of them."""
    with BagWriter(path) as bag:
        for k in range(40):
            stamp = START + k * 50_000_000
            bag.write('odom', odometry(stamp, [0.01 * k, 0.0, 0.0]), stamp)
            joints = JointSample(stamp, 0.3 * k * 0.05)
            bag.write('joint_states', encode.joint_state(FACTORY, joints, MOUNT), stamp)
            truth = odometry(stamp, [1.0, 2.0, 0.0], frame_id='map')
            bag.write('ground_truth/odom', truth, stamp)
            if k % 4 == 0:
                shot = stamp + 20_000_000
                image = encode.compressed_image(FACTORY, camera_image(k), shot, 'cam')
                bag.write('camera/image_raw/compressed', image, shot)
                info = encode.camera_info(FACTORY, CAMERA, shot, 'cam')
                bag.write('camera/camera_info', info, shot)
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


ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), default_typestore()


def _copied(source, writer, store, data_of=lambda entry: entry.data):
    """Write all messages of a bag by another writer."""
    connections = {}
    with writer:
        for entry in Bag(source).messages():
            if entry.topic not in connections:
                connections[entry.topic] = writer.add_connection(
                    entry.topic, entry.type_name, typestore=store
                )
            writer.write(connections[entry.topic], entry.stamp_ns, data_of(entry))


def rosbag2_bag(source, path, mode=None, storage=StoragePlugin.SQLITE3):
    """rosbag2, perhaps compressed by rosbag2 itself."""
    writer = Writer(path, version=9, storage_plugin=storage)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    _copied(source, writer, ROS2)
    return path


def ros1_bag(source, path, compression=None):
    """A ROS 1 bag."""
    writer = Ros1Writer(path)
    if compression is not None:
        writer.set_compression(compression)
    _copied(source, writer, ROS1, lambda entry: ROS2.cdr_to_ros1(entry.data, entry.type_name))
    return path
