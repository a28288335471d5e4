"""Base of the nodes: values of their parameters and of their robot file."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from landmark_nav.calibration import Calibration
from landmark_nav.configuration import Configuration, LIVE, READS, with_robot
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.parameters import declare, follow, settle
from landmark_nav.storage.robot_files import load_calibration


class ConfiguredNode(LandmarkNode):
    """A node with the parameters that the executable `name` reads, in `config`."""

    def __init__(self, name: str, subcomponent: str, **options: Any) -> None:
        self._executable = name
        super().__init__(name, subcomponent, **options)

    def set_up(self) -> None:
        """
        Read parameters and files; subclasses create topics and services.

        Raises `LandmarkNavError`: a value of a parameter is invalid, or a file cannot be read.
        """
        former_robot = settle(self, Configuration())
        live = LIVE.get(self._executable, ())
        config = declare(self, Configuration(), READS[self._executable], live)
        config = replace(config, former_robot=former_robot)
        self.config = with_robot(config) if config.robot_file else config
        self.close_with(follow(self, self.config, live, self._reconfigure))

    def _reconfigure(self, config: Configuration) -> None:
        """Use changed parameters of `LIVE`."""
        self.config = config

    def _robot(self) -> Calibration:
        """Calibration in the robot file; `LandmarkNavError` without one."""
        path = self.required('robot_file', self.config.robot_file)
        return load_calibration(path, self.config.former_robot)
