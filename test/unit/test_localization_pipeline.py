from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from rendered_drives import (
    camera_image,
    drive,
    error_of,
    FRAME_NS,
    LENS,
    MAP,
    MOUNT,
    ROOM,
    START,
    start_of,
    START_SIGMA,
)

from landmark_nav.localization.detection import DetectionConfig
from landmark_nav.localization.fusion import FusionConfig
from landmark_nav.localization.observation import ObservationConfig, Observer
from landmark_nav.localization.pipeline import (
    LocalizationConfig,
    LocalizationUpdate,
    Localizer,
)
from landmark_nav.localization.triplet import TripletConfig
from landmark_nav.types import (
    CameraFrame,
    FloatArray,
    LandmarkMap,
    PoseEstimate,
    Refusal,
    Triplet,
)

FIX_WINDOW_S = 3.0


@dataclass(frozen=True, eq=False)
class Run:
    """What a drive gave: updates, errors of fused poses (n, 3), their NEES (n,)."""

    updates: list[LocalizationUpdate]
    errors: FloatArray
    nees: FloatArray
    fixes: list[tuple[PoseEstimate, FloatArray]]


def localize(
    mode: str, seed: int = 1, seconds: float = 9.0, views: str = 'one', turns: bool = True
) -> Run:
    """Drive with the camera turned, if it turns, to what the last image asked for."""
    rng = np.random.default_rng(seed)
    observation = ObservationConfig(triplet=TripletConfig(views=views, fix_window_s=FIX_WINDOW_S))
    config = LocalizationConfig(observation, FusionConfig(mode=mode))
    localizer = Localizer(MAP, MOUNT, config)
    localizer.initialize(start_of(rng))
    updates, errors, nees, fixes, pan = [], [], [], [], 0.0
    for step in drive(rng, seconds):
        assert localizer.add_odometry(step.odometry) is None
        if step.stamp_ns % FRAME_NS:
            continue
        frame = replace(camera_image(step.pose, pan, rng), stamp_ns=step.stamp_ns)
        update = localizer.add_frame(frame)
        assert isinstance(update, LocalizationUpdate)
        error = error_of(update.fused, step.pose)
        updates.append(update)
        errors.append(error)
        nees.append(error @ np.linalg.solve(update.fused.covariance, error))
        if isinstance(update.observation.fix, PoseEstimate):
            fixes.append((update.observation.fix, step.pose))
        if turns and isinstance(update.triplet, Triplet):
            pan = update.triplet.pan_rad
    return Run(updates, np.array(errors), np.array(nees), fixes)


@pytest.fixture(scope='module')
def run() -> Run:
    return localize('bearings')


def test_a_drive_is_followed(run: Run) -> None:
    later = run.errors[3:]
    assert np.sqrt(np.mean(np.sum(later[:, :2] ** 2, 1))) < 0.018
    assert np.sqrt(np.mean(later[:, 2] ** 2)) < np.radians(0.35)
    assert np.mean(run.nees) / 3.0 < 2.5
    assert {update.status for update in run.updates} == {'tracking'}
    assert all(isinstance(update.triplet, Triplet) for update in run.updates)
    # The camera is turned so that the three are in the image.
    counts = [len(update.observation.detections) for update in run.updates]
    assert np.mean(counts[1:]) >= 3.0


def test_odometry_alone_is_misled() -> None:
    rng = np.random.default_rng(1)
    localizer = Localizer(MAP, MOUNT, LocalizationConfig())
    localizer.initialize(start_of(rng))
    for step in drive(rng, 9.0):
        localizer.add_odometry(step.odometry)
    last = localizer.estimate()
    assert last is not None
    error = error_of(last, step.pose)
    assert np.hypot(error[0], error[1]) > 0.02
    assert np.abs(error / np.sqrt(np.diag(last.covariance))).max() < 4.0


def test_fixes_err_as_their_covariances_say(run: Run) -> None:
    assert len(run.fixes) > 10
    errors = np.array([error_of(fix, pose) for fix, pose in run.fixes])
    sigma = np.array([np.sqrt(np.diag(fix.covariance)) for fix, _ in run.fixes])
    assert np.abs(errors / sigma).max() < 4.5
    assert np.mean((errors / sigma) ** 2) < 2.5


def test_fixes_of_several_views_come_from_what_was_gathered_on_the_way() -> None:
    run = localize('poses', views='several')
    assert np.sqrt(np.mean(np.sum(run.errors[8:, :2] ** 2, 1))) < 0.03
    assert len(run.fixes) > 2
    for fix, pose in run.fixes:
        error = error_of(fix, pose)
        assert error @ np.linalg.solve(fix.covariance, error) < 16.3  # 99.9 %
    fixes = [update.observation.fix for update in run.updates]
    reasons = {fix.reason for fix in fixes if isinstance(fix, Refusal)}
    assert 'the triplet is not complete' in reasons


def test_a_fix_waits_no_longer_for_views_that_the_camera_does_not_turn_to() -> None:
    run = localize('poses', views='several', turns=False)
    fixed = [isinstance(update.observation.fix, PoseEstimate) for update in run.updates]
    stamps = 1e-9 * np.array([update.stamp_ns for update in run.updates])
    waits = np.diff([0.0, *stamps[fixed], stamps[-1]])
    # A wait begins with the image after a fix, and is over with one.
    assert np.all(waits <= FIX_WINDOW_S + 2e-9 * FRAME_NS)
    assert max(waits) > FIX_WINDOW_S
    for fix, pose in run.fixes:
        error = error_of(fix, pose)
        assert error @ np.linalg.solve(fix.covariance, error) < 16.3  # 99.9 %


def test_poses_may_correct_the_odometry_instead_of_bearings() -> None:
    run = localize('poses')
    later = run.errors[4:]
    assert np.sqrt(np.mean(np.sum(later[:, :2] ** 2, 1))) < 0.03
    assert np.mean(run.nees) / 3.0 < 2.5
    corrected = [update for update in run.updates if update.fusion.refusal is None]
    assert len(corrected) > len(run.updates) // 2


def test_the_fix_comes_from_the_bearings_alone() -> None:
    # Priors that differ lead to one fix: they only say where to look.
    frame = camera_image(START, 0.2)
    found = []
    for shift in ((0.0, 0.0, 0.0), (0.04, -0.03, 0.01), (-0.03, 0.04, -0.012)):
        prior = PoseEstimate(0, START + np.array(shift), np.diag([0.04, 0.04, 0.012]) ** 2)
        seen = Observer(MAP, MOUNT, ObservationConfig()).look(frame, prior)
        assert isinstance(seen.fix, PoseEstimate)
        found.append(seen.fix)
    for fix in found[1:]:
        sigma = np.sqrt(np.diag(found[0].covariance))
        assert np.abs(error_of(fix, found[0].pose) / sigma).max() < 0.7


def test_every_landmark_in_view_is_found_or_refused_with_a_reason() -> None:
    prior = PoseEstimate(0, START, np.diag(START_SIGMA**2))
    seen = Observer(MAP, MOUNT, ObservationConfig()).look(camera_image(START, 0.2), prior)
    assert not set(seen.detections.ids.tolist()) & set(seen.refused)
    assert len(seen.detections) + len(seen.refused) >= 4
    assert all(refusal.reason for refusal in seen.refused.values())


def test_where_most_is_found_few_are_looked_for_and_all_once_they_are_not() -> None:
    prior = PoseEstimate(0, START, np.diag(START_SIGMA**2))
    observer = Observer(MAP, MOUNT, ObservationConfig(detection=DetectionConfig(target_count=3)))
    frame = camera_image(START, 0.2)
    blank = replace(frame, image=np.full_like(frame.image, 90))

    def looked_for(k: int, frame: CameraFrame) -> int:
        seen = observer.look(replace(frame, stamp_ns=k), replace(prior, stamp_ns=k))
        return len(seen.detections) + len(seen.refused)

    frames = (frame, frame, blank, blank, frame, frame)
    counts = [looked_for(k, frame) for k, frame in enumerate(frames)]
    assert counts[0] > 3
    assert counts == [counts[0], 3, counts[0], counts[0], counts[0], 3]


def test_a_blank_image_gives_no_fix_and_odometry_goes_on() -> None:
    rng = np.random.default_rng(3)
    localizer = Localizer(MAP, MOUNT, LocalizationConfig())
    localizer.initialize(PoseEstimate(0, START, np.diag(START_SIGMA**2)))
    dark = np.zeros((LENS.height, LENS.width, 3), np.uint8)
    for step in drive(rng, 2.0):
        localizer.add_odometry(step.odometry)
        if step.stamp_ns % FRAME_NS:
            continue
        update = localizer.add_frame(CameraFrame(step.stamp_ns, dark, LENS, 0.0))
        assert isinstance(update, LocalizationUpdate)
        assert isinstance(update.observation.fix, Refusal)
        assert len(update.observation.detections) == 0
        assert update.observation.refused
        assert update.fusion.refusal is not None
    error = error_of(update.fused, step.pose)
    assert np.abs(error / np.sqrt(np.diag(update.fused.covariance))).max() < 3.0


def test_without_a_start_the_place_is_found_from_what_is_seen() -> None:
    rng = np.random.default_rng(4)
    localizer = Localizer(MAP, MOUNT, LocalizationConfig())
    assert localizer.estimate() is None
    dark = np.zeros((LENS.height, LENS.width, 3), np.uint8)
    nothing = localizer.add_frame(CameraFrame(-FRAME_NS, dark, LENS, 0.0))
    assert isinstance(nothing, Refusal)
    assert nothing.reason == 'nothing recognised'
    outcomes = []
    for step in drive(rng, 4.0):
        localizer.add_odometry(step.odometry)
        if step.stamp_ns % FRAME_NS:
            continue
        frame = camera_image(step.pose, 0.8 * step.stamp_ns * 1e-9 - 1.0, rng)
        outcomes.append(localizer.add_frame(replace(frame, stamp_ns=step.stamp_ns)))
        if isinstance(outcomes[-1], PoseEstimate):
            found = error_of(outcomes[-1], step.pose)
            assert np.abs(found / np.sqrt(np.diag(outcomes[-1].covariance))).max() < 4.0
    kinds = [type(outcome) for outcome in outcomes]
    assert kinds.count(PoseEstimate) == 1
    # From then on it tracks.
    after = kinds.index(PoseEstimate) + 1
    assert all(issubclass(kind, Refusal) for kind in kinds[: after - 1])
    assert set(kinds[after:]) == {LocalizationUpdate}
    assert np.hypot(*error_of(outcomes[-1].fused, step.pose)[:2]) < 0.03


def test_a_map_without_landmarks_gives_refusals() -> None:
    localizer = Localizer(LandmarkMap((), walls=ROOM.walls), MOUNT, LocalizationConfig())
    localizer.initialize(PoseEstimate(0, START, np.diag(START_SIGMA**2)))
    update = localizer.add_frame(camera_image(START, 0.0))
    assert isinstance(update, LocalizationUpdate)
    assert isinstance(update.triplet, Refusal)
    assert isinstance(update.observation.fix, Refusal)


def test_a_drive_again_gives_the_same() -> None:
    first, second = (localize('bearings', seed=5, seconds=2.0) for _ in range(2))
    np.testing.assert_array_equal(first.errors, second.errors)
