"""Trajectories as TUM files, which evo and many other tools read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from landmark_nav.evaluation.replay import Replay
from landmark_nav.evaluation.smoothed_run import Smoothed
from landmark_nav.storage.atomic_io import write_atomically
from landmark_nav.types import FloatArray

__all__ = ['write_tum_files']


def write_tum_files(
    run: Replay, folder: Path, smoothed: Smoothed | None = None
) -> tuple[Path, ...]:
    """
    Write ``truth.tum``, ``fused.tum``, ``triangulation.tum`` and others into a folder.

    All are at the stamps of the images, so that other tools compare the same pairs of poses as
    `landmark_nav.evaluation.metrics`; what is not known at a stamp has no line.

    Returns
    -------
    tuple of Path
        What was written.

    """
    stamps = run.stamps_ns
    tracks = {
        'truth': (stamps, run.truth.at(stamps)),
        'fused': (stamps, run.fused),
        'triangulation': (stamps, run.fixes),
        'odometry': (stamps, run.odometry.at(stamps)),
    }
    if smoothed is not None:
        tracks['smoothed'] = smoothed.stamps_ns, smoothed.poses
    paths = []
    for name, (at_ns, poses) in tracks.items():
        known = np.flatnonzero(np.isfinite(poses).all(axis=1))
        if len(known):
            # Images may have come late.
            known = known[np.argsort(at_ns[known], kind='stable')]
            paths.append(folder / f'{name}.tum')
            write_atomically(paths[-1], _lines(at_ns[known], poses[known]))
    return tuple(paths)


def _lines(stamps_ns: npt.NDArray[np.int64], poses: FloatArray) -> str:
    """Lines ``timestamp tx ty tz qx qy qz qw``; numbers come back as the same ones."""
    return ''.join(
        f'{stamp // 10**9}.{stamp % 10**9:09d} {x!r} {y!r} 0 0 0 '
        f'{float(np.sin(heading / 2.0))!r} {float(np.cos(heading / 2.0))!r}\n'
        for stamp, (x, y, heading) in zip(stamps_ns.tolist(), poses.tolist(), strict=True)
    )
