"""Recorded sweeps and drives go through the nodes, over DDS, by `bag_player`."""

import shutil
from typing import Any

from drive_faults import displaced_drive, late_drive
from graph import is_right, off
from harness import BAGS, start_of
import numpy as np
import pytest
from unmeasured import with_odometry

from landmark_nav.calibration import NAMES
from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.learning_report import truth_of_bag
from landmark_nav.evaluation.metrics import error_summary, pose_errors
from landmark_nav.geometry import se2
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.robot_files import load_calibration, save_calibration
from landmark_nav.types import PoseEstimate

# How exact the start is given, 1 sigma.
START_SIGMA = (0.02, 0.02, 0.01)
LATE_S = 0.04
# Of 120, for time.
FEW = {'attention.candidates': 70}
ROBOT, ROOM = str(BAGS / 'robot.yaml'), str(BAGS / 'room.yaml')
LEARNER, SYNTHESIZER = 'landmark_learner', 'panorama_synthesizer'
FUSION, LOCALIZER = 'odometry_fusion', 'triangulation_localizer'


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


def has_learned_the_camera(landmarks):
    prior, known = landmarks.prior, landmarks.calibration
    assert {'focal_scale', 'camera_roll'}.isdisjoint(known.unobserved(prior))


def test_learned_and_localized_as_offline(start, client, play_all, tmp_path):
    """Also where joint states are late, which is measured."""
    robot, folder = str(shutil.copy(ROBOT, tmp_path)), str(tmp_path / 'map')
    nodes: dict[str, dict[str, Any]] = {
        SYNTHESIZER: {'robot_file': robot, 'room_file': ROOM},
        LEARNER: {'robot_file': robot, 'room_file': ROOM, 'map_folder': folder, **FEW},
        LOCALIZER: {'robot_file': robot},
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
    client.call('save_map', 20.0)
    has_learned_the_camera(load_map(tmp_path / 'map'))
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


def test_the_place_found_by_a_displaced_camera_starts_the_fusion(
    start, client, play, learned_map, tmp_path
):
    start(LEARNER, room_file=ROOM, map_folder=str(learned_map))
    search = {'relocalization.search_s': 30.0, 'relocalization.when_lost': False}
    start(LOCALIZER, robot_file=ROBOT, **search)
    start(FUSION, robot_file=ROBOT)
    client.wait(lambda: client.status_of(FUSION).reason != '', 60.0, 'the nodes')
    assert 'landmarks loaded' in client.call('load_map', 30.0)
    client.wait(lambda: 'no image' in client.status_of(LOCALIZER).reason, 30.0, 'the map')

    drive = Bag(BAGS / 'drive')
    play(displaced_drive(drive, tmp_path / 'drive', (1.0, 0.0, -2.0)), 0.5)
    found = client.call('relocalize', 40.0)
    assert found.startswith('found at')
    client.wait(lambda: client.fused is not None, 20.0, 'a fused pose')
    away_m, turned_rad = off(client.fused, truth_of_bag(drive))
    assert away_m < 0.05, (found, client.fused)
    assert turned_rad < np.radians(1.0)
    client.wait(lambda: 'camera_roll by' in client.status_of(FUSION).reason, 20.0, 'a roll')


def test_sweeps_and_odometry_become_a_map_that_a_drive_goes_by(start, client, play, tmp_path):
    """Also where the mount of the camera was measured wrong."""
    sweeps, folder = with_odometry(BAGS / 'learn', tmp_path / 'sweeps'), tmp_path / 'map'
    robot, wrong = str(tmp_path / 'robot.yaml'), {'center_x': 0.03, 'camera_roll': 0.015}
    known = load_calibration(ROBOT)
    save_calibration(known.with_values(**wrong).widened(wrong), robot)
    start(SYNTHESIZER, robot_file=robot)
    start(LEARNER, robot_file=robot, map_folder=str(folder), **FEW)
    starts: list[Any] = []
    client.listen('initialpose', starts.append)
    client.wait(lambda: {SYNTHESIZER, LEARNER} <= client.status.keys(), 60.0, 'the nodes')
    with pytest.raises(LandmarkNavError, match=r'odom.*sweep/pose.*room_file'):
        client.call('learn_landmarks', 30.0)
    player = play(sweeps, 10.0)
    client.wait(lambda: client.status_of(LEARNER).values['panoramas'] == '2', 120.0, 'two sweeps')
    client.wait(lambda: len(client.panoramas) == 2, 60.0, 'their panoramas')
    player.wait(120.0)
    answer = client.call('learn_landmarks', 240.0)
    assert 'metres from odom' in answer
    client.call('save_map', 20.0)
    learned = load_map(folder)
    assert learned.has_own_frame
    has_learned_the_camera(learned)
    assert len(learned.landmarks) >= 40

    # The robot stands where it took the last sweep.
    truth = truth_of_bag(Bag(BAGS / 'learn'))
    client.wait(lambda: bool(starts), 10.0, 'the pose of the robot')
    given = decode.pose_estimate(starts[-1])
    error = pose_errors(given.pose[None], se2.relative(truth.poses[0], truth.poses[-1])[None])[0]
    assert np.hypot(*error[:2]) < 0.02
    assert abs(error[2]) < np.radians(0.3)

    for name in (FUSION, LOCALIZER):
        start(name, robot_file=robot, use_sim_time=True)
    client.wait(
        lambda: client.status_of(FUSION).values.get('landmarks', '0') != '0', 60.0, 'the map'
    )
    drive = truth_of_bag(Bag(BAGS / 'drive')).seen_from(truth.poses[0])
    play(BAGS / 'drive', 0.5)
    client.wait(lambda: is_right(client, drive), 60.0, 'the pose in the map, which nobody gave')
