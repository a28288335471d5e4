"""The debug image: where landmarks were searched, found and refused."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.localization.observer import Observation
from landmark_nav.types import FloatArray, ImageArray, PoseEstimate

_Bgr = tuple[int, int, int]
_Box = tuple[int, int, int, int]

_FOUND: _Bgr = (90, 220, 60)
_CHOSEN: _Bgr = (40, 220, 250)
_REFUSED: _Bgr = (80, 80, 250)
_WINDOW: _Bgr = (230, 190, 120)
_BACKGROUND: _Bgr = (20, 20, 20)

# Narrower images are drawn twice as large, so that text fits.
_WIDE_PX = 640
_FONT, _SIZE = cv2.FONT_HERSHEY_SIMPLEX, 0.42
_LINE_PX, _PAD_PX = 15, 3
_MOST_LETTERS = 48


def draw_observation(
    image: ImageArray, seen: Observation, chosen: npt.ArrayLike = ()
) -> ImageArray:
    """
    Draw where landmarks were searched and found, and why others were refused.

    A thin frame is the search window. A bold frame is a match, with number and correlation, in
    another colour for the triplet; a cross is its expected centre. Labels that would overlap
    others are left out.

    Parameters
    ----------
    image : ndarray, shape (height, width) or (height, width, 3)
        Observed image, grey or BGR, uint8.
    chosen : array_like of int
        Ids of the landmarks of the triplet.

    Returns
    -------
    ndarray, shape (rows, columns, 3)
        BGR image of the same size, or twice as large if the image is small.
    """
    bgr = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy()
    scale = 1 if bgr.shape[1] >= _WIDE_PX else 2
    if scale > 1:
        bgr = cv2.resize(bgr, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)
    canvas = _Canvas(np.asarray(bgr, dtype=np.uint8), scale)
    found = seen.detections
    triplet = set(np.asarray(chosen, dtype=np.int64).tolist())
    fix = 'fix' if isinstance(seen.fix, PoseEstimate) else f'no fix: {seen.fix.reason}'
    summary = f'{len(found)} found of {len(seen.expected)} looked for; {fix}'
    canvas.write(summary, (0, 0, canvas.pixels.shape[1] // scale, 0), (255, 255, 255))
    windows = {}
    for number, place in seen.expected.items():
        x, y = place.window
        windows[number] = place.left - x, place.top - y, place.right + x, place.bottom + y
        canvas.frame(windows[number], _WINDOW, 1)
    for number, score, uv in zip(
        found.ids.tolist(), found.score.tolist(), found.uv_px, strict=True
    ):
        color = _CHOSEN if number in triplet else _FOUND
        place = seen.expected[number]
        canvas.cross(place.uv, _WINDOW)
        x, y = (round(value) for value in (uv - place.uv).tolist())
        box = place.left + x, place.top + y, place.right + x, place.bottom + y
        canvas.frame(box, color, 2)
        canvas.write(f'{number}: {score:.2f}', box, color)
    for number, refusal in seen.refused.items():
        if number in windows:
            canvas.frame(windows[number], _REFUSED, 1)
            canvas.write(f'{number}: {refusal.reason}'[:_MOST_LETTERS], windows[number], _REFUSED)
    return canvas.pixels


class _Canvas:
    """An image enlarged by `scale`, and the places of its labels."""

    def __init__(self, pixels: ImageArray, scale: int) -> None:
        self.pixels, self._scale = pixels, scale
        self._words: list[_Box] = []

    def frame(self, box: _Box, color: _Bgr, thickness: int) -> None:
        """Draw a frame."""
        left, top, right, bottom = (self._scale * value for value in box)
        cv2.rectangle(self.pixels, (left, top), (right, bottom), color, thickness, cv2.LINE_AA)

    def cross(self, uv: FloatArray, color: _Bgr) -> None:
        """Mark a point (2,)."""
        u, v = (round(self._scale * value) for value in uv.tolist())
        cv2.drawMarker(self.pixels, (u, v), color, cv2.MARKER_CROSS, 9, 1, cv2.LINE_AA)

    def write(self, words: str, box: _Box, color: _Bgr) -> None:
        """Write a label above a frame or below it, if there is room."""
        (width, _), _ = cv2.getTextSize(words, _FONT, _SIZE, 1)
        rows, columns = self.pixels.shape[:2]
        left = min(max(0, self._scale * box[0]), max(0, columns - width - 2 * _PAD_PX))
        above, below = self._scale * box[1] - _LINE_PX - 1, self._scale * box[3] + 2
        for top in (above, below):
            place = (left, top, left + width + 2 * _PAD_PX, top + _LINE_PX)
            if 0 <= top <= rows - _LINE_PX and not any(_overlap(place, k) for k in self._words):
                self._words.append(place)
                cv2.rectangle(self.pixels, place[:2], place[2:], _BACKGROUND, cv2.FILLED)
                corner = (left + _PAD_PX, place[3] - 4)
                cv2.putText(self.pixels, words, corner, _FONT, _SIZE, color, 1, cv2.LINE_AA)
                return


def _overlap(one: _Box, other: _Box) -> bool:
    """Whether two boxes share pixels."""
    return one[0] <= other[2] and other[0] <= one[2] and one[1] <= other[3] and other[1] <= one[3]
