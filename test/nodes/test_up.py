"""`landmark-nav up`, `call`, `status`, `drive`: a robot brought up without ``ros2``."""

from contextlib import suppress
import os
import pty
import signal
import subprocess
import sys
import time

import pytest

from landmark_nav.cli.main import main
from landmark_nav.demo.supervisor import node_environment

COMMAND = [sys.executable, '-m', 'landmark_nav']
NODES = [
    *('landmark_learner', 'odometry_fusion', 'panorama_synthesizer', 'room_simulator'),
    *('sweep_capture', 'triangulation_localizer', 'triplet_selector'),
]


def output_of(command, domain_id):
    """Exit status and lines of a command that ends by itself."""
    done = subprocess.run(
        [*COMMAND, *command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        timeout=120, env=node_environment(domain_id), check=False,
    )  # fmt: skip
    return done.returncode, done.stdout.strip().splitlines()


@pytest.fixture
def robot(domain_id, tmp_path):
    with (tmp_path / 'up.log').open('wb') as log:
        process = subprocess.Popen(
            [*COMMAND, 'up', '--sim', '--map', str(tmp_path / 'map')],
            env=node_environment(domain_id),
            stdout=log,
            stderr=log,
        )
    yield process
    process.kill()
    process.wait()


def test_a_robot_is_brought_up_called_driven_and_ended(robot, domain_id, tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    deadline = time.monotonic() + 60.0
    reported: list[str] = []
    while reported != NODES and time.monotonic() < deadline:
        assert robot.poll() is None, (tmp_path / 'up.log').read_text()
        _, lines = output_of(['status'], domain_id)
        heard = [line for line in lines if line[0] != ' ' and 'SILENT' not in line]
        reported = [line.split()[0] for line in heard]
    assert reported == NODES

    # No sweep was taken: refused, with a reason, in one line.
    code, lines = output_of(['call', 'learn_landmarks'], domain_id)
    assert (code, len(lines)) == (1, 1)

    from landmark_nav.ros.robot_client import RobotClient

    with RobotClient(domain_id, drives=False) as client:
        client.wait(lambda: client.odometry is not None, 30.0, 'odometry')
        keyboard, terminal = pty.openpty()
        os.set_blocking(keyboard, False)
        driver = subprocess.Popen(
            [*COMMAND, 'drive'], env=node_environment(domain_id), stdin=terminal, stdout=terminal,
            stderr=terminal,
        )  # fmt: skip
        try:

            def turned():
                os.write(keyboard, b'a')
                with suppress(BlockingIOError):
                    os.read(keyboard, 2**16)
                assert driver.poll() is None
                return client.odometry is not None and abs(client.odometry.pose_odom_base[2]) > 0.1

            client.wait(turned, 60.0, 'a turn')
            os.write(keyboard, b'x')
            assert driver.wait(30.0) == 0
        finally:
            driver.kill()
            os.close(keyboard)
            os.close(terminal)

    robot.send_signal(signal.SIGINT)
    assert robot.wait(30.0) == 130
    assert 'Traceback' not in (tmp_path / 'up.log').read_text()


def test_a_node_that_is_not_heard_is_listed(start, client, setup_files, domain_id):
    start('odometry_fusion', robot_file=setup_files['robot_file'])
    client.wait(lambda: bool(client.status_of('odometry_fusion').level), 30.0, 'the node')
    _, lines = output_of(['status', '--once'], domain_id)
    levels = dict(line.split()[:2] for line in lines if line[0] != ' ')
    assert levels['triangulation_localizer'] == 'SILENT'
    assert levels['odometry_fusion'] != 'SILENT'


@pytest.mark.parametrize(
    'command', [['up'], ['up', '--room', 'room.yaml'], ['drive'], ['call', 'cook']]
)
def test_wrong_usage(command):
    assert main(command) == 2
