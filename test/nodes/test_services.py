"""Services and bad input: nodes answer with a reason and go on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
import shutil
import signal
import subprocess
import time
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from std_srvs.srv import Trigger

from landmark_nav.demo.supervisor import node_command, node_environment
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages import encode
from landmark_nav.ros.robot_client import RobotClient, ServiceDiscovery
from landmark_nav.ros.topics import ros_factory
from landmark_nav.storage.maps import load_map, save_map
from landmark_nav.storage.setup_files import load_room
from landmark_nav.types import JointSample, Landmark, LandmarkMap, OdometrySample, PoseEstimate


def small_map() -> LandmarkMap:
    rng = np.random.default_rng(5)
    return LandmarkMap(
        tuple(
            Landmark(
                id=k,
                position=np.array([1.0 + k, 0.0, 1.5]),
                covariance=1e-4 * np.eye(3),
                shared_loading=np.zeros((3, 2)),
                normal=np.array([0.0, 1.0, 0.0]),
                width_m=0.2,
                height_m=0.2,
                patch=rng.integers(0, 255, (24, 24), dtype=np.uint8),
                viewpoint=np.array([2.0, 2.0, 1.1]),
                threshold=0.7,
            )
            for k in range(4)
        )
    )


def test_learner_states_what_is_missing(
    start: Callable[..., None], client: RobotClient, setup_files: dict[str, str], tmp_path: Path
) -> None:
    folder = tmp_path / 'map'
    start('landmark_learner', room_file=setup_files['room_file'], map_folder=str(folder))
    with pytest.raises(LandmarkNavError, match='two panoramas from different places'):
        client.call('learn_landmarks', 30.0)
    with pytest.raises(LandmarkNavError, match='no map to save'):
        client.call('save_map', 10.0)
    with pytest.raises(LandmarkNavError, match='no map there'):
        client.call('load_map', 10.0)
    assert client.call('clear_panoramas', 10.0).startswith('0 panoramas')
    assert not folder.exists()

    save_map(small_map(), folder)
    assert client.call('load_map', 10.0).startswith('4 landmarks loaded')
    client.wait(
        lambda: client.status_of('landmark_learner').reason == '4 landmarks', 20.0, 'its health'
    )
    # A learning that fails leaves the map that is there.
    with pytest.raises(LandmarkNavError, match='two panoramas'):
        client.call('learn_landmarks', 10.0)
    shutil.rmtree(folder)
    assert client.call('save_map', 10.0).startswith('4 landmarks saved')
    assert len(load_map(folder).landmarks) == 4


def test_a_learner_that_is_to_load_a_map_that_is_not_there_can_still_learn_one(
    start: Callable[..., None], client: RobotClient, setup_files: dict[str, str], tmp_path: Path
) -> None:
    folder, node = str(tmp_path / 'map'), 'landmark_learner'
    start(node, room_file=setup_files['room_file'], map_folder=folder, load_on_start=True)
    client.wait(lambda: 'no map loaded' in client.status_of(node).reason, 30.0, 'word of no map')
    assert f'{folder}: no map there' in client.status_of(node).reason
    with pytest.raises(LandmarkNavError, match='two panoramas from different places'):
        client.call('learn_landmarks', 30.0)


@pytest.mark.parametrize(
    ('scale', 'frame', 'why'),
    [(1.03, 'map', ''), (1.5, 'map', 'no wall of the one'), (1.0, 'hall', "'hall' and 'map'")],
)
def test_a_map_of_another_room_is_reported(
    start: Callable[..., None],
    client: RobotClient,
    setup_files: dict[str, str],
    tmp_path: Path,
    scale: float,
    frame: str,
    why: str,
) -> None:
    folder, node, room = tmp_path / 'map', 'landmark_learner', setup_files['room_file']
    walls = tuple(
        replace(
            wall, **{at: tuple(scale * v for v in getattr(wall, at)) for at in ('start', 'end')}
        )
        for wall in load_room(room).walls
    )
    save_map(replace(small_map(), walls=walls, frame_id=frame), folder)
    start(node, room_file=room, map_folder=str(folder), load_on_start=True)
    client.wait(lambda: '4 landmarks' in client.status_of(node).reason, 30.0, 'the map')
    files = f'{folder} and {room} are of different rooms: '
    for status_of in (
        client.status_of(node).reason,
        client.call('load_map', 10.0),
        client.call('save_map', 10.0),
    ):
        assert ('different rooms' in status_of) == bool(why)
        assert not why or files + why in status_of


def test_localizer_states_what_it_lacks(
    start: Callable[..., None], client: RobotClient, setup_files: dict[str, str]
) -> None:
    reporter = 'triangulation_localizer'
    robot = setup_files['robot_file']
    start(reporter, robot_file=robot, **{'relocalization.search_s': 0.5})
    with pytest.raises(LandmarkNavError, match='no landmarks: call learn_landmarks or load_map'):
        client.call('relocalize', 30.0)
    landmarks = [client.advertise(topic) for topic in ('landmarks', 'landmarks/atlas')]
    elsewhere = replace(small_map(), frame_id='hall')
    for publisher, message in zip(
        landmarks, encode.landmark_map(ros_factory, elsewhere, 1)[:2], strict=True
    ):
        publisher.publish(message)
    wrong = "landmarks dropped: it is in frame 'hall', not in frame map: set map_frame to it"
    client.wait(lambda: wrong in client.status_of(reporter).reason, 20.0, 'word of the frame')
    cloud, atlas, _ = encode.landmark_map(ros_factory, small_map(), 1)
    for publisher, message in zip(landmarks, (cloud, atlas), strict=True):
        publisher.publish(message)
    client.wait(lambda: 'no image' in client.status_of(reporter).reason, 20.0, 'the map to arrive')
    with pytest.raises(LandmarkNavError, match=r'within 0.5 s \(no image came\).*initialpose'):
        client.call('relocalize', 30.0)

    images, joints = client.advertise('camera/image_raw'), client.advertise('joint_states')
    camera_image = np.zeros((60, 80), dtype=np.uint8)

    def answer(words: str, late_ns: int) -> Callable[[], bool]:
        def check() -> bool:
            stamp = time.time_ns() - late_ns
            images.publish(encode.image(ros_factory, camera_image, stamp, 'camera'))
            return words in client.status_of(reporter).reason

        return check

    client.wait(answer('images arrive 3.', 3 * 10**9), 20.0, 'word of late images')
    client.wait(answer('no joint_states after a wait of 0.3 s', 0), 20.0, 'word of no joints')
    sample = JointSample(time.time_ns(), 0.0)
    joints.publish(encode.joint_state(ros_factory, sample, PanTiltMount()))
    client.wait(answer(' ms behind after a wait of 0.3 s', 0), 20.0, 'word of late joints')
    client.wait(
        lambda: 'no image for' in client.status_of(reporter).reason, 20.0, 'word of no image'
    )


def test_a_call_that_waits_for_a_place_is_answered_as_the_node_ends(
    client: RobotClient, domain_id: int, setup_files: dict[str, str]
) -> None:
    reporter = 'triangulation_localizer'
    parameters = {'robot_file': setup_files['robot_file'], 'relocalization.search_s': 600.0}
    node = subprocess.Popen(node_command(reporter, **parameters), env=node_environment(domain_id))
    try:
        publishers = [client.advertise(topic) for topic in ('landmarks', 'landmarks/atlas')]
        messages = encode.landmark_map(ros_factory, small_map(), 1)
        for publisher, message in zip(publishers, messages, strict=False):
            publisher.publish(message)
        client.wait(
            lambda: 'no image' in client.status_of(reporter).reason, 30.0, 'the map to arrive'
        )
        words: list[Any] = []
        client.listen('/diagnostics', words.append)
        clients = [client._node.create_client(Trigger, 'relocalize') for _ in range(2)]
        answers: list[Any] = []
        for caller in clients:
            client.wait(caller.service_is_ready, 30.0, 'the service')
            with ServiceDiscovery(client._node, 'relocalize') as acquaintance:
                client.wait(acquaintance.is_complete, 30.0, 'the node to know its client')
            answers.append(caller.call_async(Trigger.Request()))
        client.wait(lambda: len(words) > 6, 30.0, 'the node to go on')
        assert not any(answer.done() for answer in answers)
        node.send_signal(signal.SIGINT)
        client.wait(lambda: all(answer.done() for answer in answers), 30.0, 'the answers')
        assert node.wait(30.0) == 0
        for answer in answers:
            assert answer.result().message.startswith('the search ends with this node')
    finally:
        node.kill()
        node.wait()


def test_fusion_goes_on_through_bad_input(
    start: Callable[..., None], client: RobotClient, setup_files: dict[str, str]
) -> None:
    start('odometry_fusion', robot_file=setup_files['robot_file'])
    client.wait(lambda: client.status_of('odometry_fusion').lost, 30.0, 'the word lost')
    odometry = client.advertise('odom')
    stamp = 1_000_000_000_000
    sent = 0

    def send(x: float) -> None:
        nonlocal sent
        sent += 1
        sample = OdometrySample(stamp + sent * 50_000_000, np.array([x, 0.0, 0.0]))
        odometry.publish(encode.odometry(ros_factory, sample))

    def after(condition: Callable[[], bool], x: float) -> Callable[[], bool]:
        def check() -> bool:
            send(x)
            return condition()

        return check

    estimate = PoseEstimate(stamp, np.array([2.0, 1.0, 0.0]), 1e-4 * np.eye(3))
    client.wait(odometry.get_subscription_count, 20.0, 'the fusion')
    send(0.0)
    client.start_at(estimate)
    client.wait(after(lambda: client.fused is not None, 0.0), 20.0, 'a fused pose')

    def complains() -> bool:
        return 'not a number' in client.status_of('odometry_fusion').reason

    client.wait(after(complains, float('nan')), 20.0, 'a complaint about NaN')
    client.fused = None
    client.wait(after(lambda: client.fused is not None, 0.0), 20.0, 'another fused pose')
    fused: Any = client.fused
    np.testing.assert_allclose(fused.pose, [2.0, 1.0, 0.0], atol=0.01)


def test_start_in_another_frame_is_refused(
    start: Callable[..., None], client: RobotClient, setup_files: dict[str, str]
) -> None:
    start('odometry_fusion', robot_file=setup_files['robot_file'])
    publisher = client.advertise('initialpose')
    client.wait(publisher.get_subscription_count, 20.0, 'the fusion')
    client.wait(lambda: 'odometry_fusion' in client.status, 20.0, 'its diagnostics')
    message = encode.pose(ros_factory, PoseEstimate(1, np.zeros(3), np.eye(3)), 'odom')
    log = client_log(setup_files)

    def refused() -> bool:
        # A subscription that does not know its publisher yet misses the message.
        publisher.publish(message)
        return "conductor dropped: it is in frame 'odom'" in log.read_text()

    client.wait(refused, 20.0, 'it')
    landmarks = [client.advertise(topic) for topic in ('landmarks', 'landmarks/atlas')]
    elsewhere = replace(small_map(), frame_id='hall')
    cloud, atlas, _ = encode.landmark_map(ros_factory, elsewhere, 1)
    for publisher, message in zip(landmarks, (cloud, atlas), strict=True):
        publisher.publish(message)
    client.wait(lambda: "dropped: it is in frame 'hall'" in log.read_text(), 20.0, 'a warning')
    assert client.status_of('odometry_fusion').values['landmarks'] == '0'


def client_log(setup_files: dict[str, str]) -> Path:
    return Path(setup_files['robot_file']).parent / 'logs' / 'odometry_fusion.log'
