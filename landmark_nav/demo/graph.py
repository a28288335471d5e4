"""The nodes of the demo as processes: their command lines and their environment."""

from __future__ import annotations

import json
import os
from pathlib import Path
import sys

from landmark_nav.demo.room import DemoRoom
from landmark_nav.storage.config_files import shipped_config

__all__ = ['node_command', 'node_commands', 'node_environment']


def node_command(name: str, **parameters: object) -> list[str]:
    """Command line of a node, with its parameter file and what is given."""
    # JSON is YAML, which is how ROS reads values: names stay names.
    settings = [f'{key}:={json.dumps(value)}' for key, value in parameters.items()]
    return [
        *(sys.executable, '-m', f'landmark_nav.nodes.{name}', '--ros-args'),
        *('--params-file', str(shipped_config(f'{name}.yaml'))),
        *(status for setting in settings for status in ('-p', setting)),
    ]


def node_commands(room: DemoRoom, map_folder: Path) -> dict[str, list[str]]:
    """Command line of each node of the demo, by its name."""
    robot, walls = str(room.robot_file), str(room.room_file)
    # Raw images do not fit into the shared memory of common ROS middleware.
    image_settings: dict[str, object] = {'robot_file': robot, 'image_transport': 'compressed'}
    given: dict[str, dict[str, object]] = {
        'room_simulator': {'seed': room.seed, 'robot_file': robot},
        'sweep_capture': image_settings,
        'panorama_synthesizer': {'robot_file': robot, 'room_file': walls},
        'landmark_learner': {'room_file': walls, 'map_folder': str(map_folder)},
        'triplet_selector': {'robot_file': robot},
        'triangulation_localizer': image_settings,
        'odometry_fusion': {'robot_file': robot},
    }
    return {name: node_command(name, **parameters) for name, parameters in given.items()}


def node_environment(domain_id: int) -> dict[str, str]:
    """
    Whole environment of this process, in a ROS domain of its own on this machine.

    Whole, because the ROS wheels start Python anew with variables of their own.
    """
    return {
        **os.environ,
        'ROS_DOMAIN_ID': str(domain_id),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    }
