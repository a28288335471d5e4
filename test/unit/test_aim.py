"""A camera that looks otherwise than its joints and its sweeps say: blurred, or tilted."""

from __future__ import annotations

from dataclasses import replace

from east_wall import CONFIG, errors_of, HERE, LANDMARKS, LENS, MOUNT, PRIOR, ROOM, SCENE
import numpy as np
import pytest
from scenes import blurred_by, draw_frame, textured_room, true_landmark

from landmark_nav.localization.detection import DetectionResult
from landmark_nav.localization.detection.aim import AimedDetector
from landmark_nav.localization.detection.height import RowResiduals
from landmark_nav.types import FloatArray, PoseEstimate, Refusal


@pytest.mark.parametrize('sigmas_px', [(1.5, 1.5), (2.5, 2.5), (2.5, 0.01)])
@pytest.mark.parametrize('pose', [HERE, HERE + np.array([-0.4, 0.3, -0.1])])
def test_a_blurred_image_shows_landmarks_where_a_sharp_one_does(
    sigmas_px: tuple[float, float], pose: FloatArray
) -> None:
    """Out of focus, or in motion; a pixel is 2.5 mrad."""
    sharp = draw_frame(SCENE, LENS, MOUNT, pose, 0.05)
    image = blurred_by(sharp.image, *sigmas_px)
    detector = AimedDetector(LANDMARKS, MOUNT, CONFIG, 0.0)
    prior = PoseEstimate(sharp.stamp_ns, pose, PRIOR)
    blurred = detector.detect(replace(sharp, image=image), prior, np.arange(4))
    assert len(blurred.detections) == 4
    assert np.abs(errors_of(blurred, pose)).max() < 2.5e-4
    np.testing.assert_allclose(blurred.blur_px2.mean(axis=0), np.square(sigmas_px), atol=1.2)
    # And with the next image it is sharp again.
    again = detector.detect(sharp, prior, np.arange(4))
    assert np.abs(errors_of(again, pose)).max() < 1e-4
    assert np.abs(again.blur_px2.mean(axis=0)).max() < 0.5


def test_bearings_in_blurred_images_claim_what_they_are_worth() -> None:
    """What lies around a patch is blurred into it, and moves it more than noise does."""
    rng = np.random.default_rng(0)
    squares = []
    for _ in range(12):
        pose = HERE + rng.normal(0.0, [0.2, 0.2, 0.05])
        sharp = draw_frame(SCENE, LENS, MOUNT, pose, 0.05)
        blurred = replace(sharp, image=blurred_by(sharp.image, 2.5, 2.5))
        detector = AimedDetector(LANDMARKS, MOUNT, CONFIG, 0.0)
        found = detector.detect(blurred, PoseEstimate(0, pose, PRIOR), np.arange(4))
        squares += (errors_of(found, pose) ** 2 / found.detections.variance_rad2).tolist()
    assert len(squares) > 36
    assert 0.1 < np.mean(squares) < 1.0


def test_a_blur_that_was_mistaken_hides_nothing_for_long() -> None:
    frame = draw_frame(SCENE, LENS, MOUNT, HERE, 0.05)
    detector = AimedDetector(LANDMARKS, MOUNT, CONFIG, 0.0)
    prior = PoseEstimate(frame.stamp_ns, HERE, PRIOR)
    haze = replace(frame, image=blurred_by(frame.image, 6.0, 6.0))
    for _ in range(3):
        detector.detect(haze, prior, np.arange(4))
    assert len(detector.detect(frame, prior, np.arange(4)).detections) == 4


@pytest.mark.parametrize('strangers', [0, 8])
def test_a_camera_is_tilted_where_most_landmarks_report_it(strangers: int) -> None:
    """From a wrong place a few are mistaken for others, and may agree on a tilt."""
    knock_rad, viewpoint = 0.03, np.array([3.0, 2.3, 1.15])
    frame = draw_frame(SCENE, LENS, MOUNT, HERE, 0.05)
    frame = replace(frame, tilt_rad=frame.tilt_rad - knock_rad)
    other = textured_room(ROOM, seed=23, feature_m=0.04)
    elsewhere = [
        true_landmark(other, 10 + k, other.boards[1], 0.2 * k - 0.7, 0.4, viewpoint)
        for k in range(strangers)
    ]
    landmark_map = replace(LANDMARKS, landmarks=(*LANDMARKS.landmarks, *elsewhere))
    detector = AimedDetector(landmark_map, MOUNT, CONFIG, knock_rad)
    prior = PoseEstimate(frame.stamp_ns, HERE, PRIOR)
    found = detector.detect(frame, prior, np.arange(4 + strangers)).detections
    assert len(found) == (0 if strangers else 4)
    assert detector.tilt_rad == pytest.approx(0.0 if strangers else knock_rad, abs=1e-3)


def test_a_place_that_was_narrowed_but_is_not_sure_gives_no_tilt() -> None:
    """Landmarks that are mistaken for others agree on one, which all later images would have."""
    frame = draw_frame(SCENE, LENS, MOUNT, HERE, 0.05)
    frame = replace(frame, tilt_rad=frame.tilt_rad - 0.01)
    detector = AimedDetector(LANDMARKS, MOUNT, CONFIG, 0.03)
    prior = PoseEstimate(frame.stamp_ns, HERE, PRIOR)
    for tells, tilt_rad in ((False, 0.0), (True, 0.01)):
        found = detector.detect(frame, prior, np.arange(4), displaced=False, tells=tells)
        assert len(found.detections) == 4
        assert detector.tilt_rad == pytest.approx(tilt_rad, abs=1e-3)


def test_a_heading_that_is_put_right_is_no_camera_that_looks_beside() -> None:
    """Also where it is not known whether that may be why landmarks are missing."""
    frame = draw_frame(SCENE, LENS, MOUNT, HERE, 0.05)
    detector = AimedDetector(LANDMARKS, MOUNT, CONFIG, 0.035)
    wrong = PoseEstimate(frame.stamp_ns, HERE + np.array([0.0, 0.0, 0.1]), PRIOR)
    right = PoseEstimate(frame.stamp_ns, HERE, PRIOR)
    assert len(detector.detect(frame, wrong, np.arange(4)).detections) == 4
    found = detector.detect(frame, right, np.arange(4), displaced=False)
    assert len(found.detections) == 4
    assert np.abs(errors_of(found, HERE)).max() < 1e-4


def test_a_place_that_is_hardly_known_gives_no_tilt() -> None:
    """From half a metre nearer by, what is high is higher."""
    low = replace(MOUNT, axis_xyz=(*MOUNT.axis_xyz[:2], 0.75))
    frame = draw_frame(SCENE, LENS, low, HERE, 0.05)
    detector = AimedDetector(LANDMARKS, low, CONFIG, 0.03)
    wide = np.diag(np.square([0.3, 0.3, 0.1]))
    prior = PoseEstimate(frame.stamp_ns, HERE - np.array([0.5, 0.0, 0.0]), wide)
    for _ in range(2):
        found = detector.detect(frame, prior, np.arange(4), displaced=False)
        assert len(found.detections) >= 3
        assert detector.tilt_rad == 0.0


def test_a_knock_is_found_from_an_uncertain_pose_and_distinguished_from_a_known_one() -> None:
    """From there it would be given as 64 mrad."""
    tilt_rad = 0.08
    low = replace(MOUNT, axis_xyz=(*MOUNT.axis_xyz[:2], 0.75))
    frame = draw_frame(SCENE, LENS, low, HERE, 0.05)
    frame = replace(frame, tilt_rad=frame.tilt_rad - tilt_rad)
    detector = AimedDetector(LANDMARKS, low, CONFIG, 0.03)
    wide = np.diag(np.square([0.3, 0.3, 0.1]))
    prior = PoseEstimate(frame.stamp_ns, HERE - np.array([0.3, 0.0, 0.0]), wide)
    for _ in range(2):
        assert len(detector.detect(frame, prior, np.arange(4)).detections) >= 3
        assert detector.tilt_rad == 0.0
    prior = PoseEstimate(frame.stamp_ns, HERE, PRIOR)
    assert len(detector.detect(frame, prior, np.arange(4)).detections) == 4
    assert detector.tilt_rad == pytest.approx(tilt_rad, abs=1e-3)


def test_heights_that_are_a_centimetre_off_are_no_tilt() -> None:
    """From 1.6 m, elevations say 6 mrad."""
    pose = HERE + np.array([1.6, 0.0, 0.0])
    frame = draw_frame(SCENE, LENS, MOUNT, pose, 0.05)
    raised = np.array([0.0, 0.0, 0.01])
    higher = tuple(replace(k, position=k.position + raised) for k in LANDMARKS.landmarks)
    detector = AimedDetector(replace(LANDMARKS, landmarks=higher), MOUNT, CONFIG, 0.03)
    prior = PoseEstimate(frame.stamp_ns, pose, PRIOR)
    assert len(detector.detect(frame, prior, np.arange(4)).detections) >= 3
    assert detector.tilt_change_rad == 0.0


@pytest.mark.parametrize('hung_rad', [0.0, np.pi], ids=['stands', 'hangs'])
@pytest.mark.parametrize(('aside_rad', 'up_rad'), [(0.0, 0.04), (0.04, -0.03)])
def test_a_knock_is_reported_alike_by_a_unit_that_stands_and_by_one_that_hangs(
    hung_rad: float, aside_rad: float, up_rad: float
) -> None:
    """Its pan and tilt run the other way round; bearings stay as the joints have them."""
    mount = replace(MOUNT, axis_rpy=(hung_rad, 0.0, 0.0))
    sense = np.cos(hung_rad)
    frame = draw_frame(SCENE, LENS, mount, HERE, 0.05)
    displaced = replace(
        frame,
        pan_rad=frame.pan_rad - sense * aside_rad,
        tilt_rad=frame.tilt_rad - sense * up_rad,
    )
    detector = AimedDetector(LANDMARKS, mount, CONFIG, 0.05)
    for _ in range(3):
        found = detector.detect(displaced, PoseEstimate(0, HERE, PRIOR), np.arange(4))
        assert len(found.detections) == 4
        assert detector.tilt_change_rad == pytest.approx(up_rad, abs=1e-3)
        np.testing.assert_allclose(errors_of(found, HERE), -aside_rad, atol=3e-4)


@pytest.mark.parametrize(('fit_again', 'follows'), [(3, False), (4, True)])
def test_a_camera_is_tilted_where_most_of_what_hangs_too_high_or_low_is_found_again(
    fit_again: int, follows: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of posters that were exchanged, one or another fits some roll."""
    roll_rad = 0.03
    frame = draw_frame(SCENE, LENS, MOUNT, HERE, 0.05)
    frame = replace(frame, roll_rad=frame.roll_rad - roll_rad)
    detector = AimedDetector(LANDMARKS, MOUNT, CONFIG, 0.03)
    everywhere = detector._search(
        frame, PoseEstimate(0, HERE, PRIOR), np.arange(4), CONFIG, np.array([0.0, 0.0, roll_rad])
    )
    assert len(everywhere.detections) == 4

    off_px = 400.0 * np.array([-0.4, -0.1, 0.1, 0.4])
    by_tilt_roll = np.column_stack([np.full(4, 400.0), off_px])
    points = np.column_stack([np.arange(4.0), np.zeros((4, 2))])
    level = RowResiduals(np.zeros(4), by_tilt_roll, 0.01 * np.eye(4), points)
    tilted = level._replace(off_px=roll_rad * off_px)

    def only(count: int, *, reported: bool) -> DetectionResult:
        keep = np.arange(4) < count
        too_high = dict.fromkeys(everywhere.detections.ids[~keep], Refusal('wrong height'))
        return replace(
            everywhere,
            detections=everywhere.detections.chosen(keep),
            refused=too_high,
            rays=everywhere.rays[keep],
            blur_px2=everywhere.blur_px2[keep],
            heights=tilted if reported else level,
        )

    # As it is; with the roll that it shows; all around; with the roll of that; without.
    before, again = only(2, reported=True), only(fit_again, reported=False)
    found = iter([before, again, only(4, reported=True), again, before])
    monkeypatch.setattr(detector, '_search', lambda *_: next(found))
    detector.detect(frame, PoseEstimate(0, HERE, PRIOR), np.arange(4))
    assert detector.roll_change_rad == pytest.approx(roll_rad if follows else 0.0, abs=2e-3)


@pytest.mark.parametrize('roll_rad', [-0.035, 0.02])
def test_a_camera_that_is_tilted_is_recognized_by_the_first_image_and_by_the_first_that_is_level(
    roll_rad: float,
) -> None:
    level = draw_frame(SCENE, LENS, MOUNT, HERE, 0.05)
    tilted = draw_frame(SCENE, LENS, replace(MOUNT, camera_roll_rad=roll_rad), HERE, 0.05)
    detector = AimedDetector(LANDMARKS, MOUNT, CONFIG, 0.035)
    for frame, truth_rad in [(level, 0.0), *2 * [(tilted, roll_rad)], (level, 0.0)]:
        prior = PoseEstimate(frame.stamp_ns, HERE, PRIOR)
        found = detector.detect(frame, prior, np.arange(4))
        assert len(found.detections) == 4
        assert np.abs(errors_of(found, HERE)).max() < 3e-4
        assert detector.roll_change_rad == pytest.approx(truth_rad, abs=2e-3)
    assert detector.roll_change_rad == 0.0
