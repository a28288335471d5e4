"""A robot without a start pose finds its place, asked by service, over DDS."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TYPE_CHECKING

from drive_faults import displaced_drive
import numpy as np
import pytest

from landmark_nav.evaluation.learning_report import truth_of_bag
from landmark_nav.evaluation.metrics import pose_errors
from landmark_nav.storage.bags import Bag

if TYPE_CHECKING:
    from landmark_nav.ros.robot_client import RobotClient

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

RECORDED = Path(__file__).resolve().parents[2] / 'bags'


@pytest.mark.parametrize('turned_deg', [(0.0, 0.0, 0.0), (1.0, 0.0, -2.0)])
def test_the_place_found_starts_the_fusion(
    turned_deg: tuple[float, float, float],
    start: Callable[..., None],
    client: RobotClient,
    play: Callable[..., Any],
    learned_map: Path,
    tmp_path: Path,
) -> None:
    """Also where the camera was displaced since the map was learned."""
    room, robot = str(RECORDED / 'room.yaml'), str(RECORDED / 'robot.yaml')
    localizer = 'triangulation_localizer'
    start('landmark_learner', room_file=room, map_folder=str(learned_map))
    search = {'relocalization.search_s': 30.0, 'relocalization.when_lost': False}
    start(localizer, robot_file=robot, **search)
    start('odometry_fusion', robot_file=robot)
    client.wait(lambda: client.status_of('odometry_fusion').reason != '', 60.0, 'the nodes')
    assert 'landmarks loaded' in client.call('load_map', 30.0)
    client.wait(lambda: 'no image' in client.status_of(localizer).reason, 30.0, 'the map')

    drive = Bag(RECORDED / 'drive')
    path = (
        displaced_drive(drive, tmp_path / 'drive', turned_deg) if any(turned_deg) else drive.path
    )
    play(path, 0.5)
    assert client.call('relocalize', 40.0).startswith('found at')
    client.wait(lambda: client.fused is not None, 20.0, 'a fused pose')
    assert client.fused is not None
    fused = client.fused
    error = pose_errors(fused.pose[None], truth_of_bag(drive).at([fused.stamp_ns]))[0]
    assert np.hypot(*error[:2]) < 0.05
    assert abs(error[2]) < np.radians(1.0)
    if any(turned_deg):
        client.wait(
            lambda: 'camera_roll by' in client.status_of('odometry_fusion').reason, 20.0, 'a roll'
        )
