"""
Parameters of all nodes and of ``--config``, and the nodes that read them.

Values that describe the method are constants beside their use; those that describe the robot are
in `robot.yaml`. ``config/landmark_nav.yaml`` holds the parameters that a user may want to change.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
import logging
from pathlib import Path
from typing import Any

from landmark_nav.errors import inside, LandmarkNavError, shown
from landmark_nav.former_parameters import settled
from landmark_nav.learning.capture.config import CaptureConfig
from landmark_nav.learning.pipeline import LearningConfig
from landmark_nav.learning.unmeasured import UnmeasuredConfig
from landmark_nav.localization.localizer import LocalizationConfig
from landmark_nav.localization.triplet.look_around import LookAroundConfig
from landmark_nav.parameters import changed, Config, leaves, parameter
from landmark_nav.storage.robot_files import load_odometry, load_robot, read_parameters

_LOG = logging.getLogger(__name__)

_WHERE = ': docs/reference/parameters.md lists all'

# Node -> parameters and sections that it reads.
READS: dict[str, tuple[str, ...]] = {
    'sweep_capture': ('robot_file', 'image_transport', 'capture', 'command'),
    'panorama_synthesizer': ('robot_file', 'room_file'),
    'landmark_learner': (
        *('robot_file', 'room_file', 'map_folder', 'load_on_start'),
        *('attention', 'stereo', 'election', 'unmeasured'),
    ),
    'triplet_selector': (
        *('robot_file', 'map_frame', 'triplet', 'look_around', 'command', 'yield_s'),
    ),
    'triangulation_localizer': (
        *('robot_file', 'map_frame', 'image_transport', 'max_age_s'),
        *('triplet', 'relocalization'),
    ),
    'odometry_fusion': ('robot_file', 'map_frame', 'correction_time_s', 'estimator'),
    'room_simulator': ('seed', 'room_file', 'robot_file', 'camera_file', 'command.type'),
    'bag_player': ('bag', 'rate'),
}
# Node -> those that may be set while it runs, with effect from the next call, image or transform.
LIVE: dict[str, tuple[str, ...]] = {
    'sweep_capture': ('capture',),
    'landmark_learner': ('map_folder', 'attention', 'stereo', 'election', 'unmeasured'),
    'triplet_selector': ('yield_s',),
    'triangulation_localizer': ('max_age_s', 'relocalization'),
    'odometry_fusion': ('correction_time_s',),
}


@dataclass(frozen=True)
class PanCommandConfig(Config):
    """Format of the commands of the pan-tilt unit."""

    type: str = parameter(
        'JointTrajectory',
        'message type of pan_tilt/command',
        choices=('JointTrajectory', 'JointState', 'Float64MultiArray'),
    )
    with_tilt: bool = parameter(False, 'command the tilt joint too, to stay level')


@dataclass(frozen=True)
class Configuration(LearningConfig, LocalizationConfig):
    """
    Parameters of all nodes and commands, and settings of all stages.

    `former_robot` holds fields of `robot.yaml` that were parameters in the last release.
    """

    robot_file: str = parameter(
        '', 'robot.yaml, or a URDF: where the turning camera sits, joints, wheels'
    )
    room_file: str = parameter('', 'room.yaml: walls and papers; empty: walls and poses are found')
    map_folder: str = parameter('map', 'folder that save_map writes and load_map reads')
    load_on_start: bool = parameter(False, 'load the map as soon as the node starts')
    map_frame: str = parameter('map', 'frame of the map in messages and on /tf')
    image_transport: str = parameter(
        'auto', 'form of camera/image_raw', choices=('auto', 'raw', 'compressed')
    )
    correction_time_s: float = parameter(
        0.0,
        'time constant over which a correction of the transform map to odom is spread; 0 makes it '
        'at once; odometry/fused is never held back',
        minimum=0.0,
        maximum=60.0,
    )
    max_age_s: float = parameter(
        0.5, 'an image that arrives later is not looked at', minimum=0.01, maximum=10.0
    )
    yield_s: float = parameter(
        10.0,
        'how long to hold back after somebody else commanded the pan',
        minimum=0.0,
        maximum=3600.0,
    )
    bag: str = parameter('', 'rosbag2 folder or .mcap file to play')
    rate: float = parameter(1.0, 'speed relative to the recording', minimum=0.01, maximum=100.0)
    seed: int = parameter(1, 'draws the room and all noise', minimum=0, maximum=2**31 - 1)
    camera_file: str = parameter(
        '', 'calibration of the camera, as camera_calibration writes it; empty: 512 x 512 pixels'
    )
    unmeasured: UnmeasuredConfig = field(default_factory=UnmeasuredConfig)
    capture: CaptureConfig = field(default_factory=CaptureConfig)
    look_around: LookAroundConfig = field(default_factory=LookAroundConfig)
    command: PanCommandConfig = field(default_factory=PanCommandConfig)
    former_robot: Mapping[str, Any] = field(default_factory=dict, compare=False)


def load_configuration(
    path: Path | str | None, robot_file: Path | str, *nodes: str
) -> Configuration:
    """
    Read the parameters of `nodes` as they do, with defaults for those not in the file.

    The file is as for ``--params-file``; noise of the odometry and pan unit come from
    `robot_file`. Raises `LandmarkNavError`: the file is not YAML, a parameter does not exist, or a
    value is invalid.
    """
    config = replace(Configuration(), robot_file=str(robot_file))
    if path:
        known = [name for name, _, _ in leaves(config)]
        given = settled(read_parameters(path, nodes), known)
        for warning in given.warnings:
            _LOG.warning('%s: %s', path, warning)
        for name, meant in given.unknown.items():
            raise LandmarkNavError(f'{path}: no parameter {shown(name)}{meant or _WHERE}')
        values = given.values | {'robot_file': str(robot_file)}
        with inside(path):
            config = replace(changed(config, values), former_robot=given.robot)
    return with_robot(config)


def with_robot(config: Configuration) -> Configuration:
    """
    Return a configuration with pan unit and noise of the odometry by its robot file.

    Raises `LandmarkNavError`: the file cannot be read, or is invalid.
    """
    path, former = config.robot_file, config.former_robot
    mount = load_robot(path, former)
    low, high = mount.pan_limits_rad
    return replace(
        config,
        capture=replace(config.capture, pan_min_rad=low, pan_max_rad=high),
        triplet=replace(
            config.triplet,
            pan_rate_rad_s=mount.pan_rate_rad_s,
            pan_acceleration_rad_s2=mount.pan_acceleration_rad_s2,
        ),
        odometry=load_odometry(path, config.odometry, former),
    )
