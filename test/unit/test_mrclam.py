from dataclasses import replace
import gzip
from itertools import combinations
import json
import re

from builders import bare_landmark
import numpy as np
import pytest

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.cli.main import main
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.estimator.config import EstimatorConfig
from landmark_nav.localization.estimator.factors import ImagePoints
from landmark_nav.localization.estimator.filter import JointFilter
from landmark_nav.localization.estimator.smoothing import smoothed_poses
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig, twist_motion
from landmark_nav.localization.odometry.track import OdometryTrack
from landmark_nav.localization.triangulation.model import triangulate_three
from landmark_nav.storage.mrclam import read_mrclam
from landmark_nav.types import LandmarkMap, OdometrySample, PoseEstimate

SIGMA = np.radians(0.5)

FILES = {
    'Barcodes': '# Subject #    Barcode #\n  1 \t   5 \n  2 \t  14 \n  6 \t  63 \n  7 \t  81 \n',
    'Landmark_Groundtruth': (
        '# Subject # x y sx sy\n 6 \t 1.5 \t -4.25 \t 0.001 \t 0.002\n 7 \t 0.5 \t 2.0 \t 0 \t 0\n'
    ),
    'Robot2_Groundtruth': '# t x y o\n1248444175.103 1.0 \t 2.0 \t 0.5\n1248444176.1 1.1 2 0.6\n',
    'Robot2_Odometry': (
        '# t v w\n1248444175.156 0.086 -0.398\n1248444175.186 0.1 0\n1248444175.186 0.2 0\n'
    ),
    # Robot 1, two landmarks in one image, a barcode nobody has, a landmark later on.
    'Robot2_Measurement': (
        '# t subject range bearing\n1248444175.200 5 3.0 0.1\n1248444175.200 63 3.0 0.2\n'
        '1248444175.200 81 3.0 -0.3\n1248444175.300 99 3.0 0.4\n1248444175.900 63 3.0 0.5\n'
    ),
}


@pytest.fixture
def folder(tmp_path):
    for name, text in FILES.items():
        (tmp_path / f'{name}.dat').write_text(text)
    return tmp_path


@pytest.mark.parametrize('packed', [False, True])
def test_a_log_is_read_plain_and_packed(folder, packed):
    if packed:
        for name, text in FILES.items():
            (folder / f'{name}.dat').unlink()
            (folder / f'{name}.dat.gz').write_bytes(gzip.compress(text.encode()))
    log = read_mrclam(folder, 2, SIGMA, landmark_sigma_m=0.01)
    # Barcodes become subjects and images.
    assert log.landmark_map.ids.tolist() == [6, 7]
    assert [seen.ids.tolist() for seen in log.detections] == [[6, 7], [6]]
    assert [seen.stamp_ns for seen in log.detections] == [1248444175200000000, 1248444175900000000]
    np.testing.assert_array_equal(log.detections[0].bearing_rad, [0.2, -0.3])
    np.testing.assert_allclose(log.detections[0].variance_rad2, SIGMA**2)
    assert log.unknown == 1
    # Commands keep to increasing stamps.
    assert log.command_ns.tolist() == [1248444175156000000, 1248444175186000000]
    np.testing.assert_array_equal(log.commands, [[0.086, -0.398], [0.1, 0.0]])
    assert log.truth[1].stamp_ns == 1248444176100000000
    np.testing.assert_array_equal(log.truth[0].pose, [1.0, 2.0, 0.5])
    # The errors of the survey and of what repeats add up.
    posts = log.landmark_map
    np.testing.assert_allclose(np.diag(posts.covariances[0]), [1.01e-4, 1.04e-4, 0.0])
    assert not posts.landmarks[0].patch.size


def test_bad_files_are_named(folder):
    with pytest.raises(LandmarkNavError, match='no folder there'):
        read_mrclam(folder / 'nothing', 2, SIGMA)
    for name, content, complaint in (
        ('Robot2_Measurement.dat', b'1248444175.2 5 3.0 0.1\n', 'no landmark was seen'),
        ('Barcodes.dat', b'1 2 3\n', 'is 3 columns wide, not 2'),
        ('Barcodes.dat', None, 'Barcodes.dat: not there'),
    ):
        (folder / name).write_bytes(content) if content else (folder / name).unlink()
        with pytest.raises(LandmarkNavError, match=complaint):
            read_mrclam(folder, 2, SIGMA)


BEGIN_S = 1_248_444_187.0
STEP_S = 0.05
DELAY_STEPS = 4
POSTS = np.array(
    [[2.0, 0.3], [0.4, 2.1], [-2.0, 0.2], [0.1, -2.2], [2.5, 2.5], [-2.5, 2.4], [3, -2.0]]
)
CODES = [63, 81, 7, 70, 45, 27, 18]

EXACT = """
pan_axis: {xyz: [0, 0, 0], xyz_sigma: 0.0001, rpy_sigma: 0.0001}
optical_center_offset_sigma: 0.0001
camera_roll_sigma: 0.0001
focal_scale_sigma: 0.0001
joint_delay_sigma: 0.0001
pan_sigma: 0.003
odometry: {slip_m_per_rad: 0.005}
"""


@pytest.fixture(scope='module')
def log(tmp_path_factory):
    """Two minutes of a robot that wanders and does 5 % less than commanded, 0.2 s later."""
    folder = tmp_path_factory.mktemp('mrclam')
    rng = np.random.default_rng(1)
    turns = np.repeat(rng.uniform(-0.4, 0.5, 60), 40)
    count = len(turns)
    truth = [np.array([0.5, -0.4, 0.3])]
    for k in range(count - 1):
        turn = turns[k - DELAY_STEPS] if k >= DELAY_STEPS else 0.0
        truth.append(se2.compose(truth[-1], twist_motion(0.08, turn, STEP_S)))
    times = BEGIN_S + STEP_S * np.arange(count)
    seen = []
    for time, pose in zip(times[2::5], truth[2::5], strict=True):
        bearing = se2.bearings(pose, POSTS)
        bearing += rng.normal(0.0, 0.008, len(POSTS))
        for k in np.flatnonzero(np.abs(bearing) < 0.8):
            # One reading in fifty is mistaken for another post.
            code = CODES[k] if rng.random() > 0.02 else CODES[(k + 2) % len(CODES)]
            seen.append(f'{time:.3f} \t {code} \t 1.0 \t {bearing[k]:.3f}')
        seen.append(f'{time:.3f} \t 14 \t 1.0 \t 0.1')  # robot 2
    texts = {
        'Barcodes': [f'{k + 1} {c}' for k, c in enumerate([5, 14, 41, 32, 23, *CODES])],
        'Landmark_Groundtruth': [
            f'{k + 6} {x} {y} 0.0001 0.0001' for k, (x, y) in enumerate(POSTS)
        ],
        'Robot1_Groundtruth': [
            f'{t - 0.01:.3f} {x:.6f} {y:.6f} {h:.6f}'
            for t, (x, y, h) in zip(times, truth, strict=True)
        ],
        'Robot1_Odometry': [
            f'{t:.3f} 0.085 {1.05 * w:.3f}' for t, w in zip(times, turns, strict=True)
        ],
        'Robot1_Measurement': seen,
    }
    for name, lines in texts.items():
        (folder / f'{name}.dat').write_text('# head\n' + '\n'.join(lines) + '\n')
    return folder


@pytest.fixture(scope='module')
def converted(log, tmp_path_factory):
    bag = tmp_path_factory.mktemp('out') / 'run'
    assert main(['convert', 'mrclam', str(log), '--robot', '1', '--out', str(bag)]) == 0
    return bag


def test_evaluated_smoothed_and_exported(converted, tmp_path, capsys):
    start = json.loads(converted.with_name('run_start.json').read_text())['pose']
    config = tmp_path / 'config.yaml'
    config.write_text('/**: {ros__parameters: {estimator: {learning_sigma: 0.0}}}\n')
    arguments = ['evaluate', str(converted), '--map', f'{converted}_map', '--robot']
    robot = tmp_path / 'robot.yaml'
    robot.write_text(EXACT)
    arguments += [str(robot), '--start', *map(str, start), '--smooth']
    arguments += ['--config', str(config), '--tum', str(tmp_path / 'tum')]
    arguments += ['--report', str(tmp_path / 'run.html')]
    arguments += ['--out', str(tmp_path)]
    assert main([*arguments, '--json', str(tmp_path / 'run.json')]) == 0
    report = json.loads((tmp_path / 'run.json').read_text())
    assert report['odometry']['position_rmse_m'] > 3 * report['fused']['position_rmse_m']
    assert report['fused']['position_rmse_m'] < 0.03
    assert report['smoothed']['position_rmse_m'] < report['fused']['position_rmse_m']
    assert report['availability'] == 1.0
    assert report['fixes'] > 0
    assert 'smoothed' in capsys.readouterr().out
    assert 'smoothed' in (tmp_path / 'run.html').read_text()
    assert (tmp_path / 'trajectory.png').stat().st_size > 10_000
    rows = {k: np.loadtxt(tmp_path / 'tum' / f'{k}.tum') for k in ('truth', 'fused', 'smoothed')}
    assert len(rows['fused']) == report['frames']
    away = rows['smoothed'][:, 1:3] - rows['truth'][:, 1:3]
    rmse = np.sqrt(np.mean(np.sum(away**2, axis=1)))
    assert rmse == pytest.approx(report['smoothed']['position_rmse_m'], abs=1e-9)


SUBSETS = np.array(list(combinations(range(4), 3)))


@pytest.fixture(scope='module')
def beacons(shared_data):
    return np.loadtxt(shared_data / 'roh' / 'landmark.csv', delimiter=',')


@pytest.fixture(scope='module')
def readings(shared_data):
    """Places (n, 2) and bearings (n, 4)."""
    places, bearings = [], []
    for path in sorted((shared_data / 'roh').glob('(X*.csv')):
        match = re.fullmatch(r'\(X([\d.]+),Y([\d.]+)\)', path.stem)
        rows = np.radians(np.loadtxt(path, delimiter=','))
        places.append(np.tile([float(match[1]), float(match[2])], (len(rows), 1)))
        bearings.append(rows)
    return np.concatenate(places), np.concatenate(bearings)


def subset_poses(beacons, bearings):
    """Poses (n, 4, 3) by each three of the beacons."""
    return triangulate_three(beacons[SUBSETS], bearings[:, SUBSETS])


def test_all_subsets_together_are_within_nine_centimetres(beacons, readings):
    places, bearings = readings
    poses = subset_poses(beacons, bearings)
    error = np.linalg.norm(np.median(poses[..., :2], axis=1) - places, axis=-1)
    assert np.median(error) <= 0.09


def test_the_estimator_finds_places_and_beacons(beacons, readings):
    """
    Nine places have nine bearings too many: errors that repeat can be known without the truth.

    Where the robot is carried to, it does not know. What changes from one reading to the next, a
    robot that stands takes the median of.
    """
    places, bearings = readings
    resting, true = np.median(bearings.reshape(9, 200, 4), axis=1), places[::200]
    corners = LandmarkMap(
        tuple(
            bare_landmark(k, [*place, 0.0], 0.1**2 * np.eye(3))
            for k, place in enumerate(beacons[:, :2])
        )
    )
    mount = PanTiltMount(pan_sigma_rad=0.0)
    config = EstimatorConfig(
        floor_tilt_sigma_rad=0.0, correlation_length_m=1e9, learning_sigma=0.0
    )
    anywhere = PoseEstimate(0, np.array([3.0, 3.0, 0.0]), 9.0 * np.eye(3))
    exact = Calibration.of_mount(mount, dict.fromkeys(NAMES, 0.0))
    joint = JointFilter(corners, exact, anywhere, config)
    images = [
        replace(
            ImagePoints.of_bearings((k + 1) * 10**11, np.arange(4), row, np.full(4, 1e-4), mount),
            near=near,
        )
        for k, (row, near) in enumerate(
            zip(resting, np.median(subset_poses(beacons[:, :2], resting), axis=1), strict=True)
        )
    ]
    track = OdometryTrack(OdometryNoiseConfig())
    track.add(OdometrySample(0, np.zeros(3)))
    poses = smoothed_poses(joint, track, images, np.ones(9, dtype=np.bool_))
    off = np.array([pose.pose[:2] for pose in poses]) - true
    assert np.median(np.hypot(*off.T)) < 0.08
    found = subset_poses(joint.landmarks[:, :2], bearings)
    assert np.median(np.linalg.norm(found[..., :2] - places[:, None], axis=-1)) < 0.098
