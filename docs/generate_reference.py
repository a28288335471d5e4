"""
Pages of the reference out of the code: topics, services, parameters, commands, calibration.

``python docs/generate_reference.py FOLDER`` writes them; `conf.py` does so at each build. A topic,
service or parameter without a description raises an error, and so does a description of none.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator
from contextlib import redirect_stdout
from importlib import import_module
import io
from itertools import product
import os
from pathlib import Path
import sys
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

from landmark_nav.configuration import Configuration, LIVE, READS
from landmark_nav.demo.scenario import prepare_room
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.parameters import is_of, leaves, unit_of
from landmark_nav.storage.robot_files import QUANTITIES, read_parameters, shipped_config

# Nodes subscribe to images while they use them.
_WHILE_NEEDED = {
    topic: ['sweep_capture', 'triangulation_localizer']
    for topic in ('camera/image_raw', 'camera/image_raw/compressed')
}

TOPICS = {
    'camera/image_raw': 'image of the camera, raw or rectified ([encodings](../images.md))',
    'camera/image_raw/compressed': 'the same as JPEG or PNG; goes before raw where both are there',
    'camera/camera_info': 'its calibration',
    'joint_states': 'pan and tilt, stamped when they were measured',
    'odom': 'motion that the wheels report, with speeds or without',
    'ground_truth/odom': 'true pose in `map`, for figures alone',
    'pan_tilt/command': 'where the camera is to look; the type is the parameter `command.type`',
    'sweep/image': 'frames that a sweep keeps',
    'sweep/image/compressed': 'the same, if the camera publishes compressed images',
    'sweep/camera_info': 'calibration of these frames',
    'sweep/trajectory': 'end of a sweep: stamp, pan and tilt of each frame that was kept',
    'sweep/pose': '`base_link` in `map` at the sweep, if it is known from elsewhere',
    'panorama/image': 'cylindrical image of a sweep',
    'panorama/camera_info': '`distortion_model: cylindrical`; `k`: fx px/rad, fy px per unit '
    'tangent, cx the column of azimuth 0 in `base_link`, cy the row of the horizon; `d`: the '
    'calibration after the sweep, for learning',
    'panorama/pose': 'pose of its optical centre in `map`',
    'landmarks': 'the map: one point a landmark, with normal, size, covariance, and what '
    'learning found of the robot',
    'landmarks/atlas': 'the patches of all landmarks in one image',
    'landmarks/markers': 'the same for RViz and Foxglove',
    'triplet': 'the three landmarks to look at, each with its expected bearing and sigma',
    'detections': 'landmarks found and missed in an image, with bearing, variance, pixel, score',
    'triangulation/pose': 'fix: the pose of one image by itself',
    'global_localization/pose': 'pose found without a prior',
    'expectation': 'pose and calibration as they are known: where landmarks are looked for',
    'cmd_vel': 'speed of the simulated robot',
    'initialpose': 'start, of a person (RViz: 2D Pose Estimate) or of learning without a plan',
    'odometry/fused': 'pose of `base_link` in `map`, with covariance: the result',
    'odometry_fusion/protection_level': 'that pose with a covariance of which **one** sigma holds '
    'the error with 99 %',
    'odometry_fusion/path': 'way of the fused pose, at most 5 Hz',
    'odometry_fusion/odometry_path': 'way by odometry alone, at most 5 Hz',
    'triangulation_localizer/debug_image/compressed': 'image with expected windows and matches, '
    'while somebody subscribes',
    'triangulation_localizer/markers': 'field of view, rays to the triplet and to what is found',
    'odometry_fusion/markers': 'robot, covariance and protection level for RViz and Foxglove',
    'triplet_selector/triplet_scores': 'triplets with their [reason](../architecture.md#codes)',
    'triplet_selector/landmark_visibility': 'landmarks with their '
    '[reason](../architecture.md#codes)',
    'tf': '`map` → `odom`, and frames of the simulated robot; where tf2_msgs is installed',
    'tf_static': 'fixed frames of the robot',
    'diagnostics': 'OK, degraded or lost, with the reason, once a second',
}

SERVICES = {
    'capture_sweep': 'takes a sweep; a second call interrupts it, the next one goes on',
    'learn_landmarks': 'makes a map out of the panoramas so far',
    'save_map': 'writes the map to `map_folder`; a map there, and its figures, are replaced',
    'load_map': 'reads it from there',
    'clear_panoramas': 'forgets the panoramas',
    'relocalize': 'finds the pose without a prior, for at most `relocalization.search_s`',
    'calibrate': 'writes what the drive has shown of `robot.yaml` to a file beside it',
}


def write_reference(folder: Path) -> list[Path]:
    """
    Write the pages; ROS is initialised and shut down meanwhile.

    Raises
    ------
    KeyError
        A topic or a service has no description in this file.

    """
    folder.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as drawn:
        room = prepare_room(Path(drawn), seed=1)
        robot, plan = {'robot_file': str(room.robot_file)}, {'room_file': str(room.room_file)}
        publishers, subscribers, services, kinds = _ends_of_nodes(robot, robot | plan)
    pages = {
        'topics': _topics(publishers, subscribers, kinds),
        'services': _services(services),
        'parameters': _parameters(),
        'commands': _commands(),
        'calibration': _calibration(),
    }
    for name, lines in pages.items():
        (folder / f'{name}.md').write_text('\n'.join(lines) + '\n', encoding='utf-8')
    return [folder / f'{name}.md' for name in pages]


def _ends_of_nodes(
    *setups: dict[str, str],
) -> tuple[dict[str, list[str]], dict[str, list[str]], dict[str, str], Any]:
    """
    Nodes that publish, subscribe to and serve each name; type and QoS of each topic.

    Nodes are started with the files of each of the `setups`.
    """
    import rclpy

    from landmark_nav.ros.topics import FORMER_NAMES

    publishers, subscribers = defaultdict(list), defaultdict(list, _WHILE_NEEDED)
    services: dict[str, str] = {}
    kinds: dict[str, Any] = {}
    # Only this process sees these nodes.
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'OFF'
    rclpy.init(args=[])
    try:
        # That of the bag player depends on its bag.
        for name, files in product(READS, setups):
            if name == 'bag_player':
                continue
            node = _started(name, files)
            former = {node.resolve_topic_name(topic) for topic in FORMER_NAMES.values()}
            for found, ends in ((publishers, node.publishers), (subscribers, node.subscriptions)):
                for end in ends:
                    topic = end.topic_name.lstrip('/')
                    if end.topic_name in former or topic in ('rosout', 'parameter_events'):
                        continue
                    found[topic].append(name)
                    kinds[topic] = end.msg_type, end.qos_profile
            for service in node.services:
                if '/' not in (offered := service.srv_name.lstrip('/')):
                    services[offered] = name
            node.destroy_node()
    finally:
        rclpy.try_shutdown()
    return publishers, subscribers, services, kinds


def _started(name: str, files: dict[str, str]) -> Any:
    """Node of this name, with the files that it needs; it is never spun."""
    from rclpy.parameter import Parameter

    from landmark_nav.ros.node import LandmarkNode

    module = import_module(f'landmark_nav.nodes.{name}')
    (kind,) = (
        value
        for value in vars(module).values()
        if isinstance(value, type)
        and issubclass(value, LandmarkNode)
        and value.__module__ == module.__name__
    )
    given = [Parameter(key, value=value) for key, value in files.items() if key in READS[name]]
    return kind(parameter_overrides=given)


def _topics(
    publishers: dict[str, list[str]], subscribers: dict[str, list[str]], kinds: Any
) -> Iterator[str]:
    from rclpy.qos import QoSProfile

    from landmark_nav.ros.topics import LATCHED

    yield from (
        '# Topics',
        '',
        'Names are relative: a namespace or a remapping moves them. QoS: the depth of the queue, '
        '`reliable` or `best effort`; `latched` is transient local. `qos_overrides` changes the '
        'reliability of each. Where no node is named, the robot, a person or any other program is '
        'meant; `bag_player` publishes what its bag holds, and `/clock`. `landmark_learner` takes '
        '`panorama/*` with `room_file`, and `sweep/*` and `odom` without.',
        '',
        '| topic | type | from | to | QoS | |',
        '|---|---|---|---|---|---|',
    )
    # The ROS wheels have no tf2_msgs, so that nodes do not publish these.
    kind = SimpleNamespace(__module__='tf2_msgs', __name__='TFMessage')
    for topic, nodes, qos in (
        ('tf', ('odometry_fusion', 'room_simulator'), QoSProfile(depth=100)),
        ('tf_static', ('room_simulator',), LATCHED),
    ):
        publishers[topic], kinds[topic] = list(nodes), (kind, qos)
    described = {*publishers, *subscribers}
    if gone := TOPICS.keys() - described:
        raise KeyError(f'no node has {sorted(gone)}')
    for topic in sorted(described):
        kind, qos = kinds[topic]
        latched = ', latched' if qos.durability.name == 'TRANSIENT_LOCAL' else ''
        reliability = qos.reliability.name.lower().replace('_', ' ')
        package = kind.__module__.partition('.')[0]
        yield _row(
            f'`{topic}`',
            f'{package}/{kind.__name__}',
            _names(publishers[topic]),
            _names(subscribers[topic]),
            f'{reliability}, {qos.depth}{latched}',
            TOPICS[topic],
        )


def _services(services: dict[str, str]) -> Iterator[str]:
    yield from (
        '# Services',
        '',
        'All are `std_srvs/srv/Trigger`. One that can not be carried out answers `success: false` '
        'with a `message` that says why and what to do. `landmark-nav call SERVICE` calls them '
        'without `ros2`.',
        '',
        '| service | node | |',
        '|---|---|---|',
    )
    for service, node in services.items():
        yield _row(f'`{service}`', f'`{node}`', SERVICES[service])


def _parameters() -> Iterator[str]:
    users = read_parameters(shipped_config('landmark_nav.yaml'), ())
    yield from (
        '# Parameters',
        '',
        'One file in the format of ROS serves all: `--params-file` of the nodes, `params_file:=` '
        'of the launch files, `--config` of `landmark-nav`. `config/landmark_nav.yaml` (installed '
        'in `share/landmark_nav/config`) holds those in **bold**, which a user may change, with '
        'their defaults. `--ros-args -p NAME:=VALUE` gives a single one to a node. '
        '`ros2 param set /NODE NAME VALUE` changes those with **live** while the node runs: the '
        'next call, image or transform goes by it. The others are read when a node starts, and '
        'refused later. A name that nothing reads is reported, with the one that '
        'it is like; those of the last release are taken or explained.',
        '',
        '| parameter | default | range, unit | nodes | |',
        '|---|---|---|---|---|',
    )
    from landmark_nav.ros.node import Startup

    every = [*leaves(Configuration()), *leaves(Startup())]
    for name, field, value in sorted(every, key=lambda leaf: '.' in leaf[0]):
        nodes = [node for node, read in READS.items() if is_of(name, read)]
        is_live = any(is_of(name, LIVE[node]) for node in nodes if node in LIVE)
        shown = f'**`{name}`**' if name in users else f'`{name}`'
        description = field.metadata['description']
        limits = _range(name, field.metadata)
        yield _row(
            shown,
            f'`{_shown(value)}`',
            limits,
            (_names(nodes) or 'all') + is_live * ', **live**',
            description,
        )
    yield from (
        '',
        '## Of the robot',
        '',
        'Section `odometry` of [robot.yaml](../files.md#robot-file): noise of the wheels.',
        '',
        '| field | default | range, unit | |',
        '|---|---|---|---|',
    )
    for name, field, value in leaves(OdometryNoiseConfig()):
        description = field.metadata['description'].rstrip('.')
        yield _row(f'`{name}`', f'`{_shown(value)}`', _range(name, field.metadata), description)


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'{value:g}' if isinstance(value, float) else str(value) or "''"


def _range(name: str, metadata: Any) -> str:
    low, high, unit = metadata['minimum'], metadata['maximum'], unit_of(name)
    if metadata['choices']:
        return ', '.join(f'`{choice}`' for choice in metadata['choices'])
    if low is None and high is None:
        return ''
    limits = f'{low:g} to {high:g}' if high is not None else f'≥ {low:g}'
    return f'{limits} {unit}'.strip()


def _commands() -> Iterator[str]:
    from landmark_nav.cli.main import actions_of, COMMANDS

    yield from (
        '# Commands',
        '',
        'What `landmark-nav COMMAND --help` prints. [How long they take](../how_well.md#time).',
    )
    for name, (summary, _) in COMMANDS.items():
        yield from ('', f'## {name}', '', f'{summary[0].upper()}{summary[1:]}.', '')
        yield from ('```text', _help(name), '```')
        parser = argparse.ArgumentParser()
        import_module(f'landmark_nav.cli.{name}').add_arguments(parser)
        for action in actions_of(parser):
            yield from ('', f'### {name} {action}', '', '```text', _help(name, action), '```')


def _calibration() -> Iterator[str]:
    from landmark_nav.calibration import Calibration, MEANINGS, NAMES, UNITS
    from landmark_nav.geometry.camera import PanTiltMount

    fields = {name: f'{field}_sigma' for field, names in QUANTITIES.items() for name in names}
    yield from (
        '# Calibration',
        '',
        'What sweeps, adjustment and drive estimate ([estimator](../estimator.md)), the field of '
        '[robot.yaml](../files.md#robot-file) that gives the standard deviation of each quantity, '
        'and the one that holds where the file has none.',
        '',
        '| quantity | unit | field | default | |',
        '|---|---|---|---|---|',
    )
    defaults = Calibration.of_mount(PanTiltMount()).sigmas
    for name, sigma in zip(NAMES, defaults, strict=True):
        yield _row(f'`{name}`', UNITS[name], f'`{fields[name]}`', f'{sigma:g}', MEANINGS[name])


def _help(*command: str) -> str:
    from landmark_nav.cli.main import main

    with patch.dict(os.environ, COLUMNS='99', NO_COLOR='1'), redirect_stdout(io.StringIO()) as out:
        main([*command, '--help'])
    return out.getvalue().strip()


def _names(nodes: list[str]) -> str:
    return ', '.join(f'`{node}`' for node in dict.fromkeys(nodes))


def _row(*cells: str) -> str:
    return '| ' + ' | '.join(cell.replace('|', r'\|') for cell in cells) + ' |'


if __name__ == '__main__':
    for page in write_reference(Path(sys.argv[1])):
        print(page)
