"""Panorama synthesis: the frames of a sweep, projected on one cylinder, are joined there."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

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
from landmark_nav.parameters import Config
from landmark_nav.types import FloatArray, ImageArray, Sweep

# Blends, and up to which neighbour to both sides each frame is used by them: a place is then shown
# by eight frames, the paper has seven, or by four.
_NEIGHBOURS = {'mean': 4, 'median': 4, 'feather': 2}
BLENDS = tuple(_NEIGHBOURS)

# Pixels that fewer frames cover have no median worth the name.
_LEAST_FOR_MEDIAN = 3


@dataclass(frozen=True)
class PanoramaConfig(Config):
    """
    How frames become a panorama.

    Kinds of `blend` were compared (docs/decisions.md, sweeps and panoramas).
    """

    # Mean weighs frames alike (the paper), feather takes the frames that look straight at a place
    # (sharp), median the middle of all; fewer than three frames are feathered.
    blend: str = 'median'
    # Side of the central square used of each frame, the paper uses 350 of 512; 0 uses all.
    crop_px: int = 0
    # Whether exposures and vignetting are measured and made up for.
    even_out: bool = True
    # Columns per radian; 0 takes the camera's focal length.
    px_per_rad: float = 0.0


@dataclass(frozen=True, eq=False)
class CylinderImage:
    """A panorama before its place is known: BGR image, mask of covered pixels, geometry."""

    image: ImageArray
    mask: npt.NDArray[np.bool_]
    cylinder: Cylinder


def synthesize_cylinder(
    sweep: Sweep,
    mount: PanTiltMount,
    config: PanoramaConfig,
    range_m: RangeOfAzimuth | None = None,
) -> CylinderImage:
    """
    Project the frames of a sweep on one cylinder around the pan axis.

    Parameters
    ----------
    sweep : Sweep
        Frames with their joint angles.
    mount : PanTiltMount
        Where the optical centre turns.
    range_m : callable, optional
        Horizontal distance of what is seen at azimuths (n,) in the base frame. It matters only
        if the optical centre lies off the axis: each frame then sees the room from elsewhere.
    """
    cylinder = sweep_cylinder(sweep, mount, config.crop_px, config.px_per_rad)
    reach = _reach_rad(sweep, _NEIGHBOURS[config.blend])
    slabs = [
        frame_slab(frame, mount, cylinder, config.crop_px, range_m, float(far))
        for frame, far in zip(sweep.frames, reach, strict=True)
    ]
    count = np.zeros((cylinder.height, cylinder.width), np.uint16)
    for slab in slabs:
        for columns, part in _wrapped(slab.start, slab.width, cylinder.width):
            count[:, columns] += slab.inside[:, part] & 1
    if config.blend == 'median':
        image = _median(slabs, count)
        few = (count > 0) & (count < _LEAST_FOR_MEDIAN)
        rows = np.flatnonzero(few.any(axis=1))
        if len(rows):
            image[few] = _feather(slabs, reach, cylinder, rows)[few[rows]]
    elif config.blend == 'feather':
        image = _feather(slabs, reach, cylinder, np.arange(cylinder.height))
    else:
        image = _mean(slabs, count)
    if image.shape[2] == 1:
        image = np.repeat(image, 3, axis=2)
    return CylinderImage(image, count > 0, cylinder)


def _reach_rad(sweep: Sweep, neighbours: int) -> FloatArray:
    """
    How far from its optical axis each frame is used (n,): up to some neighbour to both sides.

    A place is then covered by about twice as many frames, those that look straightest at it.
    Frames of unequal tilt need not cover the same places, so that all of each is used.
    """
    tilt = np.array([frame.tilt_rad for frame in sweep.frames])
    if len(tilt) <= 2 * neighbours or np.ptp(tilt) > 0.02:
        return np.full(len(tilt), np.inf)
    pan = np.array([frame.pan_rad for frame in sweep.frames])
    away = np.mod(pan[:, None] - pan, 2.0 * np.pi)
    sides = np.stack([away, away.T])
    # Frames that look the same way, as on a second turn, are no neighbours.
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


def _mean(slabs: list[FrameSlab], count: npt.NDArray[np.uint16]) -> ImageArray:
    """All frames that cover a pixel, alike."""
    total = np.zeros((*count.shape, *slabs[0].image.shape[2:]), np.float32)
    for slab in slabs:
        for columns, part in _wrapped(slab.start, slab.width, count.shape[1]):
            cv2.accumulate(slab.image[:, part], total[:, columns], mask=slab.inside[:, part])
    total = np.atleast_3d(total)
    return _rounded(total, np.maximum(count, 1)[..., None])


def _feather(
    slabs: list[FrameSlab],
    reach_rad: FloatArray,
    cylinder: Cylinder,
    rows: npt.NDArray[np.intp],
) -> ImageArray:
    """Weighted mean in some rows: each frame counts most along its optical axis."""
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
    return _rounded(np.atleast_3d(total), np.maximum(weights, 1e-6)[..., None])


def _rounded(total: npt.NDArray[np.float32], weight: npt.NDArray[Any]) -> ImageArray:
    return np.asarray(total / weight + np.float32(0.5)).astype(np.uint8)


def _median(slabs: list[FrameSlab], count: npt.NDArray[np.uint16]) -> ImageArray:
    """Median over the frames that cover a pixel."""
    width = count.shape[1]
    for slab in slabs:
        # What a frame does not cover sorts behind all that the others show.
        channels = slab.image.size // slab.inside.size
        outside = cv2.merge([cv2.bitwise_not(slab.inside)] * channels)
        cv2.bitwise_or(slab.image, outside, dst=slab.image)
    image = np.zeros((*count.shape, *slabs[0].image.shape[2:]), np.uint8)
    cuts = sorted({c % width for s in slabs for c in (s.start, s.start + s.width)} | {0})
    for left, right in pairwise([*cuts, width]):
        layers = []
        for slab in slabs:
            offset = (left - slab.start) % width
            # A slab wider than the turn shows a column twice.
            for first in range(offset, slab.width - (right - left) + 1, width):
                layers.append(np.ascontiguousarray(slab.image[:, first : first + right - left]))
        if layers:
            image[:, left:right] = _middle(layers, count[:, left:right])
    return np.atleast_3d(image)


def _middle(values: list[ImageArray], count: npt.NDArray[np.uint16]) -> ImageArray:
    """Median of the `count` least of a few images, by sorting their lower half pixel by pixel."""
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
    """Mean of two, the second the greater: their difference fits a byte."""
    return np.asarray(above - (above - below) // 2, dtype=np.uint8)
