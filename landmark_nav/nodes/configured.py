"""Parameters of a node, and values of its robot file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from landmark_nav.calibration import Calibration
from landmark_nav.configuration import Configuration, LIVE, READS, with_robot
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.parameters import declare, follow, settle
from landmark_nav.storage.robot_files import load_calibration


def configured(
    node: LandmarkNode, name: str, take: Callable[[Configuration], None] | None = None
) -> Configuration:
    """
    Declare the parameters that the executable `name` reads, and return their values.

    After parameters of `LIVE` were set, `take` is called with the new configuration. Raises
    `LandmarkNavError`: a value of a parameter is invalid, or the robot file cannot be read.
    """
    former_robot = settle(node, Configuration())
    live = LIVE.get(name, ())
    config = declare(node, Configuration(), READS[name], live)
    config = replace(config, former_robot=former_robot)
    config = with_robot(config) if config.robot_file else config
    if take is not None:
        node.close_with(follow(node, config, live, take))
    return config


def calibration_of(node: LandmarkNode, config: Configuration) -> Calibration:
    """
    Read the calibration from the robot file.

    Raises `LandmarkNavError`: no robot file is given, or it cannot be read.
    """
    path = node.required('robot_file', config.robot_file)
    return load_calibration(path, config.former_robot)
