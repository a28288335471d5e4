"""Files are read through one module: bounded, regular, text; an error is one line."""

import gzip
import os
from pathlib import Path
import re
import socket

import cv2
import numpy as np
import pytest

from landmark_nav.configuration import load_configuration
from landmark_nav.errors import LandmarkNavError, one_line
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.maps import load_map, patch_reader
from landmark_nav.storage.mrclam import read_mrclam
from landmark_nav.storage.reading import read_bytes, read_text, read_yaml_mapping
from landmark_nav.storage.robot_files import load_robot
from landmark_nav.storage.setup_files import load_camera, load_room

BOMB = 'a0: &a0 [x, x]\n' + ''.join(
    f'a{k}: &a{k} [{", ".join([f"*a{k - 1}"] * 10)}]\n' for k in range(1, 10)
)
NESTED = 'a: ' * 3 + '[' * 100_000
HOSTILE = {
    'aliases': BOMB,
    'alias as a value': f'{BOMB}walls: *a9\nlandmarks: *a9\npan_axis: *a9\nimage_width: *a9\n',
    'tag without a value': 'walls: !!float\npan_axis: !!timestamp\n',
    'tag with nonsense': 'walls: !!int zz\npan_axis: !!bool maybe\nimage_width: !!int zz\n',
    'tag of Python': 'walls: !!python/object/apply:os.abort []\n',
    'digits': f'walls: {"9" * 400}\npan_axis: {"9" * 5000}\nimage_width: {"9" * 400}\n',
    'nested': NESTED,
    'nested blocks': '- ' * 50_000,
    'a list as a key': '? [1, 2]\n: 3\n',
    'keys that are there twice': 'walls: 1\nwalls: 2\npan_axis: 1\npan_axis: 2\n',
    'two documents': 'walls: []\n---\nwalls: []\n',
    'wide': f'walls: [[{"x, " * 20_000}x]]\npan_axis: {{{"k: {}, " * 5000}}}',
    'long': f'walls: {"x" * 1_000_000}\npan_axis: "{"y" * 1_000_000}"\n',
    'control characters': 'walls: "\\n\\e[2J"\npan_axis: "\\0\\x07"\n',
    'deep maps': 'walls: ' + '{a: ' * 30 + '1' + '}' * 30,
    'NUL': 'walls: \x00',
}


@pytest.fixture(params=HOSTILE)
def hostile(request, tmp_path):
    """A folder whose files all hold the same hostile document."""
    for name in ('map.yaml', 'metadata.yaml', 'x.yaml'):
        (tmp_path / name).write_text(HOSTILE[request.param])
    return tmp_path


@pytest.mark.parametrize(
    'read',
    [
        lambda folder: load_room(folder / 'x.yaml'),
        lambda folder: load_robot(folder / 'x.yaml'),
        lambda folder: load_camera(folder / 'x.yaml'),
        lambda folder: load_configuration(folder / 'x.yaml', '', 'odometry_fusion'),
        load_map,
        Bag,
    ],
)
def test_hostile_yaml_is_one_short_line(read, hostile):
    with pytest.raises(LandmarkNavError) as caught:
        read(hostile)
    assert len(str(caught.value)) < 1000
    line = one_line(str(caught.value))
    assert len(line) <= 200
    assert line.isprintable()


@pytest.mark.parametrize(
    ('text', 'stays'),
    [
        (
            '/tmp/a_long_folder/of_runs/corridor/learn: sweep 1 (of 1000.1 s): no place in the '
            'room fits; at (1, 2) m, red has 34 % of its edges, 0 % of them as they should be, '
            'green fits, blue fits, yellow is not seen: uncover the papers, or check colours, '
            'sizes and places in room.yaml',
            ('red has 34 % of its edges', 'uncover the papers'),
        ),
        (
            'nominal.yaml: the sweeps show, and use, '
            + ', '.join(f'value_{k} {k}.5 +- 0.1 mm' for k in range(12))
            + ' more than it gives',
            ('the sweeps show, and use', 'value_11 11.5 +- 0.1 mm more than it gives'),
        ),
        (
            'camera lens: fx in camera_info is 43 % too short '
            f'(or {", ".join(map(str, range(50)))}: undecided): calibrate again',
            ('fx in camera_info is 43 % too short', 'calibrate again'),
        ),
        (
            'some/bag: /sweep/image/compressed: 1 of 72 images of sweeps left out: image 21, at '
            '1009.100 s: image is 60000 x 60000, but its camera_info is for 512 x 512: calibrate '
            'at the size that is published, or at a whole factor of it',
            ('1 of 72 images of sweeps left out', 'calibrate at the size that is published'),
        ),
    ],
)  # fmt: skip
def test_a_long_line_loses_whole_parts_and_keeps_subject_and_remedy(text, stays):
    line = one_line(text)
    assert len(line) <= 200
    assert all(part in line for part in stays)
    words = set(re.split('[ ,:/]+', text))
    assert all(word in words for word in re.split('[ ,:/]+', line.replace('…', '')) if word)


def test_a_file_of_too_many_values_is_refused(tmp_path):
    (tmp_path / 'x.yaml').write_text('a: [' + '1,' * 500_001 + ']')
    with pytest.raises(LandmarkNavError, match=r'x\.yaml'):
        read_yaml_mapping(tmp_path / 'x.yaml')


def test_yaml_is_read_as_people_and_programs_write_it(tmp_path):
    path = tmp_path / 'x.yaml'
    path.write_bytes(
        b'\xef\xbb\xbf%YAML 1.1\r\n---\r\na: 1e-3 # small\r\nb: [1, -2.5, .inf, 0x10]\r\n'
        b'c: {d: yes, e: ~, f: "1"}\r\ng: 2024-01-01\r\nh: &anchor x\r\n'
        b'i: |\r\n  two\r\n  lines\r\n'
    )
    assert read_yaml_mapping(path) == {
        'a': 0.001,
        'b': [1, -2.5, np.inf, 16],
        'c': {'d': True, 'e': None, 'f': '1'},
        'g': '2024-01-01',
        'h': 'x',
        'i': 'two\nlines\n',
    }
    path.write_text('')
    assert read_yaml_mapping(path) == {}


def test_an_error_names_file_and_line(tmp_path):
    path = tmp_path / 'x.yaml'
    for text in ('a: 1\nb: [2\n', 'a: &a 1\nb: *a\n', 'a: 1\nb: !!int x', 'a: 1\na: 2'):
        path.write_text(text)
        with pytest.raises(LandmarkNavError, match=r'x\.yaml: (not YAML: )?line [23]: '):
            read_yaml_mapping(path)
    path.write_bytes(b'a: 1\nb: M\xfcller\n')
    with pytest.raises(LandmarkNavError, match=r'x\.yaml: line 2: not UTF-8'):
        read_yaml_mapping(path)


def test_only_regular_files_of_bounded_size_are_read(tmp_path, monkeypatch):
    fifo, link, large = tmp_path / 'fifo', tmp_path / 'link', tmp_path / 'large'
    os.mkfifo(fifo)
    link.symlink_to('/dev/zero')
    with large.open('wb') as stream:
        stream.truncate(10**10)
    monkeypatch.chdir(tmp_path)  # a socket's path must be short
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind('socket')
    others = (tmp_path / 'socket', tmp_path, tmp_path / 'none', Path('/dev/zero'))
    for path in (fifo, link, large, *others):
        with pytest.raises(LandmarkNavError, match=str(path)):
            read_text(path)
    with pytest.raises(LandmarkNavError, match='cannot be read'):
        read_bytes(tmp_path / 'nul\0')


def test_all_patches_of_a_map_together_are_bounded(tmp_path):
    (tmp_path / '0.png').write_bytes(cv2.imencode('.png', np.zeros((1000, 1000)))[1].tobytes())
    patch_of = patch_reader(tmp_path)
    for _ in range(100):
        assert patch_of('0.png').shape == (1000, 1000)
    with pytest.raises(LandmarkNavError, match='patches have over 100 million pixels'):
        patch_of('0.png')


@pytest.mark.parametrize(
    'data',
    [
        b'',
        b'1 2 3 4 nan',
        b'1 2 3 4 1e400',
        b'1 0x2 3 4 5',
        b'1 2\0 3 4 5',
        b'\xff\xfe1',
        b'1 2 3 4 5\n1 2',
        b'# M\xfcller\n',
    ],
)
@pytest.mark.parametrize('packed', [False, True])
def test_a_hostile_log_is_refused(data, packed, tmp_path):
    path = tmp_path / ('Landmark_Groundtruth.dat.gz' if packed else 'Landmark_Groundtruth.dat')
    (tmp_path / 'Barcodes.dat').write_bytes(b'\xef\xbb\xbf6 63\r\n7 25\r\n')
    path.write_bytes(gzip.compress(data) if packed else data)
    with pytest.raises(LandmarkNavError, match='Landmark_Groundtruth'):
        read_mrclam(tmp_path, 1, 0.01)


@pytest.mark.parametrize(
    'data',
    [b'\x1f\x8b', gzip.compress(b'1 2')[:-9], gzip.compress(b' ' * 40_000_000), b'plain'],
    ids=['cut in the header', 'cut at the end', 'grows', 'not packed'],
)
def test_a_packed_log_that_is_damaged_or_grows_is_refused(data, tmp_path):
    (tmp_path / 'Barcodes.dat.gz').write_bytes(data)
    with pytest.raises(LandmarkNavError, match='Barcodes'):
        read_mrclam(tmp_path, 1, 0.01)
