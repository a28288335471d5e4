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


def test_what_killed_processes_had_begun_is_removed(tmp_path: Path) -> None:
    gone = subprocess.Popen([sys.executable, '-c', ''])
    gone.wait()
    begun, lives, other = (
        tmp_path / name
        for name in (f'.map.part-{gone.pid}', f'.map.part-{os.getppid()}', '.map.part-of-mine')
    )
    for folder in (begun, lives, other):
        folder.mkdir()
        (folder / 'map.yaml').touch()
    with whole_folder(tmp_path / 'map', ['map.yaml']) as folder:
        (folder / 'map.yaml').touch()
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        ['map', lives.name, other.name]
    )


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
