"""
Three bearings on measured data: Roh's rotating infrared sensor, four beacons on a 6 m square.

Kept as the data say: bearings counter-clockwise in degrees, columns in the order of the beacons
(0, 0), (6, 0), (6, 6), (0, 6), the sensor's zero at +90 degrees in the beacons' frame to within
five degrees. At the known places expected and measured bearings then differ by 7.3 degrees at
most; with any other order or sign by tens.
"""

from dataclasses import replace
from itertools import combinations
import re

from bare_landmarks import bare_landmark
import numpy as np
import pytest

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.estimator import EstimatorConfig, ImagePoints, JointFilter
from landmark_nav.localization.estimator.smoothing import smoothed_poses
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.localization.odometry.track import OdometryTrack
from landmark_nav.localization.triangulation.model import triangulate_three
from landmark_nav.types import LandmarkMap, OdometrySample, PoseEstimate

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
        assert match is not None
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
            bare_landmark(k, np.array([*place, 0.0]), 0.1**2 * np.eye(3))
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
