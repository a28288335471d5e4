"""`landmark-nav calibrate` on the recorded room of bags/: results and refusals."""

import json

from drive_faults import recorded as recorded_messages
from drive_faults import write_bag
from harness import BAGS
import numpy as np
import pytest
from unmeasured import with_odometry

from landmark_nav.calibration import NAMES
from landmark_nav.cli.main import main
from landmark_nav.storage.robot_files import load_calibration, save_calibration

ROOM, LEARN, DRIVE = (str(BAGS / name) for name in ('room.yaml', 'learn', 'drive'))
DEGREE = np.pi / 180.0
OFF = {
    'axis_x': 0.03,
    'axis_z': 0.03,
    'axis_pitch': 0.8 * DEGREE,
    'axis_yaw': 0.7 * DEGREE,
    'center_x': 0.02,
    'camera_roll': -0.8 * DEGREE,
    'distortion': 0.015,
}


def without_sigmas(folder):
    """Calibration that a person with a tape and a spirit level knows, kept in `right.yaml`."""
    lines = (BAGS / 'robot.yaml').read_text().splitlines(True)
    (folder / 'right.yaml').write_text(''.join(k for k in lines if 'sigma:' not in k))
    return load_calibration(folder / 'right.yaml')


@pytest.fixture(scope='module')
def calibrated(fewer, tmp_path_factory):
    """Folder with what came of a robot.yaml that is off; the right calibration, the given one."""
    folder = tmp_path_factory.mktemp('calibrate')
    right = without_sigmas(folder)
    given = right.with_values(**{name: right[name][0] + off for name, off in OFF.items()})
    save_calibration(given, folder / 'given.yaml')
    better = folder / 'better.yaml'
    better.write_text('is mine\n')
    words = ['calibrate', LEARN, DRIVE, '--room', ROOM, '--robot', str(folder / 'given.yaml')]
    words += ['--out', str(better), '--json', str(folder / 'c.json')]
    words += ['--report', str(folder / 'report.html'), *fewer]
    # A file is replaced only on demand.
    assert main(words) == 1
    assert better.read_text() == 'is mine\n'
    assert main([*words, '--overwrite']) == 0
    return folder, right, given


def test_errors_of_the_mount_are_found(calibrated):
    folder, right, given = calibrated
    found = load_calibration(folder / 'better.yaml')
    for name in OFF:
        error, sigma = found[name][0] - right[name][0], found[name][1]
        assert abs(error) < 4.0 * sigma, name
    for name in ('axis_pitch', 'center_x', 'camera_roll', 'distortion'):
        assert abs(found[name][0] - right[name][0]) < 0.3 * abs(OFF[name]), name
        assert found[name][1] < 0.3 * given[name][1]
    # Images show the height of the camera, not of its parts.
    height = sum(found[name][0] - right[name][0] for name in ('axis_z', 'center_z'))
    assert abs(height) < 0.012


def test_the_report_states_what_was_shown(calibrated):
    folder, _, given = calibrated
    report = json.loads((folder / 'c.json').read_text())
    assert set(report['calibration']) == set(NAMES)
    row = report['calibration']['camera_roll']
    assert row['prior'] == pytest.approx(given['camera_roll'][0], abs=1e-8)
    assert row['observed']
    assert abs(row['difference_sigmas']) < 3.0
    before, after = (np.hypot(*report['residual_px'][key]) for key in ('before', 'after'))
    assert after < before
    assert {'axis_z', 'center_z'} <= {
        name for pair in report['trade_offs'] for name in pair['quantities']
    }
    assert (folder / 'report.html').stat().st_size > 30_000


def test_a_sweep_alone_shows_the_camera_and_not_the_lever(calibrated, tmp_path):
    given, out = str(calibrated[0] / 'given.yaml'), tmp_path / 'robot.yaml'
    sent = recorded_messages(LEARN)
    ends = next(k for k, one in enumerate(sent) if one[0] == '/sweep/trajectory')
    bag = str(write_bag(tmp_path / 'sweep', sent[: ends + 1]))
    assert main(['calibrate', bag, '--room', ROOM, '--robot', given, '--out', str(out)]) == 0
    found = load_calibration(out)
    assert found['axis_x'][1] == pytest.approx(0.02)
    assert found['camera_roll'][1] < 0.002


@pytest.mark.parametrize(
    ('bag', 'words'), [(DRIVE, 'needs a map'), (LEARN, '--room'), ('nowhere', 'nowhere')]
)
def test_what_cannot_be_calibrated_is_reported_in_a_line(bag, words, tmp_path, capsys):
    out = tmp_path / 'out.yaml'
    files = ['--robot', str(BAGS / 'robot.yaml'), '--out', str(out)]
    assert main(['calibrate', bag, *files]) in (1, 2)
    (line,) = [one for one in capsys.readouterr().err.splitlines() if 'WARNING' not in one]
    assert words in line
    assert not out.exists()


def test_what_a_robot_that_stands_does_not_show_stays_as_given(recorded, tmp_path):
    """The first third of a second of a drive: nothing of lever and pan zero."""
    sent = recorded_messages(DRIVE)
    write_bag(tmp_path / 'still', [one for one in sent if one[2] < sent[0][2] + 3 * 10**8])
    robot, out = str(BAGS / 'robot.yaml'), tmp_path / 'out.yaml'
    args = ['calibrate', str(tmp_path / 'still'), '--map', str(recorded / 'map')]
    args += ['--robot', robot]
    assert main([*args, '--out', str(out), '--json', str(tmp_path / 'c.json')]) == 0
    given, found = load_calibration(robot), load_calibration(out)
    hidden = ('axis_x', 'axis_y', 'axis_yaw')
    for name in hidden:
        assert found[name][1] > 0.6 * given[name][1], name
        assert abs(found[name][0] - given[name][0]) < 2.0 * given[name][1], name
    report = json.loads((tmp_path / 'c.json').read_text())
    named = {name for item in report['unobserved'] for name in item['quantities']}
    assert {'axis_x', 'axis_yaw'} <= named


def test_sweeps_and_a_drive_need_no_plan(fewer, tmp_path):
    """The frame and the scale are those of odometry; the mount is found all the same."""
    sweeps = str(with_odometry(BAGS / 'learn', tmp_path / 'sweeps', 1.0))
    right = without_sigmas(tmp_path)
    given = right.with_values(axis_yaw=right['axis_yaw'][0] + OFF['axis_yaw'])
    save_calibration(given, tmp_path / 'given.yaml')
    words = ['--robot', str(tmp_path / 'given.yaml'), '--out', str(tmp_path / 'better.yaml')]
    assert main(['calibrate', sweeps, DRIVE, *words, *fewer]) == 0
    found = load_calibration(tmp_path / 'better.yaml')
    for name in ('axis_yaw', 'axis_x', 'center_x', 'camera_roll'):
        assert abs(found[name][0] - right[name][0]) < 4.0 * found[name][1], name
        assert found[name][1] < 0.5 * given[name][1], name
    # Each bag of sweeps has a frame of its own.
    assert main(['calibrate', sweeps, sweeps, *words, '--overwrite']) == 1
