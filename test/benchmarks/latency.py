"""
How long an image takes on the live graph: from its arrival to `odometry/fused` corrected by it.

``python test/benchmarks latency DRIVE --map MAP --room R --robot R --start X Y THETA`` starts
`landmark_learner` (which gives the map), `triangulation_localizer`, `odometry_fusion` and
`triplet_selector` as processes and plays a drive's bag to them so that images come at 15 Hz:
give one that was recorded at about that (``landmark-nav simulate --camera-rate 20``). It prints
the latency and what was dropped, and exits with 1 if the 99th percentile is over 25 ms or the
latency grows.
"""

import os
from pathlib import Path
import tempfile
import time

from harness import drive_parser
from node_costs import used
import numpy as np

from landmark_nav.demo.supervisor import node_command, node_environment, Supervisor
from landmark_nav.messages import decode
from landmark_nav.ros.robot_client import RobotClient
from landmark_nav.storage.bags import Bag
from landmark_nav.types import PoseEstimate

MAX_P99_MS = 25.0
# The first seconds load what is needed once.
WARM_UP_S = 4.0
START_SIGMA = (0.02, 0.02, 0.01)


class Stopwatch:
    """Arrival times of images, and of the first fused pose after their landmarks."""

    def __init__(self, client):
        self.shown: dict[int, float] = {}
        self.took: list[tuple[float, float]] = []
        self._waiting: list[int] = []
        # The calibration comes right after its image, and weighs nothing.
        client.listen('camera/camera_info', self._on_image)
        client.listen('detections', self._on_detections)
        client.listen('odometry/fused', self._on_fused)

    def _on_image(self, message):
        self.shown[decode.stamp_ns(message.header)] = time.monotonic()

    def _on_detections(self, message):
        self._waiting.append(decode.stamp_ns(message.header))

    def _on_fused(self, message):
        now, stamp = time.monotonic(), decode.stamp_ns(message.header)
        for done in [k for k in self._waiting if k <= stamp]:
            self._waiting.remove(done)
            if done in self.shown:
                self.took.append((self.shown[done], now - self.shown[done]))


def measure(arguments):
    """Play the bag; arrival times, computing time a node, and what the localizer says."""
    bag = Bag(arguments.drive)
    camera = next(name for name in bag.counts if '/image_raw' in name)
    rate = arguments.hz * bag.duration_s / bag.counts[camera]
    domain_id = int(os.environ.get('ROS_DOMAIN_ID', '77'))
    robot = {'robot_file': str(arguments.robot.resolve())}
    transport = 'compressed' if camera.endswith('compressed') else 'raw'
    parameters: dict[str, dict[str, object]] = {
        'landmark_learner': {
            'room_file': str(arguments.room.resolve()),
            'map_folder': str(arguments.map.resolve()),
            'load_on_start': True,
        },
        'triangulation_localizer': {**robot, 'image_transport': transport},
        'odometry_fusion': robot,
        'triplet_selector': robot,
    }
    environment = node_environment(domain_id)
    with (
        tempfile.TemporaryDirectory() as logs,
        Supervisor(Path(logs), environment) as nodes,
        Supervisor(Path(logs), environment) as player,
        RobotClient(domain_id, nodes.check) as client,
    ):
        watch = Stopwatch(client)
        running = {
            name: nodes.start(name, node_command(name, **given))
            for name, given in parameters.items()
        }
        has_map = lambda: client.status_of('odometry_fusion').values.get('landmarks', '0') != '0'  # noqa: E731
        client.wait(has_map, 60.0, 'the map')
        bag_file = str(arguments.drive.resolve())
        playing = player.start('bag_player', node_command('bag_player', bag=bag_file, rate=rate))
        client.wait(lambda: client.odometry is not None, 30.0, 'the bag')
        assert client.odometry is not None
        covariance = np.diag(np.square(START_SIGMA))
        stamp = client.odometry.stamp_ns
        client.start_at(PoseEstimate(stamp, np.array(arguments.start), covariance))
        before, begin = {k: used(one)[0] for k, one in running.items()}, time.monotonic()
        client.wait(lambda: playing.poll() is not None, 300.0, 'the end of the bag')
        seconds = time.monotonic() - begin
        cpu = {k: (used(one)[0] - before[k]) / seconds for k, one in running.items()}
        client.wait(lambda: time.monotonic() - begin > seconds + 1.2, 5.0, 'last words')
        return watch, cpu, dict(client.status_of('triangulation_localizer').values)


def main():
    """Measure and judge."""
    parser = drive_parser(__doc__)
    parser.add_argument('--room', type=Path, required=True)
    parser.add_argument('--hz', type=float, default=15.0, help='images a second (15)')
    watch, cpu, status_of = measure(parser.parse_args())
    if not watch.took:
        print('no image was used: is the start right?')
        return 1
    shown, took = np.array(watch.took).T
    first = min(watch.shown.values())
    warm = shown > first + WARM_UP_S
    took_ms = 1e3 * took[warm]
    images = sum(when > first + WARM_UP_S for when in watch.shown.values())
    slope = np.polyfit(shown[warm] - first, took_ms, 1)[0]
    median, p95, p99 = np.percentile(took_ms, [50, 95, 99])
    print(f'{images} images, {len(took_ms)} used')
    print(f'image -> odometry/fused: median {median:.1f} ms, p95 {p95:.1f} ms, p99 {p99:.1f} ms, '
          f'max {took_ms.max():.1f} ms, growing {slope:+.2f} ms/s')  # fmt: skip
    print('cores used: ' + ', '.join(f'{name} {share:.2f}' for name, share in cpu.items()))
    print('triangulation_localizer: ' + ', '.join(f'{k} {v}' for k, v in status_of.items()))
    return 0 if p99 <= MAX_P99_MS and slope < 1.0 else 1
