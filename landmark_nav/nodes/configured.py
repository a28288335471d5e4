"""Parameters of a node, and what its robot file says."""

from __future__ import annotations

from dataclasses import replace

from landmark_nav.calibration import Calibration
from landmark_nav.configuration import Configuration, READS, with_robot
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.parameters import declare, settle
from landmark_nav.storage.robot_files import load_calibration


def configured(node: LandmarkNode, name: str) -> Configuration:
    """
    Declare the parameters that the executable `name` reads, and return their values.

    Raises `LandmarkNavError`: a value that a parameter may not take; a robot file that can not be
    read.
    """
    former_robot = settle(node, Configuration())
    config = replace(declare(node, Configuration(), READS[name]), former_robot=former_robot)
    return with_robot(config) if config.robot_file else config


def calibration_of(node: LandmarkNode, config: Configuration) -> Calibration:
    """
    Read the calibration of the robot file, which the node needs.

    Raises `LandmarkNavError`: none is given, or it can not be read.
    """
    path = node.required('robot_file', config.robot_file)
    return load_calibration(path, config.former_robot)
