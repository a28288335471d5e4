"""Services and bad input: nodes answer with a reason and go on."""

from dataclasses import replace
import shutil
import signal
import subprocess
import time
from typing import Any

from graph import map_sender, small_map
import numpy as np
import pytest
import rclpy
from std_srvs.srv import Trigger

from landmark_nav.demo.supervisor import node_command, node_environment
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages import encode
from landmark_nav.nodes.landmark_learner import LandmarkLearnerNode
from landmark_nav.ros.robot_client import ServiceDiscovery
from landmark_nav.ros.topics import ros_factory
from landmark_nav.storage.maps import load_map, save_map
from landmark_nav.storage.setup_files import load_room
from landmark_nav.types import JointSample, OdometrySample


def test_learner_states_what_is_missing(start, client, setup_files, tmp_path):
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


def test_one_stamp_that_is_off_costs_the_learner_no_odometry(graph, setup_files):
    node = graph.make(LandmarkLearnerNode, robot_file=setup_files['robot_file'])
    take = node.guarded('odom', node._unmeasured._on_odometry)
    for k in (*range(20), 5000, *range(20, 40), -5000, *range(40, 60)):
        take(encode.odometry(ros_factory, OdometrySample((10_000 + k) * 10**8, np.zeros(3))))
    assert [one.stamp_ns // 10**8 - 10_000 for one in node._unmeasured._odometry] == [*range(60)]
    assert node._dropped == {'odom': 2}
    for k in range(2):  # the clock was set back
        take(encode.odometry(ros_factory, OdometrySample((5_000 + k) * 10**8, np.zeros(3))))
    assert len(node._unmeasured._odometry) == 1
    with pytest.raises(LandmarkNavError, match='two panoramas from different places, not 0'):
        node._learn()


def test_a_panorama_in_the_making_is_told_to_who_wants_to_learn(graph, setup_files):
    node = graph.make(LandmarkLearnerNode, room_file=setup_files['room_file'])
    with pytest.raises(LandmarkNavError, match=r'^learning needs two panoramas'):
        node._learn()
    samples = [JointSample((100 + k) * 10**8, 0.1 * k) for k in range(3)]
    swept = encode.sweep_trajectory(ros_factory, samples, PanTiltMount())
    graph.add(rclpy.create_node('sweeper', context=graph.context))
    taker = graph.nodes[-1].create_publisher(type(swept), 'sweep/trajectory', 10)
    graph.executor.add_node(node)
    graph.until(lambda: node._swept_ns > 0, lambda: taker.publish(swept))
    with pytest.raises(LandmarkNavError, match='last sweep is still in the making'):
        node._learn()


def test_a_map_of_another_room_is_reported(start, client, setup_files, tmp_path):
    folder, node, room = tmp_path / 'map', 'landmark_learner', setup_files['room_file']

    def save(scale, frame):
        ends = {'start': lambda w: w.start, 'end': lambda w: w.end}
        walls = tuple(
            replace(w, **{k: tuple(scale * v for v in end(w)) for k, end in ends.items()})
            for w in load_room(room).walls
        )
        save_map(replace(small_map(), walls=walls, frame_id=frame), folder)

    save(1.5, 'map')
    start(node, room_file=room, map_folder=str(folder), load_on_start=True)
    client.wait(lambda: 'no wall of the one' in client.status_of(node).reason, 30.0, 'the map')
    files = f'{folder} and {room} are of different rooms: '
    for scale, frame, why in (
        (1.5, 'map', 'no wall of the one'),
        (1.03, 'map', ''),
        (1.0, 'hall', "'hall' and 'map'"),
    ):
        save(scale, frame)
        answers = [client.call(service, 10.0) for service in ('load_map', 'save_map')]
        client.wait(
            lambda why=why: why in (reason := client.status_of(node).reason)
            and ('different rooms' in reason) == bool(why), 20.0, 'its health',
        )  # fmt: skip
        for answer in answers:
            assert ('different rooms' in answer) == bool(why)
            assert not why or files + why in answer


def test_localizer_states_what_it_lacks(start, client, setup_files):
    reporter = 'triangulation_localizer'
    robot = setup_files['robot_file']
    start(reporter, robot_file=robot, **{'relocalization.search_s': 0.5})
    with pytest.raises(LandmarkNavError, match='no landmarks: call learn_landmarks or load_map'):
        client.call('relocalize', 30.0)
    send_map = map_sender(client)
    send_map(replace(small_map(), frame_id='hall'))
    wrong = "landmarks dropped: it is in frame 'hall', not in frame map: set map_frame to it"
    client.wait(lambda: wrong in client.status_of(reporter).reason, 20.0, 'word of the frame')
    send_map(small_map())
    client.wait(lambda: 'no image' in client.status_of(reporter).reason, 20.0, 'the map to arrive')
    with pytest.raises(LandmarkNavError, match=r'within 0.5 s \(no image came\).*initialpose'):
        client.call('relocalize', 30.0)

    images, joints = client.advertise('camera/image_raw'), client.advertise('joint_states')
    camera_image = np.zeros((60, 80), dtype=np.uint8)

    def answer(words, late_ns):
        def check():
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
    client, domain_id, setup_files
):
    reporter = 'triangulation_localizer'
    parameters = {'robot_file': setup_files['robot_file'], 'relocalization.search_s': 600.0}
    node = subprocess.Popen(node_command(reporter, **parameters), env=node_environment(domain_id))
    try:
        map_sender(client)(small_map())
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
