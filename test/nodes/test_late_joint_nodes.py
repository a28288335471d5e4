"""
Joint states that are stamped 200 ms late.

The nodes measure it, and turn images by it; a place that they find meanwhile is not sure of a
heading that such joint states turned.
"""

from __future__ import annotations

from collections.abc import Callable
import json
from pathlib import Path
import subprocess
from typing import Any, TYPE_CHECKING

import numpy as np
import pytest

from landmark_nav.evaluation.learning_report import truth_of_bag
from landmark_nav.evaluation.metrics import pose_errors
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag, BagWriter, sensor_events
from landmark_nav.storage.setup_files import load_robot
from landmark_nav.types import CameraFrame, PoseEstimate

if TYPE_CHECKING:
    from landmark_nav.ros.robot_client import RobotClient

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

RECORDED = Path(__file__).resolve().parents[2] / 'bags'
START_SIGMA = (0.02, 0.02, 0.01)
LATE_NS = 200_000_000
# After so long it is known by how much they are late.
KNOWN_S = 7.0


def stamped_late(path: Path, arrive_late: bool) -> Path:
    """The recorded drive with joint states that say a later time, or arrive then, too."""
    bag = Bag(RECORDED / 'drive')
    out = []
    for entry in bag.messages():
        message, log_ns = entry.message, entry.stamp_ns
        if entry.topic == '/joint_states':
            stamp = divmod(decode.stamp_ns(message.header) + LATE_NS, 10**9)
            message.header.stamp.sec, message.header.stamp.nanosec = stamp
            log_ns += LATE_NS * arrive_late
        out.append((log_ns, entry.topic, message))
    with BagWriter(path) as written:
        for log_ns, topic, message in sorted(out, key=lambda sent: sent[0]):
            written.write(topic, message, log_ns)
    return path


@pytest.fixture
def localizing(learned_map: Path, start: Callable[..., None], client: RobotClient) -> None:
    """Nodes that know the map, and not yet the place."""
    robot = str(RECORDED / 'robot.yaml')
    start(
        'landmark_learner',
        room_file=str(RECORDED / 'room.yaml'),
        map_folder=str(learned_map),
        load_on_start=True,
    )
    start('triangulation_localizer', robot_file=robot)
    start('odometry_fusion', robot_file=robot)
    client.wait(
        lambda: client.status_of('odometry_fusion').values.get('landmarks', '0') != '0',
        60.0,
        'the map',
    )
    images = 'camera/image_raw/compressed'
    client.wait(lambda: client._node.count_subscribers(images) > 0, 60.0, 'the localizer')


@pytest.mark.parametrize('arrive_late', [False, True])
def test_late_joint_states_are_measured_and_images_turned_by_it(
    arrive_late: bool,
    localizing: None,
    client: RobotClient,
    play: Callable[..., subprocess.Popen[bytes]],
    tmp_path: Path,
) -> None:
    """With a start where they arrive late as well; else the place is found by the camera."""
    drive = Bag(stamped_late(tmp_path / 'drive', arrive_late))
    first = next(drive.messages([drive.require('odom')])).message
    begin_ns = decode.stamp_ns(first.header)
    pose = np.array(json.loads((RECORDED / 'start.json').read_text())['pose'])
    given = PoseEstimate(begin_ns, pose, np.diag(np.square(START_SIGMA)))
    fused: dict[int, PoseEstimate] = {}
    found: dict[int, int] = {}

    def saw(message: Any) -> None:
        detections = decode.detections(message)
        found[detections.stamp_ns] = len(detections)

    def knew(message: Any) -> None:
        estimate = decode.pose_estimate(message)
        fused[estimate.stamp_ns] = estimate

    detected = client.listen('detections', saw)
    client.listen('odometry/fused', knew)
    client.wait(lambda: detected.get_publisher_count() > 0, 60.0, 'the localizer')
    player = play(tmp_path / 'drive')

    def over() -> bool:
        if arrive_late and not fused and client.odometry is not None:
            client.start_at(given)
        return player.poll() == 0

    client.wait(over, 60.0, 'the end of the drive')
    status_of = client.status_of('odometry_fusion').values['joint_delay_ms']
    delay_s, sigma_s = (1e-3 * float(node) for node in status_of.split(' +- '))
    assert sigma_s < 0.005
    assert delay_s == pytest.approx(1e-9 * LATE_NS, abs=4.0 * sigma_s + 0.002)
    assert 'ms late, which is put right' in client.status_of('odometry_fusion').reason
    stamps = sorted(fused)
    assert len(stamps) > 100
    errors = pose_errors(np.array([fused[k].pose for k in stamps]), truth_of_bag(drive).at(stamps))
    known = np.isfinite(errors).all(axis=1)
    # A heading that late joint states turned is never claimed to be certain.
    inverse = np.linalg.inv([fused[k].covariance for k in stamps])
    sigmas = np.sqrt(np.einsum('ni,nij,nj->n', errors, inverse, errors))
    assert arrive_late or sigmas[known].max() < 5.0
    later = known & (np.array(stamps) - begin_ns > KNOWN_S * 1e9)
    assert np.sqrt(np.mean(np.sum(errors[later, :2] ** 2, axis=1))) < 0.03
    # The camera turns by 2 rad/s: by 23 deg more than joint states of 0.2 s before say.
    mount = load_robot(RECORDED / 'robot.yaml')
    turning = [
        found[event.stamp_ns]
        for event in sensor_events(Bag(RECORDED / 'drive'), mount)
        if isinstance(event, CameraFrame)
        and abs(event.pan_rate_rad_s) > 1.0
        and event.stamp_ns - begin_ns > KNOWN_S * 1e9
        and event.stamp_ns in found
    ]
    assert turning, client.status
    # Three of five look at landmarks; one in ten finds some with the pan as it is given.
    assert np.mean(np.array(turning) >= 3) > 0.5
