"""What of an image's bearings a filter can use, and how far the pan swung about it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from landmark_nav.geometry.pan_track import PanTrack
from landmark_nav.localization.fusion.bearings import BearingFrame, FrameMaker
from landmark_nav.localization.fusion.config import FusionConfig
from landmark_nav.types import Detections


def frame(scores: npt.ArrayLike, before: npt.ArrayLike = (), **camera: object) -> BearingFrame:
    score = np.array(scores)
    n = len(score)
    ids, bearings, variances = np.arange(n), np.zeros(n), np.full(n, 1e-6)
    seen = Detections(0, ids, bearings, variances, score, np.zeros((n, 2)), **camera)  # type: ignore[arg-type]
    frames = FrameMaker(ids, FusionConfig(), 0.0)
    frames.remember(np.array(before))
    return frames.frame(seen)


def test_one_that_is_far_less_alike_than_the_others_shows_something_else() -> None:
    found = frame([0.97, 0.98, 0.6, 0.96, 0.97])
    assert list(found.unusable) == [2]
    assert 'less alike' in found.unusable[2].reason
    assert list(found.ids) == [0, 1, 3, 4]


def test_where_few_are_found_those_of_images_before_gives_what_to_expect() -> None:
    assert list(frame([0.97, 0.6], before=[0.98, 0.97, 0.96]).unusable) == [1]


def test_an_image_less_alike_as_a_whole_is_one_in_other_light() -> None:
    assert not frame([0.6, 0.62, 0.58], before=[0.98] * 12).unusable


def test_the_pan_swings_about_where_the_joints_are_taken_to_be() -> None:
    about = np.linspace(-1.0, 1.0, 401)
    track = PanTrack(about, np.exp(about))
    found = frame([0.9], pan_track=track, pan_delay_s=0.2)
    assert found.pan_range_rad(0.1) == pytest.approx(np.exp(0.3) - np.exp(0.2), rel=0.01)
    assert frame([0.9], pan_rate_rad_s=-2.0).pan_range_rad(0.1) == pytest.approx(0.2)
