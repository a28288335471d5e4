"""Which directions the frames of a sweep see."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad

# Angles that a text names at most.
_LISTED = 4


def _some_of(words: Sequence[str], between: str) -> str:
    """The first few of some words in one line, and how many more there are."""
    more = len(words) - _LISTED
    return between.join(words[:_LISTED]) + (f' and {more} more' if more > 0 else '')


def unseen_arcs(pan_rad: npt.ArrayLike, half_fov_rad: float) -> list[tuple[float, float]]:
    """
    Arcs (from, to), counter-clockwise, radians, that no frame sees.

    Parameters
    ----------
    pan_rad : array_like, shape (n,)
        Where frames look, in any order, on any turn.
    half_fov_rad : float
        How far each sees to both sides.

    """
    pan = np.unique(np.mod(np.asarray(pan_rad, dtype=np.float64), 2.0 * np.pi))
    if not len(pan):
        return [(-np.pi, np.pi)]
    steps = np.diff(pan, append=pan[0] + 2.0 * np.pi)
    width = steps - 2.0 * half_fov_rad
    starts = wrap_rad(pan + half_fov_rad)
    return [(float(starts[k]), float(starts[k] + width[k])) for k in np.flatnonzero(width > 0.0)]


def describe_coverage(
    pan_rad: npt.ArrayLike, half_fov_rad: float, missing_rad: npt.ArrayLike = ()
) -> str:
    """
    What a sweep lacks, in words; nothing if it has all frames and sees the full turn.

    Parameters
    ----------
    pan_rad : array_like, shape (n,)
        Where the frames look.
    half_fov_rad : float
        How far each sees to both sides.
    missing_rad : array_like, shape (m,)
        Where frames were taken that are not there.

    """
    missing = [f'{np.degrees(pan):.0f}' for pan in np.asarray(missing_rad, dtype=np.float64)]
    arcs = [
        f'from pan {np.degrees(a):.0f} to {np.degrees(b):.0f} deg'
        for a, b in unseen_arcs(pan_rad, half_fov_rad)
    ]
    words = []
    if missing:
        listed = _some_of(missing, ', ')
        frames = '1 frame is' if len(missing) == 1 else f'{len(missing)} frames are'
        words.append(f'{frames} missing, at pan {listed} deg')
    if arcs:
        words.append(f'nothing is seen {_some_of(arcs, " and ")}')
    elif missing:
        words.append('their neighbours see it all')
    return '; '.join(words)
