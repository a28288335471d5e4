"""Fixtures of node tests: a ROS domain for each test, processes that end with it, a client."""

import fcntl
from importlib import import_module
from importlib.util import find_spec
from itertools import count
import logging
import os
from pathlib import Path
import subprocess
import tempfile

import pytest

from landmark_nav.demo.supervisor import node_command, node_environment, Supervisor

_NUMBER = count(7 * os.getpid())


class _WithoutRos(pytest.Module):
    """Tests of a machine on which nothing of ROS 2 can be imported."""

    def collect(self):
        pytest.skip('ROS 2 is not installed', allow_module_level=True)


def pytest_pycollect_makemodule(module_path, parent):
    return None if find_spec('rclpy') else _WithoutRos.from_parent(parent, path=module_path)


@pytest.fixture(autouse=True)
def _logging(monkeypatch):
    """A node that runs here logs to ROS until it ends."""
    package = logging.getLogger('landmark_nav')
    for name in ('handlers', 'propagate', 'level'):
        monkeypatch.setattr(package, name, getattr(package, name))


@pytest.fixture
def domain_id():
    """A domain that no other test on this machine uses, below the ephemeral ports."""
    for number in _NUMBER:
        domain = 10 + number % 88
        try:
            with (Path(tempfile.gettempdir()) / f'ros_domain_{domain}.lock').open('w') as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                yield domain
                return
        except OSError:
            continue


@pytest.fixture
def supervisor(domain_id, tmp_path):
    with Supervisor(tmp_path / 'logs', node_environment(domain_id)) as started:
        yield started


@pytest.fixture
def start(supervisor):
    """Start a node as a process, with its parameter file and what is given."""

    def start_node(name, **parameters):
        supervisor.start(name, node_command(name, **parameters))

    return start_node


@pytest.fixture(scope='session')
def learned_map(once):
    """Folder of what is learned of the recorded room; figures take a sixth of the time."""
    from harness import BAGS, learn

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('landmark_nav.cli.learn._draw', lambda *_: None)
        return once('learned', lambda out: learn(BAGS, out / 'map')) / 'map'


@pytest.fixture
def play(domain_id):
    """Play a bag in a process of its own."""
    players = []

    def play_bag(bag, rate=1.0):
        command = node_command('bag_player', bag=str(bag), rate=rate)
        players.append(subprocess.Popen(command, env=node_environment(domain_id)))
        return players[-1]

    yield play_bag
    for player in players:
        player.kill()
        player.wait()


@pytest.fixture
def client(domain_id, supervisor, monkeypatch):
    # Only here: without ROS these fixtures must still be importable.
    from landmark_nav.ros.robot_client import RobotClient

    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    with RobotClient(domain_id, supervisor.check) as joined:
        yield joined


@pytest.fixture
def graph(domain_id):
    from graph import Graph

    made = Graph(domain_id)
    yield made
    made.close()


@pytest.fixture
def setup_files(tmp_path):
    """Paths of a `robot_file` and a `room_file`."""
    robot, room = tmp_path / 'robot.yaml', tmp_path / 'room.yaml'
    robot.write_text('pan_axis:\n  xyz: [0.08, 0.0, 1.1]\n')
    corners = [(0.0, 0.0), (6.0, 0.0), (6.0, 4.0), (0.0, 4.0)]
    walls = [
        f'- {{id: w{k}, start: {list(a)}, end: {list(b)}, height: 2.6}}'
        for k, (a, b) in enumerate(zip(corners, corners[1:] + corners[:1], strict=True))
    ]
    room.write_text('\n'.join(['walls:', *walls, '']))
    return {'robot_file': str(robot), 'room_file': str(room)}


@pytest.fixture
def run_main(monkeypatch, domain_id, capfd):
    """Run a node here, until it ends by itself; its exit status and the lines that it wrote."""
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain_id))
    # It would end the tests.
    monkeypatch.setattr('landmark_nav.ros.run._GRACE_S', 600.0)

    def run(name, *arguments):
        monkeypatch.setattr('sys.argv', [name, '--ros-args', *arguments])
        status = import_module(f'landmark_nav.nodes.{name}').main()
        return status, capfd.readouterr().err.strip().splitlines()

    return run
