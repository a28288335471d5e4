from dataclasses import replace
from itertools import combinations

from builders import detections_of, pose_error
import cv2
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from rendered_drives import camera_image, drive, FRAME_NS, LENS, MAP, MOUNT, start_of
from scenes import rectangle_room, textured_room, true_landmark

from landmark_nav.calibration import Calibration
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.patches import observed_well, relative_sampling
from landmark_nav.geometry.se2 import compose
from landmark_nav.localization.debug_image import draw_observation
from landmark_nav.localization.detection.expectation import Expectation
from landmark_nav.localization.expected_poses import ExpectedPoses, SpreadCorrection
from landmark_nav.localization.localizer import LocalizationConfig, Localizer
from landmark_nav.localization.observer import most_informative, Observation
from landmark_nav.localization.triangulation.model import bearing_gradients
from landmark_nav.localization.triplet.planning_scene import CameraState
from landmark_nav.localization.triplet.selection import ActiveCamera
from landmark_nav.localization.triplet.visibility import TripletConfig
from landmark_nav.types import LandmarkMap, OdometrySample, PoseEstimate, Refusal

EXACT = Calibration.exact(MOUNT)


@pytest.fixture(scope='module')
def fixes():
    """Fixes and truth of a drive with the camera on the best triplet after each image."""
    rng = np.random.default_rng(1)
    localizer = Localizer(MAP, EXACT, LocalizationConfig())
    camera = ActiveCamera(MAP, MOUNT, TripletConfig())
    localizer.initialize(start_of(rng))
    found, pan = [], 0.0
    for step in drive(rng, 9.0):
        assert localizer.add_odometry(step.odometry) is None
        if step.stamp_ns % FRAME_NS:
            continue
        frame = replace(camera_image(step.pose, pan, rng), stamp_ns=step.stamp_ns)
        update = localizer.add_frame(frame)
        if isinstance(update.observation.fix, PoseEstimate):
            found.append((update.observation.fix, step.pose))
        pan = camera.choose(update.fused, LENS, CameraState(pan)).chosen.pan_rad
    return found


def test_fixes_err_as_their_covariances_say(fixes):
    assert len(fixes) > 10
    errors = np.array([pose_error(fix, pose) for fix, pose in fixes])
    sigma = np.array([np.sqrt(np.diag(fix.covariance)) for fix, _ in fixes])
    assert np.abs(errors / sigma).max() < 4.5
    assert np.mean((errors / sigma) ** 2) < 2.5


def expected(u, v):
    """A template of 31 x 21 pixels, searched 12 and 8 around."""
    left, top = round(u) - 15, round(v) - 10
    return Expectation(np.array([u, v]), left, top, left + 30, top + 20, (12, 8), np.eye(3))


def observation(found, refused):
    """Landmarks found so far off where they were expected, and others refused, side by side."""
    ids = [*found, *refused]
    places = {number: expected(60.0 + 90.0 * k, 120.0) for k, number in enumerate(ids)}
    uv = np.array([places[k].uv + off for k, off in found.items()]).reshape(-1, 2)
    detections = detections_of(0, list(found), np.zeros(len(found)), uv_px=uv)
    reasons = {number: Refusal(reason) for number, reason in refused.items()}
    return Observation(detections, reasons, lambda: Refusal('too few'), expected=places)


def test_what_is_drawn_lies_where_it_was_searched():
    frame = cv2.resize(np.random.default_rng(0).integers(0, 256, (32, 32), np.uint8), (512, 512))
    seen = observation({4: (3.0, -2.0), 7: (0.0, 0.0)}, {9: 'low correlation'})
    drawn = draw_observation(frame, seen, [7])
    scale = drawn.shape[1] // frame.shape[1]
    # All that is not grey.
    rows, columns = np.nonzero((np.ptp(drawn.astype(int), axis=2) > 40)[20:])
    # Within the windows, and the words above and below.
    assert columns.min() >= scale * (45 - 12) - 1
    assert rows.min() + 20 >= scale * (110 - 8) - 20
    assert rows.max() + 20 <= scale * (130 + 8) + 20
    changed = np.any(drawn != draw_observation(frame, observation({}, {})), axis=2)
    assert changed[:, : scale * 30].sum() == changed[:16, : scale * 30].sum()


ROOM = rectangle_room(6.0, 5.0)
SCENE = textured_room(ROOM, seed=3)
VIEWPOINT = np.array([3.0, 2.5, 1.1])
LANDMARKS = LandmarkMap(
    tuple(
        true_landmark(SCENE, 4 * k + j, board, place, 0.0, VIEWPOINT, sigma_m=0.002)
        for k, board in enumerate(SCENE.boards)
        for j, place in enumerate((-1.8, -0.5, 0.6, 1.7))
    )
)
AXIS = PoseEstimate(0, np.array([2.2, 2.0, 0.4]), np.diag([0.05, 0.05, 0.02]) ** 2)
EVERY = np.arange(len(LANDMARKS.landmarks))
SIGMA = 4e-4


def information(index):
    """Log determinant of the information on the pose after bearings to some landmarks."""
    gradient = bearing_gradients(AXIS.pose, LANDMARKS.positions[index, :2])
    own = LANDMARKS.covariances[index, :2, :2]
    variance = SIGMA**2 + np.einsum('ni,nij,nj->n', gradient, own, gradient)
    rows = np.column_stack([gradient, -np.ones(len(index))])
    total = np.linalg.inv(AXIS.covariance) + (rows.T / variance) @ rows
    return float(np.linalg.slogdet(total)[1])


def test_three_are_nearly_as_good_as_the_best_three():
    chosen = most_informative(AXIS, LANDMARKS, EVERY, SIGMA, 3)
    assert len(set(chosen)) == 3
    nothing = float(np.linalg.slogdet(np.linalg.inv(AXIS.covariance))[1])
    gains = [information(np.array(three)) - nothing for three in combinations(EVERY, 3)]
    assert information(chosen) - nothing > 0.95 * max(gains)


POINT = np.array([[2.0, 0.0, 1.2]])
NORMAL = np.array([[0.0, 1.0, 0.0]])


@given(st.floats(0.0, 2.0 * np.pi), st.floats(0.1, 9.0), st.floats(-1.2, 1.2))
def test_area_is_the_annulus_between_two_tangent_circles(direction, distance, incidence):
    reference = POINT + 3.0 * np.array([[np.sin(incidence), np.cos(incidence), 0.0]])
    viewer = POINT[0] + distance * np.array([np.cos(direction), np.sin(direction), 0.0])

    def inside_tangent_circle(diameter):
        return bool(np.hypot(viewer[0] - 2.0, viewer[1] - diameter / 2.0) <= diameter / 2.0)

    expected = (
        1.5 <= distance <= 6.0
        and inside_tangent_circle(6.0 / np.cos(incidence))
        and not inside_tangent_circle(1.5 / np.cos(incidence))
    )
    # On the very border rounding decides.
    horizontal, vertical = relative_sampling(POINT, NORMAL, reference, viewer)
    values = np.array([horizontal[0], vertical[0]])
    if np.all(np.abs(values - [[0.5], [2.0]]) > 1e-6):
        assert observed_well(POINT, NORMAL, reference, viewer)[0] == expected


SPEED, RATE = 0.5, 0.8


def circle(stamp_ns):
    """Pose on the circle that constant speeds drive."""
    angle = RATE * stamp_ns * 1e-9
    radius = SPEED / RATE
    return np.array([radius * np.sin(angle), radius * (1.0 - np.cos(angle)), angle])


@pytest.fixture
def track():
    made = ExpectedPoses(0.5)
    for stamp in range(0, 1_000_000_001, 50_000_000):
        pose = circle(stamp)
        made.add(PoseEstimate(stamp, pose, np.eye(3)), OdometrySample(stamp, pose, SPEED, RATE))
    return made


@pytest.mark.parametrize('stamp', [0, 333_000_000, 500_000_000, 1_200_000_000, -300_000_000])
def test_moved_to_the_stamp_by_its_own_speeds(track, stamp):
    prior = track.at(stamp)
    assert prior.stamp_ns == stamp
    np.testing.assert_allclose(prior.pose, circle(stamp), atol=1e-9)


def test_too_far_in_time(track):
    refusal = track.at(1_600_000_000)
    assert '+0.60 s' in refusal.detail


def test_what_is_recent(track):
    newest = track.recent(1_500_000_000)
    assert newest.stamp_ns == 10**9
    assert track.recent(1_500_000_001) is None
    # The clock was set back, and nothing was fused since.
    assert track.recent(0) is None


def test_a_clock_set_back_begins_anew(track):
    def fused(stamp, x):
        pose = np.array([x, 0.0, 0.0])
        track.add(PoseEstimate(stamp, pose, np.eye(3)), OdometrySample(stamp, pose))

    fused(900_000_000, 7.0)
    assert isinstance(track.at(0), PoseEstimate), 'a little late'
    before = track._known
    fused(200_000_000, 8.0)
    assert before, 'another thread may be reading them'
    found = track.at(600_000_000)
    assert found.pose[0] == 8.0


def test_nothing_known():
    empty = ExpectedPoses(0.5)
    assert isinstance(empty.at(0), Refusal)
    assert not empty.reaches(0)


SECOND_NS = 1_000_000_000
angles = st.floats(-np.pi, np.pi)
places = st.floats(-50.0, 50.0)
poses = st.tuples(places, places, angles).map(np.array)
small = st.tuples(*3 * [st.floats(-0.3, 0.3)]).map(np.array)


@given(fused=poses, odometry=poses, correction=small)
def test_a_correction_decays_at_the_base_wherever_odom_begins(fused, odometry, correction):
    spread = SpreadCorrection(2.0)
    spread.at(0, fused, odometry)
    for k in range(1, 9):
        shown = compose(spread.at(k * SECOND_NS // 2, fused + correction, odometry), odometry)
        error = fused + correction - shown
        error[2] = wrap_rad(error[2])
        np.testing.assert_allclose(error, correction * np.exp(-0.25 * k), atol=1e-9)


def test_a_new_start_and_a_clock_set_back_are_not_spread():
    spread = SpreadCorrection(5.0)
    here, there, odometry = np.zeros(3), np.array([4.0, 2.0, 1.0]), np.array([1.0, 1.0, 0.3])
    spread.at(10 * SECOND_NS, here, odometry)
    np.testing.assert_allclose(compose(spread.at(SECOND_NS, there, odometry), odometry), there)
    spread.restart()
    shown = compose(spread.at(2 * SECOND_NS, here, odometry), odometry)
    np.testing.assert_allclose(shown, here, atol=1e-12)
