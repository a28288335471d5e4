"""
Candidates for coloured papers in a cylinder image: blobs of a hue, in any light.

Colours are relative to the grey around them (von Kries), so that a warm lamp does not change the
hue. Several thresholds are tried, as the contrast of paper differs between light and shade (after
Matas et al., Robust wide baseline stereo, 2004).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import cv2
import numpy as np

from landmark_nav.arrays import BoolArray, IndexArray
from landmark_nav.geometry.walls import paper_bgr
from landmark_nav.learning.panorama.synthesis import CylinderImage
from landmark_nav.types import FloatArray

# Resolution of the search.
_SEARCH_PX_PER_RAD = 280.0
_PURITIES = (0.15, 0.25, 0.35, 0.45, 0.55, 0.7)
# Greatest deviation of the hue in any light, and its sigma.
_WIDEST_TURN_RAD = np.radians(38.0)
_TURN_SIGMA_RAD = np.radians(13.0)
# Darker pixels have no hue, brighter ones are saturated.
_DARKEST, _BRIGHTEST = 14.0, 250.0
# Least share of its bounding box that a blob fills; it is small for a partly covered paper.
_SOLID = 0.55
_LEAST_AREA_PX = 40.0
_MOST_BLOBS = 80


@dataclass(frozen=True, eq=False)
class PaperBlobs:
    """
    Candidates for papers of one colour, arrays over n blobs.

    `edges` (n, 4) are the azimuths of their right and left edges in the base frame, unwrapped, and
    the tangents of the elevation of bottom and top; `misfit` (n,) are the squared deviations of
    their hues, in sigmas.
    """

    edges: FloatArray
    misfit: FloatArray

    def __len__(self) -> int:
        """Return the number of blobs."""
        return len(self.misfit)

    def only(self, chosen: BoolArray) -> PaperBlobs:
        """Return the blobs selected by a mask (n,)."""
        return PaperBlobs(self.edges[chosen], self.misfit[chosen])


# Blobs of panoramas that are still in use.
_FOUND: WeakKeyDictionary[CylinderImage, dict[str, PaperBlobs]] = WeakKeyDictionary()


def color_blobs(view: CylinderImage, colors: Iterable[str]) -> dict[str, PaperBlobs]:
    """Candidates for papers of some colours in a panorama in the base frame; cached."""
    colors = dict.fromkeys(colors)
    found = _FOUND.setdefault(view, {})
    if not found.keys() >= colors.keys():
        search = ColorSearch(view)
        found |= {color: search.blobs(color) for color in colors if color not in found}
    return {color: found[color] for color in colors}


def hue_direction(color: str) -> FloatArray:
    """
    Direction (3,) in blue, green, red that measures the amount of a paper's hue.

    The amount is 0 for any grey, and 1 for the purest and brightest (1.0) colour of the hue.
    """
    direction = np.array(paper_bgr(color))
    direction -= direction.min()
    pure = direction / direction.max()
    direction -= direction.mean()
    return np.asarray(direction / (direction @ pure))


class ColorSearch:
    """Searches papers of any colour in one cylinder image in the base frame."""

    def __init__(self, view: CylinderImage) -> None:
        self._cylinder = view.cylinder
        step = max(1, round(view.cylinder.fx / _SEARCH_PX_PER_RAD))
        self._step = step
        # A blob across the seam is whole in the padded part.
        pad = view.cylinder.width // 8 + (-view.cylinder.width * 9 // 8) % step
        image = cv2.copyMakeBorder(view.image, 0, 0, 0, pad, cv2.BORDER_WRAP)
        size = (image.shape[1] // step, image.shape[0] // step)
        small = cv2.resize(
            image[: size[1] * step, : size[0] * step], size, interpolation=cv2.INTER_AREA
        )
        small = cv2.medianBlur(small, 5 if step == 1 else 3)
        brightest = small.max(axis=2)
        usable = (brightest > 2 * _DARKEST) & (brightest < _BRIGHTEST)
        grey = np.median(small[usable], axis=0) if usable.any() else np.full(3, 128.0)
        self._lit = brightest > _DARKEST
        self._balanced = (small / np.maximum(grey, 1.0)).astype(np.float32)
        self._value = self._balanced.max(axis=2)

    def blobs(self, color: str) -> PaperBlobs:
        """Compact blobs of a colour, those with the best hue first."""
        along = hue_direction(color)
        across = np.cross(np.full(3, 3.0**-0.5), along)
        pure = self._balanced @ along.astype(np.float32)
        turned = np.abs(self._balanced @ across.astype(np.float32))
        hue = self._lit & (turned < np.tan(_WIDEST_TURN_RAD) * pure)
        purity = np.where(hue, pure / np.maximum(self._value, 1e-6), 0.0)
        boxes = _distinct(np.concatenate([self._boxes(purity > level) for level in _PURITIES]))
        misfit = np.array([self._misfit(box, along, across) for box in boxes[:, :4].astype(int)])
        order = np.argsort(misfit)[:_MOST_BLOBS]
        left, top, width, height = boxes[order, :4].T * self._step
        right_left = self._cylinder.azimuth_rad(np.stack([left + width, left], 1) - 0.5)
        bottom_top = self._cylinder.tangent(np.stack([top + height, top], 1) - 0.5)
        return PaperBlobs(np.hstack([right_left, bottom_top]), misfit[order])

    def _boxes(self, mask: BoolArray) -> FloatArray:
        """Left, top, width, height and filled share of compact components, (n, 5)."""
        _, _, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
        left, top, width, height, area = stats[1:].astype(np.float64).T
        filled = area / (width * height)
        turn = self._cylinder.width / self._step
        # Each blob starts once in (0, turn]; a blob across the seam is whole there.
        good = (left > 0) & (left <= turn) & (left + width < mask.shape[1])
        good &= (filled >= _SOLID) & (area >= max(_LEAST_AREA_PX / self._step**2, 10.0))
        good &= (width > 0.12 * height) & (width < 6.0 * height)
        return np.asarray(np.stack([left, top, width, height, filled], 1)[good])

    def _misfit(self, box: IndexArray, along: FloatArray, across: FloatArray) -> float:
        """Squared deviation of a blob's hue, relative to grey in its surroundings."""
        left, top, width, height = box
        core = self._balanced[
            top + height // 4 : top + max(1, height - height // 4),
            left + width // 4 : left + max(1, width - width // 4),
        ]
        color = np.median(core.reshape(-1, 3), axis=0)
        ring = 3 + (width + height) // 8
        rows = slice(max(0, top - ring), top + height + ring)
        around = [
            self._balanced[rows, max(0, left - ring) : max(0, left - 1)],
            self._balanced[rows, left + width + 1 : left + width + ring],
        ]
        beside = np.concatenate([part.reshape(-1, 3) for part in around])
        if len(beside):
            grey = np.median(beside, axis=0)
            if grey.min() > 0.7 * grey.max() and grey.max() > 0.1:
                color = color / grey
        turn = np.arctan2(color @ across, color @ along)
        return float((turn / _TURN_SIGMA_RAD) ** 2)


def _distinct(boxes: FloatArray) -> FloatArray:
    """Of boxes (n, 5) that nearly coincide, keep the one with the largest filled share."""
    boxes = boxes[np.argsort(-boxes[:, 4])]
    low, high = boxes[:, :2], boxes[:, :2] + boxes[:, 2:4]
    shared = np.clip(
        np.minimum(high[:, None], high) - np.maximum(low[:, None], low), 0.0, None
    ).prod(-1)
    area = boxes[:, 2] * boxes[:, 3]
    alike = shared > 0.7 * np.maximum(area[:, None], area)
    keep = np.ones(len(boxes), bool)
    for k in range(len(boxes)):
        if keep[k]:
            keep[k + 1 :] &= ~alike[k, k + 1 :]
    return boxes[keep]
