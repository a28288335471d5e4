"""Errors of lens, mount and odometry are recovered from what images and values show."""

from dataclasses import replace

import numpy as np
import pytest

from landmark_nav.diagnosis.camera_errors import camera_error, CameraSetup, Matches
from landmark_nav.diagnosis.odometry import check_jumps, check_path
from landmark_nav.diagnosis.streams import Stream
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.se2 import rot_z

CAMERA = CameraModel(512, 512, 555.0, 555.0, 256.0, 250.0, distortion=(-0.19, 0.06, 0.0, 0.0))
RIGHT = CameraSetup(CAMERA, PanTiltMount(axis_xyz=(0.1, 0.0, 1.1)))


@pytest.fixture(scope='module')
def matches():
    """Walls 2 to 5 m away, a robot that turns, drives and pans, noise of 0.2 pixels."""
    rng = np.random.default_rng(6)
    before, after, pairs, pans = [], [], [], []
    for pair in range(24):
        pan = rng.uniform(-1.0, 1.0) + np.array([0.0, rng.uniform(-0.3, 0.3)])
        turn, moved = rng.uniform(-0.1, 0.1), [*rng.uniform(-0.02, 0.02, 2), 0.0]
        pixels = rng.uniform(20.0, 490.0, (40, 2))
        (first, second), (center, other) = RIGHT.mount.camera_pose_base(pan)
        rays = CAMERA.unproject(pixels) @ first.T
        points = center + rays * rng.uniform(2.0, 5.0, (40, 1))
        seen = CAMERA.project(((points - moved) @ rot_z(turn) - other) @ second)
        inside = CAMERA.contains(seen)
        before.append(pixels[inside])
        after.append(seen[inside] + rng.normal(0.0, 0.2, (inside.sum(), 2)))
        pairs.append(np.full(inside.sum(), pair))
        pans.append(pan)
    joints = np.array(pans)
    return Matches(
        np.concatenate(before), np.concatenate(after), np.concatenate(pairs), joints,
        np.zeros_like(joints),
    )  # fmt: skip


def lens(**change):
    return replace(RIGHT, camera=replace(CAMERA, **change))


def mounted(**change):
    return replace(RIGHT, mount=replace(RIGHT.mount, **change))


@pytest.mark.parametrize(
    ('given', 'name', 'value'),
    [
        (mounted(axis_rpy=(0.0, 0.2, 0.0)), 'axis pitch', -0.2),
        (mounted(axis_rpy=(-0.15, 0.0, 0.0)), 'axis roll', 0.15),
        (mounted(camera_roll_rad=-0.5 * np.pi), 'roll', 0.5 * np.pi),
        (replace(RIGHT, tilt_rad=0.25), 'tilt', -0.25),
        (lens(cx=346.0), 'cx', -90.0 / 555.0),
        (lens(fx=800.0, fy=800.0), 'focal length', np.log(555.0 / 800.0)),
        (lens(fx=277.5, fy=277.5, cx=127.75, cy=124.75), 'size', np.log(2.0)),
        (lens(distortion=(0.1, 0.06, 0.0, 0.0)), 'distortion', -0.29),
    ],
)
def test_an_error_of_lens_or_mount_is_recovered(matches, given, name, value):
    found = camera_error(matches, given)
    assert found.name == name
    assert found.value == pytest.approx(value, abs=0.03)


def test_nothing_is_found_where_nothing_is_wrong(matches):
    assert camera_error(matches, RIGHT) is None


def test_joints_that_are_wrong_do_not_blame_the_camera(matches):
    wrong = replace(matches, pans_rad=-57.3 * matches.pans_rad + 0.4)
    assert camera_error(wrong, RIGHT) is None
    assert camera_error(replace(matches, tilts_rad=matches.pans_rad), RIGHT) is None


TIMES = np.arange(0.0, 20.0, 0.05)
YAW = 1.2 * np.sin(0.4 * TIMES)
SPEED = 0.4 * np.sign(np.sin(0.5 * TIMES) + 0.6)


def driven(side_rad=0.0):
    """x, y, yaw, speed and yaw rate of a drive forwards and backwards, so far beside the yaw."""
    steps = 0.05 * SPEED[:, None] * np.stack([np.cos(YAW + side_rad), np.sin(YAW + side_rad)], 1)
    return np.column_stack([np.cumsum(steps, axis=0), YAW, SPEED, np.gradient(YAW, TIMES)])


def stream_of(values):
    stamps = np.round(1e9 * TIMES).astype(np.int64)
    return Stream('odom', 'odom', stamps, stamps, values)


# Backwards, to all sides, and straight on, which does not show a mirrored path.
@pytest.mark.parametrize('side_rad', [0.0, np.pi, 3.0 * np.sin(1.7 * TIMES), np.pi / 2 - YAW])
def test_a_path_in_its_own_axes_passes(side_rad):
    assert check_path(stream_of(driven(side_rad))) is None


@pytest.mark.parametrize('side_rad', [0.5 * np.pi, -0.8])
def test_a_path_that_is_turned_is_named_and_turned_back(side_rad):
    finding, mended = check_path(stream_of(driven(side_rad)))
    assert finding.values['aside_rad'] == pytest.approx(side_rad, abs=0.01)
    assert mended == pytest.approx(driven(), abs=0.05)


@pytest.mark.parametrize(
    ('axes', 'reported'),
    [
        ([[1, 0], [0, -1]], 'y has'),
        ([[-1, 0], [0, 1]], 'x has'),
        ([[0, 1], [1, 0]], 'x and y are exchanged'),
    ],
)
def test_a_mirrored_path_is_named(axes, reported):
    values = driven()
    values[:, :2] = values[:, :2] @ np.array(axes)
    finding, mended = check_path(stream_of(values))
    assert reported in finding.measured
    assert mended == pytest.approx(driven())


def test_jumps_are_found_with_their_size_and_time():
    assert not [*check_jumps(stream_of(driven()))]
    values = driven()
    values[200:, 0] += 0.8
    (found,) = check_jumps(stream_of(values))
    assert found.values['metres'] == pytest.approx(0.8, abs=0.05)
    assert f'{TIMES[200]:.1f} s' in found.measured


def test_a_gap_or_a_robot_that_drives_off_is_no_jump():
    kept = np.r_[0:150, 250:400]
    assert not [*check_jumps(stream_of(driven()).only(kept))]
    values = driven()
    values[:300, :2] = 0.0
    values[300:, :2] -= values[300, :2]
    assert not [*check_jumps(stream_of(values))]
