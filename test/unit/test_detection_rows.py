"""Image rows of landmarks: wrong heights and tilts are distinguished."""

from dataclasses import replace

import numpy as np
import pytest

from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.localization.detection.rows import RowModel, RowResiduals, wrong_heights
from landmark_nav.localization.relocalization.verification import estimate_camera_tilt

PLAIN = CameraModel(512, 512, 555.0, 555.0, 256.0, 256.0, distortion=(-0.1, 0.02, 0.0, 0.0))
FISHEYE = CameraModel(512, 512, 250.0, 250.0, 256.0, 256.0, 'equidistant', (0.02, -0.01, 0.0, 0.0))
MOUNT = PanTiltMount(axis_xyz=(0.1, 0.0, 1.2))
POSE, PAN, TILT = np.array([1.0, 2.0, 0.3]), 0.4, 0.1


def model_of(camera, spread, mount=MOUNT):
    """Rows of eight points about 3 m away."""
    rotation, center = mount.camera_pose_map(POSE, PAN, TILT)
    offset = np.random.default_rng(0).uniform(-spread, spread, (8, 3))
    offset[:, 2] += 3.0
    points = center + offset @ rotation.T
    return RowModel.of(points, POSE, rotation, center, camera, mount.camera_roll_rad), points


@pytest.mark.parametrize(
    ('camera', 'spread', 'mounted_rad', 'hung_rad'),
    [
        (PLAIN, 0.8, 0.0, 0.0),
        (FISHEYE, 2.0, 0.0, 0.0),
        (PLAIN, 0.8, np.pi, 0.0),
        (PLAIN, 0.8, 0.5, 0.0),
        (PLAIN, 0.8, 0.0, np.pi),
    ],
)
def test_derivatives_are_those_of_the_camera(camera, spread, mounted_rad, hung_rad):
    """Also where camera or unit are mounted upside down, or aslant."""
    mount = replace(MOUNT, camera_roll_rad=mounted_rad, axis_rpy=(hung_rad, 0.0, 0.0))
    model, points = model_of(camera, spread, mount)

    def rows(pose, tilt_rad, roll_rad, higher_m):
        turn, _ = mount.camera_pose_base(PAN, tilt_rad, roll_rad)
        _, center = mount.camera_pose_map(pose, PAN, tilt_rad)
        heading = np.eye(3)
        heading[:2, :2] = [[np.cos(pose[2]), -np.sin(pose[2])], [np.sin(pose[2]), np.cos(pose[2])]]
        rotation = heading @ turn
        raised = points + np.array([0.0, 0.0, higher_m])
        return camera.project((raised - center) @ rotation)[:, 1]

    step = 1e-5 * np.eye(6)
    by = [
        (
            rows(POSE + s[:3], TILT + s[3], s[4], s[5])
            - rows(POSE - s[:3], TILT - s[3], -s[4], -s[5])
        )
        / 2e-5
        for s in step
    ]
    np.testing.assert_allclose(model.by_pose.T, by[:3], rtol=1e-3, atol=0.05)
    np.testing.assert_allclose(model.by_tilt_roll.T, by[3:5], rtol=1e-3, atol=0.05)
    np.testing.assert_allclose(model.by_height, by[5], rtol=1e-3, atol=0.05)


POSE_SIGMA = np.array([0.01, 0.01, 0.005])


def rows_of(model, own_px, sigma=POSE_SIGMA):
    """Covariance (8, 8) of rows, of points that are where they seem to be."""
    none = np.zeros((8, 3, 3))
    return model.covariance(np.diag(sigma**2), none, none) + own_px**2 * np.eye(8)


@pytest.mark.parametrize('camera', [PLAIN, FISHEYE])
def test_right_heights_are_refused_hardly_ever_and_wrong_ones_are(camera):
    model, _ = model_of(camera, 0.8)
    covariance = rows_of(model, 0.15) + 0.002**2 * model.by_tilt_roll @ model.by_tilt_roll.T
    rng = np.random.default_rng(2)
    # Of one row, given the others: a single near point distinguishes a height from a tilt.
    own_px = 1.0 / np.sqrt(np.diag(np.linalg.inv(covariance)))
    refused = 0
    for _ in range(300):
        off = rng.multivariate_normal(np.zeros(8), covariance)
        refused += int(wrong_heights(off, covariance).sum())
        k = int(rng.integers(8))
        off[k] += 12.0 * own_px[k]
        wrong = wrong_heights(off, covariance)
        assert wrong[k]
        assert wrong.sum() <= 2
    assert refused <= 3


def test_two_heights_do_not_show_which_is_wrong():
    assert not wrong_heights(np.array([0.0, 9.0]), 0.01 * np.eye(2)).any()


@pytest.mark.parametrize('camera', [PLAIN, FISHEYE])
def test_a_tilt_is_recognised_by_all_rows_together_and_not_by_any_single_one(camera):
    model, points = model_of(camera, 0.8)
    runs, tilted = 200, np.array([0.01, -0.03])
    covariance = rows_of(model, 0.3)
    rng = np.random.default_rng(4)

    def tilt_of(off):
        return estimate_camera_tilt(RowResiduals(off, model.by_tilt_roll, covariance, points))

    squares, level, mistaken, reported = [], 0, 0, 0
    for _ in range(runs):
        off = rng.multivariate_normal(np.zeros(8), covariance)
        level += tilt_of(off).sure
        camera_tilt = tilt_of(off + model.by_tilt_roll @ tilted)
        reported += camera_tilt.sure
        squares.append(((camera_tilt.roll_rad - tilted[1]) / camera_tilt.roll_sigma_rad) ** 2)
        off[int(rng.integers(8))] += 5.0 * rng.choice([-1.0, 1.0])
        mistaken += tilt_of(off).sure
    assert reported == runs
    assert level + mistaken <= 2
    assert 0.75 < np.mean(squares) < 1.3


def test_a_poster_that_was_exchanged_is_no_tilt():
    """Two things are in view; what hangs now instead of one of them looks like it, and higher."""
    by_roll = np.array([-3.0, -1.0, 1.0, 3.0, 140.0, 150.0, 160.0, 170.0])
    exchanged = by_roll > 10.0
    by_tilt_roll = np.column_stack([np.full(8, 560.0), by_roll])
    off = np.where(exchanged, 0.012 * by_roll, 0.0)
    covariance = 1.0 + 0.15**2 * np.eye(8)
    two_things = np.where(exchanged[:, None], [0.0, 1.0, 1.5], [4.0, 1.0, 1.5])
    eight_things = np.arange(8.0)[:, None] * [1.0, 0.0, 0.0]
    assert not estimate_camera_tilt(RowResiduals(off, by_tilt_roll, covariance, two_things)).sure
    assert estimate_camera_tilt(RowResiduals(off, by_tilt_roll, covariance, eight_things)).sure


def test_a_height_that_was_measured_wrongly_is_no_tilt():
    """What is near, on one side of the image, is shifted more than what is far on the other."""
    rotation, center = MOUNT.camera_pose_map(POSE, PAN, TILT)
    aside = np.linspace(-0.35, 0.35, 8)
    reach = np.linspace(1.2, 4.0, 8)
    points = center + np.stack([reach * aside, 0.1 * reach, reach], -1) @ rotation.T
    model = RowModel.of(points, POSE, rotation, center, PLAIN, 0.0)
    own = 0.2
    covariance = rows_of(model, own, np.array([0.003, 0.003, 0.002]))
    rng = np.random.default_rng(3)

    def is_roll(off):
        tilt = estimate_camera_tilt(RowResiduals(off, model.by_tilt_roll, covariance, points))
        return tilt.is_roll

    for lower_m in (-0.01, 0.01):
        for _ in range(20):
            off = lower_m * model.by_height + own * rng.normal(size=8)
            assert not is_roll(off)
            assert is_roll(off + model.by_tilt_roll @ [0.0, 0.035])
