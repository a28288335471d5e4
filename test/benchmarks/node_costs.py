"""
What the nodes cost beside their work: idle, and for images that are received and decoded.

``python test/benchmarks/node_costs.py`` starts the nodes of a simulated robot without the robot,
apart and in one process, and reads their computing time and memory from /proc. Then one process
publishes mono8 images of 640 x 480 pixels at 30 Hz, and a node takes them as the localizer does:
subscription, guard, `decode.camera_image`. Where the robot drives is measured by `latency`.
Ends with 1 if an idle node takes over 3 % of a core, or images over 15 % or 2 ms each.
"""

import argparse
import os
from pathlib import Path
import subprocess
import sys
import tempfile
from threading import Thread
import time

import numpy as np

from landmark_nav.demo.scenario import prepare_room
from landmark_nav.demo.supervisor import node_commands, node_environment, Supervisor

RATE_HZ, SHAPE = 30.0, (480, 640)
MAX_IDLE, MAX_SHARE, MAX_MS = 0.03, 0.15, 2.0
START_S = 8.0


def used(process):
    """Computing time, s, and resident memory, MB."""
    folder = Path(f'/proc/{process.pid}')
    fields = (folder / 'stat').read_text().rpartition(')')[2].split()
    pages = int((folder / 'statm').read_text().split()[1])
    ticks = (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')
    return ticks, 1e-6 * pages * os.sysconf('SC_PAGE_SIZE')


def shares(commands, seconds, environment):
    """Share of a core and memory, MB, of each process."""
    with tempfile.TemporaryDirectory() as logs, Supervisor(Path(logs), environment) as nodes:
        running = {name: nodes.start(name, command) for name, command in commands.items()}
        time.sleep(START_S)
        before, begin = {name: used(one)[0] for name, one in running.items()}, time.monotonic()
        time.sleep(seconds)
        nodes.check()
        took = time.monotonic() - begin
        after = {name: used(one) for name, one in running.items()}
    return {name: ((cpu - before[name]) / took, memory) for name, (cpu, memory) in after.items()}


def send():
    """Publish images until the process is ended."""
    from landmark_nav.messages import encode
    from landmark_nav.ros.robot_client import RobotClient
    from landmark_nav.ros.topics import ros_factory

    pixels = np.random.default_rng(0).integers(0, 255, SHAPE, np.uint8)
    with RobotClient(int(os.environ['ROS_DOMAIN_ID']), lambda: None) as client:
        publisher = client.advertise('camera/image_raw')
        due = time.monotonic()
        while True:
            publisher.publish(encode.image(ros_factory, pixels, time.time_ns(), 'camera'))
            due += 1.0 / RATE_HZ
            time.sleep(max(due - time.monotonic(), 0.0))


def receive():
    """Take images as a node does; after a while print how many, CPU a message and age."""
    from landmark_nav.messages import decode
    from landmark_nav.ros.camera_frames import ImageSource
    from landmark_nav.ros.health import Health, Level
    from landmark_nav.ros.node import LandmarkNode
    from landmark_nav.ros.run import run_node

    class Receiver(LandmarkNode):
        def set_up(self):
            self.ages_ms: list[float] = []
            self.took_ms: list[float] = []
            ImageSource(self, 'camera/image_raw', self._take, 'raw', depth=2)

        def health(self):
            return Health(Level.OK, 'receives')

        def _take(self, message):
            begin = time.thread_time()
            decode.image(message, grey=True)
            self.took_ms.append(1e3 * (time.thread_time() - begin))
            self.ages_ms.append(1e-6 * (time.time_ns() - decode.stamp_ns(message.header)))

    made: list[Receiver] = []

    def make():
        made.append(Receiver('receiver', 'test'))
        Thread(target=watch, args=(made[0],), daemon=True).start()
        return made[0]

    def watch(node):
        time.sleep(3.0)
        first, cpu, begin = len(node.ages_ms), time.process_time(), time.monotonic()
        time.sleep(float(os.environ['SECONDS']))
        spent, took = time.process_time() - cpu, time.monotonic() - begin
        ages = np.array(node.ages_ms[first:])
        median, p99 = np.percentile(ages, [50, 99])
        print(
            f'{len(ages) / took:.1f} images/s: {100 * spent / took:.1f} % of a core, '
            f'{1e3 * spent / len(ages):.2f} ms CPU each (decoding '
            f'{np.median(node.took_ms):.2f}), stamp to callback p50 {median:.1f}, p99 {p99:.1f} ms'
        )
        passed = spent / took <= MAX_SHARE and 1e3 * spent / len(ages) <= MAX_MS
        os._exit(0 if passed else 1)

    return run_node(make)


def main():
    """Measure and judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=20.0)
    parser.add_argument('--role', choices=('send', 'receive'), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.role:
        role = arguments.role
        sys.argv = sys.argv[:1]
        return receive() if role == 'receive' else int(bool(send()))
    environment = node_environment(int(os.environ.get('ROS_DOMAIN_ID', '77')))
    environment['SECONDS'] = str(arguments.seconds)
    idle = 0.0
    with tempfile.TemporaryDirectory() as folder:
        room = prepare_room(Path(folder), 1)
        for composed in (False, True):
            commands = node_commands(
                room.robot_file, room.room_file, Path(folder) / 'map', composed=composed
            )
            for name, (share, memory) in shares(commands, arguments.seconds, environment).items():
                print(f'idle {name:24} {100 * share:5.2f} % of a core, {memory:4.0f} MB')
                idle = max(idle, share if not composed else 0.0)
    role = [sys.executable, __file__, '--role']
    sender = subprocess.Popen([*role, 'send'], env=environment)
    try:
        status = subprocess.run([*role, 'receive'], env=environment, check=False).returncode
    finally:
        sender.kill()
        sender.wait()
    return int(status != 0 or idle > MAX_IDLE)


if __name__ == '__main__':
    sys.exit(main())
