"""Robot and base station on two hosts (network namespaces): the link is cut, and loses packets."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
import shutil
import subprocess
import sys
import textwrap
import time

import pytest

from landmark_nav.demo.graph import node_command, node_environment
from landmark_nav.demo.supervisor import Supervisor
from landmark_nav.storage.bags import Bag

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

RECORDED = Path(__file__).resolve().parents[2] / 'bags'
ROBOT = str(RECORDED / 'robot.yaml')
CUT_S, LOSS_S, AFTER_S = 10.0, 6.0, 3.0
BACK_NS = 2_000_000_000
RECORDED_THERE = ['odometry/fused', 'camera/image_raw/compressed', '/diagnostics']

# Of 2^32 random numbers those below go on: 70 %. See bpf-helpers(7), `tc-bpf`; TC_ACT_SHOT is 2.
LOSS = f'4,32 0 0 4294963256,53 0 1 {2**32 * 30 // 100},6 0 0 4294967295,6 0 0 2'

# On the robot it drives in a circle; on the base station it says when the place is known.
OBSERVER = """
    import sys
    from contextlib import suppress
    from pathlib import Path
    from landmark_nav.demo.interruption import Interruption
    from landmark_nav.ros.robot_client import RobotClient

    drives, folder, *topics = sys.argv[1:]
    with Interruption() as interruption, RobotClient(watch=interruption.check) as client:
        with client.recording(Path(folder), topics):
            def known():
                word = client.status_of('odometry_fusion')
                return bool(word.values) and not word.lost and client.fixes > 10

            # A recording that ends by an error is not kept.
            with suppress(KeyboardInterrupt):
                if drives == 'drives':
                    client.wait(lambda: client.drive(0.1, 0.2), 600.0, 'the end')
                client.wait(known, 600.0, 'the place')
                print('known', flush=True)
                client.wait(lambda: False, 600.0, 'the end')
"""


class Host:
    """A network of its own, and memory that it shares with no other, as long as it lives."""

    def __init__(self, address: str) -> None:
        memory = 'mount -t tmpfs tmpfs /dev/shm && ip link set lo up && echo up && exec sleep 300'
        command = ['unshare', '--net', '--mount', 'sh', '-c', memory]
        self._holder = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self.address, self.id = address, str(self._holder.pid)
        self.enter = ['nsenter', f'--target={self.id}', '--net', '--mount', '--']
        assert self._holder.stdout is not None
        if self._holder.stdout.readline() != 'up\n':
            pytest.skip(f'no network namespaces here: {self._holder.communicate()[1].strip()}')

    def do(self, command: str) -> None:
        """Run a command there."""
        run([*self.enter, *command.split()])

    def lose(self, bytecode: str) -> None:
        """Let a classic BPF program decide what of that which arrives is taken."""
        self.do('tc qdisc replace dev wire clsact')
        tc = ['tc', 'filter', 'add', 'dev', 'wire', 'ingress', 'bpf', 'da', 'bytecode']
        run([*self.enter, *tc, bytecode])

    def end(self) -> None:
        self._holder.kill()
        self._holder.communicate()


def run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, timeout=20)
    if done.returncode:
        raise OSError(f'{" ".join(command)}: {done.stderr.strip()}')


@pytest.fixture
def hosts() -> Iterator[tuple[Host, Host]]:
    """The robot's and the base station's, linked."""
    missing = [tool for tool in ('ip', 'nsenter', 'tc', 'unshare') if shutil.which(tool) is None]
    if missing:
        pytest.skip(f'{", ".join(missing)} of iproute2, util-linux not installed')
    with ExitStack() as stack:
        ends = []
        for address in ('10.9.0.1/24', '10.9.0.2/24'):
            ends.append(Host(address))
            stack.callback(ends[-1].end)
        robot, base = ends
        link = f'ip link add name wire netns {robot.id} type veth peer name wire netns {base.id}'
        try:
            run(link.split())
        except OSError as error:
            pytest.skip(f'no links between network namespaces here: {error}')
        for host in ends:
            host.do(f'ip address add {host.address} dev wire')
            host.do('ip link set wire up')
            # As docs/networks.md advises: what is left of incomplete images is soon forgotten.
            run([*host.enter, 'sh', '-c', 'echo 1 > /proc/sys/net/ipv4/ipfrag_time'])
        yield robot, base


def test_a_link_that_is_cut_or_loses_packets_is_survived(
    hosts: tuple[Host, Host], learned_map: Path, tmp_path: Path, domain_id: int
) -> None:
    robot, base = hosts
    room, camera = str(RECORDED / 'room.yaml'), {'image_transport': 'compressed'}
    learner = {'room_file': room, 'map_folder': str(learned_map), 'load_on_start': True}
    nodes = {
        'room_simulator': (robot, {'seed': 7, 'robot_file': ROBOT, 'image_rate_hz': 15.0}),
        'sweep_capture': (robot, {'robot_file': ROBOT, **camera}),
        'panorama_synthesizer': (base, {'robot_file': ROBOT, 'room_file': room}),
        'landmark_learner': (base, learner),
        'triplet_selector': (base, {'robot_file': ROBOT}),
        'triangulation_localizer': (base, {'robot_file': ROBOT, **camera}),
        'odometry_fusion': (base, {'robot_file': ROBOT}),
    }
    observers = {
        'driver': (robot, 'drives', ['odom']),
        'base': (base, 'stays', RECORDED_THERE),
    }
    environment = node_environment(domain_id) | {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}
    with Supervisor(tmp_path / 'logs', environment) as processes:

        def wait(seconds: float) -> None:
            time.sleep(seconds)
            processes.check()

        for name, (host, parameters) in nodes.items():
            processes.start(name, [*host.enter, *node_command(name, **parameters)])
        script = textwrap.dedent(OBSERVER)
        for name, (host, does, topics) in observers.items():
            arguments = [does, str(tmp_path / name), *topics]
            processes.start(name, [*host.enter, sys.executable, '-c', script, *arguments])
        deadline = time.monotonic() + 60.0
        while 'known' not in (tmp_path / 'logs' / 'base.log').read_text():
            assert time.monotonic() < deadline, 'the place is not found'
            wait(0.2)
        cut_ns = time.time_ns()
        robot.do('ip link set wire down')
        wait(CUT_S)
        robot.do('ip link set wire up')
        returns_ns = [time.time_ns()]
        wait(AFTER_S)
        try:
            for host in hosts:
                host.lose(LOSS)
        except OSError as error:
            print(f'without loss of packets: {error}')
        else:
            wait(LOSS_S)
            for host in hosts:
                host.do('tc qdisc del dev wire clsact')
            returns_ns.append(time.time_ns())
            wait(AFTER_S)
        statuses = processes.stop()
    assert {name: statuses[name] for name in nodes} == dict.fromkeys(nodes, 0)
    judge(Bag(tmp_path / 'base'), cut_ns, returns_ns)


def judge(base: Bag, cut_ns: int, returns_ns: list[int]) -> None:
    """It said that it was lost while nothing came, and soon after each return all came again."""
    arrived: dict[str, list[int]] = {topic.lstrip('/'): [] for topic in RECORDED_THERE}
    lost_ns = []
    for entry in base.messages():
        topic = entry.topic.lstrip('/')
        arrived[topic].append(entry.stamp_ns)
        for status in entry.message.status if topic == 'diagnostics' else ():
            # DiagnosticStatus.ERROR, which rosbags reads as a number.
            if status.name.startswith('odometry_fusion:') and int(status.level) == 2:
                lost_ns.append(entry.stamp_ns)
    assert any(cut_ns < stamp < returns_ns[0] for stamp in lost_ns)
    for topic in ('odometry/fused', 'camera/image_raw/compressed'):
        assert not [k for k in arrived[topic] if cut_ns + BACK_NS < k < returns_ns[0]]
        for back_ns in returns_ns:
            assert any(back_ns < stamp < back_ns + BACK_NS for stamp in arrived[topic]), topic
