"""What is written appears whole, and what cannot be written is refused before the work."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import sys

import pytest

from landmark_nav.cli.main import main
from landmark_nav.errors import LandmarkNavError
from landmark_nav.storage.whole import check_writable, whole_folder


@pytest.fixture
def gone() -> int:
    """Number of a process that has ended."""
    process = subprocess.Popen([sys.executable, '-c', ''])
    process.wait()
    return process.pid


def save(folder: Path) -> None:
    with whole_folder(folder, ['map.yaml'], overwrite=True) as growing:
        (growing / 'map.yaml').touch()


def test_what_killed_processes_had_begun_is_removed(tmp_path: Path, gone: int) -> None:
    begun, lives, other = (
        tmp_path / name
        for name in (f'.map.part-{gone}', f'.map.part-{os.getppid()}', '.map.part-of-mine')
    )
    for folder in (begun, lives, other):
        folder.mkdir()
        (folder / 'map.yaml').touch()
    save(tmp_path / 'map')
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        ['map', lives.name, other.name]
    )


def test_what_killed_processes_had_replaced_is_removed_but_for_what_the_user_kept_there(
    tmp_path: Path, gone: int
) -> None:
    target, old, lives = (
        tmp_path / name for name in ('map', f'.map.old-{gone}', f'.map.old-{os.getppid()}')
    )
    for folder in (old, lives):
        folder.mkdir()
        for name in ('map.yaml', 'notes.txt'):
            (folder / name).write_text(folder.name)
    save(target)
    assert (old / 'map.yaml').exists(), 'it may be all that there was'
    save(target)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(['map', lives.name])
    assert (target / 'map.yaml').read_text() == ''
    assert (target / 'notes.txt').read_text() == old.name


def test_what_the_user_kept_in_both_stays_in_both(tmp_path: Path, gone: int) -> None:
    target, old = tmp_path / 'map', tmp_path / f'.map.old-{gone}'
    save(target)
    old.mkdir()
    for folder in (target, old):
        (folder / 'notes.txt').write_text(folder.name)
    save(target)
    assert (target / 'notes.txt').read_text() == 'map'
    assert (old / 'notes.txt').read_text() == old.name


def test_places_that_cannot_be_written_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / 'file').touch()
    check_writable(tmp_path / 'new' / 'folders' / 'e.json', tmp_path / 'file', None)
    assert [path.name for path in tmp_path.iterdir()] == ['file']
    with pytest.raises(LandmarkNavError, match='file: is a file'):
        check_writable(tmp_path / 'file' / 'below' / 'e.json')
    with pytest.raises(LandmarkNavError, match='is a folder'):
        check_writable(tmp_path)
    monkeypatch.setattr(os, 'access', lambda *_: False)
    with pytest.raises(LandmarkNavError, match=r'e\.json: cannot be written: no permission'):
        check_writable(tmp_path / 'e.json')


@pytest.mark.parametrize(
    'command',
    [
        ['evaluate', 'nowhere', '--map', 'm', '--robot', 'r', '--json'],
        ['evaluate', 'nowhere', '--map', 'm', '--robot', 'r', '--tum'],
        ['learn', 'nowhere', '--room', 'r', '--robot', 'r', '--out', 'm', '--json'],
        ['plan', '--room', 'r', '--robot', 'r', '--positions', '2', '--out'],
    ],
)
def test_commands_look_first(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'file').touch()
    assert main([*command, str(tmp_path / 'file' / 'e.json')]) == 1
    assert 'file: is a file: take another name' in capsys.readouterr().err
