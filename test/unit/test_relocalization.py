"""Global localization: found, refused, or not unique."""

from dataclasses import replace

from builders import nees, pose_error
import cv2
import numpy as np
import pytest
from scenes import draw_frame, rectangle_room, Scene, textured_room, true_landmark

from landmark_nav.calibration import Calibration
from landmark_nav.geometry import se2
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.localization.localizer import LocalizationConfig, LocalizationUpdate, Localizer
from landmark_nav.localization.relocalization.candidate_detections import find_candidate_detections
from landmark_nav.localization.relocalization.search import RelocalizationConfig
from landmark_nav.localization.relocalization.stream import Relocalizer
from landmark_nav.types import CameraFrame, LandmarkMap, OdometrySample, PoseEstimate, Refusal

LENS = CameraModel(
    400, 300, 330.0, 330.0, 200.0, 150.0, distortion=(-0.15, 0.05, 0.001, -0.001, 0.0)
)
MOUNT = PanTiltMount(axis_xyz=(0.12, 0.02, 1.15), optical_center_offset=(0.03, 0.01, 0.02))
ROOM = rectangle_room(5.0, 4.0)
SCENE = textured_room(ROOM, seed=7, feature_m=0.045)
ALONG = ((-0.33, 0.3), (-0.2, -0.3), (-0.05, 0.35), (0.1, -0.2), (0.22, 0.25), (0.34, -0.35))
PANS = np.radians(np.arange(-180, 180, 40))


def learned(scene):
    """Six landmarks a wall, at different heights."""
    landmarks = [
        true_landmark(
            scene, 10 * k + j, board, across * board.width_m, up, np.array([2.5, 2.0, 1.17])
        )
        for k, board in enumerate(scene.boards)
        for j, (across, up) in enumerate(ALONG)
    ]
    return LandmarkMap(tuple(landmarks), walls=ROOM.walls)


MAP = learned(SCENE)


def sweep(scene, pose, pans=PANS, tilt_rad=0.0):
    rng = np.random.default_rng(3)
    return [
        draw_frame(
            scene, LENS, MOUNT, np.array(pose), float(p), tilt_rad, stamp_ns=k * 10**8, rng=rng
        )
        for k, p in enumerate(pans)
    ]


def assert_right(found, pose):
    assert isinstance(found, PoseEstimate), str(found)
    error = pose_error(found, pose)
    assert np.hypot(*error[:2]) < 0.02
    assert abs(error[2]) < np.radians(0.4)
    assert nees(error, found.covariance) < 21.0  # 3 dof: one in 10 000


def assert_refused(found, reason, *words):
    assert found.reason == reason
    assert all(word in found.detail for word in words)


def located_at_rest(frames, landmark_map=MAP, **limits):
    return driven(frames, np.zeros((len(frames), 3)), landmark_map, **limits)


def driven(frames, poses_odom, landmark_map=MAP, **limits):
    """The first place that is found, or why there is none after all images."""
    relocalizer = Relocalizer(landmark_map, MOUNT, RelocalizationConfig(**limits))
    for k, (frame, pose) in enumerate(zip(frames, poses_odom, strict=True)):
        relocalizer.add_odometry(OdometrySample(10**8 * k, pose))
        outcome = relocalizer.add_frame(replace(frame, stamp_ns=10**8 * k))
        if isinstance(outcome, PoseEstimate):
            break
    return outcome


@pytest.mark.parametrize('pose', [(2.4, 1.9, 0.4), (1.5, 2.6, 3.1), (3.6, 1.4, -1.9)])
def test_one_sweep_gives_the_place(pose):
    assert_right(located_at_rest(sweep(SCENE, pose)), pose)


def test_other_light_and_images_exchanged_do_no_harm():
    pose = (2.2, 2.3, -2.5)
    other = textured_room(ROOM, seed=8, feature_m=0.045)
    # A whole wall looks different now.
    changed = Scene((*SCENE.boards[:2], other.boards[2], *SCENE.boards[3:]))
    frames = [
        replace(frame, image=np.asarray(0.5 * frame.image + 20.0, dtype=np.uint8))
        for frame in sweep(changed, pose)
    ]
    assert_right(located_at_rest(frames), pose)


def test_views_from_different_places_are_joined_by_odometry():
    poses = np.array([[1.8, 1.5, 0.2], [2.0, 1.6, 0.5], [2.3, 1.8, 0.9], [2.4, 2.1, 1.3]])
    frames = [
        draw_frame(SCENE, LENS, MOUNT, pose, pan, stamp_ns=k)
        for k, (pose, pan) in enumerate(zip(poses, (-1.5, 0.3, 1.8, 2.6), strict=True))
    ]
    found = driven(frames, se2.relative(poses[0], poses))
    assert_right(found, poses[found.stamp_ns // 10**8].tolist())
    assert found.stamp_ns


def test_a_room_that_looks_the_same_turned_by_half_is_not_unique():
    south, east = SCENE.boards[:2]
    twins = [
        replace(b, center=np.array([5.0, 4.0, 0.0]) + [-1, -1, 1] * b.center, normal=-b.normal)
        for b in (south, east)
    ]
    symmetric = Scene((south, east, *twins))
    found = located_at_rest(sweep(symmetric, (1.9, 1.5, 0.7)), learned(symmetric))
    # Both places are reported.
    assert_refused(found, 'not unique', '(1.90, 1.50)', '(3.10, 2.50)')

    # Nor is it where the map has more landmarks of one end than of the other.
    known = learned(symmetric)
    south_east = [k for k in known.landmarks if k.normal[1] > 0.9 or k.normal[0] < -0.9]
    few = {k.id for k in south_east[::2]}
    sparse = replace(
        known, landmarks=tuple(k for k in known.landmarks if k not in south_east or k.id in few)
    )
    assert_refused(located_at_rest(sweep(symmetric, (1.9, 1.5, 0.7)), sparse), 'not unique')

    # A wall that is different decides.
    north = SCENE.boards[2]
    decided = Scene((south, east, north, twins[1]))
    assert_right(
        located_at_rest(sweep(decided, (1.9, 1.5, 0.7)), learned(decided)), (1.9, 1.5, 0.7)
    )


def test_another_room_is_not_recognised_though_a_known_wall_is_in_it():
    other = textured_room(ROOM, seed=11, feature_m=0.045)
    stolen = Scene((SCENE.boards[0], *other.boards[1:]))
    # It comes into view last.
    found = located_at_rest(sweep(stolen, (2.4, 1.9, 0.4), np.roll(PANS, -4)))
    assert_refused(found, 'nothing recognised', 'of')


def test_a_hand_in_front_of_the_lens_shows_nothing_and_what_comes_after_it_is_searched():
    pose, rng = (2.4, 1.9, 0.4), np.random.default_rng(5)
    hand = cv2.GaussianBlur(rng.normal(80.0, 10.0, (LENS.height, LENS.width)), (0, 0), 9.0)
    frames = sweep(SCENE, pose)
    covered = [replace(frame, image=hand.astype(np.uint8)) for frame in frames]
    assert not len(find_candidate_detections(covered[0], MAP, MOUNT))
    assert_refused(located_at_rest(covered), 'nothing recognised')
    assert_right(located_at_rest([*covered, *frames]), pose)


def test_darkness_and_maps_without_landmarks_or_texture_are_refusals():
    dark = CameraFrame(0, np.zeros((LENS.height, LENS.width), np.uint8), LENS, 0.0)
    for landmark_map in (MAP, LandmarkMap(())):
        assert_refused(located_at_rest([dark], landmark_map), 'nothing recognised')
    blank = [replace(k, patch=np.full_like(k.patch, 90), views=()) for k in MAP.landmarks]
    (frame,) = sweep(SCENE, (2.4, 1.9, 0.4), PANS[:1])
    assert not len(find_candidate_detections(frame, LandmarkMap(tuple(blank)), MOUNT))


@pytest.mark.parametrize(
    ('limit', 'words'),
    [({}, 'look around'), ({'max_sigma_m': 1e-6}, 'sigma'), ({'max_sigma_rad': 1e-7}, 'sigma')],
)
def test_views_that_determine_the_pose_badly_are_refused(limit, words):
    """Or all around is looked for more; six landmarks within 0.6 rad show it hardly."""
    pose = (2.4, 1.9, 0.4) if limit else (4.6, 2.0, np.pi)
    frames = sweep(SCENE, pose, PANS[::3] if limit else np.zeros(1))
    found = located_at_rest(frames, **({'max_sigma_m': 9.0, 'max_sigma_rad': 3.0} | limit))
    assert_refused(found, 'too little seen', words)


@pytest.mark.parametrize(('max_sigma_m', 'found'), [(0.02, True), (0.012, False)])
def test_no_single_landmark_decides(max_sigma_m, found):
    """Five on one wall leave the place open by 29 mm; with one of another it is 5 mm."""
    pose, lone = (1.2, 2.0, 0.4), 30
    few = tuple(k for k in MAP.landmarks if k.id in (10, 11, 12, 13, 14, lone))
    known = replace(MAP, landmarks=few)
    outcome = located_at_rest(sweep(SCENE, pose), known, max_sigma_m=max_sigma_m)
    if found:
        assert_right(outcome, pose)
    else:
        assert_refused(outcome, 'too little seen', f'landmark {lone} decides')


OTHER = textured_room(ROOM, seed=23, feature_m=0.045)

POSE = (2.4, 1.9, 0.4)


def reported(frames):
    """What the state says with each image of a robot that turns its camera, and places found."""
    localizer = Localizer(MAP, Calibration.exact(MOUNT), LocalizationConfig())
    statuses, places = [], 0
    for k, frame in enumerate(frames):
        for tick in range(4):
            stamp_ns = 200_000_000 * k + 50_000_000 * tick
            localizer.add_odometry(OdometrySample(stamp_ns, np.zeros(3)))
        frame = replace(frame, stamp_ns=200_000_000 * k)
        update = localizer.add_frame(frame)
        found = update.search if isinstance(update, LocalizationUpdate) else update
        places += isinstance(found, PoseEstimate)
        statuses.append(localizer.status()[0])
    return statuses, places


@pytest.mark.xfail(
    strict=True, reason='tracking in 5 of 18 images, where the camera looks at the shared wall'
)
def test_one_known_wall_in_a_foreign_room_is_not_the_room():
    boards = (SCENE.boards[0], *OTHER.boards[1:])
    pans = np.radians(np.arange(-180, 360, 30))
    statuses, places = reported(sweep(replace(OTHER, boards=boards), POSE, pans))
    assert places
    assert 'OK' not in statuses


def test_a_place_found_while_the_camera_turns_has_an_uncertain_heading():
    """Joint states that are late make all images agree on a wrong one."""
    relocalizer = Relocalizer(MAP, MOUNT)
    pose = np.array([2.4, 1.9, 0.4])
    relocalizer.add_odometry(OdometrySample(0, np.zeros(3)))
    relocalizer.add_odometry(OdometrySample(10**9, np.zeros(3)))
    rate, outcome = 1.5, Refusal('nothing seen yet')
    for k, frame in enumerate(sweep(SCENE, pose.tolist())):
        # It rested at first.
        outcome = relocalizer.add_frame(replace(frame, pan_rate_rad_s=rate if k else 0.0))
        if isinstance(outcome, PoseEstimate):
            break
    assert_right(outcome, pose.tolist())
    sigma = np.sqrt(np.diag(outcome.covariance))
    assert sigma[2] == pytest.approx(0.1 * rate, rel=0.01)
    assert sigma[0] < 0.03


def test_a_frozen_camera_shows_nothing_new_at_any_pan():
    relocalizer = Relocalizer(MAP, MOUNT)
    frame, turned = sweep(SCENE, (2.4, 1.9, 0.4), PANS[:2])
    for k in range(2):
        relocalizer.add_odometry(OdometrySample(k * 10**8, np.zeros(3)))
    first = relocalizer.add_frame(frame)
    assert relocalizer.add_frame(replace(turned, image=frame.image)) is first
    assert relocalizer.add_frame(turned) is not first
