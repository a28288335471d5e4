"""Chooses the three landmarks that promise the best fix and turns the camera to them."""

from __future__ import annotations

from dataclasses import dataclass, field
import time
from typing import Any

import numpy as np

from landmark_nav.localization.triplet import select_triplet, TripletConfig
from landmark_nav.messages import decode, encode
from landmark_nav.parameters import check_parameters, parameter
from landmark_nav.ros.camera_frames import CameraFrames
from landmark_nav.ros.factory import ros_factory
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.pan_command import listen_for_pan, PanCommander, PanCommandParameters
from landmark_nav.ros.run import run_node
from landmark_nav.ros.same_stamp import listen_together
from landmark_nav.storage.setup_files import load_robot
from landmark_nav.types import LandmarkMap, PoseEstimate, Refusal, Triplet

__all__ = ['Parameters', 'TripletSelectorNode', 'main']


@dataclass(frozen=True)
class Parameters:
    """Of the node ``triplet_selector``."""

    robot_file: str = parameter('', 'robot.yaml: where the turning camera sits')
    period_s: float = parameter(0.5, 'time between two choices, s', minimum=0.05)
    deadband_rad: float = parameter(
        0.05, 'least change of the pan that is worth a command, rad', minimum=0.0
    )
    pan_min_rad: float = parameter(-np.pi, 'least pan of the joint, rad', maximum=0.0)
    pan_max_rad: float = parameter(np.pi, 'largest pan of the joint, rad', minimum=0.0)
    yield_s: float = parameter(
        10.0, 'how long to hold back after somebody else commanded the pan, s', minimum=0.0
    )
    triplet: TripletConfig = field(default_factory=TripletConfig)
    command: PanCommandParameters = field(default_factory=PanCommandParameters)

    def __post_init__(self) -> None:
        """Check the values."""
        check_parameters(self)


class TripletSelectorNode(LandmarkNode):
    """``odometry/fused`` to ``triplet`` and the pan, by `localization.triplet.select_triplet`."""

    def __init__(self, **options: Any) -> None:
        super().__init__('triplet_selector', 'attention', **options)
        self._config = self.configure(Parameters)
        self._mount = load_robot(self.required('robot_file', self._config.robot_file))
        self._publisher = self.advertise('triplet')
        self._frames = CameraFrames(self, self._mount)
        self._commander = PanCommander(self, self._mount, self._config.command)
        self._map: LandmarkMap | None = None
        self._fused: PoseEstimate | None = None
        self._chosen: Triplet | None = None
        self._commanded_rad: float | None = None
        self._yield_until = 0.0
        self._health = Health(Level.DEGRADED, 'no landmarks: call learn_landmarks or load_map')
        self.listen('odometry/fused', self._on_fused, depth=1)
        listen_for_pan(self, self._mount, self._config.command.type, self._on_command)
        listen_together(self, ('landmarks', 'landmarks/atlas'), self._on_landmarks)
        self.create_timer(self._config.period_s, self._choose)

    def health(self) -> Health:
        """What was chosen last."""
        return self._health

    def _on_fused(self, message: Any) -> None:
        self._fused = decode.pose_estimate(message)

    def _on_landmarks(self, points: Any, atlas: Any) -> None:
        self._map = decode.landmark_map(points, atlas)

    def _on_command(self, pan_rad: float) -> None:
        """Leave the camera to who else turns it, such as a sweep."""
        if self._commanded_rad is None or abs(pan_rad - self._commanded_rad) > 1e-6:
            self._yield_until = time.monotonic() + self._config.yield_s
            self._commanded_rad = pan_rad

    def _choose(self) -> None:
        if self._map is None or self._fused is None or self._frames.camera is None:
            return
        chosen = select_triplet(
            self._fused,
            self._map,
            self._frames.camera,
            self._mount,
            self._config.triplet,
            joint_limits=(self._config.pan_min_rad, self._config.pan_max_rad),
            previous=self._chosen,
        )
        if isinstance(chosen, Refusal):
            self._health = Health(Level.DEGRADED, f'no triplet: {chosen}')
            return
        self._chosen = chosen
        self._publisher.publish(encode.triplet(ros_factory, chosen, self._mount.base_frame))
        sigma_m = float(np.sqrt(np.trace(chosen.covariance[:2, :2])))
        names = ', '.join(str(k) for k in chosen.ids)
        values = {'pan_deg': f'{np.degrees(chosen.pan_rad):.1f}', 'sigma_m': f'{sigma_m:.4f}'}
        self._health = Health(Level.OK, f'landmarks {names}', values)
        self._turn_to(chosen)

    def _turn_to(self, chosen: Triplet) -> None:
        if time.monotonic() < self._yield_until:
            return
        last = self._commanded_rad
        if last is None or abs(chosen.pan_rad - last) > self._config.deadband_rad:
            self._commanded_rad = chosen.pan_rad
            self._commander.command(chosen.pan_rad, self._frames.pan_rad)


def main() -> int:
    """Entry point of the executable."""
    return run_node(TripletSelectorNode)


if __name__ == '__main__':
    raise SystemExit(main())
