"""Continuation of an interrupted sweep, and texts about a sweep."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from landmark_nav.geometry.cylinder import describe_coverage
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
    Continue an incomplete sweep if the base has not moved since; else begin a new one.

    Returns
    -------
    sweep : SweepCapture
    note : str
        Text: whether earlier frames are used, or why not; '' if there are none.
    """
    note = ''
    if before is not None and not before.done and before.kept:
        frames, why = len(before.kept), before.why_not_resumed(now_ns)
        if not why:
            before.resume(now_ns)
            no_odometry = (
                '' if before.base_motion.known else ' (no odom: did the robot stand still?)'
            )
            return before, f'continued after {frames} earlier frames{no_odometry}'
        note = f'begun anew without {frames} earlier frames: {why}'
    return SweepCapture(config, inspect, now_ns), note


def describe_progress(sweep: SweepCapture[Any], now_ns: int) -> str:
    """Text of the progress: "frame 12 of 72, at 35.0 deg, 62 s to go"."""
    kept = sweep.kept
    words = f'frame {len(kept)} of {sweep.total}'
    if kept:
        words += f', at {np.degrees(kept[-1].joints.pan_rad):.1f} deg'
    seconds = sweep.seconds_to_go(now_ns)
    return words if seconds is None else f'{words}, {seconds:.0f} s to go'


def describe_sweep(sweep: SweepCapture[Any], half_fov_rad: float) -> str:
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
