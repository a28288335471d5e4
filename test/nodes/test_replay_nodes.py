"""Recorded sweeps and a drive go through the nodes, over DDS, by `bag_player`."""

from __future__ import annotations

from collections.abc import Callable
import json
from pathlib import Path
import shutil
import subprocess
from typing import TYPE_CHECKING

import numpy as np
import pytest

from landmark_nav.calibration import NAMES
from landmark_nav.evaluation.learning_report import truth_of_bag
from landmark_nav.evaluation.metrics import error_summary, pose_errors
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.robot_files import load_calibration
from landmark_nav.types import PoseEstimate

if TYPE_CHECKING:
    from landmark_nav.ros.robot_client import RobotClient

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

REPOSITORY = Path(__file__).resolve().parents[2]

# How exact the start is given, 1 sigma.
START_SIGMA = (0.02, 0.02, 0.01)


@pytest.fixture
def recorded() -> Path:
    """Folder of the recorded sweeps, the drive, and what the robot was given."""
    found = sorted((REPOSITORY / 'bags').rglob('start.json'))
    if not found:
        pytest.skip('bags/ holds no recording')
    return found[0].parent


@pytest.fixture
def play_all(
    play: Callable[..., subprocess.Popen[bytes]], client: RobotClient
) -> Callable[..., None]:
    def play_bag(bag: Path, rate: float, meanwhile: Callable[[], None] = lambda: None) -> None:
        player = play(bag, rate)

        def over() -> bool:
            meanwhile()
            assert player.poll() in (None, 0)
            return player.poll() == 0

        client.wait(over, 120.0, f'the end of {bag}')

    return play_bag


def test_learned_and_localized_as_offline(
    recorded: Path,
    start: Callable[..., None],
    client: RobotClient,
    play_all: Callable[..., None],
    tmp_path: Path,
) -> None:
    robot, room = str(tmp_path / 'robot.yaml'), str(recorded / 'room.yaml')
    shutil.copy(recorded / 'robot.yaml', robot)
    start('panorama_synthesizer', robot_file=robot, room_file=room)
    start('landmark_learner', room_file=room, map_folder=str(tmp_path / 'map'))
    start('triangulation_localizer', robot_file=robot)
    start('odometry_fusion', robot_file=robot)

    nodes = (
        *('panorama_synthesizer', 'landmark_learner'),
        *('triangulation_localizer', 'odometry_fusion'),
    )
    client.wait(lambda: all(client.status_of(name).reason for name in nodes), 60.0, 'the nodes')
    sweeps = Bag(recorded / 'learn').counts['/sweep/trajectory']
    play_all(recorded / 'learn', 20.0)
    client.wait(
        lambda: client.status_of('landmark_learner').values.get('panoramas') == str(sweeps),
        60.0,
        'the panoramas',
    )
    learned = client.call('learn_landmarks', 60.0)
    assert 'landmarks on' in learned
    assert 'not saved yet: call save_map' in learned
    client.wait(
        lambda: client.status_of('odometry_fusion').values.get('landmarks', '0') != '0',
        10.0,
        'the map',
    )

    drive = Bag(recorded / 'drive')
    first = next(drive.messages([drive.require('odom')])).message
    pose = np.array(json.loads((recorded / 'start.json').read_text())['pose'])
    given = PoseEstimate(decode.stamp_ns(first.header), pose, np.diag(np.square(START_SIGMA)))
    fused: dict[int, np.ndarray] = {}

    def take() -> None:
        if client.fused is not None:
            fused[client.fused.stamp_ns] = client.fused.pose
        elif client.odometry is not None:
            client.start_at(given)

    play_all(recorded / 'drive', 1.0, take)
    truth = truth_of_bag(drive)
    stamps = sorted(fused)
    # The rest of the drive after the start was given, at least most of it.
    assert stamps[-1] - stamps[0] > 0.8e9 * drive.duration_s
    errors = pose_errors(np.array([fused[stamp] for stamp in stamps]), truth.at(stamps))
    summary = error_summary(errors)
    assert summary['position_rmse_m'] < 0.03
    assert summary['heading_rmse_deg'] < 0.4
    status_of = client.status_of('odometry_fusion')
    assert not status_of.lost
    delay, sigma = (float(node) for node in status_of.values['joint_delay_ms'].split(' +- '))
    assert sigma < 10.0
    assert abs(delay) < 4.0 * sigma + 1.0

    # The recorded robot is as its robot.yaml says.
    client.call('calibrate', 10.0)
    known, better = load_calibration(robot), load_calibration(tmp_path / 'robot_calibrated.yaml')
    assert not set(NAMES) - set(better.unobserved(known)) <= {'joint_delay'}
    np.testing.assert_array_less(abs(better.values - known.values), 5.0 * better.sigmas + 1e-9)
