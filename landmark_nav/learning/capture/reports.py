"""What is reported of a sweep while it runs and when it ends."""

from __future__ import annotations

from typing import Any

import numpy as np

from landmark_nav.geometry.coverage import describe_coverage
from landmark_nav.learning.capture.sweep import SweepCapture


def describe_progress(sweep: SweepCapture[Any], now_ns: int) -> str:
    """How far it is: "frame 12 of 72, at 35.0 deg, 62 s to go"."""
    kept = sweep.kept
    words = f'frame {len(kept)} of {sweep.total}'
    if kept:
        words += f', at {np.degrees(kept[-1].joints.pan_rad):.1f} deg'
    seconds = sweep.seconds_to_go(now_ns)
    return words if seconds is None else f'{words}, {seconds:.0f} s to go'


def describe_sweep(sweep: SweepCapture[Any], half_fov_rad: float) -> str:
    """Which part of the turn it covers, why not more, and what was taken again."""
    lacks = describe_coverage([kept.joints.pan_rad for kept in sweep.kept], half_fov_rad)
    words = [f'a partial sweep, {lacks}' if lacks else 'the full turn']
    if stops := sweep.reach.stops_rad:
        angles = ' and '.join(f'{np.degrees(pan):.1f}' for pan in sorted(stops))
        words.append(f'the pan joint stops at {angles} deg')
    if sweep.refused:
        counts = ', '.join(f'{count} {reason}' for reason, count in sweep.refused.most_common())
        words.append(f'frames refused and taken again: {counts}')
    return '; '.join(words)
