"""What decodes a message: each type with hostile values gives a value or a refusal."""

from functools import cache, partial
from pathlib import Path
import tempfile

from bounds import enter, FUZZ
import corpus
from hostile import changed_message
from hypothesis import given
from hypothesis import strategies as st
import pytest
import yaml

from landmark_nav.messages import decode
from landmark_nav.messages.factory import rosbag_factory
from landmark_nav.storage.bags.definitions import TOPIC_TYPES
from landmark_nav.storage.setup_files import load_robot


@cache
def prepared():
    with tempfile.TemporaryDirectory() as folder:
        robot = Path(folder) / 'robot.yaml'
        robot.write_text(yaml.safe_dump(corpus.ROBOT_YAML), encoding='utf-8')
        return corpus.messages(rosbag_factory(), robot), load_robot(robot)


def _decoders():
    valid, mount = prepared()
    joints = partial(decode.joint_sample, mount=mount)
    tilt = partial(decode.lone_tilt, mount=mount)
    return {
        'camera/image_raw': decode.image,
        'camera/image_raw/compressed': decode.image,
        'camera/camera_info': decode.camera_model,
        'joint_states': lambda message: (joints(message), tilt(message)),
        'odom': decode.odometry,
        'sweep/trajectory': partial(decode.sweep_trajectory, mount=mount),
        'sweep/pose': decode.pose_estimate,
        'panorama/image': lambda m: decode.panorama(
            m, valid['panorama/camera_info'], valid['panorama/pose']
        ),
        'panorama/camera_info': lambda m: decode.panorama(
            valid['panorama/image'], m, valid['panorama/pose']
        ),
        'panorama/pose': lambda m: decode.panorama(
            valid['panorama/image'], valid['panorama/camera_info'], m
        ),
        'landmarks': lambda m: decode.landmark_map(m, valid['landmarks/atlas']),
        'landmarks/atlas': lambda m: decode.landmark_map(valid['landmarks'], m),
        'triplet': decode.triplet,
        'detections': decode.detections,
        'global_localization/pose': decode.global_pose,
    }


@pytest.mark.parametrize('topic', sorted(_decoders()))
def test_valid_messages_pass(topic):
    _decoders()[topic](prepared()[0][topic])


@pytest.mark.parametrize('topic', sorted(_decoders()))
@FUZZ
@given(data=st.data())
def test_hostile_messages(topic, data):
    message = data.draw(changed_message(TOPIC_TYPES[topic], prepared()[0][topic]))
    enter(lambda: _decoders()[topic](message))
