"""The offline commands as a user calls them, and their errors for wrong data."""

import csv
import json
import re

import cv2
from drive_faults import recorded as sent
from drive_faults import rewritten, write_bag
from harness import BAGS, command, start_of
from message_changes import at_origin, driven, moved
import numpy as np
import pytest

from landmark_nav.cli.main import main
from landmark_nav.storage.bags import Bag

ROBOT, ROOM = str(BAGS / 'robot.yaml'), str(BAGS / 'room.yaml')
START = tuple(map(str, start_of(BAGS)))


def refused(capsys, arguments, *words, status=1):
    """The command ends with a status and one line on stderr that holds all `words`."""
    capsys.readouterr()
    assert main([str(a) for a in arguments]) == status
    lines = capsys.readouterr().err.strip().splitlines()
    last = lines[-1]
    assert last.startswith(f'landmark-nav {arguments[0]}: ')
    assert 'Traceback' not in last
    for word in words:
        assert word in last, last


# What the issue asks for


def test_learn_finds_the_sweeps_and_enough_landmarks(recorded, capsys):
    report = json.loads((recorded / 'learn.json').read_text())
    assert len(report['sweeps']) == 2
    for sweep in report['sweeps']:
        assert sweep['frames'] == 72
        assert len(sweep['pose']) == len(sweep['sigma']) == len(sweep['error']) == 3
    refusals = sum(report['refused'].values())
    assert report['candidates'] == report['elected'] + refusals
    assert report['candidates'] >= report['reconstructed'] >= report['elected']
    for stage in ('panorama', 'reference_area', 'attention', 'stereo', 'election'):
        assert report['stages'][stage]['seconds'] > 0.0
        assert report['stages'][stage]['peak_memory_mb'] > 10.0
    # The map, its images, and what `map show` says of it.
    learned = recorded / 'map'
    names = {path.name for path in learned.iterdir()}
    assert names == {'map.yaml', 'patches', 'views', 'map.png', 'panorama_1.png', 'panorama_2.png'}
    assert len(list((learned / 'patches').iterdir())) == report['elected']
    assert main(['map', 'show', str(learned)]) == 0
    printed = capsys.readouterr().out
    assert f'{report["elected"]} landmarks in frame map' in printed
    assert 'learned_from: learn' in printed


@pytest.mark.parametrize('name', ['grail', 'parrington'])
def test_photographs_become_a_panorama_of_a_full_turn(shared_data, tmp_path, capsys, name):
    folder, out = shared_data / 'pan_sweeps' / name, tmp_path / 'panorama.png'
    assert main(['panorama', str(folder), '--out', str(out)]) == 0
    reported = ' '.join(capsys.readouterr().out.split())
    (focal_px,) = map(float, re.findall(r'focal length ([\d.]+) \+-', reported))
    (closure_deg,) = map(float, re.findall(r'closure error ([\d.]+) deg', reported))
    with (folder / 'frames.csv').open() as stream:
        listed_px = np.median([float(row['focal_px']) for row in csv.DictReader(stream)])
    assert focal_px == pytest.approx(listed_px, rel=0.005)
    assert closure_deg <= 0.1
    camera_image = cv2.imread(str(out), cv2.IMREAD_UNCHANGED)
    assert camera_image.shape[1] > 3000
    assert np.mean(camera_image[..., 3] > 0) > 0.9
    middle = camera_image[camera_image.shape[0] // 2]
    assert np.all(middle[:, 3] > 0)


# Bad input: one line, status 1, nothing half-written


def learn(bag, out, room=ROOM):
    return ['learn', bag, '--room', room, '--robot', ROBOT, '--out', out]


def evaluate(bag, learned, start=START):
    return ['evaluate', bag, '--map', learned, '--robot', ROBOT, '--start', *start]


def test_a_recording_that_broke_off_may_leave_a_single_sweep(tmp_path, capsys, caplog):
    whole = (BAGS / 'learn' / 'learn.mcap').read_bytes()
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(whole[: int(0.6 * len(whole))])
    refused(capsys, learn(cut, tmp_path / 'map'), 'two panoramas')
    assert 'cut off or damaged' in caplog.text
    assert [p.name for p in tmp_path.iterdir()] == ['cut.mcap']


@pytest.mark.parametrize(
    ('topic', 'change', 'words'),
    [
        ('sweep/camera_info', {'distortion_model': 'fisheye624'}, ('fisheye624', 'plumb_bob')),
        (
            'sweep/image/compressed',
            {'format': 'h264', 'data': np.array([0, 0, 0, 1, 0x67] * 20, np.uint8)},
            ('h264', 'jpeg'),
        ),
    ],
)
def test_unknown_cameras_and_encodings_are_refused_by_name(tmp_path, capsys, topic, change, words):
    def with_change(message):
        vars(message).update(change)
        return message

    bag = rewritten(BAGS / 'learn', tmp_path / 'strange', (topic,), with_change)
    refused(capsys, learn(bag, tmp_path / 'map'), f'/{topic}', *words)
    assert not (tmp_path / 'map').exists()


@pytest.mark.parametrize(
    ('change', 'reported'),
    [
        (moved(3.0, 1.0, 0.5), r'another frame.* lies at .(3\.0|2\.9).*, 28\.. deg'),
        (driven(1000.0, 1000.0), 'another .* unit .*lengths are 10.. times'),
        (at_origin, ''),
    ],
)
def test_truth_in_another_frame_or_unit_is_named(
    recorded, tmp_path, caplog, recwarn, change, reported
):
    half_ns = Bag(BAGS / 'drive').start_ns + 7 * 10**9
    half = write_bag(tmp_path / 'half', (one for one in sent(BAGS / 'drive') if one[2] < half_ns))
    bag = rewritten(half, tmp_path / 'truth', ('ground_truth/odom',), change)
    report = tmp_path / 'report.json'
    command(*evaluate(bag, recorded / 'map'), '--json', report)
    said = ' '.join(line.getMessage() for line in caplog.records)
    assert bool(re.search('ground_truth.* frame', said)) == bool(reported)
    assert re.search(reported, said)
    assert 'Warning: ' not in said
    assert json.loads(report.read_text())['frames'] > 30


def test_sweeps_show_what_camera_info_and_robot_yaml_are_off_by(few, tmp_path):
    def misread(message):
        message.k = message.k * [1.03, 1, 1, 1, 1.03, 1, 1, 1, 1] + 10.0 * (np.arange(9) == 2)
        message.d = message.d + 0.04 * (np.arange(len(message.d)) == 0)
        return message

    bag = rewritten(BAGS / 'learn', tmp_path / 'misread', ('sweep/camera_info',), misread)
    robot, out = tmp_path / 'robot.yaml', tmp_path / 'learn.json'
    robot.write_text('pan_axis: {xyz: [0.08, 0, 1.1]}\noptical_center_offset: [0, -0.02, 0]\n')
    files = ('--room', ROOM, '--robot', robot, '--out', tmp_path / 'map', '--json', out)
    command('learn', bag, *files, *few)
    sweeps = json.loads(out.read_text())['sweeps']
    assert max(sweep['error_position_m'] for sweep in sweeps) < 0.005


def test_starts_that_cannot_be_are_refused(recorded, capsys):
    drive = BAGS / 'drive'
    turned, outside = (evaluate(drive, recorded / 'map', s) for s in ((1, 1, 90), (9.8, 1, 0)))
    refused(capsys, turned, 'radians', status=2)
    refused(capsys, outside, '1.00 m outside the room', status=2)


def test_nothing_is_written_over_what_is_no_map(tmp_path, capsys):
    (tmp_path / 'thesis.txt').write_text('precious')
    refused(capsys, learn(BAGS / 'learn', tmp_path), 'other files')
    assert [p.name for p in tmp_path.iterdir()] == ['thesis.txt']
