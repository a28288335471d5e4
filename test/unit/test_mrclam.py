from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.storage.mrclam import read_mrclam

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
def folder(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        (tmp_path / f'{name}.dat').write_text(text)
    return tmp_path


@pytest.mark.parametrize('packed', [False, True])
def test_a_log_is_read_plain_and_packed(folder: Path, packed: bool) -> None:
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


@pytest.mark.parametrize(
    ('name', 'content', 'complaint'),
    [
        ('Robot2_Odometry.dat', None, 'Robot2_Odometry.dat: not there'),
        ('Barcodes.dat', b'1 2 3\n', 'is 3 columns wide, not 2'),
        ('Robot2_Measurement.dat', b'1248444175.2 5 3.0 0.1\n', 'no landmark was seen'),
    ],
)
def test_bad_files_are_named(
    folder: Path, name: str, content: bytes | None, complaint: str
) -> None:
    (folder / name).unlink()
    if content is not None:
        (folder / name).write_bytes(content)
    with pytest.raises(LandmarkNavError, match=complaint):
        read_mrclam(folder, 2, SIGMA)
    with pytest.raises(LandmarkNavError, match='no folder there'):
        read_mrclam(folder / 'nothing', 2, SIGMA)
