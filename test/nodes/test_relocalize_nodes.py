"""A robot without a start pose finds its place, asked by service, over DDS."""

from drive_faults import displaced_drive
from harness import BAGS
import numpy as np

from landmark_nav.evaluation.learning_report import truth_of_bag
from landmark_nav.evaluation.metrics import pose_errors
from landmark_nav.storage.bags import Bag


def test_the_place_found_by_a_displaced_camera_starts_the_fusion(
    start, client, play, learned_map, tmp_path
):
    room, robot = str(BAGS / 'room.yaml'), str(BAGS / 'robot.yaml')
    localizer = 'triangulation_localizer'
    start('landmark_learner', room_file=room, map_folder=str(learned_map))
    search = {'relocalization.search_s': 30.0, 'relocalization.when_lost': False}
    start(localizer, robot_file=robot, **search)
    start('odometry_fusion', robot_file=robot)
    client.wait(lambda: client.status_of('odometry_fusion').reason != '', 60.0, 'the nodes')
    assert 'landmarks loaded' in client.call('load_map', 30.0)
    client.wait(lambda: 'no image' in client.status_of(localizer).reason, 30.0, 'the map')

    drive = Bag(BAGS / 'drive')
    play(displaced_drive(drive, tmp_path / 'drive', (1.0, 0.0, -2.0)), 0.5)
    found = client.call('relocalize', 40.0)
    assert found.startswith('found at')
    client.wait(lambda: client.fused is not None, 20.0, 'a fused pose')
    fused = client.fused
    error = pose_errors(fused.pose[None], truth_of_bag(drive).at([fused.stamp_ns]))[0]
    assert np.hypot(*error[:2]) < 0.05, (found, fused)
    assert abs(error[2]) < np.radians(1.0)
    client.wait(
        lambda: 'camera_roll by' in client.status_of('odometry_fusion').reason, 20.0, 'a roll'
    )
