"""Learning without a plan on the real graph, and a drive in the map."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import subprocess
from typing import Any

import numpy as np
import pytest
from unmeasured_bags import with_odometry

from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.learning_report import truth_of_bag
from landmark_nav.evaluation.metrics import pose_errors
from landmark_nav.geometry import se2
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.maps import load_map

RECORDED = Path(__file__).resolve().parents[2] / 'bags'
ROBOT = str(RECORDED / 'robot.yaml')
LEARNER, SYNTHESIZER = 'landmark_learner', 'panorama_synthesizer'
LOCALIZATION = ('odometry_fusion', 'triangulation_localizer')
Play = Callable[..., subprocess.Popen[bytes]]


def test_sweeps_and_odometry_become_a_map_that_a_drive_goes_by(start, client, play, tmp_path):
    sweeps, folder = with_odometry(RECORDED / 'learn', tmp_path / 'sweeps'), tmp_path / 'map'
    start(SYNTHESIZER, robot_file=ROBOT)
    start(LEARNER, robot_file=ROBOT, map_folder=str(folder))
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
    assert len(learned.landmarks) >= 40

    # The robot stands where it took the last sweep.
    truth = truth_of_bag(Bag(RECORDED / 'learn'))
    client.wait(lambda: bool(starts), 10.0, 'the pose of the robot')
    given = decode.pose_estimate(starts[-1])
    error = pose_errors(given.pose[None], se2.relative(truth.poses[0], truth.poses[-1])[None])[0]
    assert np.hypot(*error[:2]) < 0.02
    assert abs(error[2]) < np.radians(0.3)

    for name in LOCALIZATION:
        start(name, robot_file=ROBOT, use_sim_time=True)
    client.wait(
        lambda: client.status_of('odometry_fusion').values.get('landmarks', '0') != '0',
        60.0,
        'the map',
    )
    drive = truth_of_bag(Bag(RECORDED / 'drive')).seen_from(truth.poses[0])

    def is_right():
        fused, client.fused = client.fused, None
        if fused is None or np.trace(fused.covariance[:2, :2]) > 0.05**2:
            return False
        off = pose_errors(fused.pose[None], drive.at([fused.stamp_ns]))[0]
        return bool(np.hypot(*off[:2]) < 0.05 and abs(off[2]) < np.radians(1.0))

    play(RECORDED / 'drive', 0.5)
    client.wait(is_right, 60.0, 'the pose in the map, which nobody gave')
