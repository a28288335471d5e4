"""Panorama synthesis: the frames of a sweep are projected on one cylinder and blended."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.learning.panorama.projection import (
    frame_slab,
    FrameSlab,
    RangeOfAzimuth,
    sweep_cylinder,
)
from landmark_nav.types import FloatArray, ImageArray, Sweep

# Neighbour to both sides up to which a frame is used: each pixel is then covered by eight frames
# (seven in the paper), or four, if they are feathered.
_OF_MEDIAN, _OF_FEATHER = 4, 2

# Smallest number of frames for a median; pixels covered by fewer are feathered.
_MIN_FOR_MEDIAN = 3


@dataclass(frozen=True, eq=False)
class CylinderImage:
    """A panorama without pose: BGR image, mask of covered pixels, geometry."""

    image: ImageArray
    mask: npt.NDArray[np.bool_]
    cylinder: Cylinder


def synthesize_cylinder(
    sweep: Sweep,
    mount: PanTiltMount,
    range_m: RangeOfAzimuth | None = None,
    feathered: bool = False,
) -> CylinderImage:
    """
    Project the frames of a sweep on one cylinder around the pan axis.

    A pixel is the median of the frames that cover it, feathered where they are fewer than three.

    Parameters
    ----------
    sweep : Sweep
        Frames with their joint angles.
    mount : PanTiltMount
        Geometry of the pan-tilt unit.
    range_m : callable, optional
        Horizontal distance of the scene at azimuths (n,) in the base frame. It corrects the
        parallax between frames if the optical centre does not lie on the axis.
    feathered : bool
        Whether all pixels are feathered, which is faster.
    """
    cylinder = sweep_cylinder(sweep, mount)
    reach = _reach_rad(sweep, _OF_FEATHER if feathered else _OF_MEDIAN)
    slabs = [
        frame_slab(frame, mount, cylinder, range_m, float(far))
        for frame, far in zip(sweep.frames, reach, strict=True)
    ]
    count = np.zeros((cylinder.height, cylinder.width), np.uint16)
    for slab in slabs:
        for columns, part in _wrapped(slab.start, slab.width, cylinder.width):
            count[:, columns] += slab.inside[:, part] & 1
    if feathered:
        image = _feather(slabs, reach, cylinder, np.arange(cylinder.height))
    else:
        image = _median(slabs, count)
        few = (count > 0) & (count < _MIN_FOR_MEDIAN)
        rows = np.flatnonzero(few.any(axis=1))
        if len(rows):
            image[few] = _feather(slabs, reach, cylinder, rows)[few[rows]]
    if image.shape[2] == 1:
        image = np.repeat(image, 3, axis=2)
    return CylinderImage(image, count > 0, cylinder)


def _reach_rad(sweep: Sweep, neighbours: int) -> FloatArray:
    """
    Largest angle from the optical axis at which each frame is used, (n,).

    It is the angle to the `neighbours`-th frame to both sides, so that each azimuth is covered by
    about twice that number of frames. Frames of different tilts may not cover the same elevations;
    then all of each frame is used.
    """
    tilt = np.array([frame.tilt_rad for frame in sweep.frames])
    if len(tilt) <= 2 * neighbours or np.ptp(tilt) > 0.02:
        return np.full(len(tilt), np.inf)
    pan = np.array([frame.pan_rad for frame in sweep.frames])
    away = np.mod(pan[:, None] - pan, 2.0 * np.pi)
    sides = np.stack([away, away.T])
    # Frames at the same azimuth, such as on a second turn, do not count as neighbours.
    sides[np.minimum(sides, 2.0 * np.pi - sides) < 1e-2] = np.inf
    return np.asarray(np.sort(sides, axis=2)[..., neighbours - 1].max(axis=0))


def _wrapped(start: int, count: int, width: int) -> list[tuple[slice, slice]]:
    """Split unwrapped columns [start, start + count) at the seam: (in panorama, in slab)."""
    pieces = []
    done = 0
    while done < count:
        column = (start + done) % width
        size = min(count - done, width - column)
        pieces.append((slice(column, column + size), slice(done, done + size)))
        done += size
    return pieces


def _feather(
    slabs: list[FrameSlab], reach_rad: FloatArray, cylinder: Cylinder, rows: npt.NDArray[np.intp]
) -> ImageArray:
    """Weighted mean in some rows; the weight of a frame falls with the angle from its axis."""
    channels = slabs[0].image.shape[2:]
    total = np.zeros((len(rows), cylinder.width, *channels), np.float32)
    weights = np.zeros((len(rows), cylinder.width), np.float32)
    for slab, far in zip(slabs, reach_rad, strict=True):
        off = np.abs(slab.start + np.arange(slab.width) - slab.middle)
        share = np.minimum(off / (min(cylinder.fx * far, slab.width / 2.0) + 1.0), 1.0)
        window = (np.cos(np.pi / 2.0 * share) ** 2 + 1e-3).astype(np.float32)
        weight = window * (slab.inside[rows] & 1)
        wide = cv2.merge([weight] * 3) if channels else weight
        weighted = cv2.multiply(slab.image[rows], wide, dtype=cv2.CV_32F)
        for columns, part in _wrapped(slab.start, slab.width, cylinder.width):
            total[:, columns] += weighted[:, part]
            weights[:, columns] += weight[:, part]
    mean = np.atleast_3d(total) / np.maximum(weights, 1e-6)[..., None]
    return np.asarray(mean + np.float32(0.5)).astype(np.uint8)


def _median(slabs: list[FrameSlab], count: npt.NDArray[np.uint16]) -> ImageArray:
    """Median over the frames that cover a pixel."""
    width = count.shape[1]
    for slab in slabs:
        # Uncovered pixels are set to 255, so that they sort behind all others.
        channels = slab.image.size // slab.inside.size
        outside = cv2.merge([cv2.bitwise_not(slab.inside)] * channels)
        cv2.bitwise_or(slab.image, outside, dst=slab.image)
    image = np.zeros((*count.shape, *slabs[0].image.shape[2:]), np.uint8)
    cuts = sorted({c % width for s in slabs for c in (s.start, s.start + s.width)} | {0})
    for left, right in pairwise([*cuts, width]):
        layers = []
        for slab in slabs:
            offset = (left - slab.start) % width
            # A slab wider than the turn contains a column twice.
            for first in range(offset, slab.width - (right - left) + 1, width):
                layers.append(np.ascontiguousarray(slab.image[:, first : first + right - left]))
        if layers:
            image[:, left:right] = _middle(layers, count[:, left:right])
    return np.atleast_3d(image)


def _middle(values: list[ImageArray], count: npt.NDArray[np.uint16]) -> ImageArray:
    """Median of the `count` smallest values of each pixel, by sorting their lower half."""
    total = len(values)
    half = total // 2
    for i in range(half + 1):
        for j in range(total - 1, i, -1):
            low = np.minimum(values[j - 1], values[j])
            values[j] = np.maximum(values[j - 1], values[j])
            values[j - 1] = low
    middle = _halfway(values[(total - 1) // 2], values[half])
    partly = np.nonzero((count < total) & (count > 0))
    if len(partly[0]):
        seen = count[partly].astype(np.intp)
        lower = np.stack(values[: half + 1])
        row, column = partly
        below, above = lower[(seen - 1) // 2, row, column], lower[seen // 2, row, column]
        middle[partly] = _halfway(below, above)
    return middle


def _halfway(below: ImageArray, above: ImageArray) -> ImageArray:
    """Mean of two images; `above` is not smaller, so that the difference fits a byte."""
    return np.asarray(above - (above - below) // 2, dtype=np.uint8)
