"""`landmark-nav panorama`: choice of the sweep, warnings and errors."""

from __future__ import annotations

from pathlib import Path

from bag_writers import camera_image, full_turn, SECOND, START, write_sweep
import cv2
import pytest

from landmark_nav.cli.main import main
from landmark_nav.storage.bags import BagWriter


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Two sweeps, of 24 and 18 frames."""
    with BagWriter(tmp_path / 'learn') as bag:
        write_sweep(bag, START, full_turn())
        write_sweep(bag, START + 60 * SECOND, full_turn(18))
    return tmp_path / 'learn'


def panorama(source: Path, *options: str) -> int:
    out = source.parent / 'out.png'
    command = ['panorama', str(source), '--out', str(out), '--overwrite', '--no-align']
    return main([*command, *options])


def test_of_two_sweeps_one_is_chosen(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert panorama(bag) == 2
    assert 'holds 2 sweeps: take one by --sweep 1 to 2' in capsys.readouterr().err
    for number, frames in (('1', 24), ('2', 18)):
        assert panorama(bag, '--sweep', number) == 0
        assert f'{frames} frames' in capsys.readouterr().out
    assert panorama(bag, '--sweep', '0') == 2
    assert panorama(bag, '--sweep', '3') == 2
    assert 'holds 2 sweeps, no number 3: take' in capsys.readouterr().err


def test_a_crop_that_leaves_gaps_is_warned_of(bag: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert panorama(bag, '--sweep', '1', '--crop', '40') == 0
    assert not caplog.text
    assert panorama(bag, '--sweep', '1', '--crop', '5') == 0
    assert '--crop 5: so narrow parts of the frames do not meet' in caplog.text


def test_an_image_that_is_missing_is_reported_in_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    cv2.imwrite(str(tmp_path / '0.png'), camera_image(5))
    assert panorama(tmp_path) == 1
    assert 'images without frames.csv (file,pan_rad' in capfd.readouterr().err
    rows = ['file,pan_rad,focal_px,width,height', '0.png,0,60,64,48', 'gone.png,0.3,60,64,48']
    (tmp_path / 'frames.csv').write_text('\n'.join(rows))
    assert panorama(tmp_path) == 1
    reported = capfd.readouterr().err
    assert reported.startswith('landmark-nav panorama: ')
    assert reported.count('\n') == 1
    assert 'gone.png: cannot be read: No such file' in reported
    assert panorama(tmp_path, '--sweep', '1') == 2
    assert 'is one sweep: leave out --sweep 1' in capfd.readouterr().err
