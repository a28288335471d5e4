"""Sweeps over DDS: of a small simulated robot, raw or compressed."""

import copy
from threading import Thread
from typing import Any

import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.messages import decode, encode
from landmark_nav.ros.camera_frames import listen_for_pan
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.topics import ros_factory
from landmark_nav.types import JointSample, OdometrySample

FRAMES = 8
STEP_RAD = 0.25
MOUNT = PanTiltMount((0.08, 0.0, 1.1))
CAMERA = CameraModel(64, 48, 60.0, 60.0, 31.5, 23.5)

# Texture with a mean of nothing: what is blank may well look the same in all directions.
STRIPES = 20 * np.sign(np.arange(64) % 8 - 3.5)


class SmallRobot(LandmarkNode):
    """
    Joint states at 50 Hz, every third with an image; keeps what a sweep publishes.

    `stuck` and `lone_tilt_rad`, which is given in messages of its own now and then, may be changed
    while it runs.
    """

    def __init__(self, transport, command, **options):
        super().__init__('small_robot', 'robot', **options)
        self._pan, self._target, self._count = 0.0, 0.0, 0
        self.stuck = False
        self.lone_tilt_rad: float | None = None
        self._joints = self.advertise('joint_states')
        self._info = self.advertise('camera/camera_info')
        self._odometry = self.advertise('odom')
        raw = transport == 'raw'
        self._image = self.advertise('camera/image_raw' + ('' if raw else '/compressed'))
        self._encode = encode.image if raw else encode.compressed_image
        listen_for_pan(self, MOUNT, command, self._turn)
        self.images: list[Any] = []
        self.infos: list[Any] = []
        self.trajectories: list[Any] = []
        self.listen('sweep/image' + ('' if raw else '/compressed'), self.images.append)
        self.listen('sweep/camera_info', self.infos.append)
        self.listen('sweep/trajectory', self.trajectories.append)
        self.create_timer(0.02, self._tick)

    def health(self):
        return Health(Level.OK, 'running')

    def _turn(self, pan_rad):
        self._target = pan_rad

    def _tick(self):
        if not self.stuck:
            self._pan += float(np.clip(self._target - self._pan, -0.1, 0.1))
        self._count += 1
        stamp = self.get_clock().now().nanoseconds
        both = encode.joint_state(
            ros_factory, JointSample(stamp, self._pan, self.lone_tilt_rad or 0.0), MOUNT
        )
        if self.lone_tilt_rad is not None:
            if self._count % 5 == 0:
                tilt = copy.deepcopy(both)
                tilt.name, tilt.position = both.name[1:], both.position[1:]
                self._joints.publish(tilt)
            both.name, both.position = both.name[:1], both.position[:1]
        self._joints.publish(both)
        place = OdometrySample(stamp, np.zeros(3))
        self._odometry.publish(encode.odometry(ros_factory, place))
        if self._count % 3 == 0:
            # The image shows the pan it was taken at.
            grey = 100.0 + 50.0 * self._pan + STRIPES
            camera_image = np.tile(np.rint(grey).astype(np.uint8), (48, 1))
            self._image.publish(
                self._encode(ros_factory, camera_image, stamp, 'camera_optical_frame')
            )
            self._info.publish(encode.camera_info(ros_factory, CAMERA, stamp, 'camera'))


@pytest.fixture
def robot(graph):
    """Make a robot, which is spun by a thread of its own."""

    def spin():
        try:
            graph.executor.spin()
        except Exception:
            # A timer may publish at the moment of the shutdown.
            if graph.context.ok():
                raise

    def make(transport='raw', command='JointTrajectory'):
        node = graph.add(SmallRobot(transport, command, context=graph.context))
        thread.start()
        return node

    thread = Thread(target=spin)
    yield make
    graph.context.try_shutdown()
    thread.join(5.0)


def sweep_parameters(setup_files):
    return {
        'robot_file': setup_files['robot_file'],
        'capture.start_rad': -1.0,
        'capture.step_rad': STEP_RAD,
        'capture.frames': FRAMES,
    }


def check_frames(small, client):
    """Every frame of the first whole sweep is there, with the pan it was taken at."""
    client.wait(lambda: bool(small.trajectories), 20.0, 'the trajectory')
    samples = decode.sweep_trajectory(small.trajectories[0], MOUNT)
    np.testing.assert_allclose(
        [sample.pan_rad for sample in samples], -1.0 + STEP_RAD * np.arange(FRAMES), atol=0.01
    )
    stamps = [sample.stamp_ns for sample in samples]

    def kept(messages):
        return [each for each in messages if decode.stamp_ns(each.header) >= stamps[0]]

    client.wait(
        lambda: min(len(kept(small.images)), len(kept(small.infos))) >= FRAMES, 20.0, 'all frames'
    )
    images = kept(small.images)
    assert [decode.stamp_ns(message.header) for message in images] == stamps
    assert [decode.stamp_ns(message.header) for message in kept(small.infos)] == stamps
    for sample, message in zip(samples, images, strict=True):
        assert abs(float(decode.image(message).mean()) - (100 + 50 * sample.pan_rad)) < 2.0


def test_refusals_state_why_and_leave_the_node_running(robot, start, client, setup_files):
    command = 'Float64MultiArray'
    own = {'capture.step_timeout_s': 1.0, 'command.type': command}
    start('sweep_capture', **sweep_parameters(setup_files), **own)
    with pytest.raises(LandmarkNavError, match=r'waits for .*/joint_states \(nobody publishes it'):
        client.call('capture_sweep', 30.0)
    small = robot('raw', command)
    small.stuck = True
    client.wait(lambda: client.status_of('sweep_capture').reason == 'ready', 20.0, 'joint states')
    with pytest.raises(LandmarkNavError, match=r'frame 1 of 8, -57.3 deg.*the pan is 0.00 deg'):
        client.call('capture_sweep', 30.0)
    small.stuck, small.lone_tilt_rad = False, 0.1
    assert client.call('capture_sweep', 60.0).startswith(f'{FRAMES} frames')
    check_frames(small, client)
    samples = decode.sweep_trajectory(small.trajectories[0], MOUNT)
    np.testing.assert_allclose([sample.tilt_rad for sample in samples], 0.1)


def test_a_sweep_is_interrupted_and_continued(robot, start, client, setup_files):
    command = 'JointState'
    start('sweep_capture', **sweep_parameters(setup_files), **{'command.type': command})
    called = False

    def call_again():
        nonlocal called
        if not called:
            called = True
            with pytest.raises(LandmarkNavError, match='under way is interrupted'):
                client.call('capture_sweep', 20.0)

    with pytest.raises(LandmarkNavError, match='no sweep: capture_sweep was called again'):
        client.call('capture_sweep', 30.0, call_again)
    small = robot('compressed', command)
    client.wait(lambda: client.status_of('sweep_capture').reason == 'ready', 20.0, 'the robot')

    called = False

    def interrupt():
        if len(small.images) >= 3:
            call_again()

    with pytest.raises(LandmarkNavError, match='capture_sweep was called again'):
        client.call('capture_sweep', 60.0, interrupt)
    client.wait(
        lambda: 'interrupted' in client.status_of('sweep_capture').reason, 20.0, 'its word'
    )
    frames = len(small.images)
    assert not small.trajectories
    reported = client.call('capture_sweep', 60.0)
    assert f'continued after {frames} earlier frames' in reported
    assert 'no odom' not in reported
    check_frames(small, client)


NODE = 'panorama_synthesizer'


def test_a_sweep_may_come_in_another_form_than_the_last(start, client, setup_files, tmp_path):
    start(NODE, **setup_files)
    forms = {'sweep/image': encode.image, 'sweep/image/compressed': encode.compressed_image}
    images = {topic: client.advertise(topic) for topic in forms}
    info, trajectory = client.advertise('sweep/camera_info'), client.advertise('sweep/trajectory')
    publishers = [*images.values(), info, trajectory]
    client.wait(
        lambda: all(each.get_subscription_count() for each in publishers), 30.0, 'the synthesizer'
    )
    log = tmp_path / 'logs' / f'{NODE}.log'

    def reported(times):
        return lambda: log.read_text().count('no panorama') == times

    for number, topic in enumerate([*forms, 'sweep/image'], start=1):
        samples = [JointSample(1000 * number + k, 0.5 * k) for k in range(3)]
        for sample in samples:
            camera_image = np.full((48, 64), 100, np.uint8)
            images[topic].publish(
                forms[topic](ros_factory, camera_image, sample.stamp_ns, 'camera')
            )
            info.publish(encode.camera_info(ros_factory, CAMERA, sample.stamp_ns, 'camera'))
        trajectory.publish(encode.sweep_trajectory(ros_factory, samples, PanTiltMount()))
        client.wait(reported(number), 30.0, f'word of the sweep on {topic}')
    assert 'lacks all' not in log.read_text()
