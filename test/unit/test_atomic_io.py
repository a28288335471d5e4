"""Files are written atomically; paths that cannot be written are refused before the work."""

import os
from pathlib import Path
import subprocess
import sys

import pytest
from test_maps import make_map

from landmark_nav.cli.main import main
from landmark_nav.errors import LandmarkNavError
from landmark_nav.storage.atomic_io import atomic_folder, check_writable, write_atomically
from landmark_nav.storage.maps import save_map


@pytest.fixture
def gone():
    """Number of a process that has ended."""
    process = subprocess.Popen([sys.executable, '-c', ''])
    process.wait()
    return process.pid


def save(folder):
    with atomic_folder(folder, ['map.yaml'], overwrite=True) as growing:
        (growing / 'map.yaml').touch()


@pytest.mark.parametrize('name', ['map', 'map [2]'])
def test_what_killed_processes_had_begun_is_removed(tmp_path, gone, name):
    begun, lives, other = (
        tmp_path / f'.{name}.part-{number}' for number in (gone, os.getppid(), 'of-mine')
    )
    for folder in (begun, lives, other):
        folder.mkdir()
        (folder / 'map.yaml').touch()
    save(tmp_path / name)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        [name, lives.name, other.name]
    )


def test_what_killed_processes_had_replaced_is_removed_but_for_what_the_user_kept_there(
    tmp_path, gone
):
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
    # What is kept in both stays in both.
    old.mkdir()
    (old / 'notes.txt').write_text('older')
    save(target)
    assert (target / 'notes.txt').read_text() == old.name
    assert (old / 'notes.txt').read_text() == 'older'


def test_places_that_cannot_be_written_are_refused(tmp_path, monkeypatch):
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
    ('command', 'output'),
    [
        ('evaluate bag --map map --robot robot.yaml --json', 'map/map.yaml'),
        ('evaluate bag --map map --robot robot.yaml --report', 'bag/drive.mcap'),
        ('evaluate bag --map link --robot robot.yaml --video', 'map/map.yaml'),
        ('check bag --json', 'bag/metadata.yaml'),
        ('calibrate bag bag --robot robot.yaml --out new.yaml --json', 'bag/drive.mcap'),
        ('learn bag --robot robot.yaml --out new --walls-out', 'robot.yaml'),
    ],
)
def test_what_is_read_is_not_replaced(command, output, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ('map/map.yaml', 'bag/drive.mcap', 'bag/metadata.yaml', 'robot.yaml'):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    (tmp_path / 'link').symlink_to('map')
    assert main([*command.split(), output]) == 2
    assert f'{output}: is read, too' in capsys.readouterr().err
    assert (tmp_path / output).read_text() == output


def test_what_a_link_leads_to_is_written(tmp_path):
    real, link, chain, dangling, new = (
        tmp_path / name for name in ('real', 'link', 'chain', 'dangling', 'new')
    )
    real.write_text('before')
    real.chmod(0o640)
    link.symlink_to('real')
    chain.symlink_to(link)
    dangling.symlink_to(new)
    for path in (link, chain, dangling):
        check_writable(path)
        write_atomically(path, path.name)
        assert path.is_symlink()
        assert path.read_text() == path.name
    assert real.read_text() == 'chain'
    assert real.stat().st_mode & 0o777 == 0o640
    assert new.read_text() == 'dangling'
    link.unlink()
    link.symlink_to(link)
    with pytest.raises(LandmarkNavError, match='link: cannot be written'):
        write_atomically(link, '')


def test_pipes_and_devices_are_written_to(tmp_path):
    fifo = tmp_path / 'fifo'
    os.mkfifo(fifo)
    with pytest.raises(LandmarkNavError, match='fifo: cannot be written: nobody reads it'):
        write_atomically(fifo, 'x')
    reader = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    check_writable(fifo)
    write_atomically(fifo, 'through')
    assert os.read(reader, 100) == b'through'
    os.close(reader)
    assert fifo.is_fifo()
    # A terminal: no test run by root can replace it, as it could /dev/null.
    master, slave = os.openpty()
    device = Path(os.ttyname(slave))
    check_writable(device)
    write_atomically(device, 'through')
    assert os.read(master, 100) == b'through'
    assert device.is_char_device()


@pytest.mark.parametrize('stream', ['/dev/fd/1', '/proc/self/fd/1', 'link'])
def test_an_open_file_of_the_process_is_written_in_its_order(stream, tmp_path):
    (tmp_path / 'link').symlink_to('/proc/self/fd/1')  # as /dev/stdout is
    code = (
        'from pathlib import Path\n'
        'from landmark_nav.storage.atomic_io import check_writable, write_atomically\n'
        f'path = Path({stream!r})\n'
        'check_writable(path)\n'
        "print('one')\n"
        "write_atomically(path, 'two\\n')\n"
        "print('three')\n"
    )
    out = tmp_path / 'out'
    with out.open('wb') as file:
        subprocess.run([sys.executable, '-c', code], stdout=file, check=True, cwd=tmp_path)
    assert out.read_text() == 'one\ntwo\nthree\n'
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, cwd=tmp_path)
    assert done.stdout == b'one\ntwo\nthree\n', done.stderr
    assert (tmp_path / 'link').is_symlink()


def test_a_full_disk_is_one_line(tmp_path):
    save_map(make_map(), tmp_path / 'map')
    command = [sys.executable, '-m', 'landmark_nav', 'map', 'show', str(tmp_path / 'map')]
    with Path('/dev/full').open('wb') as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE)
    assert done.returncode == 1
    (line,) = done.stderr.decode().splitlines()
    assert line == 'landmark-nav map: standard output or a file: No space left on device'
