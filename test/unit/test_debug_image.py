"""The debug image: frames where landmarks were found, readable labels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from landmark_nav.localization.debug_image import draw_observation
from landmark_nav.localization.detection.expectation import Expectation
from landmark_nav.localization.observer import Observation
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag
from landmark_nav.types import Detections, ImageArray, Refusal

DRIVE = Path(__file__).resolve().parents[2] / 'bags' / 'drive'


def expected(u: float, v: float) -> Expectation:
    """A template of 31 x 21 pixels, searched 12 and 8 around."""
    left, top = round(u) - 15, round(v) - 10
    return Expectation(np.array([u, v]), left, top, left + 30, top + 20, (12, 8), np.eye(3))


def observation(found: dict[int, tuple[float, float]], refused: dict[int, str]) -> Observation:
    """Landmarks found so far off where they were expected, and others refused, side by side."""
    ids = [*found, *refused]
    places = {number: expected(60.0 + 90.0 * k, 120.0) for k, number in enumerate(ids)}
    uv = np.array([places[k].uv + off for k, off in found.items()]).reshape(-1, 2)
    count = len(found)
    detections = Detections(
        0,
        np.array(list(found), dtype=np.int64),
        np.zeros(count),
        np.ones(count),
        np.full(count, 0.93),
        uv,
    )
    reasons = {number: Refusal(reason) for number, reason in refused.items()}
    return Observation(detections, reasons, lambda: Refusal('too few'), expected=places)


@pytest.fixture(scope='module')
def frame() -> ImageArray:
    """A real one, grey."""
    bag = Bag(DRIVE)
    topic = bag.find('camera/image_raw/compressed')
    info_topic = bag.find('camera/camera_info')
    assert topic
    assert info_topic
    info = decode.camera_info(next(iter(bag.messages([info_topic]))).message)
    image, _ = decode.camera_image(next(iter(bag.messages([topic]))).message, info, grey=True)
    return image


def colored(drawn: ImageArray) -> np.ndarray:
    """Pixels that are not grey."""
    return np.ptp(drawn.astype(int), axis=2) > 40


def test_what_is_drawn_lies_where_it_was_searched(frame: ImageArray) -> None:
    seen = observation({4: (3.0, -2.0), 7: (0.0, 0.0)}, {9: 'low correlation'})
    drawn = draw_observation(frame, seen, [7])
    scale = drawn.shape[1] // frame.shape[1]
    rows, columns = np.nonzero(colored(drawn)[20:])
    # Within the windows, and the words above and below.
    assert columns.min() >= scale * (45 - 12) - 1
    assert rows.min() + 20 >= scale * (110 - 8) - 20
    assert rows.max() + 20 <= scale * (130 + 8) + 20
    changed = np.any(drawn != draw_observation(frame, observation({}, {})), axis=2)
    assert changed[:, : scale * 30].sum() == changed[:16, : scale * 30].sum()
