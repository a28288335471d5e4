"""Angles, planar poses, cylinder, walls, cameras and their mount."""

from typing import Any

from builders import pose_error, walls_of
import cv2
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import unwrap_joint, wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.patches import patch_axes, rays_to_patch
from landmark_nav.geometry.se2 import rotation_rpy
from landmark_nav.geometry.walls import Room, Wall

ANGLES = st.floats(-1e3, 1e3)


@given(ANGLES)
def test_wrapped_angle_has_the_same_direction_and_lies_in_one_turn(angle):
    wrapped = wrap_rad(angle)
    assert -np.pi < wrapped <= np.pi
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angle), atol=1e-9)


def test_the_half_turn_is_positive():
    np.testing.assert_array_equal(wrap_rad([np.pi, -np.pi]), [np.pi, np.pi])


def test_a_joint_that_is_reported_within_half_a_turn_turns_on():
    stamps_ns = 50_000_000 * np.arange(400)
    true = 2.5 + np.cumsum(np.repeat([0.1, -0.08], 200))
    for way in (slice(None), slice(None, None, -1)):
        found = unwrap_joint(stamps_ns[way], wrap_rad(true)[way])
        np.testing.assert_allclose(found - found[0], true[way] - true[way][0], atol=1e-9)
        assert found[0] == wrap_rad(true)[way][0]


def test_a_joint_that_counts_its_turns_stays_as_it_is():
    pans = np.array([18.7, 18.9, 24.0, 31.0, 18.0])
    stamps_ns = np.array([0, 50_000_000, 600_000_000, 1_400_000_000, 3_000_000_000])
    np.testing.assert_array_equal(unwrap_joint(stamps_ns, pans), pans)


POSES = st.tuples(*[st.floats(-50.0, 50.0)] * 2, st.floats(-10.0, 10.0)).map(np.array)


def matrix(pose):
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[cos, -sin, pose[0]], [sin, cos, pose[1]], [0.0, 0.0, 1.0]])


def differences(function, at):
    """Central differences of poses by poses, (3, 3)."""
    step = 1e-6
    ends = ((function(at + offset), function(at - offset)) for offset in step * np.eye(3))
    return np.stack([pose_error(up, down) / (2.0 * step) for up, down in ends], -1)


@given(POSES, POSES)
def test_compose_is_the_product_of_matrices(first, second):
    for found in (se2.compose(first, second), se2.compose([first], [second])[0]):
        np.testing.assert_allclose(matrix(found), matrix(first) @ matrix(second), atol=1e-9)


@given(POSES, POSES)
def test_relative_undoes_compose(first, second):
    whole = se2.compose(first, second)
    for found in (se2.relative(first, whole), se2.relative([first], [whole])[0]):
        np.testing.assert_allclose(matrix(found), matrix(second), atol=1e-9)
    one, several = se2.inverse(first), se2.inverse([first])[0]
    np.testing.assert_allclose(matrix(one), np.linalg.inv(matrix(first)), atol=1e-9)
    np.testing.assert_allclose(matrix(several), matrix(one), atol=1e-9)


@given(POSES, POSES)
def test_jacobians_agree_with_differences(first, second):
    by_first, by_second = se2.compose_jacobians(first, second)
    numeric_first = differences(lambda pose: se2.compose(pose, second), first)
    numeric_second = differences(lambda pose: se2.compose(first, pose), second)
    np.testing.assert_allclose(by_first, numeric_first, atol=1e-6)
    np.testing.assert_allclose(by_second, numeric_second, atol=1e-6)


@given(POSES, st.lists(st.tuples(*[st.floats(-50.0, 50.0)] * 2), min_size=1, max_size=4))
def test_points_move_with_the_frame(pose, points):
    moved = se2.transform_points(pose, points)
    homogeneous = np.c_[np.array(points), np.ones(len(points))]
    np.testing.assert_allclose(moved, (homogeneous @ matrix(pose).T)[:, :2], atol=1e-9)


@given(POSES, st.lists(st.floats(-3.1, 3.1), min_size=1, max_size=4), st.floats(0.1, 50.0))
def test_bearings_are_those_at_which_points_were_put(pose, angles, away):
    ahead = away * np.column_stack([np.cos(angles), np.sin(angles)])
    found = se2.bearings(pose, se2.transform_points(pose, ahead))
    np.testing.assert_allclose(found, angles, atol=1e-9)


CYLINDER = Cylinder(width=3600, height=350, fy=573.0, cx=1799.5, cy=170.0)

COLUMNS = st.floats(-0.5, 3599.499)

ROWS = st.floats(-0.5, 349.5)


@given(COLUMNS, ROWS)
def test_every_pixel_comes_back(column, row):
    found = CYLINDER.project(CYLINDER.rays([column, row]))
    # A column within rounding of the seam may come back on its other side.
    gap = (found[0] - column + 1800.0) % 3600.0 - 1800.0
    assert abs(gap) < 1e-8
    assert found[1] == pytest.approx(row, abs=1e-8)


@given(st.floats(-20.0, 20.0))
def test_every_azimuth_comes_back(azimuth):
    column = CYLINDER.column_of(azimuth)
    assert -0.5 <= column < 3599.5
    assert abs(wrap_rad(CYLINDER.azimuth_rad(column) - azimuth)) < 1e-9


@pytest.mark.parametrize('px_per_rad', [1e4, 1e300, np.nan])
def test_a_cylinder_too_large_to_hold_is_refused(px_per_rad):
    with pytest.raises(LandmarkNavError, match='million pixels'):
        Cylinder.with_resolution(px_per_rad, -0.5, 0.5)


# An L: 6 x 4 m without its upper right 3 x 2 m.
CORNERS = [(0.0, 0.0), (6.0, 0.0), (6.0, 2.0), (3.0, 2.0), (3.0, 4.0), (0.0, 4.0)]

ROOM = Room(walls_of(CORNERS))

INSIDE = st.tuples(st.floats(0.01, 2.99), st.floats(0.01, 3.99)) | st.tuples(
    st.floats(0.01, 5.99), st.floats(0.01, 1.99)
)


@given(INSIDE, st.floats(-7.0, 7.0))
def test_a_ray_from_inside_ends_on_the_wall_that_it_names(origin, azimuth):
    distance, wall = ROOM.raycast(origin, azimuth)
    direction = np.array([np.cos(azimuth), np.sin(azimuth)])
    hit = np.array(origin) + distance * direction
    start, normal = np.array(ROOM.walls[wall].start), ROOM.normals[wall, :2]
    assert abs((hit - start) @ normal) < 1e-6
    assert ROOM.contains(origin + 0.999 * distance * direction)


def test_a_ray_that_meets_nothing_reports_it():
    distance, wall = ROOM.raycast([7.0, 1.0], 0.0)
    assert np.isinf(distance)
    assert wall == -1


def test_nearest_wall_measures_to_the_segment_not_its_line():
    # (5, 2.5) is 0.5 m above wall 2; the line of wall 1, x = 6, is 1 m away.
    assert ROOM.nearest_wall([[5.0, 2.5], [0.2, 2.0], [3.0, 0.1]]).tolist() == [2, 5, 0]


def test_a_room_shares_a_wall_with_itself_measured_again_and_none_with_another():
    again = walls_of([(1.03 * x, 0.97 * y) for x, y in CORNERS])
    assert ROOM.shares_wall(again, 0.3)
    assert ROOM.shares_wall([again[4]], 0.3)
    # Parallel walls from the same corner are not the same.
    assert not ROOM.shares_wall(walls_of([(0.0, 0.0), (5.0, 0.0), (5.0, 3.2), (0.0, 3.2)]), 0.3)
    assert not ROOM.shares_wall((), 0.3)


OUTLINE = walls_of(CORNERS)


@pytest.mark.parametrize(
    ('walls', 'message'),
    [
        (OUTLINE[:2], 'room has 2 walls: a closed outline needs 3'),
        (
            (*OUTLINE[:2], Wall('2', (6.0, 2.3), (3.0, 2.0), 2.5), *OUTLINE[3:]),
            r'open: wall 1 ends at \(6, 2\).*0\.3 m away',
        ),
        (walls_of([(0, 0), (4, 3), (4, 0), (0, 3)]), 'walls 0 and 2 cross'),
        (walls_of(CORNERS[::-1]), r'to the left.*swap start and end'),
        *(
            ((Wall('0', start, end, height), *OUTLINE[1:]), message)
            for start, end, height, message in (
                ((0.0, float('nan')), (6.0, 0.0), 2.5, 'wall 0 has a coordinate'),
                ((0.0, 0.0), (0.0, 0.0), 2.5, 'wall 0 has no length'),
                ((0.0, 0.0), (6.0, 0.0), 0.0, 'no length or no height'),
            )
        ),
    ],
)
def test_walls_that_make_no_room_are_refused(walls, message):
    with pytest.raises(LandmarkNavError, match=message):
        Room(walls)


BODY_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@given(
    azimuth=st.floats(-np.pi, np.pi),
    off=st.floats(-1.2, 1.2),
    reach=st.floats(0.4, 9.0),
    rpy=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-0.5, 0.5)),
    ray=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
)
def test_rays_meet_the_patch_where_the_plane_states(azimuth, off, reach, rpy, ray):
    normal = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    position = np.array([2.0, -3.0, 1.4])
    direction = np.array([np.cos(azimuth + off), np.sin(azimuth + off), 0.05])
    center = position + reach * direction
    facing = rotation_rpy([0.0, 0.0, azimuth + off + np.pi]) @ rotation_rpy(rpy)
    rotation = facing @ BODY_FROM_OPTICAL
    # Metres on the patch, by meeting of ray and plane.
    out = rotation @ np.array([*ray, 1.0])
    if out @ normal > -0.05:
        return  # along the wall, or away from it
    point = center + ((position - center) @ normal) / (out @ normal) * out
    right, down = patch_axes(normal)
    expected = np.array([(point - position) @ right, (point - position) @ down])

    homography = rays_to_patch(position[None], normal[None], rotation, center)[0]
    found = homography @ np.array([*ray, 1.0])
    np.testing.assert_allclose(found[:2] / found[2], expected, rtol=1e-8, atol=1e-9)
    # In front of the camera the scale is positive: what lies behind is distinguished by its sign.
    assert found[2] > 0.0


SIZE: dict[str, Any] = {
    'width': 512, 'height': 384, 'fx': 570.0, 'fy': 572.0, 'cx': 254.0, 'cy': 193.5,
}  # fmt: skip
CAMERAS = {
    'ideal': CameraModel(**SIZE),
    'plumb_bob': CameraModel(
        **SIZE, model='plumb_bob', distortion=(-0.21, 0.06, 0.001, -0.0007, 0.01)
    ),
    'rational_polynomial': CameraModel(
        **SIZE,
        model='rational_polynomial',
        distortion=(0.4, -0.1, 0.0005, 0.0002, 0.02, 0.7, -0.05, 0.01),
    ),
    'equidistant': CameraModel(
        **{**SIZE, 'fx': 230.0, 'fy': 231.0},
        model='equidistant',
        distortion=(-0.02, 0.005, -0.003, 0.0004),
    ),
}


@pytest.mark.parametrize('camera', CAMERAS.values(), ids=CAMERAS.keys())
@settings(max_examples=30)
@given(st.floats(-0.5, 511.5), st.floats(-0.5, 383.5))
def test_every_pixel_of_a_camera_comes_back(camera, u, v):
    ray = camera.unproject([u, v])
    assert ray[2] == 1.0
    np.testing.assert_allclose(camera.project(7.0 * ray), [u, v], atol=1e-6)


@pytest.mark.parametrize('camera', CAMERAS.values(), ids=CAMERAS.keys())
def test_what_is_behind_or_folds_back_has_no_pixel(camera):
    pixels = camera.project([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [30.0, 0.0, 1.0]])
    assert np.isnan(pixels).all()


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'model': 'fov'}, "'fov' is not supported: publish camera_info as one of equidistant"),
        ({'distortion': (0.1,) * 13}, 'takes 12 distortion coefficients at most'),
        ({'fx': 0.0}, 'not a calibrated camera'),
        ({'cx': float('nan')}, 'not a calibrated camera'),
        ({'distortion': (0.1, float('nan'))}, 'd not a number'),
        ({'width': 0}, '0 x 384 image'),
        ({'distortion': (-1.5,)}, 'folds back'),
        ({'distortion': (0, 0, 0, 3)}, 'folds back'),
        ({'distortion': (0, 0, 1e308, 0)}, 'folds back'),
        ({'distortion': (0,) * 8 + (30.0, 0, 0, 0)}, 'folds back'),
        ({'fx': 1.0, 'fy': 1.0}, 'deg wide'),
        ({'fx': 57000.0, 'fy': 57000.0}, 'to one side'),
        ({'cx': 1e6}, 'outside of the image'),
        ({'cy': -1e6}, 'outside of the image'),
        ({'distortion': (1e300, 0, 0, 0, 0, -1e300)}, 'folds back'),
    ],
)
def test_what_is_no_camera_is_refused(change, message):
    with pytest.raises(LandmarkNavError, match=message):
        CameraModel(**{**SIZE, **change})


def test_a_lens_that_folds_back_in_the_corners_is_used_inside_of_that():
    camera = CameraModel(**SIZE, distortion=(-0.7,))
    assert 'folds back' in camera.restriction
    rng = np.random.default_rng(0)
    pixels = rng.uniform(-0.5, [511.5, 383.5], (2000, 2))
    rays = camera.unproject(pixels)
    assert np.isfinite(rays).all()
    assert np.isfinite(camera.ray_grid).all()
    back = camera.project(rays * [0.999, 0.999, 1.0])
    inside = np.linalg.norm((pixels - [254.0, 193.5]) / [570.0, 572.0], axis=1) < 0.44
    assert 0.7 < inside.mean() < 1.0
    np.testing.assert_allclose(camera.project(rays[inside]), pixels[inside], atol=1e-6)
    # No ray comes back to a pixel beyond the fold.
    assert np.linalg.norm(np.nan_to_num(back) - [254.0, 193.5], axis=1).max() < 0.51 * 570.0


def test_the_same_numbers_of_another_model_are_another_lens():
    straight, fisheye = (CameraModel(**SIZE, model=k) for k in ('plumb_bob', 'equidistant'))
    bent = CameraModel(**SIZE, distortion=(float(fisheye.intrinsics[-1]),))
    near = [[SIZE['cx'] + 0.1 * SIZE['fx'], SIZE['cy']]]
    assert fisheye.intrinsics != pytest.approx(straight.intrinsics)
    assert bent.unproject(near) == pytest.approx(fisheye.unproject(near), abs=1e-5)


@pytest.mark.parametrize('distortion', [(0.9,), (3.0,), (-0.3, 0.1, 0.02, -0.02), (0.0,) * 5])
@pytest.mark.parametrize('prism', [(), (0.0, 0.0, 0.0, 0.01, 0.002, -0.02, 0.003)])
def test_strong_lenses_and_thin_prisms_invert(distortion, prism):
    lens = (*distortion, *[0.0] * (5 - len(distortion)), *prism)
    camera = CameraModel(**SIZE, distortion=lens)
    pixels = np.random.default_rng(1).uniform(-0.5, [511.5, 383.5], (500, 2))
    rays = camera.unproject(pixels)
    np.testing.assert_allclose(camera.project(rays), pixels, atol=1e-6)
    expected, _ = cv2.projectPoints(
        rays, np.zeros(3), np.zeros(3), camera.matrix, camera.coefficients
    )
    np.testing.assert_allclose(expected[:, 0], pixels, atol=1e-6)


@pytest.mark.parametrize('size', [(256, 192), (171, 128), (1024, 768)])
def test_a_resized_camera_sees_the_same_rays(size):
    camera = CAMERAS['plumb_bob']
    resized = camera.resized(*size)
    points = camera.unproject(np.random.default_rng(2).uniform(0.0, [511.0, 383.0], (50, 2)))
    np.testing.assert_allclose(
        resized.in_full_image(resized.project(points)), camera.project(points), atol=1e-6
    )


def test_at_zero_the_camera_looks_ahead_pan_is_to_the_left_and_tilt_upwards():
    mount = PanTiltMount(axis_xyz=(0.1, 0.2, 1.1))
    rotation, center = mount.camera_pose_base(0.0)
    # Image right, image down, forward.
    np.testing.assert_allclose(rotation, BODY_FROM_OPTICAL, atol=1e-15)
    np.testing.assert_allclose(center, [0.1, 0.2, 1.1])
    (left, _), (up, _) = mount.camera_pose_base(np.pi / 2), mount.camera_pose_base(0.0, np.pi / 6)
    np.testing.assert_allclose(left[:, 2], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(up[:, 2], [np.cos(np.pi / 6), 0, 0.5], atol=1e-15)


@pytest.mark.parametrize('roll_rad', [0.0, np.pi])
@pytest.mark.parametrize('pitch_rad', [0.0, np.pi, 0.02])
@given(yaw_rad=st.floats(-3.0, 3.0), pan_rad=st.floats(-3.0, 3.0))
def test_a_pan_looks_at_its_azimuth_however_the_unit_is_mounted(
    roll_rad, pitch_rad, yaw_rad, pan_rad
):
    mount = PanTiltMount(axis_rpy=(roll_rad, pitch_rad, yaw_rad))
    x, y, _ = mount.camera_pose_base(pan_rad)[0][:, 2]
    azimuth = mount.azimuth_base_rad(pan_rad)
    assert abs(wrap_rad(np.arctan2(y, x) - azimuth)) < 1e-3
    assert mount.pan_toward_rad(azimuth) == pytest.approx(pan_rad, abs=1e-9)
