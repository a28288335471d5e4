"""Points that two frames of a sweep both show, in a chain of frames around the turn."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.learning.panorama.projection import frame_slab, FrameSlab, sweep_cylinder
from landmark_nav.types import FloatArray, ImageArray, Sweep

__all__ = ['Overlaps', 'track_overlaps']

_POINTS_PER_PAIR = 60
_SPACING_PX = 14
_LEAST_PER_PAIR = 6

# A chain skips frames until they are apart so much of the field of view.
_LEAP = 0.42


@dataclass(frozen=True, eq=False)
class Overlaps:
    """
    Matches between frames that follow each other in a chain, counter-clockwise.

    `frames` (m, 2) are indices in the sweep, the later one in pan first; `pixels` (m, 2, 2) where
    each shows the point; `pair` (m,) counts the links of the chain, `closed` is set if they
    make a full turn. `gaps_rad` holds the pans where a full turn has no link, as there is too
    little to match.
    """

    frames: npt.NDArray[np.intp]
    pixels: FloatArray
    pair: npt.NDArray[np.intp]
    closed: bool
    gaps_rad: tuple[float, ...] = ()

    def __len__(self) -> int:
        """Return how many matches there are."""
        return len(self.frames)

    @classmethod
    def none(cls) -> Overlaps:
        """Nothing in common."""
        nobody = np.zeros(0, np.intp)
        return cls(nobody.reshape(0, 2), np.zeros((0, 2, 2)), nobody, False)


def track_overlaps(sweep: Sweep, mount: PanTiltMount, every_frame: bool = False) -> Overlaps:
    """
    Track points between frames of a sweep.

    Parameters
    ----------
    sweep : Sweep
        Frames whose angles are right to a few pixels.
    every_frame : bool
        Whether all frames are links of the chain, or just enough of them.

    """
    chain, closed = _chain(sweep, every_frame)
    cylinder = sweep_cylinder(sweep, mount)
    grey = {k: _grey_slab(sweep, k, mount, cylinder) for k in set(chain)}
    frames, pixels, pairs, gaps = [], [], [], []
    for link, (a, b) in enumerate(pairwise(chain)):
        columns = _track(grey[a], grey[b], cylinder)
        if columns is None or len(columns) < _LEAST_PER_PAIR:
            start, end = sweep.frames[a].pan_rad, sweep.frames[b].pan_rad
            gaps.append(float(wrap_rad(start + 0.5 * wrap_rad(end - start))))
            continue
        pixels.append(
            np.stack(
                [
                    sweep.frames[k].camera.project(
                        cylinder.rays(columns[:, side]) @ _rotation(sweep, k, mount)
                    )
                    for side, k in enumerate((a, b))
                ],
                1,
            )
        )
        frames.append(np.tile([a, b], (len(columns), 1)))
        pairs.append(np.full(len(columns), link))
    if not frames:
        return Overlaps.none()
    seen = np.isfinite(np.concatenate(pixels)).all(axis=(1, 2))
    return Overlaps(
        np.concatenate(frames).astype(np.intp)[seen],
        np.concatenate(pixels)[seen],
        np.concatenate(pairs).astype(np.intp)[seen],
        closed and not gaps,
        tuple(gaps) if closed else (),
    )


def _chain(sweep: Sweep, every_frame: bool) -> tuple[list[int], bool]:
    """Frames in the order of their pan, some left out, and whether the last meets the first."""
    pan = np.array([frame.pan_rad for frame in sweep.frames])
    field = 2.0 * sweep.frames[0].camera.half_fov_rad
    order = np.argsort(np.mod(pan, 2.0 * np.pi), kind='stable')
    step = np.mod(np.diff(pan[order], append=pan[order[0]]), 2.0 * np.pi)
    # It starts after the widest gap, so that a part of a turn is one chain.
    order = np.roll(order, -1 - int(np.argmax(step)))
    step = np.roll(step, -1 - int(np.argmax(step)))
    closed = bool(step[-1] < 0.8 * field) and len(order) > 2
    chain, since = [int(order[0])], 0.0
    ends = len(order) if closed else len(order) - 1
    for n in range(ends):
        since += float(step[n])
        last = n == ends - 1
        ahead = float(step[n + 1]) if not last else 0.0
        if every_frame or last or since + ahead > _LEAP * field:
            chain.append(int(order[(n + 1) % len(order)]))
            since = 0.0
    return chain, closed


def _rotation(sweep: Sweep, k: int, mount: PanTiltMount) -> FloatArray:
    frame = sweep.frames[k]
    return mount.camera_pose_base(frame.pan_rad, frame.tilt_rad, frame.roll_rad)[0]


def _grey_slab(sweep: Sweep, k: int, mount: PanTiltMount, cylinder: Cylinder) -> FrameSlab:
    frame = sweep.frames[k]
    if frame.image.ndim == 3:
        grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
        frame = replace(frame, image=np.asarray(grey, dtype=np.uint8))
    return frame_slab(frame, mount, cylinder)


def _track(first: FrameSlab, second: FrameSlab, cylinder: Cylinder) -> FloatArray | None:
    """Cylinder pixels (n, 2, 2) of points in two slabs; None where they have none in common."""
    # Columns of the second frame, counted in the first's.
    shift = (second.start - first.start + cylinder.width // 2) % cylinder.width
    shift -= cylinder.width // 2
    low, high = max(0, shift), min(first.width, shift + second.width)
    if high - low < 24:
        return None
    here, there = slice(low, high), slice(low - shift, high - shift)
    both = first.inside[:, here] & second.inside[:, there]
    mask = cv2.erode(both, np.ones((15, 15), np.uint8))
    one, other = first.image[:, here].copy(), second.image[:, there].copy()
    corners = cv2.goodFeaturesToTrack(one, _POINTS_PER_PAIR, 0.01, _SPACING_PX, mask=mask)
    if corners is None:
        return None
    found, good = _follow(one, other, np.asarray(corners, dtype=np.float32))
    offset = np.array([first.start + low, 0.0])
    return np.stack([corners[good, 0] + offset, found[good, 0] + offset], 1)


def _follow(
    one: ImageArray, other: ImageArray, here: npt.NDArray[np.float32]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Follow points (n, 1, 2) there and back; which came back to where they were."""
    tracked, found, _ = cv2.calcOpticalFlowPyrLK(one, other, here, here.copy())
    there = np.asarray(tracked, dtype=np.float32)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(other, one, there, here.copy())
    away = np.linalg.norm(np.asarray(back) - here, axis=2)[:, 0]
    return there, (np.ravel(found) == 1) & (np.ravel(returned) == 1) & (away < 0.3)
