from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from rendered_drives import camera_image, drive, error_of, FRAME_NS, LENS, MAP, MOUNT, start_of

from landmark_nav.calibration import Calibration
from landmark_nav.localization.debug_image import draw_observation
from landmark_nav.localization.detection import DetectionConfig
from landmark_nav.localization.detection.expectation import Expectation
from landmark_nav.localization.estimator import EstimatorConfig
from landmark_nav.localization.image_stages import ImageStagesConfig
from landmark_nav.localization.localizer import LocalizationConfig, LocalizationUpdate, Localizer
from landmark_nav.localization.observer import Observation, Observer
from landmark_nav.localization.triplet import CameraState, TripletConfig
from landmark_nav.localization.triplet.selection import ActiveCamera
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag
from landmark_nav.types import Detections, FloatArray, PoseEstimate, Refusal, Triplet

EXACT = Calibration.exact(MOUNT)


def observer(config=None):
    return Observer(MAP, EXACT, config or ImageStagesConfig(), EstimatorConfig())


@dataclass(frozen=True, eq=False)
class Run:
    """What a drive gave: updates, errors of fused poses (n, 3), their NEES (n,)."""

    updates: list[LocalizationUpdate]
    errors: FloatArray
    nees: FloatArray
    fixes: list[tuple[PoseEstimate, FloatArray]]


def localize(seed=1, seconds=9.0, config=None):
    """Drive with the camera turned to the triplet that is best after each image."""
    rng = np.random.default_rng(seed)
    localizer = Localizer(MAP, EXACT, config or LocalizationConfig())
    camera = ActiveCamera(MAP, MOUNT, TripletConfig())
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
        chosen = camera.choose(update.fused, LENS, CameraState(pan)).chosen
        assert isinstance(chosen, Triplet)
        pan = chosen.pan_rad
    return Run(updates, np.array(errors), np.array(nees), fixes)


@pytest.fixture(scope='module')
def run():
    return localize()


def test_fixes_err_as_their_covariances_say(run):
    assert len(run.fixes) > 10
    errors = np.array([error_of(fix, pose) for fix, pose in run.fixes])
    sigma = np.array([np.sqrt(np.diag(fix.covariance)) for fix, _ in run.fixes])
    assert np.abs(errors / sigma).max() < 4.5
    assert np.mean((errors / sigma) ** 2) < 2.5


def test_no_more_landmarks_are_searched_than_allowed():
    few = LocalizationConfig(detection=DetectionConfig(target_count=3, max_count=2))
    updates = localize(seconds=2.0, config=few).updates
    assert max(len(update.observation.expected) for update in updates) == 2


DRIVE = Path(__file__).resolve().parents[2] / 'bags' / 'drive'


def expected(u, v):
    """A template of 31 x 21 pixels, searched 12 and 8 around."""
    left, top = round(u) - 15, round(v) - 10
    return Expectation(np.array([u, v]), left, top, left + 30, top + 20, (12, 8), np.eye(3))


def observation(found, refused):
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
def frame():
    """A real one, grey."""
    bag = Bag(DRIVE)
    topic = bag.find('camera/image_raw/compressed')
    info_topic = bag.find('camera/camera_info')
    assert topic
    assert info_topic
    info = decode.camera_info(next(iter(bag.messages([info_topic]))).message)
    image, _ = decode.camera_image(next(iter(bag.messages([topic]))).message, info, grey=True)
    return image


def colored(drawn):
    """Pixels that are not grey."""
    return np.ptp(drawn.astype(int), axis=2) > 40


def test_what_is_drawn_lies_where_it_was_searched(frame):
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
