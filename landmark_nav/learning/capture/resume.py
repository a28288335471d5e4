"""Whether a call goes on with the sweep that was interrupted or begins another."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from landmark_nav.learning.capture.config import CaptureConfig
from landmark_nav.learning.capture.frames import Look
from landmark_nav.learning.capture.sweep import SweepCapture

FrameT = TypeVar('FrameT')


def begin_or_resume(
    before: SweepCapture[FrameT] | None,
    config: CaptureConfig,
    inspect: Callable[[FrameT], Look],
    now_ns: int,
) -> tuple[SweepCapture[FrameT], str]:
    """
    Go on with a sweep if something is missing and the robot still stands there, or begin one.

    Returns
    -------
    sweep : SweepCapture
    note : str
        What became of the frames of before; nothing if there were none.

    """
    note = ''
    if before is not None and not before.done and before.kept:
        frames, why = len(before.kept), before.why_not_resumed(now_ns)
        if not why:
            before.resume(now_ns)
            unknown_place = '' if before.place.known else ' (no odom: did the robot stand still?)'
            return before, f'gone on after {frames} frames of before{unknown_place}'
        note = f'begun anew without {frames} frames of before: {why}'
    return SweepCapture(config, inspect, now_ns), note
