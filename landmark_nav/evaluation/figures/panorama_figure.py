"""``panorama_K.png``: candidates and elected landmarks drawn on the panorama."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
from matplotlib.colors import to_rgb
import numpy as np

from landmark_nav.evaluation.figures import style
from landmark_nav.image_codec import encode_image
from landmark_nav.storage.atomic_io import write_atomically
from landmark_nav.types import Candidate, Landmark, Panorama, Refusal

_FONT, _SIZE = cv2.FONT_HERSHEY_SIMPLEX, 0.45
# Height of an id, and its distance from the patch below it.
_ID_PX, _ABOVE_PX = 14, 3


def draw_panorama(
    panorama: Panorama,
    candidates: Sequence[Candidate],
    outcomes: Sequence[Landmark | Refusal],
    path: Path,
) -> None:
    """
    Draw a panorama with its candidates thin and its elected landmarks bold, with their ids.

    Ids that would overlap a previous one are omitted.
    """
    image = np.where(panorama.mask[..., None], panorama.image, np.uint8(255))
    turn = image.shape[1]
    thin, bold = (
        tuple(round(255 * part) for part in to_rgb(color)[::-1])
        for color in (style.CANDIDATE, style.LANDMARK)
    )
    elected: list[tuple[str, float, float]] = []
    for candidate, outcome in zip(candidates, outcomes, strict=True):
        color, width = thin, 1
        size = np.array([candidate.width_px, candidate.height_px])
        top_left = np.array([candidate.column, candidate.row]) - 0.5 * size
        if isinstance(outcome, Landmark):
            color, width = bold, 2
            elected.append((str(outcome.id), *top_left))
        # Patches across the seam are drawn at both ends.
        for shift in (-turn, 0, turn):
            first, last = np.rint(np.add([top_left, top_left + size], (shift, 0))).astype(int)
            cv2.rectangle(image, first.tolist(), last.tolist(), color, width)
    widths = [cv2.getTextSize(word, _FONT, _SIZE, 1)[0][0] for word, *_ in elected]
    above = [(left, top - _ABOVE_PX - _ID_PX) for _, left, top in elected]
    free = style.free_labels(above, [(width, _ID_PX) for width in widths])
    for (word, left, top), width, is_free in zip(elected, widths, free, strict=True):
        if is_free:
            x, y = round(left), round(top) - _ABOVE_PX
            cv2.rectangle(image, (x, y - _ID_PX), (x + width, y), bold, cv2.FILLED)
            cv2.putText(image, word, (x, y - 2), _FONT, _SIZE, (255, 255, 255), 1, cv2.LINE_AA)
    write_atomically(path, encode_image(image, '.png').tobytes())
