"""Where a camera looks at a time that is not known."""

from __future__ import annotations

import numpy as np
import pytest

from landmark_nav.geometry.angles import PanTrack

TIMES = np.linspace(-1.0, 1.0, 401)


@pytest.mark.parametrize('sigma_s', [0.01, 0.1])
def test_an_even_pan_has_its_rate_and_no_bend(sigma_s: float) -> None:
    lagged = PanTrack(TIMES, 0.5 + 2.0 * TIMES).lagged(0.1, sigma_s)
    assert lagged == pytest.approx((0.7, 2.0, 0.0), abs=1e-9)


def test_a_pan_that_begins_to_turn_is_as_uncertain_as_samples_of_it() -> None:
    track = PanTrack(TIMES, 3.0 * np.maximum(TIMES, 0.0) ** 2)
    pan, rate, bend = track.lagged(0.0, 0.1)
    seconds = 0.1 * np.random.default_rng(0).normal(size=100_000)
    drawn = track.at(seconds)
    slope = float(drawn @ seconds / (seconds @ seconds))
    assert rate == pytest.approx(slope, rel=0.1)
    assert bend == pytest.approx(np.sqrt(np.mean((drawn - pan - slope * seconds) ** 2)), rel=0.1)
