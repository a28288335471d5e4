"""Command lines and environment of the nodes as processes."""

from __future__ import annotations

from collections.abc import Mapping
import json
import os
from pathlib import Path
import sys

from landmark_nav.storage.config_files import shipped_config


def node_command(
    name: str, namespace: str = '', parameter_file: Path | None = None, **parameters: object
) -> list[str]:
    """Command line of a node with parameters and a parameter file, by default the shipped one."""
    # ROS parses values as YAML, of which JSON is a subset; quotes keep names strings.
    settings = [f'{key}:={json.dumps(value)}' for key, value in parameters.items()]
    return [
        *(sys.executable, '-m', f'landmark_nav.nodes.{name}', '--ros-args'),
        *('--params-file', str(parameter_file or shipped_config('landmark_nav.yaml'))),
        *(status for setting in settings for status in ('-p', setting)),
        *(('-r', f'__ns:=/{namespace}') if namespace else ()),
    ]


def node_commands(
    robot_file: Path,
    room_file: Path | None,
    map_folder: Path,
    *,
    simulator: Mapping[str, object] | None = None,
    load_on_start: bool = False,
    image_transport: str = '',
    namespace: str = '',
    composed: bool = False,
    parameter_file: Path | None = None,
) -> dict[str, list[str]]:
    """
    Command line of each process, by its name: one for each node, or one for all if `composed`.

    The simulator is always a separate process. `simulator` holds its parameters besides
    `robot_file`; if it is None, there is no simulator. Without `room_file`, the nodes estimate
    walls and poses. The other arguments are parameters of the nodes.
    """
    robot, room = str(robot_file), str(room_file or '')
    camera: dict[str, object] = {'robot_file': robot}
    if image_transport:
        camera['image_transport'] = image_transport
    learner = {'robot_file': robot, 'room_file': room, 'map_folder': str(map_folder)}
    given: dict[str, dict[str, object]] = {
        'sweep_capture': camera,
        'panorama_synthesizer': {'robot_file': robot, 'room_file': room},
        'landmark_learner': {**learner, 'load_on_start': load_on_start},
        'triplet_selector': {'robot_file': robot},
        'triangulation_localizer': camera,
        'odometry_fusion': {'robot_file': robot},
    }
    if composed:
        given = {'all_nodes': {k: v for one in given.values() for k, v in one.items()}}
    if simulator is not None:
        given = {'room_simulator': {'robot_file': robot, **simulator}} | given
    return {
        name: node_command(name, namespace, parameter_file, **parameters)
        for name, parameters in given.items()
    }


def node_environment(domain_id: int) -> dict[str, str]:
    """
    Environment of this process, changed to a ROS domain of this machine alone.

    It is complete, as the ROS wheels restart Python with their own variables.
    """
    return {
        **os.environ,
        'ROS_DOMAIN_ID': str(domain_id),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    }
