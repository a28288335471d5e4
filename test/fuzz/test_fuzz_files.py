"""Every file format that is read, with hostile contents: it is read, or refused in one line."""

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
import shutil
from typing import Any

from bag_writers import ros1_bag, rosbag2_bag
from bounds import enter, FUZZ
import corpus
import cv2
from hostile import changed_bytes, changed_message, changed_yaml
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin
import yaml

from landmark_nav.calibration import Calibration
from landmark_nav.configuration import load_configuration, READS
from landmark_nav.diagnosis import diagnose, QUICK
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages.factory import default_typestore
from landmark_nav.storage.bags import Bag, BagWriter, read_sweeps, sensor_events
from landmark_nav.storage.bags.definitions import TOPIC_TYPES
from landmark_nav.storage.bags.sweeps import read_sweep_folder
from landmark_nav.storage.maps import load_map, save_map
from landmark_nav.storage.mrclam import read_mrclam
from landmark_nav.storage.robot_files import load_robot
from landmark_nav.storage.setup_files import load_camera, load_room

STORE = default_typestore()
BAG_TOPICS = ('camera/image_raw/compressed', 'camera/camera_info', 'joint_states', 'odom')
CAMERA_YAML = {
    'image_width': 64,
    'image_height': 48,
    'distortion_model': 'plumb_bob',
    'camera_matrix': {'rows': 3, 'cols': 3, 'data': [60.0, 0, 31.5, 0, 60.0, 23.5, 0, 0, 1]},
    'distortion_coefficients': {'rows': 1, 'cols': 5, 'data': [0.0] * 5},
}
CONFIG = {'/**': {'ros__parameters': {'capture': {'frames': 3}, 'triplet': {'views': 'one'}}}}


def read_config(path):
    """Read parameters of all nodes, for a robot of which nothing is known."""
    robot = path.with_name('any_robot.yaml')
    robot.write_text('pan_axis: {xyz: [0, 0, 1]}', encoding='utf-8')
    return load_configuration(path, robot, *READS)


# Name -> document, what reads it.
YAML_FILES: dict[str, tuple[Any, Callable[[Path], Any]]] = {
    'room.yaml': (corpus.ROOM_YAML, load_room),
    'robot.yaml': (corpus.ROBOT_YAML, load_robot),
    'camera.yaml': (CAMERA_YAML, load_camera),
    'landmark_nav.yaml': (CONFIG, read_config),
}


@pytest.mark.parametrize('name', sorted(YAML_FILES))
@FUZZ
@given(data=st.data())
def test_yaml_files(name, data, scratch):
    document, read = YAML_FILES[name]
    path = scratch / name
    if data.draw(st.booleans()):
        text = yaml.safe_dump(data.draw(changed_yaml(document)), allow_unicode=True).encode()
    else:
        text = data.draw(changed_bytes(yaml.safe_dump(document).encode()))
    path.write_bytes(text)
    enter(lambda: read(path))


@FUZZ
@given(data=st.data())
def test_maps(data, scratch):
    folder = scratch / 'map'
    if not folder.exists():
        save_map(corpus.landmark_map(), folder)
        (scratch / 'map.yaml').write_bytes((folder / 'map.yaml').read_bytes())
        (scratch / 'patch.png').write_bytes((folder / 'patches' / '000.png').read_bytes())
    text, patch = (scratch / 'map.yaml').read_bytes(), (scratch / 'patch.png').read_bytes()
    kind = data.draw(st.sampled_from(('bytes', 'values', 'patch')))
    if kind == 'bytes':
        text = data.draw(changed_bytes(text))
    elif kind == 'values':
        text = yaml.safe_dump(data.draw(changed_yaml(yaml.safe_load(text)))).encode()
    else:
        patch = data.draw(changed_bytes(patch))
    (folder / 'map.yaml').write_bytes(text)
    (folder / 'patches' / '000.png').write_bytes(patch)
    enter(lambda: load_map(folder))


@FUZZ
@given(data=st.data())
def test_sweep_folders(data, scratch):
    image = np.random.default_rng(0).integers(0, 255, (12, 16, 3), dtype=np.uint8)
    jpeg = cv2.imencode('.jpg', image)[1].tobytes()
    rows = [f'{k}.jpg,{0.5 * k},20.0,16,12' for k in range(3)]
    table = '\n'.join(['file,pan_rad,focal_px,width,height', *rows]).encode()
    if data.draw(st.booleans()):
        table = data.draw(changed_bytes(table))
    else:
        jpeg = data.draw(changed_bytes(jpeg))
    (scratch / 'frames.csv').write_bytes(table)
    for k in range(3):
        (scratch / f'{k}.jpg').write_bytes(jpeg)
    enter(lambda: read_sweep_folder(scratch))


MRCLAM = {
    'Barcodes.dat': '# subject barcode\n6 72\n7 27\n8 54\n',
    'Landmark_Groundtruth.dat': '6 1.0 2.0 0.0 0.0\n7 2.0 -1.0 0.0 0.0\n8 3.0 1.0 0.0 0.0\n',
    'Robot1_Odometry.dat': ''.join(f'{100 + k}.0 0.1 0.02\n' for k in range(9)),
    'Robot1_Measurement.dat': ''.join(
        f'{101 + k}.5 {(72, 27)[k % 2]} 1.5 0.2\n' for k in range(7)
    ),
    'Robot1_Groundtruth.dat': ''.join(f'{100 + k}.0 {0.1 * k} 0.0 0.0\n' for k in range(9)),
}


@FUZZ
@given(data=st.data())
def test_mrclam_logs(data, scratch):
    for name, text in MRCLAM.items():
        (scratch / name).write_text(text, encoding='utf-8')
    name = data.draw(st.sampled_from(sorted(MRCLAM)))
    (scratch / name).write_bytes(data.draw(changed_bytes(MRCLAM[name].encode())))
    enter(lambda: read_mrclam(scratch, 1, 0.03))


def write_bag(folder, kind):
    """Write messages of each topic to `bag` in a folder, of a kind of file."""
    sent = [
        (topic, k * corpus.SECOND_NS, serialized(topic, corpus.recorded()[topic]))
        for topic in BAG_TOPICS
        for k in range(10, 13)
    ]
    write_raw(folder / 'source', sent)
    if kind == 'ros1':
        ros1_bag(folder / 'source', folder / 'bag')
    else:
        storage = StoragePlugin.MCAP if kind == 'mcap' else StoragePlugin.SQLITE3
        rosbag2_bag(folder / 'source', folder / 'bag', storage=storage)


def read_all(path):
    """Read all messages; what is passed over is said in one line."""
    warnings: list[str] = []
    bag = Bag(path, warnings.append)
    for entry in bag.messages():
        try:
            _ = entry.message
        except LandmarkNavError as error:
            warnings.append(str(error))
    assert all(line.isprintable() for line in warnings), warnings


@pytest.mark.parametrize('kind', ['mcap', 'db3', 'ros1'])
@FUZZ
@given(data=st.data())
def test_bags(kind, data, scratch):
    if not (scratch / 'good').exists():
        (scratch / 'good').mkdir()
        write_bag(scratch / 'good', kind)
    shutil.rmtree(scratch / 'bad', ignore_errors=True)
    shutil.copytree(scratch / 'good', scratch / 'bad')
    path = file = scratch / 'bad' / 'bag'
    if kind != 'ros1':
        described = data.draw(st.integers(0, 3)) == 0
        file = path / 'metadata.yaml' if described else next(path.glob('bag.*'))
    file.write_bytes(data.draw(changed_bytes(file.read_bytes())))
    enter(lambda: read_all(path))
    enter(lambda: check_bag(path))


# Times of recording that are none.
LOG_NS = (0, 1, 2**63 - 1, 2**63, 2**64 - 1)


def check_bag(path):
    """What `landmark-nav check`, `learn` and `evaluate` begin with."""
    found = diagnose(Bag(path, lambda _: None), Calibration.of_mount(PanTiltMount()), None, QUICK)
    assert all(finding.line().isprintable() for finding in found.findings), found


def write_raw(path, sent):
    """Write a bag of topics, times of recording and serialised messages."""
    with BagWriter(path, overwrite=True) as bag:
        for topic, stamp, raw in sent:
            bag.write_serialized(topic, TOPIC_TYPES[topic], raw, stamp)


def serialized(topic, message):
    return STORE.serialize_cdr(message, TOPIC_TYPES[topic])


def changed(data, topic):
    """A message of a topic with hostile values."""
    return data.draw(changed_message(TOPIC_TYPES[topic], corpus.recorded()[topic]))


@FUZZ
@given(data=st.data())
def test_bags_of_hostile_messages(data, scratch):
    topic = data.draw(st.sampled_from(BAG_TOPICS))
    raw = data.draw(changed_bytes(serialized(topic, changed(data, topic))))
    write_raw(scratch / 'bag', [(topic, 10 * corpus.SECOND_NS, raw)])
    enter(lambda: read_all(scratch / 'bag'))


SWEEP_TOPICS = ('sweep/image/compressed', 'sweep/camera_info', 'sweep/trajectory', 'sweep/pose')


@pytest.mark.parametrize(
    ('topics', 'read'), [(BAG_TOPICS, sensor_events), (SWEEP_TOPICS, read_sweeps)]
)
@FUZZ
@given(data=st.data())
def test_checks_of_hostile_drives_and_sweeps(topics, read, data, scratch):
    path = scratch / 'bag'
    hostile = data.draw(st.sampled_from(topics))

    def sent():
        for topic in topics:
            for k in range(1 if 'trajectory' in topic else 12):
                stamp = 10 * corpus.SECOND_NS + k * corpus.SECOND_NS // 10
                if topic == hostile and data.draw(st.booleans()):
                    message = changed(data, topic)
                else:
                    message = deepcopy(corpus.recorded()[topic])
                    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
                logged = data.draw(st.sampled_from([stamp, stamp, *LOG_NS]))
                yield topic, logged, serialized(topic, message)

    write_raw(path, sent())
    enter(lambda: check_bag(path))
    enter(lambda: list(read(Bag(path, lambda _: None), PanTiltMount())))
