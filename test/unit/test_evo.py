"""Our errors are what evo, the usual tool for trajectories, says of the exported files."""

from __future__ import annotations

from pathlib import Path

from bare_landmarks import bare_landmark
import numpy as np
import pytest

from landmark_nav.calibration import Calibration
from landmark_nav.evaluation.metrics import error_summary
from landmark_nav.evaluation.replay import Replay, replay
from landmark_nav.evaluation.run_report import run_errors
from landmark_nav.evaluation.smoothed_run import write_tum_files
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.localizer import LocalizationConfig
from landmark_nav.types import Detections, LandmarkMap, OdometrySample, PoseEstimate

BEGIN_NS = 1_763_654_321_000_000_007
STEP_NS = 20_000_001
POSTS = np.array([[0.0, 4.0], [4.0, 3.0], [5.0, -1.0], [-2.0, -3.0]])


def posts() -> LandmarkMap:
    return LandmarkMap(
        tuple(
            bare_landmark(k, np.array([*place, 0.0]), 1e-6 * np.eye(3))
            for k, place in enumerate(POSTS)
        )
    )


@pytest.fixture(scope='module')
def run() -> Replay:
    """A circle with a wrong scale of the odometry and noisy bearings, 200 images."""
    rng = np.random.default_rng(0)
    events: list[Detections | OdometrySample | PoseEstimate] = []
    pose = np.array([1.0, 0.0, 3.0])
    reckoned = np.zeros(3)
    for k in range(1000):
        stamp = BEGIN_NS + k * STEP_NS
        events.append(PoseEstimate(stamp - 1_000_003, pose, np.zeros((3, 3))))
        events.append(OdometrySample(stamp, reckoned))
        if k % 5 == 0:
            bearing = se2.bearings(pose, POSTS) + rng.normal(0, 0.01, 4)
            found = wrap_rad(bearing), np.full(4, 1e-4), np.ones(4), np.zeros((4, 2))
            events.append(Detections(stamp, np.arange(4), *found))
        pose = se2.compose(pose, [0.008, 0.0, 0.006])
        reckoned = se2.compose(reckoned, [0.0084, 0.0, 0.0062])
    start = np.array([1.02, 0.01, 3.01])
    covariance = np.diag([0.05, 0.05, 0.03]) ** 2
    return replay(
        events, posts(), Calibration.exact(PanTiltMount()), LocalizationConfig(), start, covariance
    )


def test_the_files_hold_the_poses_to_the_last_bit(run: Replay, tmp_path: Path) -> None:
    paths = write_tum_files(run, tmp_path)
    names = ['truth', 'fused', 'triangulation', 'odometry']
    assert [path.name for path in paths] == [f'{name}.tum' for name in names]
    rows = np.loadtxt(paths[1])
    assert rows.shape == (200, 8)
    np.testing.assert_array_equal(rows[:, 1:3], run.fused[:, :2])
    np.testing.assert_allclose(rows[:, 0], 1e-9 * run.stamps_ns, rtol=1e-15)
    heading = 2.0 * np.arctan2(rows[:, 6], rows[:, 7])
    np.testing.assert_allclose(wrap_rad(heading - run.fused[:, 2]), 0.0, atol=1e-12)
    # The truth ends a millisecond before the last odometry, not before the last image.
    assert len(np.loadtxt(paths[0])) == 200


def test_evo_agrees(run: Replay, tmp_path: Path) -> None:
    pytest.importorskip('evo', reason="evo is not installed: pip install '.[dev]'")
    from evo.core import metrics, sync
    from evo.tools import file_interface

    write_tum_files(run, tmp_path)
    errors = run_errors(run)
    for name, ours in (('fused', errors.fused), ('odometry', errors.odometry)):
        truth, estimate = (
            file_interface.read_tum_trajectory_file(tmp_path / f'{file}.tum')
            for file in ('truth', name)
        )
        pair = sync.associate_trajectories(truth, estimate, max_diff=1e-6)
        assert pair[0].num_poses == 200
        summary = error_summary(ours)
        position = metrics.APE(metrics.PoseRelation.translation_part)
        position.process_data(pair)
        theirs = position.get_all_statistics()
        for key in ('rmse', 'median', 'max'):
            assert theirs[key] == pytest.approx(summary[f'position_{key}_m'], abs=1e-9)
        heading = metrics.APE(metrics.PoseRelation.rotation_angle_deg)
        heading.process_data(pair)
        # evo's angle comes from the trace of a rotation matrix: less digits near zero.
        rmse = heading.get_statistic(metrics.StatisticsType.rmse)
        assert rmse == pytest.approx(summary['heading_rmse_deg'], abs=1e-6)
