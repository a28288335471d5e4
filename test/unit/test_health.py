"""What the filter shows of itself, and for how long."""

from __future__ import annotations

import numpy as np
import pytest

from landmark_nav.localization.fusion.config import HealthConfig
from landmark_nav.localization.fusion.health import Health
from landmark_nav.localization.fusion.update import FusionUpdate
from landmark_nav.types import PoseEstimate, Refusal

NS = 10**9


def status(health: Health, seconds: float) -> str:
    here = PoseEstimate(round(seconds * NS), np.zeros(3), 1e-6 * np.eye(3))
    return health.status(here, here.stamp_ns)[0]


def test_what_images_contradicted_for_long_is_flagged_for_six_seconds_more() -> None:
    health = Health(HealthConfig(coasting_after_s=1000.0))
    health.restart(0)
    for k in range(61):
        health.note_surprise(k * NS // 4, Refusal('turned'))
    assert status(health, 15.0 + 5.9) == 'coasting'
    assert status(health, 15.0 + 6.1) == 'tracking'


def test_trouble_with_the_odometry_distinguished_from_then_on() -> None:
    health = Health(HealthConfig(coasting_after_s=1000.0))
    health.restart(0)
    health.note_trouble(10 * NS, Refusal('odometry jumped'))
    reported = [status(health, seconds) for seconds in (9.9, 10.0, 11.9, 12.1)]
    assert reported == ['tracking', 'coasting', 'coasting', 'tracking']


def test_an_image_that_comes_late_makes_those_after_it_no_older() -> None:
    health = Health(HealthConfig())
    health.restart(0)
    for seconds in (10.0, 8.5):
        health.note_update(FusionUpdate(round(seconds * NS), degrees=3))
    assert status(health, 10.9) == 'tracking'
    assert status(health, 11.1) == 'coasting'


def test_a_pose_that_was_contradicted_for_long_is_flagged_after_it_fits_again() -> None:
    health = Health(HealthConfig(coasting_after_s=1000.0))
    health.restart(0)
    for k in range(21):
        health.doubt(k * NS // 4, 'nothing is found')
    assert status(health, 5.0) == 'lost'
    for k in range(3):
        health.note_update(FusionUpdate(5 * NS + (k + 1) * NS // 10, degrees=3))
    # For 5.25 s, of which two are nothing.
    assert [status(health, seconds) for seconds in (5.4, 8.2, 8.3)] == [
        'coasting',
        'coasting',
        'tracking',
    ]


def test_once_contradicted_chance_must_be_excluded() -> None:
    """Of so many that should be in view, these must agree with each other."""
    health = Health(HealthConfig())
    health.restart(0)
    assert [health.least(expected) for expected in (3, 20)] == [1, 1]
    health.note_update(FusionUpdate(NS, refusal=Refusal('pose does not fit'), contradicts=True))
    assert [health.least(expected) for expected in (0, 2, 20)] == [1, 2, 3]
    health.doubt(NS, 'nothing is found')
    assert [health.least(expected) for expected in (3, 20)] == [3, 8]


@pytest.mark.parametrize(('contradicts', 'verdict'), [(True, 'lost'), (False, 'tracking')])
def test_what_is_too_little_to_be_used_is_no_contradiction(
    contradicts: bool, verdict: str
) -> None:
    health = Health(HealthConfig(coasting_after_s=1000.0))
    health.restart(0)
    for k in range(6):
        refusal = Refusal('bearings do not fit the expected pose')
        health.note_update(FusionUpdate(k * NS // 5, refusal=refusal, contradicts=contradicts))
    assert status(health, 1.2) == verdict


@pytest.mark.parametrize(
    ('contradict', 'verdict'),
    [
        ([7, 8], 'coasting'),  # Posters that were exchanged, as often as they are looked at.
        ([7, 3], 'lost'),  # One that agreed before.
        ([7, 8, 9, 10, 11], 'lost'),  # So many are not all exchanged.
    ],
)
def test_a_few_images_never_seen_before_do_not_call_the_pose_lost(
    contradict: list[int], verdict: str
) -> None:
    health = Health(HealthConfig(coasting_after_s=1.0))
    health.restart(0)
    health.note_update(FusionUpdate(0, np.array([1, 2, 3]), degrees=3))
    for k in range(10):
        rejected = {contradict[k % len(contradict)]: Refusal('outside its gate')}
        health.note_update(
            FusionUpdate(k * NS // 5, rejected=rejected, refusal=Refusal('?'), contradicts=True)
        )
    assert status(health, 2.0) == verdict
