"""Nodes as processes start, report, end cleanly and by status; clocks of their timers."""

from pathlib import Path
import signal

from graph import small_map
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import get_typestore, Stores

from landmark_nav.demo.supervisor import node_commands
from landmark_nav.errors import LandmarkNavError
from landmark_nav.ros.robot_client import ServiceDiscovery
from landmark_nav.storage.maps import save_map

NODES = {
    'landmark_learner': ('room_file',),
    'odometry_fusion': ('robot_file',),
    'panorama_synthesizer': ('robot_file', 'room_file'),
    'room_simulator': ('robot_file',),
    'sweep_capture': ('robot_file',),
    'triangulation_localizer': ('robot_file',),
    'triplet_selector': ('robot_file',),
}


def test_all_start_and_end_cleanly(start, supervisor, client, setup_files, tmp_path):
    for name, needed in NODES.items():
        start(name, **{key: setup_files[key] for key in needed})
    client.wait(lambda: set(NODES) <= client.status.keys(), 60.0, 'the diagnostics of all')
    supervisor.check()
    assert supervisor.stop(signal.SIGINT) == dict.fromkeys(NODES, 0)
    logs = {name: (tmp_path / 'logs' / f'{name}.log').read_text() for name in NODES}
    assert [name for name, text in logs.items() if 'Traceback' in text] == []
    for name, needed in NODES.items():
        (ready,) = [line for line in logs[name].splitlines() if 'ready: ' in line]
        assert all(setup_files[key] in ready for key in needed)


@pytest.mark.parametrize(
    ('node', 'parameter', 'words'),
    [
        ('sweep_capture', 'use_sim_time:=false', 'robot_file of sweep_capture is not set'),
        ('sweep_capture', 'capture.frames:=many', 'wrong type'),
        ('bag_player', 'bag:=/nowhere', '/nowhere: '),
        ('all_nodes', 'robot_file:=nowhere.yaml', 'nowhere.yaml: cannot be read'),
    ],
)
def test_what_cannot_run_states_why(node, parameter, words, run_main):
    status, (line,) = run_main(node, '-p', parameter)
    assert status == 1
    assert words in line


def test_a_bag_of_ros_1_is_played(tmp_path, run_main):
    store = get_typestore(Stores.ROS1_NOETIC)
    kind = 'std_msgs/msg/String'
    with Writer(tmp_path / 'notes.bag') as bag:
        notes = bag.add_connection('/note', kind, typestore=store)
        bag.write(notes, 5, store.serialize_ros1(store.types[kind]('a'), kind))
    status, reported = run_main('bag_player', '-p', f'bag:={tmp_path / "notes.bag"}')
    assert status == 0, reported
    assert 'is played' in '\n'.join(reported)


FUSION, LEARNER = 'odometry_fusion', 'landmark_learner'
MANAGED = {'autostart': False}


class Manager:
    """What Nav2's lifecycle manager does to a node, without a bond."""

    def __init__(self, client, node):
        self._client, self._node = client, node
        made = client._node
        self._change = made.create_client(ChangeState, f'{node}/change_state')
        self._state = made.create_client(GetState, f'{node}/get_state')
        client.wait(self._change.service_is_ready, 60.0, 'the services of the lifecycle')
        client.wait(self._state.service_is_ready, 60.0, 'the services of the lifecycle')
        # Otherwise an answer may be lost.
        with ServiceDiscovery(made, f'{node}/change_state') as discovery:
            client.wait(discovery.is_complete, 60.0, 'the node to know its manager')

    def __call__(self, step):
        request = ChangeState.Request(transition=Transition(id=step))
        answer = self._change.call_async(request)
        self._client.wait(answer.done, 30.0, 'the transition')
        return bool(answer.result().success)

    @property
    def state(self):
        answer = self._state.call_async(GetState.Request())
        self._client.wait(answer.done, 30.0, 'the state')
        return str(answer.result().current_state.label)

    def publishes(self, topic):
        known = self._client._node.get_publishers_info_by_topic(topic)
        return any(one.node_name == self._node for one in known)


def test_a_node_is_configured_paused_reset_and_shut_down(start, supervisor, client, setup_files):
    start(FUSION, robot_file=setup_files['robot_file'], **MANAGED)
    manager = Manager(client, FUSION)
    assert manager.state == 'unconfigured'
    assert not manager.publishes('/odometry/fused')
    for _ in range(2):
        assert manager(Transition.TRANSITION_CONFIGURE)
        assert manager.state == 'inactive'
        client.wait(lambda: manager.publishes('/odometry/fused'), 30.0, 'its topics')
        for _ in range(2):
            assert manager(Transition.TRANSITION_ACTIVATE)
            assert manager.state == 'active'
            assert manager(Transition.TRANSITION_DEACTIVATE)
        assert manager(Transition.TRANSITION_CLEANUP)
        assert manager.state == 'unconfigured'
        client.wait(lambda: not manager.publishes('/odometry/fused'), 30.0, 'their end')
    client.wait(lambda: 'unconfigured' in client.status_of(FUSION).reason, 30.0, 'its report')
    assert manager(Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)
    assert manager.state == 'finalized'
    supervisor.check()
    assert supervisor.stop(signal.SIGTERM) == {FUSION: 0}


def test_a_node_that_cannot_be_configured_says_why_and_can_be_tried_again(
    start, client, supervisor, tmp_path
):
    robot = tmp_path / 'late.yaml'
    start(FUSION, robot_file=str(robot), **MANAGED)
    manager = Manager(client, FUSION)
    assert not manager(Transition.TRANSITION_CONFIGURE)
    assert manager.state == 'unconfigured'
    assert 'late.yaml: cannot be read' in (tmp_path / 'logs' / f'{FUSION}.log').read_text()
    robot.write_text('pan_axis:\n  xyz: [0.08, 0.0, 1.1]\n')
    assert manager(Transition.TRANSITION_CONFIGURE)
    assert manager(Transition.TRANSITION_ACTIVATE)
    client.wait(lambda: 'lifecycle' not in client.status_of(FUSION).reason, 30.0, 'an active node')


def test_an_inactive_node_refuses_services_and_keeps_what_comes_once(
    start, client, setup_files, tmp_path
):
    save_map(small_map(), tmp_path / 'map')
    start(FUSION, robot_file=setup_files['robot_file'], **MANAGED)
    manager = Manager(client, FUSION)
    assert manager(Transition.TRANSITION_CONFIGURE)
    start(LEARNER, room_file=setup_files['room_file'], map_folder=str(tmp_path / 'map'), **MANAGED)
    learner = Manager(client, LEARNER)
    assert learner(Transition.TRANSITION_CONFIGURE)
    with pytest.raises(LandmarkNavError, match='landmark_learner is inactive: activate it'):
        client.call('load_map', 30.0)
    assert learner(Transition.TRANSITION_ACTIVATE)
    assert 'landmarks loaded' in client.call('load_map', 30.0)
    # The map comes to an inactive node, and nobody sends it again.
    client.pause(2.0)
    assert manager(Transition.TRANSITION_ACTIVATE)
    client.wait(
        lambda: int(client.status_of(FUSION).values.get('landmarks', 0)) > 0, 30.0, 'the map'
    )


def test_all_nodes_run_in_one_process(supervisor, client, setup_files, tmp_path):
    files = {key: Path(value) for key, value in setup_files.items()}
    apart = node_commands(**files, map_folder=tmp_path / 'map')
    (name,) = together = node_commands(**files, map_folder=tmp_path / 'map', composed=True)
    supervisor.start(name, together[name])
    client.wait(lambda: apart.keys() <= client.status.keys(), 60.0, 'the diagnostics of all')
    assert supervisor.stop(signal.SIGTERM) == {name: 0}
    log = (tmp_path / 'logs' / f'{name}.log').read_text()
    assert 'Traceback' not in log
    assert all(f'[{node}]: ready' in log for node in apart)
