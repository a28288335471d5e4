"""The calibration of a robot: type, file, what was observed."""

import numpy as np
import pytest
import yaml

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.storage.robot_files import load_calibration, load_odometry, save_calibration
from landmark_nav.storage.setup_files import load_robot

MOUNT = PanTiltMount((0.1, 0.02, 1.2), (0.01, -0.02, 0.3), (0.03, -0.01, 0.02), 0.04, 3e-4)
ROBOT = {'pan_axis': {'xyz': [0.1, 0.02, 1.2]}}


def written(path, document):
    file = path / 'robot.yaml'
    file.write_text(yaml.safe_dump(document), encoding='utf-8')
    return file


def test_a_file_without_sigmas_stays_valid(tmp_path):
    found = load_calibration(written(tmp_path, ROBOT))
    assert found.mount.axis_xyz == (0.1, 0.02, 1.2)
    assert found['axis_x'] == (0.1, 0.02)
    assert found['axis_yaw'] == (0.0, 0.017)
    assert found['focal_scale'] == (0.0, 0.01)
    assert found['joint_delay'] == (0.0, 0.03)


@pytest.mark.parametrize(
    'odometry', [3, {'along': 0.1}, {'max_gap_s': 'x'}, {'along_m_per_sqrt_m': -1}]
)
def test_noise_that_cannot_be_is_named(tmp_path, odometry):
    path = written(tmp_path, {'pan_axis': {'xyz': [0, 0, 1]}, 'odometry': odometry})
    with pytest.raises(LandmarkNavError, match=rf'{path.name}: odometry'):
        load_odometry(path, OdometryNoiseConfig())


def test_survives_its_file(tmp_path):
    rng = np.random.default_rng(0)
    spread = np.diag(rng.uniform(1e-8, 1e-4, len(NAMES)))
    before = Calibration(
        Calibration.of_mount(MOUNT).values + 1e-3 * rng.normal(size=len(NAMES)), spread, MOUNT
    )
    save_calibration(before, tmp_path / 'robot.yaml')
    after = load_calibration(tmp_path / 'robot.yaml')
    assert after.values == pytest.approx(before.values, abs=1e-9)
    assert after.sigmas == pytest.approx(before.sigmas, abs=1e-9)
    assert after.base.pan_sigma_rad == MOUNT.pan_sigma_rad
    assert load_robot(tmp_path / 'robot.yaml').axis_xyz == pytest.approx(before.mount.axis_xyz)


@pytest.mark.parametrize(
    ('changes', 'reported'),
    [
        ({'joint_delay': 'soon'}, 'joint_delay'),
        ({'joint_delay': 25.0}, 'joint_delay'),
        ({'focal_scale': float('nan')}, 'focal_scale'),
        ({'camera_tilt': 12.0}, 'camera_tilt'),
        ({'camera_roll_sigma': -0.1}, 'camera_roll_sigma'),
        ({'joint_delay_sigma': float('inf')}, 'joint_delay_sigma'),
        ({'joint_delay_sigma': [0.1, 0.2]}, 'joint_delay_sigma'),
        ({'joint_delay_sigma': True}, 'joint_delay_sigma'),
        ({'joint_delay_sigma': None}, 'joint_delay_sigma'),
        ({'focal_scale_sigma': 20.0}, 'focal_scale_sigma'),
        ({'optical_center_offset_sigma': [0.1, 0.1]}, 'optical_center_offset_sigma'),
        ({'optical_center_offset_sigma': [0.1, [0.1], 0.1]}, 'optical_center_offset_sigma'),
        ({'pan_axis': {'xyz': [0, 0, 1], 'xyz_sigma': 20}}, 'xyz_sigma'),
        ({'pan_axis': {'xyz': [0, 0, 1], 'rpy_sigma': 'x'}}, 'rpy_sigma'),
        ({'pan_axis': {'xyz': [0, 0, 1], 'xyz_sigmas': 0.1}}, 'xyz_sigma'),
        ({'focal_scale_sigmas': 0.1}, 'focal_scale_sigma'),
    ],
)
def test_states_which_field_is_wrong(tmp_path, changes, reported):
    file = written(tmp_path, {**ROBOT, **changes})
    with pytest.raises(LandmarkNavError, match=reported) as caught:
        load_calibration(file)
    assert str(file) in str(caught.value)
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('degraded', [np.nan, np.inf])
def test_takes_numbers_only(degraded):
    good = Calibration.of_mount(MOUNT)
    with pytest.raises(LandmarkNavError):
        Calibration(np.full(len(NAMES), degraded), good.covariance, MOUNT)
    with pytest.raises(LandmarkNavError):
        Calibration(good.values, -good.covariance, MOUNT)


def test_what_errs_together_survives_its_file(tmp_path):
    rng = np.random.default_rng(1)
    root = 1e-3 * rng.normal(size=(len(NAMES), 4))
    before = Calibration(Calibration.of_mount(MOUNT).values, root @ root.T, MOUNT)
    save_calibration(before, tmp_path / 'robot.yaml')
    after = load_calibration(tmp_path / 'robot.yaml')
    assert after.covariance == pytest.approx(before.covariance, abs=1e-11)


@pytest.mark.parametrize(
    'entries',
    [
        3,
        [['axis_yaw', 'principal_point']],
        [['axis_yaw', 'axis_yaw', 0.5]],
        [['axis_yaw', 'zoom', 0.5]],
        [['axis_yaw', 'principal_point', 1.5]],
        [['axis_yaw', 'principal_point', 'much']],
        [['axis_yaw', 'principal_point', float('nan')]],
        [[['axis_yaw'], 'principal_point', 0.5]],
        [
            ['axis_yaw', 'principal_point', 1.0],
            ['axis_yaw', 'focal_scale', 1.0],
            ['principal_point', 'focal_scale', -1.0],
        ],
    ],
)
def test_correlations_that_are_none_are_refused(entries, tmp_path):
    file = written(tmp_path, {**ROBOT, 'correlations': entries})
    with pytest.raises(LandmarkNavError) as error:
        load_calibration(file)
    assert len(str(error.value).replace(str(tmp_path), '')) < 200


def test_a_measurement_is_weighed_against_what_is_known():
    prior = Calibration.of_mount(MOUNT, {'axis_yaw': 0.02})
    found = prior.measured('axis_yaw', MOUNT.axis_rpy[2] + 0.01, 0.02)
    assert found['axis_yaw'] == pytest.approx((MOUNT.axis_rpy[2] + 0.005, 0.02 / np.sqrt(2.0)))
    others = [k for k, name in enumerate(NAMES) if name != 'axis_yaw']
    np.testing.assert_array_equal(found.values[others], prior.values[others])


def test_a_sum_moves_its_parts_and_their_difference_stays_unknown():
    prior = Calibration.of_mount(MOUNT)
    row = np.isin(NAMES, ('axis_z', 'center_z')).astype(float)
    total = float(row @ prior.values) + 0.03
    found = prior.observed(row[None], np.array([total]), np.array([[1e-6]]))
    assert row @ found.values == pytest.approx(total, abs=1e-4)
    assert np.sqrt(row @ found.covariance @ row) == pytest.approx(1e-3, rel=0.01)
    assert found['axis_z'][1] > 0.01


def test_what_contradicts_the_given_sigma_counts_by_itself():
    prior = Calibration.of_mount(MOUNT, {'axis_yaw': 0.001})
    found = prior.measured('axis_yaw', MOUNT.axis_rpy[2] + 0.1, 0.002)
    assert found['axis_yaw'][0] == pytest.approx(MOUNT.axis_rpy[2] + 0.1, abs=1e-3)
    assert found['axis_yaw'][1] < 0.0021
    assert 'axis_yaw' in found.surprises(prior)


def test_what_is_exact_stays_or_is_contradicted():
    prior = Calibration.of_mount(MOUNT, {'axis_yaw': 0.0})
    near = prior.measured('axis_yaw', MOUNT.axis_rpy[2] + 0.001, 0.001)
    assert near['axis_yaw'] == (MOUNT.axis_rpy[2], 0.0)
    with pytest.raises(LandmarkNavError, match=r'axis_yaw as exact.*\+5\.7'):
        prior.measured('axis_yaw', MOUNT.axis_rpy[2] + 0.1, 0.001)
