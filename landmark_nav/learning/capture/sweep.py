"""
One sweep under way.

Event-driven and free of clocks: the caller reports joint samples, frames and odometry as they come
and asks for the next command. Arrival and settling are seen in the joint angles; the time limits
only serve to give up with a reason.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
import logging
from typing import Generic, TypeVar

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.learning.capture.config import CaptureConfig
from landmark_nav.learning.capture.frames import (
    Album,
    FrameLog,
    KeptFrame,
    Look,
    Phase,
    sharpest,
    Shot,
    Step,
)
from landmark_nav.learning.capture.joints import JointTrack, PanReach, Place
from landmark_nav.types import JointSample, OdometrySample

FrameT = TypeVar('FrameT')

_LOG = logging.getLogger(__name__)

# Frames of one direction that are all alike but less sharp than its neighbours show how it looks.
_ALIKE = 0.1
_SIMILAR_FRAMES = 3
_TO_COMPARE = 2
# An interrupted sweep is gone on with up to this age: light and things change. Chosen by hand.
_RESUME_S = 600.0


class SweepCapture(Generic[FrameT]):
    """
    A sweep, from its first command to its last frame, over any number of interruptions.

    Parameters
    ----------
    inspect : callable
        Measures a frame; raises `LandmarkNavError` for one that can't be used.
    now_ns : int
        The caller's clock; only differences count, so it need not be that of the stamps.

    Attributes
    ----------
    refused : Counter
        How many frames were refused, by reason.
    reach : PanReach
        Where the joint gets.
    place : Place
        Whether the robot stands.
    """

    def __init__(
        self, config: CaptureConfig, inspect: Callable[[FrameT], Look], now_ns: int
    ) -> None:
        self._config = config
        self._inspect = inspect
        self._album: Album[FrameT] = Album()
        self._reviewed = False
        self.place = Place()
        self.refused: Counter[str] = Counter()
        self.resume(now_ns)

    def resume(self, now_ns: int) -> None:
        """Begin, or go on with the steps that are missing."""
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
    def kept(self) -> tuple[KeptFrame[FrameT], ...]:
        """Frames so far, by stamp."""
        return tuple(sorted(self._album.frames.values(), key=lambda kept: kept.joints.stamp_ns))

    @property
    def total(self) -> int:
        """How many frames it will have, as far as is known."""
        return len(self._album.frames) + len(self._missing())

    @property
    def done(self) -> bool:
        """Whether every step that can be reached has its frame."""
        return self._step is None and bool(self._album.frames)

    def seconds_to_go(self, now_ns: int) -> float | None:
        """How long the rest will take at the pace so far."""
        if not self._run_frames:
            return None
        pace_s = (now_ns - self._run_start_ns) * 1e-9 / self._run_frames
        return pace_s * (len(self._missing()) + len(self._album.suspect))

    def why_not_resumed(self, now_ns: int) -> str:
        """Why the frames so far are of no use for going on; nothing if they are."""
        age_s = (now_ns - self._heard_ns) * 1e-9
        if moved := self.place.moved:
            return f'the robot moved {moved}'
        return f'{age_s:.0f} s have passed' if age_s > _RESUME_S else ''

    def command(self, now_ns: int) -> float | None:
        """Pan to command now, if a command is due: a new one, or again if it was not heeded."""
        step = self._step
        if self._fault or step is None:
            return None
        if step.commanded_ns is not None:
            waited_s = (now_ns - step.commanded_ns) * 1e-9
            if step.phase is not Phase.SETTLING or waited_s < 0.5 * self._config.step_timeout_s:
                return None
        step.commanded_ns = now_ns
        return step.target_rad

    def add_odometry(self, sample: OdometrySample) -> None:
        """Take the robot's place: the frames of a sweep must come from one."""
        self.place.add(sample, anew=not self._album.frames)
        if not self.done and (moved := self.place.moved):
            self.stop(f'the robot moved {moved}')

    def add_frame(self, shot: Shot[FrameT], now_ns: int) -> None:
        """Offer a frame; it is taken if the camera stood still before it was exposed."""
        newest, step = self._track.last, self._step
        if self._fault or newest is None or step is None:
            return
        untimely = self._log.untimely(shot.stamp_ns, newest.stamp_ns, now_ns)
        frozen = not untimely and self._log.seen_elsewhere(shot.digest, shot.stamp_ns, self._track)
        if step.phase is not Phase.EXPOSING or now_ns < step.again_ns:
            return
        if untimely:
            self._refuse(step, untimely, now_ns)
        elif shot.stamp_ns > step.settled_stamp_ns:
            if frozen and not self._is_flat(shot):
                if self._log.is_first(shot.digest):
                    # It may have been frozen before the joint began to turn.
                    self._album.distrust(shot.digest)
                self._refuse(step, 'frozen: the same image came at another pan', now_ns)
            else:
                step.pending, step.phase = shot, Phase.CONFIRMING

    def add_joints(self, sample: JointSample, now_ns: int) -> KeptFrame[FrameT] | None:
        """Take a joint sample; returns the frame that it confirms, if any."""
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
        if step.phase is Phase.SETTLING and self._stands(step, stamp, step.target_rad):
            if not step.settled_stamp_ns:
                self._progressed(step, now_ns)
            step.phase, step.settled_stamp_ns = Phase.EXPOSING, stamp
        elif step.pending is not None and stamp >= step.pending.stamp_ns:
            return self._confirm(step, step.number, step.pending, now_ns)
        return None

    def check(self, now_ns: int) -> None:
        """
        Give up if there is a reason to; what was captured is kept.

        Time counts by the robot's own stamps too, as long as there are any: a simulator on a busy
        machine may be slow. Silence counts by the caller's clock alone.

        Raises `LandmarkNavError`: with what was waited for and what was measured.
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
                self._wait_no_longer(step, last, now_ns)
        if self._fault:
            kept, total = len(self._album.frames), self.total
            at_deg = f', {np.degrees(step.target_rad):.1f} deg' if step is not None else ''
            raise LandmarkNavError(
                f'sweep interrupted at frame {min(kept + 1, total)} of {total}{at_deg}: '
                f'{self._fault}; {kept} frames are kept: call capture_sweep '
                + ('here to go on' if kept else 'to try again')
            )

    def stop(self, reason: str) -> None:
        """Interrupt it."""
        self._fault = self._fault or reason

    def _missing(self) -> list[int]:
        """Steps without a frame that can be reached."""
        within = np.flatnonzero(~np.isnan(self.reach.targets))
        return [int(k) for k in within if k not in self._album.frames]

    def _begin_step(self, now_ns: int) -> None:
        missing, unconfirmed_rad = self._missing(), self.reach.unconfirmed_limit_rad
        if not missing and not self._reviewed:
            self._reviewed = True
            for kept, reason in self._album.review():
                self._count(reason, kept.joints.pan_rad)
        again = [k for k in sorted(self._album.suspect) if not np.isnan(self.reach.targets[k])]
        number = next(iter([*missing, *again]), None)
        self._step: Step[FrameT] | None = None
        if number is not None:
            target = float(self.reach.targets[number])
        elif unconfirmed_rad is not None and self._album.frames:
            # Nothing is left but to see that the joint can still move.
            target = max(
                (k.joints.pan_rad for k in self.kept), key=lambda pan: abs(pan - unconfirmed_rad)
            )
        else:
            return
        before = None if number is None else self._album.frames.get(number)
        last = self._track.last
        self._step = Step(
            number,
            target,
            [] if before is None else [before],
            now_ns,
            last.stamp_ns if last else None,
            last.stamp_ns if last else 0,
        )

    def _progressed(self, step: Step[FrameT], now_ns: int) -> None:
        step.progress_ns = now_ns
        step.progress_stamp_ns = self._track.last.stamp_ns if self._track.last else 0

    def _stands(self, step: Step[FrameT], since_ns: int, target_rad: float | None = None) -> bool:
        return self._track.stands(step.begin_stamp_ns or 0, since_ns, target_rad)

    def _waited(self, step: Step[FrameT]) -> str:
        return f'waited {self._config.step_timeout_s:g} s for {step.phase.value}'

    def _wait_no_longer(self, step: Step[FrameT], last: JointSample, now_ns: int) -> None:
        seen = f'{self._waited(step)}; the pan is {np.degrees(last.pan_rad):.2f} deg'
        if step.phase is not Phase.SETTLING:
            self.stop(f'{seen}, {self._log.why_none(now_ns)}')
        elif step.settled_stamp_ns or not self._stands(step, last.stamp_ns):
            self.stop(f'{seen} and does not come to rest')
        elif not self.reach.stop(last.pan_rad, step.target_rad):
            self.stop(
                f'{seen} and does not move: if that is its limit, give pan_min, pan_max in '
                'robot.yaml'
            )
        else:
            _LOG.warning(
                'the pan joint stops at %.1f deg on its way to %.1f deg: taken for its limit',
                np.degrees(last.pan_rad),
                np.degrees(step.target_rad),
            )
            self._begin_step(now_ns)
            if not self.total:
                self.stop(f'{seen}, and no frame of the sweep lies on this side: change start_rad')

    def _confirm(
        self, step: Step[FrameT], number: int, shot: Shot[FrameT], now_ns: int
    ) -> KeptFrame[FrameT] | None:
        """Keep the pending frame if the joint still stood after its exposure, and it is good."""
        if not self._stands(step, shot.stamp_ns, step.target_rad):
            # It was only the turning point of an oscillation.
            step.pending, step.phase = None, Phase.SETTLING
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

    def _judge(self, step: Step[FrameT], number: int, now_ns: int) -> KeptFrame[FrameT] | None:
        """Keep the frame unless it is less sharp than its neighbours and another may be better."""
        blurred = self._album.blurred(number, step.shots[-1])
        best, spread = sharpest(step.shots)
        if blurred is None and len(step.shots) < _TO_COMPARE:
            # Nothing else shows the same: the sharper of two will do.
            step.pending, step.phase = None, Phase.EXPOSING
            self._progressed(step, now_ns)
            return None
        if blurred:
            alike = len(step.shots) >= _SIMILAR_FRAMES and spread < _ALIKE
            if not alike and step.refusals < self._config.retakes:
                self._refuse(step, blurred, now_ns)
                return None
            _LOG.warning(
                'the view at %.1f deg stays less sharp than its neighbours: taken as it is',
                np.degrees(best.joints.pan_rad),
            )
        is_new = self._album.keep(number, best)
        self._run_frames += 1
        self._begin_step(now_ns)
        return best if is_new else None

    def _is_flat(self, shot: Shot[FrameT]) -> bool:
        """Whether it shows nothing, so that it may well be the same in all directions."""
        try:
            return self._inspect(shot.frame).flat
        except LandmarkNavError:
            return False

    def _refuse(self, step: Step[FrameT], reason: str, now_ns: int) -> None:
        self._count(reason, step.target_rad)
        step.refusals += 1
        step.pending, step.phase = None, Phase.EXPOSING
        step.again_ns = now_ns + int(self._config.retake_pause_s * 1e9)
        self._progressed(step, now_ns)
        if step.refusals > self._config.retakes:
            self.stop(f'{step.refusals} frames refused, the last as {reason}')

    def _count(self, reason: str, pan_rad: float) -> None:
        self.refused[reason.partition(':')[0]] += 1
        _LOG.warning('frame at %.1f deg refused, %s', np.degrees(pan_rad), reason)
