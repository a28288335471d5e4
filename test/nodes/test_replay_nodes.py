"""Recorded sweeps and a drive go through the nodes, over DDS, by `bag_player`."""

from __future__ import annotations

import shutil
from typing import Any

from drive_faults import late_drive
from harness import BAGS, start_of
import numpy as np
import pytest

from landmark_nav.calibration import NAMES
from landmark_nav.evaluation.learning_report import truth_of_bag
from landmark_nav.evaluation.metrics import error_summary, pose_errors
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.robot_files import load_calibration
from landmark_nav.types import PoseEstimate

# How exact the start is given, 1 sigma.
START_SIGMA = (0.02, 0.02, 0.01)
LATE_S = 0.04
LEARNER, FUSION = 'landmark_learner', 'odometry_fusion'


@pytest.fixture
def play_all(play, client):
    def play_bag(bag, rate, meanwhile=lambda: None):
        player = play(bag, rate)

        def over():
            meanwhile()
            assert player.poll() in (None, 0)
            return player.poll() == 0

        client.wait(over, 120.0, f'the end of {bag}')

    return play_bag


def test_learned_and_localized_as_offline(start, client, play_all, tmp_path):
    """Also where joint states are late, which is measured."""
    robot, room = str(tmp_path / 'robot.yaml'), str(BAGS / 'room.yaml')
    shutil.copy(BAGS / 'robot.yaml', robot)
    nodes: dict[str, dict[str, Any]] = {
        'panorama_synthesizer': {'robot_file': robot, 'room_file': room},
        LEARNER: {'room_file': room, 'map_folder': str(tmp_path / 'map')},
        'triangulation_localizer': {'robot_file': robot},
        FUSION: {'robot_file': robot},
    }
    for name, parameters in nodes.items():
        start(name, **parameters)
    client.wait(lambda: all(client.status_of(name).reason for name in nodes), 60.0, 'the nodes')
    play_all(BAGS / 'learn', 20.0)
    client.wait(
        lambda: client.status_of(LEARNER).values.get('panoramas') == '2', 60.0, 'the panoramas'
    )
    learned = client.call('learn_landmarks', 60.0)
    assert 'landmarks on' in learned
    assert 'not saved yet: call save_map' in learned
    client.wait(
        lambda: client.status_of(FUSION).values.get('landmarks', '0') != '0', 10.0, 'the map'
    )

    drive = Bag(late_drive(Bag(BAGS / 'drive'), tmp_path / 'drive', LATE_S))
    first = next(drive.messages([drive.require('odom')])).message
    pose = np.array(start_of(BAGS))
    given = PoseEstimate(decode.stamp_ns(first.header), pose, np.diag(np.square(START_SIGMA)))
    fused: dict[int, np.ndarray] = {}

    def take():
        if client.fused is not None:
            fused[client.fused.stamp_ns] = client.fused.pose
        elif client.odometry is not None:
            client.start_at(given)

    play_all(tmp_path / 'drive', 1.0, take)
    stamps = sorted(fused)
    # The rest of the drive after the start was given, at least most of it.
    assert stamps[-1] - stamps[0] > 0.8e9 * drive.duration_s
    poses = np.array([fused[stamp] for stamp in stamps])
    summary = error_summary(pose_errors(poses, truth_of_bag(drive).at(stamps)))
    assert summary['position_rmse_m'] < 0.03
    assert summary['heading_rmse_deg'] < 0.4
    status = client.status_of(FUSION)
    assert not status.lost
    delay, sigma = (float(node) for node in status.values['joint_delay_ms'].split(' +- '))
    assert sigma < 10.0
    assert abs(delay - 1e3 * LATE_S) < 4.0 * sigma + 1.0

    # But for that the recorded robot is as its robot.yaml says.
    client.call('calibrate', 10.0)
    known, better = load_calibration(robot), load_calibration(tmp_path / 'robot_calibrated.yaml')
    assert not set(NAMES) - set(better.unobserved(known)) <= {'joint_delay'}
    mount = np.array(NAMES) != 'joint_delay'
    off = (better.values - known.values)[mount]
    np.testing.assert_array_less(abs(off), 5.0 * better.sigmas[mount] + 1e-9)
