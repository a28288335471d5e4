"""Images of either topic, joint states that are kept for them, and transforms."""

from collections.abc import Callable
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages import encode
from landmark_nav.ros.camera_frames import CameraFrames, ImageSource
from landmark_nav.ros.inputs import IrrelevantError
from landmark_nav.ros.topics import ros_factory
from landmark_nav.types import JointSample, Refusal

MOUNT = PanTiltMount()
RATE_RAD_S = 0.5


def listening(*joints):
    """Frames of a node, and what makes it hear of `joints`, of both unless they are named."""
    callbacks: dict[str, Any] = {}
    node: Any = SimpleNamespace(listen=lambda topic, call, **_: callbacks.setdefault(topic, call))
    frames = CameraFrames(node, MOUNT)

    def hear(sample):
        both = encode.joint_state(ros_factory, sample, MOUNT)
        for joint in joints:
            alone = encode.joint_state(ros_factory, sample, MOUNT)
            at = list(both.name).index(joint)
            alone.name, alone.position = [joint], [both.position[at]]
            with suppress(IrrelevantError):
                callbacks['joint_states'](alone)
        if not joints:
            callbacks['joint_states'](both)

    return frames, hear


@pytest.mark.parametrize('step_ns', [1_000_000, 20_000_000])
def test_they_reach_back_however_fast_they_come(step_ns):
    frames, hear = listening()
    last_ns = 6 * 10**9
    for stamp_ns in range(0, last_ns + 1, step_ns):
        hear(JointSample(stamp_ns, 1e-9 * stamp_ns * RATE_RAD_S))
        assert frames.reaches(stamp_ns)
    for before_ns in (0, 10**9, 2 * 10**9):
        joints = frames.joints_at(last_ns - before_ns)
        assert joints.pan_rad == pytest.approx(1e-9 * (last_ns - before_ns) * RATE_RAD_S)
        assert joints.pan_rate_rad_s == pytest.approx(RATE_RAD_S)
    assert frames.pan_range_rad == pytest.approx(3.0 * RATE_RAD_S, abs=0.02)


@pytest.mark.parametrize(
    'pan_of',
    [lambda k: np.degrees(0.01 * k), lambda k: 0.01 * k * (k % 2)],
    ids=['degrees', 'two publishers'],
)
def test_pans_that_no_joint_could_turn_are_refused_until_they_are_over(pan_of):
    frames, hear = listening()
    for k in range(400):
        hear(JointSample(k * 20_000_000, pan_of(k) if 100 <= k < 200 else 0.01 * k))
        if k in (99, 199, 399):
            known = frames.joints_at(k * 20_000_000)
            assert isinstance(known, Refusal) == (k == 199)


def test_a_tilt_of_another_driver_is_waited_for_and_kept():
    frames, hear = listening(MOUNT.tilt_joint, MOUNT.pan_joint)
    for k in range(400):
        hear(JointSample(k * 20_000_000, 0.0, 0.001 * k))
    last_ns = 399 * 20_000_000
    joints = frames.joints_at(last_ns - 110_000_000)
    assert joints.tilt_rad == pytest.approx(0.399 - 0.0055, abs=1e-6)
    assert frames.tilt_rad == pytest.approx(0.399)
    assert len(frames._tilts) < 200

    def hear_pan(stamp_ns):
        frames._on_joints(JointSample(stamp_ns, 0.0))

    # A tilt is awaited, but not for long: it may be given now and then only.
    hear_pan(last_ns + 20_000_000)
    assert frames.reaches(last_ns)
    assert not frames.reaches(last_ns + 10_000_000)
    hear_pan(last_ns + 160_000_000)
    assert frames.reaches(last_ns + 10_000_000)
    joints = frames.joints_at(last_ns + 100_000_000)
    assert joints.tilt_rad == pytest.approx(0.399)
    hear(JointSample(0, 0.0, 0.2))
    assert [tilt for _, tilt in frames._tilts] == [0.2]


RAW, COMPRESSED = 'camera/image_raw', 'camera/image_raw/compressed'


class Listener:
    """Keeps who listens to what, as a node; `meanwhile` is what another thread does."""

    def __init__(self):
        self.heard: dict[str, Callable[[Any], None]] = {}
        self.meanwhile: Callable[[], None] = lambda: None

    def listen(self, topic, callback, **_):
        self.heard[topic] = callback
        return SimpleNamespace(topic=topic)

    def destroy_subscription(self, subscription):
        del self.heard[subscription.topic]
        self.meanwhile()

    def create_timer(self, _seconds, tick, **_):
        self.tick = tick

    def destroy_timer(self, _timer):
        self.tick = lambda: None


def test_raw_images_are_taken_while_no_compressed_ones_come():
    node: Any = Listener()
    images: list[Any] = []
    source = ImageSource(node, RAW, images.append)
    late = node.heard[RAW]
    node.heard[COMPRESSED]('jpeg')
    late('raw')
    assert images == ['jpeg']
    for _ in range(2):
        assert list(node.heard) == [COMPRESSED]
        node.tick()
    node.heard[RAW]('raw')
    node.heard[COMPRESSED]('another')
    assert images == ['jpeg', 'raw', 'another']
    assert list(node.heard) == [COMPRESSED]
    source.close()
    node.tick()
    assert not node.heard
