"""Directions that no frame sees."""

from __future__ import annotations

import numpy as np
import pytest

from landmark_nav.geometry.cylinder import describe_coverage, unseen_arcs
from landmark_nav.quality import PanoramaQuality


@pytest.mark.parametrize('seed', range(20))
def test_arcs_are_what_no_frame_sees(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pan, half = rng.uniform(-7.0, 7.0, rng.integers(1, 9)), rng.uniform(0.1, 1.0)
    arcs = unseen_arcs(pan, half)
    around = np.linspace(-np.pi, np.pi, 2001)
    off = np.abs(np.angle(np.exp(1j * (around[:, None] - pan)))).min(axis=1)
    inside = np.zeros(len(around), dtype=bool)
    for start, end in arcs:
        inside |= np.mod(around - start, 2.0 * np.pi) < end - start
    clear = np.abs(off - half) > 1e-9
    np.testing.assert_array_equal(inside[clear], (off > half)[clear])


def test_a_full_turn_has_none() -> None:
    assert not unseen_arcs(np.radians(np.arange(0.0, 360.0, 40.0)), np.radians(20.1))
    assert unseen_arcs([], 0.4) == [(-np.pi, np.pi)]


def test_in_words() -> None:
    turn = np.radians(np.arange(-180.0, 180.0, 5.0))
    half = np.radians(24.0)
    assert describe_coverage(turn, half) == ''
    assert describe_coverage(np.delete(turn, 3), half, turn[3:4]) == (
        '1 frame is missing, at pan -165 deg; their neighbours see it all'
    )
    assert describe_coverage(np.radians([-100.0, -60.0, -20.0, 20.0, 60.0, 100.0]), half) == (
        'nothing is seen from pan 124 to 236 deg'
    )


def test_a_text_stays_short_however_many_gaps_there_are() -> None:
    text = describe_coverage(np.linspace(-3.0, 3.0, 72), 0.01, np.linspace(-3.0, 3.0, 71))
    assert len(text) < 200
    quality = PanoramaQuality(gaps_rad=tuple(np.linspace(-3.0, 3.0, 72).tolist()))
    assert len(quality.closure) < 100
