"""
The state machine that captures one sweep.

It is event-driven and has no clock: the caller adds joint samples, frames and odometry on arrival,
and requests the next command. Arrival and settling are detected in the joint angles; time limits
are only used to stop with a reason.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
import logging
from typing import Any

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.cylinder import describe_coverage
from landmark_nav.learning.capture.config import CaptureConfig
from landmark_nav.learning.capture.frames import Album, FrameLog, KeptFrame, Look, sharpest, Shot
from landmark_nav.learning.capture.joints import BaseMotion, JointTrack, PanReach
from landmark_nav.types import JointSample, OdometrySample

_LOG = logging.getLogger(__name__)

# If this number of frames at one pan agree in sharpness (relative range), they are kept although
# their neighbours are sharper.
_MAX_SHARPNESS_RANGE = 0.1
_SIMILAR_FRAMES = 3
# Number of frames of which the sharper one is kept where no neighbour overlaps.
_TO_COMPARE = 2
# Largest age of a sweep that is continued: light and objects change. Chosen by hand.
_RESUME_S = 600.0


class _Phase(Enum):
    """Phase of a step: what it waits for."""

    SETTLING = 'the pan joint to stand at the commanded angle'
    EXPOSING = 'an image'
    CONFIRMING = 'a joint sample later than the image'


@dataclass
class _Step:
    """The current step. Stamps are those of messages; other times are by the caller's clock."""

    # None if all frames are kept and only the motion of the joint is to be checked.
    number: int | None
    target_rad: float
    shots: list[KeptFrame]
    begin_stamp_ns: int | None
    progress_ns: int = 0
    progress_stamp_ns: int = 0
    phase: _Phase = _Phase.SETTLING
    pending: Shot | None = None
    refusals: int = 0
    commanded_ns: int | None = None
    settled_stamp_ns: int = 0
    again_ns: int = 0
    distance_rad: float = float(np.inf)


class SweepCapture:
    """
    A sweep, from its first command to its last frame, over any number of interruptions.

    `refused` are numbers of refused frames by reason, `reach` the steps that the joint can reach,
    `base_motion` the motion of the base since the first frame. `inspect` measures a frame, and
    raises `LandmarkNavError` for one that cannot be used. Times `now_ns` are by the caller's
    clock, which need not be that of the stamps.
    """

    def __init__(self, config: CaptureConfig, inspect: Callable[[Any], Look], now_ns: int) -> None:
        self._config = config
        self._inspect = inspect
        self._album: Album = Album()
        self._reviewed = False
        self.base_motion = BaseMotion()
        self.refused: Counter[str] = Counter()
        self.resume(now_ns)

    def resume(self, now_ns: int) -> None:
        """Begin, or continue with the missing steps."""
        self.reach = PanReach(self._config)
        self._track = JointTrack(self._config)
        self._log = FrameLog(self._config)
        for kept in self.kept:
            pan_rad = kept.joints.pan_rad
            self._log.remember(kept.digest, kept.joints.stamp_ns, (pan_rad, pan_rad))
        self._fault = ''
        self._heard_ns = self._run_start_ns = now_ns
        self._run_frames = 0
        self._begin_step(now_ns)

    @property
    def kept(self) -> tuple[KeptFrame, ...]:
        """Frames so far, by stamp."""
        return tuple(sorted(self._album.frames.values(), key=lambda kept: kept.joints.stamp_ns))

    @property
    def total(self) -> int:
        """Expected number of frames: those kept and those that can be reached."""
        return len(self._album.frames) + len(self._missing())

    @property
    def done(self) -> bool:
        """Whether every step that can be reached has its frame."""
        return self._step is None and bool(self._album.frames)

    def seconds_to_go(self, now_ns: int) -> float | None:
        """Remaining time at the rate so far; None before the first frame."""
        if not self._run_frames:
            return None
        pace_s = (now_ns - self._run_start_ns) * 1e-9 / self._run_frames
        return pace_s * (len(self._missing()) + len(self._album.suspect))

    def why_not_resumed(self, now_ns: int) -> str:
        """Why the sweep cannot be continued; '' if it can."""
        age_s = (now_ns - self._heard_ns) * 1e-9
        if moved := self.base_motion.moved:
            return f'the robot moved {moved}'
        return f'{age_s:.0f} s have passed' if age_s > _RESUME_S else ''

    def command(self, now_ns: int) -> float | None:
        """Pan to command now, if a command is due: a new one, or one that had no effect."""
        step = self._step
        if self._fault or step is None:
            return None
        if step.commanded_ns is not None:
            waited_s = (now_ns - step.commanded_ns) * 1e-9
            if step.phase is not _Phase.SETTLING or waited_s < 0.5 * self._config.step_timeout_s:
                return None
        step.commanded_ns = now_ns
        return step.target_rad

    def add_odometry(self, sample: OdometrySample) -> None:
        """Add a pose of the base; motion interrupts the sweep."""
        self.base_motion.add(sample, anew=not self._album.frames)
        if not self.done and (moved := self.base_motion.moved):
            self.stop(f'the robot moved {moved}')

    def add_frame(self, shot: Shot, now_ns: int) -> None:
        """Add a frame; it is a candidate if the camera stood still before its stamp."""
        newest, step = self._track.last, self._step
        if self._fault or newest is None or step is None:
            return
        stamp_error = self._log.stamp_error(shot.stamp_ns, newest.stamp_ns, now_ns)
        frozen = not stamp_error and self._log.seen_at_other_pan(
            shot.digest, shot.stamp_ns, self._track
        )
        if step.phase is not _Phase.EXPOSING or now_ns < step.again_ns:
            return
        if stamp_error:
            self._refuse(step, stamp_error, now_ns)
        elif shot.stamp_ns > step.settled_stamp_ns:
            if frozen and not self._is_flat(shot):
                if self._log.is_first(shot.digest):
                    # The image may have been frozen since before the first step.
                    self._album.remove(shot.digest)
                self._refuse(step, 'frozen: the same image came at another pan', now_ns)
            else:
                step.pending, step.phase = shot, _Phase.CONFIRMING

    def add_joints(self, sample: JointSample, now_ns: int) -> KeptFrame | None:
        """Add a joint sample; return the frame that it confirms, if any."""
        step = self._step
        if self._fault or step is None or not self._track.add(sample):
            return None
        stamp = sample.stamp_ns
        self._heard_ns = now_ns
        self.reach.add(sample.pan_rad)
        if step.begin_stamp_ns is None:
            step.begin_stamp_ns = stamp - 1
            self._progressed(step, now_ns)
        if step.number is None:
            if self.reach.unconfirmed_limit_rad is None:
                self._begin_step(now_ns)
            return None
        distance = abs(sample.pan_rad - step.target_rad)
        if distance < step.distance_rad - 0.5 * self._config.arrival_tolerance_rad:
            step.distance_rad = distance
            self._progressed(step, now_ns)
        if step.phase is _Phase.SETTLING and self._stands_still(step, stamp, step.target_rad):
            if not step.settled_stamp_ns:
                self._progressed(step, now_ns)
            step.phase, step.settled_stamp_ns = _Phase.EXPOSING, stamp
        elif step.pending is not None and stamp >= step.pending.stamp_ns:
            return self._confirm(step, step.number, step.pending, now_ns)
        return None

    def check(self, now_ns: int) -> None:
        """
        Stop if a time limit is exceeded; the frames are kept.

        A limit must be exceeded by the stamps of joint states too, since a simulator on a busy
        machine may be slow. Missing joint states are detected by the caller's clock only.

        Raises `LandmarkNavError`: the sweep was interrupted; the message has the reason.
        """
        limit_ns = self._config.step_timeout_s * 1e9
        last, step = self._track.last, self._step
        if step is not None and not self._fault:
            robot_ns = last.stamp_ns - step.progress_stamp_ns if last else 0
            if now_ns - self._heard_ns > limit_ns:
                self.stop(
                    f'{self._waited(step)}; no joint_states since then: is the pan unit on, '
                    'is pan_joint its name?'
                )
            elif last and now_ns - step.progress_ns > limit_ns and robot_ns > limit_ns:
                self._time_out(step, last, now_ns)
        if self._fault:
            kept, total = len(self._album.frames), self.total
            at_deg = f', {np.degrees(step.target_rad):.1f} deg' if step is not None else ''
            raise LandmarkNavError(
                f'sweep interrupted at frame {min(kept + 1, total)} of {total}{at_deg}: '
                f'{self._fault}; {kept} frames are kept: call capture_sweep '
                + ('here to continue' if kept else 'to try again')
            )

    def stop(self, reason: str) -> None:
        """Interrupt the sweep."""
        self._fault = self._fault or reason

    def _missing(self) -> list[int]:
        """Reachable steps without a frame."""
        within = np.flatnonzero(~np.isnan(self.reach.targets))
        return [int(k) for k in within if k not in self._album.frames]

    def _begin_step(self, now_ns: int) -> None:
        missing, unconfirmed_rad = self._missing(), self.reach.unconfirmed_limit_rad
        if not missing and not self._reviewed:
            self._reviewed = True
            for kept, reason in self._album.review():
                self._count_refusal(reason, kept.joints.pan_rad)
        again = [k for k in sorted(self._album.suspect) if not np.isnan(self.reach.targets[k])]
        number = next(iter([*missing, *again]), None)
        self._step: _Step | None = None
        if number is not None:
            target = float(self.reach.targets[number])
        elif unconfirmed_rad is not None and self._album.frames:
            # All frames are kept. Check that the joint still moves after the unconfirmed stop.
            target = max(
                (k.joints.pan_rad for k in self.kept), key=lambda pan: abs(pan - unconfirmed_rad)
            )
        else:
            return
        before = None if number is None else self._album.frames.get(number)
        begin_ns = self._track.last.stamp_ns if self._track.last else None
        self._step = _Step(number, target, [before] if before else [], begin_ns)
        self._progressed(self._step, now_ns)

    def _progressed(self, step: _Step, now_ns: int) -> None:
        step.progress_ns = now_ns
        step.progress_stamp_ns = self._track.last.stamp_ns if self._track.last else 0

    def _stands_still(self, step: _Step, since_ns: int, target_rad: float | None = None) -> bool:
        return self._track.stands_still(step.begin_stamp_ns or 0, since_ns, target_rad)

    def _waited(self, step: _Step) -> str:
        return f'waited {self._config.step_timeout_s:g} s for {step.phase.value}'

    def _time_out(self, step: _Step, last: JointSample, now_ns: int) -> None:
        seen = f'{self._waited(step)}; the pan is {np.degrees(last.pan_rad):.2f} deg'
        if step.phase is not _Phase.SETTLING:
            self.stop(f'{seen}, {self._log.no_image_reason(now_ns)}')
        elif step.settled_stamp_ns or not self._stands_still(step, last.stamp_ns):
            self.stop(f'{seen} and does not come to rest')
        elif not self.reach.stop(last.pan_rad, step.target_rad):
            self.stop(
                f'{seen} and does not move: if that is its limit, give pan_min, pan_max in '
                'robot.yaml'
            )
        else:
            _LOG.warning(
                'the pan joint stops at %.1f deg on its way to %.1f deg: assumed to be its limit',
                np.degrees(last.pan_rad),
                np.degrees(step.target_rad),
            )
            self._begin_step(now_ns)
            if not self.total:
                self.stop(f'{seen}, and no frame of the sweep lies on this side: change start_rad')

    def _confirm(self, step: _Step, number: int, shot: Shot, now_ns: int) -> KeptFrame | None:
        """Keep the pending frame if the joint stood still until after it, and it is good."""
        if not self._stands_still(step, shot.stamp_ns, step.target_rad):
            # The joint had not settled: this was the turning point of an oscillation.
            step.pending, step.phase = None, _Phase.SETTLING
            return None
        joints = self._track.at(shot.stamp_ns)
        if joints is None:
            gap_s = self._config.stamp_gap_s
            self._refuse(step, f'badly timed: no joint_states within {gap_s:g} s of it', now_ns)
            return None
        try:
            look = self._inspect(shot.frame)
        except LandmarkNavError as error:
            self._refuse(step, f'unusable: {error}', now_ns)
            return None
        step.shots.append(KeptFrame(shot.frame, joints, look, shot.digest))
        return self._judge(step, number, now_ns)

    def _judge(self, step: _Step, number: int, now_ns: int) -> KeptFrame | None:
        """Keep the frame unless it is less sharp than its neighbours and another may be better."""
        blurred = self._album.blurred(number, step.shots[-1])
        best, spread = sharpest(step.shots)
        if blurred is None and len(step.shots) < _TO_COMPARE:
            # No neighbour overlaps: the sharper of two frames is kept.
            step.pending, step.phase = None, _Phase.EXPOSING
            self._progressed(step, now_ns)
            return None
        if blurred:
            agree = len(step.shots) >= _SIMILAR_FRAMES and spread < _MAX_SHARPNESS_RANGE
            if not agree and step.refusals < self._config.retakes:
                self._refuse(step, blurred, now_ns)
                return None
            _LOG.warning(
                'the frame at %.1f deg stays less sharp than its neighbours: kept nevertheless',
                np.degrees(best.joints.pan_rad),
            )
        is_new = self._album.keep(number, best)
        self._run_frames += 1
        self._begin_step(now_ns)
        return best if is_new else None

    def _is_flat(self, shot: Shot) -> bool:
        """Whether a frame has no contrast, so that equal images at different pans are normal."""
        try:
            return self._inspect(shot.frame).flat
        except LandmarkNavError:
            return False

    def _refuse(self, step: _Step, reason: str, now_ns: int) -> None:
        self._count_refusal(reason, step.target_rad)
        step.refusals += 1
        step.pending, step.phase = None, _Phase.EXPOSING
        step.again_ns = now_ns + int(self._config.retake_pause_s * 1e9)
        self._progressed(step, now_ns)
        if step.refusals > self._config.retakes:
            self.stop(f'{step.refusals} frames refused, the last as {reason}')

    def _count_refusal(self, reason: str, pan_rad: float) -> None:
        self.refused[reason.partition(':')[0]] += 1
        _LOG.warning('frame at %.1f deg refused, %s', np.degrees(pan_rad), reason)


def begin_or_resume(
    before: SweepCapture | None, config: CaptureConfig, inspect: Callable[[Any], Look], now_ns: int
) -> tuple[SweepCapture, str]:
    """
    Continue an incomplete sweep if the base has not moved since; else begin a new one.

    The text says whether earlier frames are used, or why not; '' if there are none.
    """
    note = ''
    if before is not None and not before.done and before.kept:
        frames, why = len(before.kept), before.why_not_resumed(now_ns)
        if not why:
            before.resume(now_ns)
            unsure = '' if before.base_motion.known else ' (no odom: did the robot stand still?)'
            return before, f'continued after {frames} earlier frames{unsure}'
        note = f'begun anew without {frames} earlier frames: {why}'
    return SweepCapture(config, inspect, now_ns), note


def describe_progress(sweep: SweepCapture, now_ns: int) -> str:
    """Text of the progress: "frame 12 of 72, at 35.0 deg, 62 s to go"."""
    kept = sweep.kept
    words = f'frame {len(kept)} of {sweep.total}'
    if kept:
        words += f', at {np.degrees(kept[-1].joints.pan_rad):.1f} deg'
    seconds = sweep.seconds_to_go(now_ns)
    return words if seconds is None else f'{words}, {seconds:.0f} s to go'


def describe_sweep(sweep: SweepCapture, half_fov_rad: float) -> str:
    """Text: the covered part of the turn, stops of the joint, and refused frames."""
    lacks = describe_coverage([kept.joints.pan_rad for kept in sweep.kept], half_fov_rad)
    words = [f'a partial sweep, {lacks}' if lacks else 'the full turn']
    if stops := sweep.reach.stops_rad:
        angles = ' and '.join(f'{np.degrees(pan):.1f}' for pan in sorted(stops))
        words.append(f'the pan joint stops at {angles} deg')
    if sweep.refused:
        counts = ', '.join(f'{count} {reason}' for reason, count in sweep.refused.most_common())
        words.append(f'frames refused and taken again: {counts}')
    return '; '.join(words)
