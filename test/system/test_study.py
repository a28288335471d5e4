"""Learning and localization in a room that another simulator rendered."""

from harness import evaluate, learn, SHARED, start_of
import numpy as np
import pytest

from landmark_nav.storage.maps import load_map

pytestmark = pytest.mark.usefixtures('undrawn')
MOUNT = 'xyz: [0.08, 0.0, 1.1]\n  rpy: [0.0, 0.0, 0.0]'


@pytest.fixture(scope='module')
def study(shared_data):
    return shared_data / 'study'


@pytest.fixture(scope='module')
def learned(study, tmp_path_factory):
    out = tmp_path_factory.mktemp('study') / 'map'
    learn(study, out)
    return out


def driven(study, learned, folder, mount, more=''):
    """Figures of the drive with another mount in robot.yaml."""
    given = (study / 'robot.yaml').read_text()
    assert MOUNT in given
    robot = folder / 'robot.yaml'
    robot.write_text(given.replace(MOUNT, mount) + more)
    out = folder / 'run.json'
    report = evaluate(study, learned, start=start_of(study), robot=robot, out=out)
    assert report['frames'] == 184
    assert report['availability'] >= 0.95
    assert report['integrity']['undetected_wrong'] == 0
    return report


def test_a_drive_shows_the_pan_zero_of_a_mount_without_sigmas(study, learned, tmp_path):
    # Reached: 0.14 degrees over all of the drive, the first images included.
    mount = MOUNT.replace('rpy: [0.0, 0.0, 0.0]', 'rpy: [0.0, 0.0, 0.0122]')
    report = driven(study, learned, tmp_path, mount)
    assert report['fused']['heading_rmse_deg'] <= 0.2
    assert report['fused']['position_rmse_m'] <= 0.015
    yaw = report['calibration']['axis_yaw']
    assert yaw['observed']
    assert abs(yaw['value']) <= 3.0 * yaw['sigma'] <= np.radians(0.6)


FLAT = SHARED / 'flat'


@pytest.mark.skipif(not FLAT.is_dir(), reason='needs ../shared/data/flat')
def test_a_flat_is_learned_whatever_matches(tmp_path):
    wide = tmp_path / 'wide.yaml'
    # Stereo that takes any match, of few candidates.
    limits = 'stereo: {max_displaced_px: 8.0}\nattention: {candidates: 70}\n'
    wide.write_text(limits + (FLAT / 'relaxed.yaml').read_text().split('\n', 1)[1])
    learn(FLAT, tmp_path / 'map', '--config', wide)
    landmarks = load_map(tmp_path / 'map').landmarks
    assert len(landmarks) >= 3
    assert all(np.linalg.eigvalsh(k.covariance)[0] > 0.0 for k in landmarks)
    assert max(float(np.abs(k.position).max()) for k in landmarks) < 10.0
