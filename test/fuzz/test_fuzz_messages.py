"""What decodes a message: each type with hostile values gives a value or a refusal."""

from functools import partial

from bounds import enter, FUZZ
import corpus
from hostile import changed_message
from hypothesis import given
from hypothesis import strategies as st
import pytest

from landmark_nav.messages import decode
from landmark_nav.storage.bags.definitions import TOPIC_TYPES


def _decoders():
    valid, mount = corpus.recorded(), corpus.MOUNT
    panorama = ('panorama/image', 'panorama/camera_info', 'panorama/pose')
    whole = {
        part: lambda m, part=part: decode.panorama(
            *(m if k == part else valid[k] for k in panorama)
        )
        for part in panorama
    }
    return whole | {
        'camera/image_raw': decode.image,
        'camera/image_raw/compressed': decode.image,
        'camera/camera_info': decode.camera_model,
        'joint_states': partial(decode.joint_angles, mount=mount),
        'odom': decode.odometry,
        'sweep/trajectory': partial(decode.sweep_trajectory, mount=mount),
        'sweep/pose': decode.pose_estimate,
        'landmarks': lambda m: decode.landmark_map(m, valid['landmarks/atlas']),
        'landmarks/atlas': lambda m: decode.landmark_map(valid['landmarks'], m),
        'triplet': decode.triplet,
        'detections': decode.detections,
        'global_localization/pose': decode.global_pose,
    }


@pytest.mark.parametrize('topic', sorted(_decoders()))
def test_valid_messages_pass(topic):
    _decoders()[topic](corpus.recorded()[topic])


@pytest.mark.parametrize('topic', sorted(_decoders()))
@FUZZ
@given(data=st.data())
def test_hostile_messages(topic, data):
    message = data.draw(changed_message(TOPIC_TYPES[topic], corpus.recorded()[topic]))
    enter(lambda: _decoders()[topic](message))
