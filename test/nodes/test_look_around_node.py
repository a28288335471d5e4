"""A robot that is lost turns its camera around, unless another node commands the camera."""

from __future__ import annotations

from pathlib import Path
import time

import numpy as np

from landmark_nav.messages import decode, encode
from landmark_nav.ros.camera_frames import listen_for_pan, PanCommander
from landmark_nav.ros.topics import ros_factory
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.setup_files import load_robot
from landmark_nav.types import JointSample, OdometrySample

RECORDED = Path(__file__).resolve().parents[2] / 'bags'
SELECTOR = 'triplet_selector'
LIMITS = (-1.2, 0.9)


def test_it_looks_around_within_the_limits_and_leaves_the_camera_to_others(
    start, client, learned_map, tmp_path
):
    mount = load_robot(str(RECORDED / 'robot.yaml'))
    drive = Bag(RECORDED / 'drive')
    info = next(drive.messages([drive.require('camera/camera_info')])).message
    camera = decode.camera_model(info)
    topics = ('camera/camera_info', 'joint_states', 'odometry/fused')
    infos, joints, fused = (client.advertise(topic) for topic in topics)
    robot = tmp_path / 'robot.yaml'
    limits = f'pan_min: {LIMITS[0]}\npan_max: {LIMITS[1]}\n'
    robot.write_text((RECORDED / 'robot.yaml').read_text() + limits)
    start(SELECTOR, robot_file=str(robot), yield_s=1.5)
    for topic, message in zip(
        ('landmarks', 'landmarks/atlas'),
        encode.landmark_map(ros_factory, load_map(learned_map), 1),
        strict=False,
    ):
        client.advertise(topic).publish(message)
    commands: list[float] = []
    others: list[float] = []
    known = False

    def take(pan_rad):
        if pan_rad not in others:
            commands.append(pan_rad)

    def alive():
        """Be a robot whose joint is where it was commanded, for a moment."""
        now_ns = time.time_ns()
        infos.publish(encode.camera_info(ros_factory, camera, now_ns, 'camera'))
        pan = commands[-1] if commands else 0.0
        joints.publish(encode.joint_state(ros_factory, JointSample(now_ns, pan), mount))
        if known:
            sample = OdometrySample(now_ns, np.array([2.0, 2.0, 0.0]), 0.0, 0.0)
            sigma = np.diag([1e-4, 1e-4, 1e-4])
            fused.publish(
                encode.odometry(ros_factory, sample, sigma, frame_id='map', child_frame_id='base')
            )
        return False

    def live(seconds, until=lambda: False):
        end = time.monotonic() + seconds
        client.wait(lambda: alive() or until() or time.monotonic() > end, seconds + 1.0, 'time')

    listen_for_pan(client._node, mount, 'JointTrajectory', take)
    other = PanCommander(client._node, mount, 'JointTrajectory')
    live(20.0, lambda: len(set(commands)) >= 4)
    assert len(set(commands)) >= 4
    assert all(LIMITS[0] <= pan <= LIMITS[1] for pan in commands)
    live(3.0, lambda: 'looks around' in client.status_of(SELECTOR).reason)
    assert 'looks around' in client.status_of(SELECTOR).reason

    others.append(0.123)
    other.command(0.123)
    live(0.4)
    before = len(commands)
    live(1.0)
    assert len(commands) == before, 'somebody else turns the camera'
    live(8.0, lambda: len(commands) > before)
    assert len(commands) > before

    known = True
    live(3.0, lambda: 'looks around' not in client.status_of(SELECTOR).reason)
    assert 'looks around' not in client.status_of(SELECTOR).reason
