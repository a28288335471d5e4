"""
Faults on a real robot: the localizer reports them, survives, and recovers.

Of the start, the place, the map and the objects on the walls; `test_bad_sensors` has the rest.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from degraded_drives import (
    check_consistent,
    FAULT_S,
    first,
    run,
    Sensed,
    untouched,
)
import numpy as np
import pytest
from rendered_drives import MAP, START, Step

from landmark_nav.geometry import se2
from landmark_nav.localization import observer
from landmark_nav.localization.relocalization.search import localize_within_prior
from landmark_nav.localization.relocalization.verification import Verification
from landmark_nav.types import CameraFrame, PoseEstimate, Refusal


def test_without_faults_it_tracks(sensed: list[Sensed]) -> None:
    moments = list(run(sensed, untouched))
    check_consistent(moments)
    # Towards the end the camera looks where no landmark is.
    assert {m.status for m in moments if m.after_s < 6.0} == {'tracking'}
    assert all(m.update.search is None for m in moments)


@pytest.mark.parametrize('offset', [(0.8, 0.6, 0.0), (-0.6, 0.1, 0.8)])
def test_a_wrong_start_is_noticed_and_put_right(
    sensed: list[Sensed], offset: tuple[float, float, float]
) -> None:
    moments = list(run(sensed, untouched, start=START + np.array(offset)))
    found = next(m for m in moments if isinstance(m.update.search, PoseEstimate))
    assert found.after_s + FAULT_S <= 2.0
    assert 'tracking' not in {m.status for m in moments if m.after_s < found.after_s}
    assert np.hypot(*found.error[:2]) < 0.05
    assert {m.status for m in moments if found.after_s < m.after_s < 6.0} == {'tracking'}
    check_consistent(moments)


def test_a_pose_that_expects_nothing_is_put_right_all_the_same(sensed: list[Sensed]) -> None:
    """Behind the walls no landmark is to be seen, so that no image contradicts it."""
    moments = list(run(sensed, untouched, start=START + np.array([-30.0, 0.0, 0.0])))
    assert not any(m.update.observation.refused for m in moments[:5])
    reported = next(m for m in moments if m.status != 'tracking')
    assert reported.after_s + FAULT_S <= 2.0
    found = next(m for m in moments if isinstance(m.update.search, PoseEstimate))
    assert found.after_s + FAULT_S <= 6.0
    later = [m for m in moments if found.after_s < m.after_s < 6.0]
    assert {m.status for m in later} == {'tracking'}
    assert max(np.hypot(*m.error[:2]) for m in later) < 0.05
    check_consistent(later)


def test_a_kidnapped_robot_finds_its_place(sensed: list[Sensed]) -> None:
    """From one image to the next it is where it comes seconds later; the wheels know nothing."""
    begin, back = round(FAULT_S * 20), 64
    before, after = (sensed[k][0].odometry.pose_odom_base for k in (begin, begin - back))
    offset = se2.compose(before, se2.inverse(after))
    # Carried back within the time between two samples, it drives the same way again.
    again: list[Sensed] = []
    for (now, _), (then, frame) in zip(sensed[begin:], sensed[begin - back :], strict=False):
        wheels = replace(
            then.odometry,
            stamp_ns=now.stamp_ns,
            pose_odom_base=se2.compose(offset, then.odometry.pose_odom_base),
        )
        moved = replace(frame, stamp_ns=now.stamp_ns) if frame is not None else None
        again.append((Step(now.stamp_ns, then.pose, wheels), moved))

    moments = list(run([*sensed[:begin], *again], untouched))
    assert 'tracking' not in {m.status for m in moments if 0.0 <= m.after_s <= 2.0}
    assert moments[-1].status == 'tracking'
    assert np.hypot(*moments[-1].error[:2]) < 0.05
    check_consistent(moments)


def test_a_covered_lens_is_reported_and_forgotten_when_free(sensed: list[Sensed]) -> None:
    def covered(step: Step, frame: CameraFrame | None) -> Sensed:
        if frame is not None and step.stamp_ns * 1e-9 < FAULT_S + 3.0:
            frame = replace(frame, image=np.zeros_like(frame.image))
        return step, frame

    moments = list(run(sensed, covered))
    assert 'tracking' not in {m.status for m in moments if 0.0 <= m.after_s <= 3.0}
    assert first(moments, 'lost').after_s <= 3.0
    hidden = [m for m in moments if 0.0 <= m.after_s < 2.9]
    assert all(np.diff([np.hypot(*m.sigma[:2]) for m in hidden]) > 0.0)
    back = next(m for m in moments if m.after_s > 3.0 and m.status == 'tracking')
    assert back.after_s <= 4.5
    assert np.hypot(*back.error[:2]) < 0.05
    check_consistent(moments)


def test_a_map_of_another_room_is_not_accepted(
    sensed: list[Sensed], monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: dict[int, Verification | Refusal] = {}

    def counted(frame: CameraFrame, *arguments: Any) -> Verification | Refusal:
        tried[frame.stamp_ns] = place = localize_within_prior(frame, *arguments)
        return place

    monkeypatch.setattr(observer, 'localize_within_prior', counted)
    rng = np.random.default_rng(0)
    patches = [np.ascontiguousarray(k.patch[::-1, ::-1]) for k in MAP.landmarks]
    landmarks = tuple(
        replace(k, patch=patches[p])
        for k, p in zip(MAP.landmarks, rng.permutation(len(patches)), strict=True)
    )
    moments = list(run(sensed, untouched, landmarks=replace(MAP, landmarks=landmarks)))
    assert all(m.status == 'lost' for m in moments if m.after_s + FAULT_S >= 2.0)
    assert not any(isinstance(m.update.search, PoseEstimate) for m in moments)
    # What is in vain is not tried with each image.
    assert all(isinstance(place, Refusal) for place in tried.values())
    assert 5 < len(tried) < 0.6 * sum(m.status == 'lost' for m in moments)


def test_a_covered_and_an_exchanged_landmark_do_no_harm(sensed: list[Sensed]) -> None:
    landmarks = list(MAP.landmarks)
    rng = np.random.default_rng(1)
    for k in range(0, len(landmarks), 4):
        landmarks[k] = replace(landmarks[k], patch=landmarks[k - 1].patch)
        noise = rng.integers(0, 255, landmarks[k + 1].patch.shape).astype(np.uint8)
        landmarks[k + 1] = replace(landmarks[k + 1], patch=noise)
    moments = list(run(sensed, untouched, replace(MAP, landmarks=tuple(landmarks))))
    assert 'lost' not in {m.status for m in moments}
    assert np.sqrt(np.mean([np.sum(m.error[:2] ** 2) for m in moments])) < 0.04
    check_consistent(moments)
