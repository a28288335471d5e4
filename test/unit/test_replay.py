from dataclasses import replace

from builders import bare_landmark
import numpy as np
import pytest

from landmark_nav.calibration import Calibration
from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.metrics import error_summary
from landmark_nav.evaluation.replay import replay, shifts_by_odometry, UnknownPlaceError
from landmark_nav.evaluation.run_report import run_report, smooth_run, write_tum_files
from landmark_nav.geometry import se2
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.localization.localizer import LocalizationConfig
from landmark_nav.types import CameraFrame, JointSample, LandmarkMap, OdometrySample, PoseEstimate

SECOND = 1_000_000_000
START = 1_763_654_321_000_000_007
MOUNT = PanTiltMount(axis_xyz=(0.1, 0.0, 1.0))
CAMERA = CameraModel(160, 120, 150.0, 150.0, 79.5, 59.5)
CONFIG = LocalizationConfig()
ROBOT = Calibration.of_mount(MOUNT)
BEGIN = (1.0, 0.5, 0.2)
PRIOR = np.diag([0.05**2, 0.05**2, 0.03**2])


def a_map():
    rng = np.random.default_rng(0)
    return LandmarkMap(
        tuple(
            bare_landmark(
                k, np.array([4.0, 0.5 * k, 1.0]), 1e-6 * np.eye(3),
                shared_loading=np.full((3, 1), 1e-4), normal=np.array([-1.0, 0.0, 0.0]),
                patch=rng.integers(0, 256, (40, 40)).astype(np.uint8),
                viewpoint=np.array([2.0, 0.5, 1.0]),
            )
            for k in range(4)
        )
    )  # fmt: skip


def drive(seconds=3, truth=True, scale=1.05):
    """A straight drive past an empty wall; the odometry has its own origin and a wrong scale."""
    begin = np.array(BEGIN)
    origin = np.array([-3.0, 7.0, 2.0])
    for k in range(seconds * 20 + 1):
        stamp = START + k * SECOND // 20
        way = 0.02 * k
        yield JointSample(stamp, 0.0)
        odometry = se2.compose(origin, [scale * way, 0.0, 0.0])
        yield OdometrySample(stamp, odometry, 0.4 * scale, 0.0)
        if truth:
            pose = se2.compose(begin, [way, 0.0, 0.0])
            yield PoseEstimate(stamp, pose, np.zeros((3, 3)))
        if k % 4 == 0:
            yield CameraFrame(stamp, np.full((120, 160), 128, np.uint8), CAMERA, 0.0)


def run(events, pose=BEGIN):
    start = None if pose is None else np.array(pose)
    return replay(events, a_map(), ROBOT, CONFIG, start, PRIOR)


def test_report_has_the_keys_of_the_contract_and_is_the_same_run_after_run():
    reports = []
    for _ in range(2):
        done = run(drive())
        reports.append(run_report(done, a_map(), ROBOT, CONFIG))
    first, second = reports
    assert first['result_hash'] == second['result_hash']
    assert set(first) >= {
        *('schema', 'frames', 'fixes', 'availability', 'landmarks', 'fused', 'triangulation'),
        *('odometry', 'nees', 'crlb_ratio', 'update_ms', 'realtime_factor', 'result_hash'),
    }
    assert first['found'] is None
    assert (first['frames'], first['fixes'], first['landmarks']) == (16, 0, 4)
    assert 0.0 <= first['availability'] <= 1.0
    assert first['crlb_ratio'] > 0.0
    assert first['triangulation']['position_rmse_m'] is None


@pytest.mark.parametrize(
    ('event_of', 'pose', 'words'),
    [
        (lambda e: e if not isinstance(e, CameraFrame) else None, BEGIN, 'no image or no odom'),
        (lambda e: e if not isinstance(e, OdometrySample) else None, BEGIN, 'no image or no odom'),
        (lambda e: replace(e, stamp_ns=0), BEGIN, '16 images are of one moment'),
        (lambda e: e, None, r'not found in 16 images .*is the map'),
    ],
)
def test_drives_that_cannot_be_evaluated_are_refused(event_of, pose, words):
    with pytest.raises(LandmarkNavError, match=words):
        run(filter(None, map(event_of, drive())), pose)


def test_images_of_a_lower_resolution_than_the_map_are_named():
    def drive_with(focal_px):
        camera = CameraModel(160, 120, focal_px, focal_px, 79.5, 59.5)
        for event in drive():
            yield replace(event, camera=camera) if isinstance(event, CameraFrame) else event

    learned = a_map()
    for share, is_said in ((1.1, False), (0.4, True)):
        with pytest.raises(UnknownPlaceError) as refused:
            replay(drive_with(share * learned.focal_px), learned, ROBOT, CONFIG)
        assert ('pixels per degree' in str(refused.value)) == is_said


def test_truth_is_never_given_to_the_localizer():
    shifted = [
        replace(event, pose=event.pose + 5.0) if isinstance(event, PoseEstimate) else event
        for event in drive()
    ]
    np.testing.assert_array_equal(run(shifted).fused, run(drive()).fused)


@pytest.mark.parametrize('first', [PoseEstimate, CameraFrame, OdometrySample])
def test_a_clock_that_was_set_back_is_no_error_of_the_pose(first):
    """It was set back where the three come together; any of them may come first."""
    back = 2 * SECOND
    events = sorted(drive(6), key=lambda event: (event.stamp_ns, not isinstance(event, first)))
    late = [
        replace(event, stamp_ns=event.stamp_ns - back * (event.stamp_ns >= START + 4 * SECOND))
        for event in events
    ]
    good, done = run(events), run(late)
    assert np.all(np.diff(done.stamps_ns) > 0)
    truth, odometry = (run.errors.odometry for run in (good, done))
    np.testing.assert_allclose(odometry, truth, atol=1e-6)
    np.testing.assert_allclose(done.errors.fused[-5:], good.errors.fused[-5:], atol=0.15)


def test_stamps_that_go_back_alone_or_a_little_stay():
    truth = np.array([10, 20, 15, 30, 40]) * SECOND // 100
    assert not shifts_by_odometry([5, 900, 7], [-1, 2, 4], truth).any()
    assert shifts_by_odometry([5, 7], [-1, -1], []).tolist() == [0, 0]


def test_an_image_that_came_late_is_smoothed_in_its_time():
    events = list(drive(3))
    frames = [k for k, event in enumerate(events) if isinstance(event, CameraFrame)]
    events.insert(frames[5] + 1, events.pop(frames[4]))
    done = run(events)
    assert np.any(np.diff(done.stamps_ns) < 0)
    smoothed = smooth_run(done, a_map(), ROBOT, CONFIG)
    assert np.all(np.diff(smoothed.stamps_ns) > 0)
    assert len(smoothed.stamps_ns) == len(frames)


@pytest.fixture(scope='module')
def beside():
    """A drive from a start that is a little off, to be compared by other tools."""
    return run(drive(), pose=(1.02, 0.51, 0.23))


def test_evo_agrees(beside, tmp_path):
    """The usual tool for trajectories finds the same errors in the exported files."""
    pytest.importorskip('evo', reason="evo is not installed: pip install '.[dev]'")
    from evo.core import metrics, sync
    from evo.tools import file_interface

    write_tum_files(beside, tmp_path)
    errors = beside.errors
    for name, ours in (('fused', errors.fused), ('odometry', errors.odometry)):
        truth, estimate = (
            file_interface.read_tum_trajectory_file(tmp_path / f'{file}.tum')
            for file in ('truth', name)
        )
        pair = sync.associate_trajectories(truth, estimate, max_diff=1e-6)
        assert pair[0].num_poses == 16
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
        for name, measure in (('position_p95_m', position), ('heading_p95_deg', heading)):
            expected = np.percentile(measure.error, 95.0)
            assert summary[name] == pytest.approx(expected, abs=1e-6)
