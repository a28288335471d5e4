"""Fuses wheel odometry and landmark detections to the pose of the robot in map."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from landmark_nav.calibration import NAMES, SHOWN_IN, UNITS
from landmark_nav.configuration import Configuration
from landmark_nav.errors import LandmarkNavError
from landmark_nav.localization.estimator.integrity import Status
from landmark_nav.localization.expected_poses import SpreadCorrection
from landmark_nav.localization.fusion import Fusion
from landmark_nav.localization.odometry.track import Distrusted
from landmark_nav.localization.start import with_sigmas
from landmark_nav.messages import decode, encode
from landmark_nav.messages.clouds import GlobalPose
from landmark_nav.nodes.configured import ConfiguredNode
from landmark_nav.nodes.live_pose import LivePose
from landmark_nav.ros.camera_frames import CameraFrames, listen_for_map
from landmark_nav.ros.health import Health, Latency, Level
from landmark_nav.ros.run import run_node
from landmark_nav.ros.topics import ros_factory, TransformBroadcaster
from landmark_nav.storage.robot_files import read_robot, save_calibration
from landmark_nav.types import (
    Detections,
    JointSample,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Refusal,
)

# Least range of the pan at which an uncertain joint delay matters, and greatest time for which
# detections wait for late joint states then.
_PAN_RANGE_RAD, _PATIENCE_S = 0.1, 0.4
_LEVELS = {Status.OK: Level.OK, Status.DEGRADED: Level.DEGRADED, Status.LOST: Level.LOST}
# Least deviation from robot.yaml that is reported, in sigmas of the estimated value.
_SIGNIFICANT_SIGMAS = 5.0
# Sigmas of an initialpose without covariance, which a person sets on a plan by hand.
_START_SIGMA_M, _START_SIGMA_RAD = 0.3, 0.2


class OdometryFusionNode(ConfiguredNode):
    """Fuses ``odom`` and ``detections`` to ``odometry/fused`` by `Fusion`."""

    def __init__(self, **options: Any) -> None:
        super().__init__('odometry_fusion', 'fusion', **options)

    def set_up(self) -> None:
        """Read parameters and files; create topics and services."""
        super().set_up()
        calibration = self._robot()
        self._mount = calibration.mount
        self._fused = self.advertise('odometry/fused')
        self._live = LivePose(self, self.config.map_frame)
        self._transform = TransformBroadcaster(self)
        self._spread = SpreadCorrection(self.config.correction_time_s)
        config = self.config
        self._fusion = Fusion(LandmarkMap(()), calibration, config.estimator, config.odometry)
        self._expectation = self.advertise('expectation')
        self._level = self.advertise('odometry_fusion/protection_level')
        self._landmarks = 0
        self._accepted = self._rejected = 0
        self._last: OdometrySample | None = None
        self._heard_ns = 0
        self._start_given_ns: int | None = None
        self._odom_frame = 'odom'
        self._latency = Latency()
        self._waiting: deque[Detections | GlobalPose] = deque()
        self._last_message: Any = None
        self.listen('odom', self._on_odometry, depth=50)
        self._frames = CameraFrames(self, self._mount)
        self.listen('detections', self._on_detections)
        self.listen('initialpose', self._on_initial_pose)
        self.listen('global_localization/pose', self._on_global_pose)
        listen_for_map(self, self.config.map_frame, self._on_map)
        self.offer('calibrate', self._calibrate)

    def _reconfigure(self, config: Configuration) -> None:
        """Use changed parameters."""
        self.config, self._spread.time_constant_s = config, config.correction_time_s

    def health(self) -> Health:
        """Status of the fusion."""
        # Without odometry the fusion does not advance, so that the time is given.
        status, reason = self._fusion.status_at(self._now_ns() if self._last else None)
        counts = {'landmarks': self._landmarks, 'accepted': self._accepted}
        values = counts | {'rejected': self._rejected} | self._latency.values()
        values |= _calibration_values(self._fusion)
        advice = self._delay_advice() + self._mount_advice()
        advice += ''.join(f'; {each}' for each in self._fusion.map_contradictions)
        return Health(_LEVELS[status], (reason or 'tracking') + advice, values)

    def _now_ns(self) -> int:
        """Time now by the clock of the odometry."""
        now_ns = int(self.get_clock().now().nanoseconds)
        return now_ns if self._last is None else self._last.stamp_ns + now_ns - self._heard_ns

    def _delay_advice(self) -> str:
        """Advice to set an estimated joint delay in robot.yaml; empty if it does not matter."""
        late = self._fusion.late
        if not late.matters:
            return ''
        advice = (
            f'; joint_states are stamped {1e3 * late.delay_s:.1f} ms late, which is put right; at '
            f'once with joint_delay: {late.delay_s:.4f} in robot.yaml'
        )
        if late.delay_s < 0.0:
            advice += '; or the images are late: landmark-nav check shows it in a recording'
        return advice

    def _mount_advice(self) -> str:
        """Significant deviations of the estimated calibration from robot.yaml."""
        known, prior = self._fusion.calibration, self._fusion.robot
        off = known.values - prior.values
        far = np.abs(off) > np.maximum(prior.sigmas, _SIGNIFICANT_SIGMAS * known.sigmas)
        names = []
        for name, value in zip(NAMES, np.where(far, off, 0.0).tolist(), strict=True):
            factor, unit = SHOWN_IN[UNITS[name]]
            if value and name != 'joint_delay':
                names.append(f'{name} by {factor * value:+.2f} {unit}')
        return f'; robot.yaml is off, which is put right: {", ".join(names)}' if names else ''

    def _on_map(self, landmarks: LandmarkMap) -> None:
        """Change the map and keep the pose."""
        self._fusion.change_map(landmarks)
        self._landmarks = len(landmarks.landmarks)
        self.get_logger().info(f'{self._landmarks} landmarks received')

    def _calibrate(self) -> str:
        """Write the estimated calibration beside `robot_file`, which is not changed."""
        given, found = self._fusion.robot, self._fusion.calibration
        hidden = found.unobserved(given)
        shown = [name for name in NAMES if name not in hidden and given[name][1] > 0.0]
        if not (shown and self._fusion.used_image):
            raise LandmarkNavError(
                'the drive has shown nothing of the calibration yet: find the pose, then drive a '
                'metre straight on and turn on the spot'
            )
        file = Path(self.config.robot_file)
        written = file.with_name(f'{file.stem}_calibrated.yaml')
        noise = read_robot(file, self.config.former_robot).get('odometry')
        save_calibration(found, written, noise)
        off = found.surprises(given) or 'nothing is off'
        words = f'{len(shown)} quantities calibrated in {written}; {off}'
        return f'{words}; not observed: {", ".join(hidden)}' if hidden else words

    def _on_initial_pose(self, message: Any) -> None:
        decode.check_frame(message.header, self.config.map_frame, 'give it there')
        start = decode.pose_estimate(message)
        start = with_sigmas(start, _START_SIGMA_M, _START_SIGMA_RAD)
        self._fusion.initialize(start, self._now_ns())
        self._started(start, 'start')
        self._start_given_ns = None if self._last is None else self._now_ns()
        self._waiting = deque(one for one in self._waiting if isinstance(one, Detections))

    def _on_global_pose(self, message: Any) -> None:
        decode.check_frame(message.header, self.config.map_frame, 'set map_frame to it')
        place = decode.global_pose(message)
        if not self._fusion.reaches(place.stamp_ns):
            raise LandmarkNavError('it is of an image far off the odometry that is kept')
        if self._start_given_ns is not None and place.stamp_ns <= self._start_given_ns:
            raise LandmarkNavError('it is of an image from before the given start pose')
        self._waiting.append(place)
        self._use_waiting()

    def _started(self, start: PoseEstimate, how: str) -> None:
        self._spread.restart()
        self._live.restart()
        x, y, heading = start.pose
        self.get_logger().info(f'{how} at ({x:.2f}, {y:.2f}) m, {np.degrees(heading):.1f} deg')

    def _on_odometry(self, message: Any) -> None:
        if message == self._last_message:
            # A repeated message does not count: a source that only repeats one has failed.
            return
        self._last_message = message
        sample = decode.odometry(message)
        refusal = self._fusion.add_odometry(sample)
        if isinstance(refusal, Distrusted):
            self.note(str(refusal))
        elif refusal is not None:
            # Odometry that is late or frozen does not advance the filter.
            raise LandmarkNavError(str(refusal))
        if self._last is not None and sample.stamp_ns < self._last.stamp_ns:
            # The clock was set back: the stamp of the given start does not apply to it.
            self._start_given_ns = None
        self._last, self._heard_ns = sample, self.get_clock().now().nanoseconds
        self._odom_frame = message.header.frame_id.lstrip('/')
        self._use_waiting()
        estimate = self._estimate(sample.stamp_ns)
        if estimate is not None:
            self._publish(estimate, sample)
            # Only here, as a transform must not be published twice for one stamp.
            pose = self._spread.at(sample.stamp_ns, estimate.pose, sample.pose_odom_base)
            frames = (self.config.map_frame, self._odom_frame)
            self._transform.send(sample.stamp_ns, [encode.planar_transform(*frames, pose)])

    def _on_detections(self, message: Any) -> None:
        self._waiting.append(decode.detections(message))
        self._use_waiting()

    def _use_waiting(self) -> None:
        """Use waiting detections and global poses in order, up to the first that must wait."""
        while self._waiting and not self._waits(self._waiting[0]):
            found = self._waiting.popleft()
            if isinstance(found, Detections):
                self._use(found)
            elif not self._fusion.reaches(found.stamp_ns):
                self.note('global_localization/pose dropped: its image is far off the odometry')
            else:
                self._fusion.place(found, self._joints_of(found))
                self._started(found, 'found')

    def _waits(self, found: Detections | GlobalPose) -> bool:
        """Whether detections or a global pose must wait for joint states that may still arrive."""
        late = self._fusion.late
        settled = late.is_known or self._frames.pan_range_rad < _PAN_RANGE_RAD
        if settled and not late.matters:
            return False
        ahead_s = found.joint_delay_s + (late.delay_s if settled else _PATIENCE_S)
        newest = self._last.stamp_ns if self._last is not None else 0
        if 1e-9 * abs(newest - found.stamp_ns) > _PATIENCE_S:
            # It has waited long enough, or has another clock than the odometry.
            return False
        return not self._frames.reaches(found.stamp_ns + round(1e9 * ahead_s))

    def _joints_of(self, found: Detections | GlobalPose) -> JointSample | None:
        """Angles at the stamp of an image and the assumed delay, if they are known."""
        joints = self._frames.joints_at(found.stamp_ns + round(1e9 * found.joint_delay_s))
        return None if isinstance(joints, Refusal) else joints

    def _use(self, found: Detections) -> None:
        update = self._fusion.add_detections(found, self._joints_of(found))
        if isinstance(update, Refusal):
            self.note(f'detections dropped: {update}')
            return
        self._accepted += len(update.used)
        self._rejected += len(update.columns) - len(update.used)
        self._corrected(found.stamp_ns)

    def _corrected(self, stamp_ns: int) -> None:
        """Publish the pose after an update by an image, at the newest stamp."""
        if self._last is None:
            return
        newest = max(stamp_ns, self._last.stamp_ns)
        estimate = self._estimate(newest)
        if estimate is not None:
            self._publish(estimate, replace(self._last, stamp_ns=newest))
            self._latency.note(self.get_clock().now().nanoseconds - stamp_ns)

    def _estimate(self, stamp_ns: int) -> PoseEstimate | None:
        """Pose at a time; None before the first known one, as of an image newer than odometry."""
        estimate = self._fusion.estimate(stamp_ns)
        return None if estimate is None or estimate.stamp_ns > stamp_ns else estimate

    def _publish(self, estimate: PoseEstimate, sample: OdometrySample) -> None:
        fused = replace(sample, pose_odom_base=estimate.pose)
        frames = {'frame_id': self.config.map_frame, 'child_frame_id': self._mount.base_frame}
        # Before the pose, so that a node that has received the pose has the expectation too.
        expected = self._fusion.expectation(estimate.stamp_ns)
        if expected is not None:
            self._expectation.publish(
                encode.expectation(ros_factory, expected, sample, self.config.map_frame)
            )
        if self._level.get_subscription_count():
            level = self._protection_level(estimate)
            self._level.publish(encode.pose(ros_factory, level, self.config.map_frame))
        self._fused.publish(encode.odometry(ros_factory, fused, estimate.covariance, **frames))
        self._live.show(estimate, sample, lambda: self._protection_level(estimate))

    def _protection_level(self, estimate: PoseEstimate) -> PoseEstimate:
        """Pose with a covariance whose one-sigma bound is the protection level."""
        return self._fusion.level(estimate).scaled(estimate)


def _calibration_values(fusion: Fusion) -> dict[str, str]:
    """Prior, value and sigma of quantities that are not exact, and whether they are observed."""
    delay_s, sigma_s = fusion.calibration['joint_delay']
    values = {'joint_delay_ms': f'{1e3 * delay_s:.2f} +- {1e3 * sigma_s:.2f}'}
    for name, of in fusion.calibration.differences(fusion.robot).items():
        if fusion.robot[name][1] > 0.0:
            factor, unit = SHOWN_IN[UNITS[name]]
            value, sigma = (factor * float(of[key]) for key in ('value', 'sigma'))
            prior, given = (factor * number for number in fusion.robot[name])
            known = '' if of['observed'] else ', not observed yet'
            values[f'calibration/{name}'] = (
                f'{value:.3f} +- {sigma:.3f} {unit} (prior {prior:.3f} +- {given:.3f}{known})'
            )
    return values


main = partial(run_node, OdometryFusionNode)

if __name__ == '__main__':
    raise SystemExit(main())
