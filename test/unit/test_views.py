"""When images contradict a pose by what they do not show."""

from __future__ import annotations

import numpy as np
import pytest

from landmark_nav.localization.fusion.views import Views

NS = 10**9
# Along two walls.
PLACES = np.stack([0.2 * np.arange(40), np.zeros(40), np.full(40, 1.2)], -1)


def look(views: Views, seconds: float, found: range, missed: range, elsewhere: int = 0) -> str:
    """Show an image; what is missing after it."""
    ids = np.array(found, dtype=np.intp), np.array(missed, dtype=np.intp)
    views.add(round(seconds * NS), *ids, PLACES[list(missed)], elsewhere)
    return views.missing()


def reported_after_s(views: Views, found: range, missed: range) -> float:
    """Seconds of the same image, five times a second, until too little of it is found."""
    for k in range(100):
        if look(views, 10.0 + 0.2 * k, found, missed):
            return 0.2 * k
    return np.inf


@pytest.fixture
def confirmed() -> Views:
    """Twelve landmarks of sixteen were found a moment ago."""
    return shown(12)


def shown(count: int) -> Views:
    """So many landmarks and four that were not there, a moment ago."""
    views = Views()
    assert not look(views, 9.8, range(count), range(count, count + 4))
    return views


def test_a_pose_that_nothing_has_spoken_for_is_lost_at_once() -> None:
    assert reported_after_s(Views(), range(2), range(2, 18)) < 1.5


def test_what_was_there_a_moment_ago_is_missed_at_once(confirmed: Views) -> None:
    assert reported_after_s(confirmed, range(1), range(1, 12)) < 1.5


def test_a_wall_of_exchanged_images_is_no_wrong_pose_for_a_while(confirmed: Views) -> None:
    assert 14.0 < reported_after_s(confirmed, range(20, 22), range(22, 38)) < 16.0


def test_where_few_have_spoken_for_the_pose_it_is_reported_after_a_while() -> None:
    assert 3.5 < reported_after_s(shown(6), range(20, 22), range(22, 38)) < 5.0


def test_what_is_missing_within_one_image_may_be_exchanged(confirmed: Views) -> None:
    assert reported_after_s(confirmed, range(0), range(30, 37)) == np.inf


def test_a_few_mistaken_matches_do_not_make_landmarks_familiar() -> None:
    views = Views()
    assert not look(views, 9.8, range(3), range(3, 18))
    assert reported_after_s(views, range(2), range(20, 36)) < 1.5


def test_landmarks_that_lie_elsewhere_are_reported(confirmed: Views) -> None:
    assert not confirmed.elsewhere()
    look(confirmed, 10.0, range(10), range(0), elsewhere=3)
    assert not confirmed.elsewhere()
    look(confirmed, 10.2, range(10), range(0), elsewhere=3)
    assert confirmed.elsewhere().startswith('6 of 38')
