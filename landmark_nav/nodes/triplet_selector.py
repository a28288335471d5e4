"""Chooses the three landmarks of the best expected fix and turns the camera to them."""

from __future__ import annotations

from collections import deque
from functools import partial
import time
from typing import Any

import numpy as np

from landmark_nav.localization.triplet.look_around import is_known, LookAround
from landmark_nav.localization.triplet.planning_scene import CameraState
from landmark_nav.localization.triplet.ranking import Ranking
from landmark_nav.localization.triplet.selection import ActiveCamera
from landmark_nav.messages import decode, encode
from landmark_nav.messages.clouds import pack_cloud
from landmark_nav.nodes.configured import ConfiguredNode
from landmark_nav.ros.camera_frames import (
    CameraFrames,
    listen_for_map,
    listen_for_pan,
    PanCommander,
)
from landmark_nav.ros.health import Health, Level, own_clock
from landmark_nav.ros.run import run_node
from landmark_nav.ros.topics import message_class, RELIABLE, ros_factory
from landmark_nav.types import LandmarkMap, PoseEstimate, Refusal

# Greatest age of the fused pose for a choice.
_SILENCE_S = 1.0
# Period of choices, chosen by hand: a turn of half a radian takes as long.
_PERIOD_S = 0.5
# Least change of the pan that is commanded, chosen by hand: some 3 degrees.
_DEADBAND_RAD = 0.05
# Period at which the view is checked while the camera looks around.
_DWELL_TIME_S = 0.1
# Number of own commands that are remembered: they are received too, on a busy machine after later
# ones.
_ECHOES = 8


class TripletSelectorNode(ConfiguredNode):
    """Turns ``odometry/fused`` into ``triplet`` and commands of the pan by `ActiveCamera`."""

    def __init__(self, **options: Any) -> None:
        super().__init__('triplet_selector', 'attention', **options)

    def set_up(self) -> None:
        """Read parameters and files; create topics and services."""
        super().set_up()
        self._given = self._robot()
        self._mount = self._calibrated = self._given.mount
        self._publisher = self.advertise('triplet')
        cloud = message_class('sensor_msgs/msg/PointCloud2')
        self._triplet_scores = self.create_publisher(cloud, '~/triplet_scores', RELIABLE)
        self._landmark_visibility = self.create_publisher(cloud, '~/landmark_visibility', RELIABLE)
        self._frames = CameraFrames(self, self._mount)
        command = self.config.command
        self._commander = PanCommander(self, self._mount, command.type, command.with_tilt)
        self._map: LandmarkMap | None = None
        self._fused: PoseEstimate | None = None
        self._fused_s = 0.0
        self._camera: ActiveCamera | None = None
        self._limits = self._mount.pan_limits_rad
        self._around = LookAround(self.config.look_around, self._limits)
        self._looks_at: float | None = None
        self._commanded: deque[float] = deque(maxlen=_ECHOES)
        self._yield_until = 0.0
        self._health = Health(Level.DEGRADED, 'waits for its first choice')
        self.listen('odometry/fused', self._on_fused, depth=1)
        self.listen('expectation', self._on_expectation, depth=1)
        self.listen('detections', self._on_detections)
        listen_for_pan(self, self._mount, command.type, self._on_command)
        listen_for_map(self, self.config.map_frame, self._on_map)
        self.create_timer(_PERIOD_S, self._choose, clock=own_clock(self))
        self.create_timer(_DWELL_TIME_S, self._look_around, clock=own_clock(self))

    def health(self) -> Health:
        """Last choice, or the missing input; independent of a stopped clock."""
        missing, at = self._missing(), self._looks_at
        health = Health(Level.DEGRADED, missing) if missing else self._health
        if at is None:
            return health
        words = f'{health.reason}; looks around for the place, at {np.degrees(at):.0f} deg'
        return Health(Level.DEGRADED, words, health.values)

    def _on_fused(self, message: Any) -> None:
        decode.check_frame(message.header, self.config.map_frame, 'set map_frame to it')
        self._fused, self._fused_s = decode.pose_estimate(message), time.monotonic()

    def _on_expectation(self, message: Any) -> None:
        """Use the extrinsics estimated by the fusion."""
        self._calibrated = decode.expectation(message, self._mount)[0].calibration.mount
        if self._camera is not None:
            self._camera.mount = self._calibrated

    def _on_map(self, landmarks: LandmarkMap) -> None:
        self._map = landmarks
        # Until the fusion estimates it.
        self._calibrated = self._map.calibration_from(self._given).mount
        self._camera = ActiveCamera(self._map, self._calibrated, self.config.triplet)

    def _on_detections(self, message: Any) -> None:
        """Count found and missed landmarks of those that should be in view."""
        if self._camera is not None:
            self._camera.saw(decode.detections(message))

    def _on_command(self, pan_rad: float) -> None:
        """Yield the camera for a while if another node, such as a sweep, commands the pan."""
        if not any(abs(pan_rad - own) <= 1e-6 for own in self._commanded):
            self._yield_until = time.monotonic() + self.config.yield_s
            self._commanded.clear()
            self._commanded.append(pan_rad)

    def _missing(self) -> str:
        """Description of the missing input of a choice; empty if none is missing."""
        silent_s = time.monotonic() - self._fused_s
        if self._camera is None:
            return 'no landmarks: call learn_landmarks or load_map'
        if self._fused is None:
            return 'no fused pose: odom is missing, or the place is not found yet'
        if silent_s > _SILENCE_S:
            return f'no fused pose for {silent_s:.1f} s'
        return '' if self._frames.camera is not None else 'no camera_info'

    def _choose(self) -> None:
        active, fused, model, known = self._camera, self._fused, self._frames.camera, self._map
        if active is None or known is None or fused is None or model is None or self._missing():
            return
        start = time.perf_counter()
        camera_state = CameraState(self._frames.pan_rad, self._frames.tilt_rad, self._limits)
        ranking = active.choose(fused, model, camera_state)
        took_ms = 1e3 * (time.perf_counter() - start)
        stamp, base = fused.stamp_ns, self._mount.base_frame
        head = encode.header(ros_factory, stamp, base)
        self._triplet_scores.publish(pack_cloud(ros_factory, head, ranking.table()))
        visibility = ranking.landmark_table(known.ids)
        self._landmark_visibility.publish(pack_cloud(ros_factory, head, visibility))
        chosen = ranking.chosen
        values = {'choice_ms': f'{took_ms:.1f}'} | _why_others_lost(ranking)
        if isinstance(chosen, Refusal):
            self._health = Health(Level.DEGRADED, f'no triplet: {chosen}', values)
            return
        self._publisher.publish(encode.triplet(ros_factory, chosen, base))
        sigma_m = float(np.sqrt(np.trace(chosen.covariance[:2, :2])))
        names = ', '.join(str(k) for k in chosen.ids)
        values['pan_deg'] = f'{np.degrees(chosen.pan_rad):.1f}'
        values['sigma_m'] = f'{sigma_m:.4f}'
        self._health = Health(Level.OK, f'landmarks {names}', values)
        if self._looks_at is None and time.monotonic() >= self._yield_until:
            self._command(chosen.pan_rad, _DEADBAND_RAD)

    def _look_around(self) -> None:
        """Turn the camera from view to view while the pose is unknown, for global localization."""
        now_s, model, pan_rad = time.monotonic(), self._frames.camera, self._frames.pan_rad
        self._looks_at = None
        fused = self._fused if now_s - self._fused_s <= _SILENCE_S else None
        if now_s < self._yield_until or (fused is not None and is_known(fused)):
            self._around.end()
        elif self._camera is not None and model is not None and pan_rad is not None:
            self._looks_at = self._around.pan_at(now_s, pan_rad, 2.0 * model.half_fov_rad)
            if self._looks_at is not None:
                self._command(self._looks_at, 0.0)

    def _command(self, pan_rad: float, deadband_rad: float) -> None:
        if not self._commanded or abs(pan_rad - self._commanded[-1]) > deadband_rad:
            self._commanded.append(pan_rad)
            self._commander.command(pan_rad, self._frames.pan_rad)


def _why_others_lost(ranking: Ranking) -> dict[str, str]:
    """Diagnostic values: the next best triplets and the excluded landmarks, with reasons."""
    rivals = zip(ranking.ids[1:], ranking.sigma_m[1:], ranking.verdicts()[1:], strict=True)
    lines = {
        f'rival_{k}': f'{"-".join(map(str, ids))}: {why.words} ({1e3 * sigma:.1f} mm)'
        for k, (ids, sigma, why) in enumerate(rivals, 1)
    }
    excluded = ', '.join(f'{count} {words}' for words, count in ranking.excluded().items())
    return lines | {'excluded': excluded or 'none'}


main = partial(run_node, TripletSelectorNode)

if __name__ == '__main__':
    raise SystemExit(main())
