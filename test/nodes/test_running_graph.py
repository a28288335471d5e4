"""Running nodes survive restarts, another map, a replayed bag and a wrong start, over DDS."""

from contextlib import contextmanager
from dataclasses import replace
import json
import subprocess
import sys
from typing import Any

from graph import is_right, map_sender, off
from harness import BAGS
import numpy as np

from landmark_nav.demo.supervisor import node_environment
from landmark_nav.evaluation.learning_report import truth_of_bag
from landmark_nav.messages.clouds import Layout, unpack_cloud
from landmark_nav.ros.topics import message_class
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.maps import load_map
from landmark_nav.types import PoseEstimate

ROBOT = str(BAGS / 'robot.yaml')
FUSION, LOCALIZER, SELECTOR = 'odometry_fusion', 'triangulation_localizer', 'triplet_selector'


@contextmanager
def fusion(domain_id):
    """Run the fusion in a process that may end before the others."""
    command = [sys.executable, '-m', f'landmark_nav.nodes.{FUSION}', '--ros-args']
    command += ['-p', f'robot_file:={json.dumps(ROBOT)}', '-p', 'use_sim_time:=true']
    process = subprocess.Popen(command, env=node_environment(domain_id))
    try:
        yield
    finally:
        process.kill()
        process.wait()


class Watch:
    """Compares what is fused with the truth."""

    def __init__(self, client, drive):
        self._client = client
        self._truth = truth_of_bag(drive)

    def wait(self, seconds, what):
        """Until a pose comes that claims to be well known, and is."""
        self._client.fused = None
        self._client.wait(lambda: is_right(self._client, self._truth), seconds, what)

    def wait_for_wrong(self, seconds, what):
        """Until a pose comes that is far off."""
        self._client.fused = None
        self._client.wait(lambda: self._off_m() > 0.5, seconds, what)

    def given_wrongly(self, error):
        """Where the robot is, but for an error, given as if it were certain."""
        stamp = self._client.odometry.stamp_ns
        return PoseEstimate(stamp, self._truth.at([stamp])[0] + error, 1e-4 * np.eye(3))

    def _off_m(self):
        return off(self._client.fused, self._truth)[0] if self._client.fused else 0.0


def test_a_restart_another_map_the_bag_again_and_a_wrong_start(
    start, client, play, learned_map, domain_id
):
    drive, whole = Bag(BAGS / 'drive'), load_map(learned_map)
    half = replace(whole, landmarks=whole.landmarks[::2])
    send_map = map_sender(client)
    ranked: list[Any] = []
    visibilities: list[Any] = []

    def known():
        return int(client.status_of(FUSION).values.get('landmarks', '0'))

    def status_of(node, words):
        return lambda: words in client.status_of(node).reason

    watch = Watch(client, drive)
    send_map(whole, 1)
    start(LOCALIZER, robot_file=ROBOT, use_sim_time=True)
    start(SELECTOR, robot_file=ROBOT, use_sim_time=True)
    kind, topic = message_class('sensor_msgs/msg/PointCloud2'), f'{SELECTOR}/triplet_scores'
    client._node.create_subscription(kind, topic, ranked.append, 10)
    client._node.create_subscription(
        kind, f'{SELECTOR}/landmark_visibility', visibilities.append, 10
    )
    with fusion(domain_id):
        client.wait(lambda: known() == len(whole.landmarks), 30.0, 'the map')
        client.wait(status_of(LOCALIZER, 'no image'), 30.0, 'what the localizer waits for')
        client.wait(status_of(SELECTOR, 'no fused pose'), 30.0, 'what the selector waits for')
        # Slowly: there is time enough on slow machines, too.
        first = play(drive.path, 0.5)
        watch.wait(20.0, 'the place, which nobody asked for')
        client.wait(lambda: any(cloud.width > 1 for cloud in ranked), 15.0, 'the ranking')
        client.wait(lambda: bool(visibilities), 15.0, 'the visibility of the landmarks')
        reasons = Layout('triplet_scores', 'reason:u1')
        best, *others = unpack_cloud(max(ranked, key=lambda cloud: cloud.width), reasons)
        assert best['reason'] == 0
        assert all(other['reason'] > 0 for other in others)
        assert visibilities[-1].width == len(whole.landmarks)
        # Ages of images make sense on the clock of the bag alone.
        client.wait(
            lambda: 'latency_median_ms' in client.status_of(LOCALIZER).values, 15.0, 'ages'
        )
    with fusion(domain_id):
        watch.wait(20.0, 'the place after a restart')
        send_map(half, 2)
        client.wait(lambda: known() == len(half.landmarks), 15.0, 'the other map')
        first.kill()
        # The clock is set back, and the robot is elsewhere.
        second = play(drive.path, 0.5)
        client.wait(status_of(LOCALIZER, 'no image'), 15.0, 'the silence between')
        watch.wait(20.0, 'the place by the new clock')
        second.kill()
    # How long a robot stays lost hangs on the landmarks that come into view: there are enough of
    # them at the beginning of the drive, not where a slow machine would be by now.
    send_map(whole, 3)
    client.status.clear()
    with fusion(domain_id):
        client.wait(lambda: known() == len(whole.landmarks), 30.0, 'the map once more')
        play(drive.path, 0.5)
        watch.wait(20.0, 'the place once more')
        client.wait(status_of(FUSION, 'tracking'), 15.0, 'the word tracking')
        client.start_at(watch.given_wrongly(np.array([0.8, 0.6, 0.0])))
        watch.wait_for_wrong(8.0, 'the wrong start')
        watch.wait(10.0, 'the place after a wrong start')
