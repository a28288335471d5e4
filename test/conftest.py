"""What all tests share."""

import fcntl
import os
from pathlib import Path

from hypothesis import settings
import pytest

# Nodes that tests start must not talk to other machines, however pytest was called.
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')

# How long an example takes depends on what else the machine does.
settings.register_profile('any machine', deadline=None)
settings.load_profile('any machine')

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope='session')
def shared_data():
    """Folder of data that this project did not draw, beside the repository."""
    folder = REPOSITORY.parent / 'shared' / 'data'
    if not folder.is_dir():
        pytest.skip(f'{folder} is not there')
    return folder


@pytest.fixture(scope='session')
def once(tmp_path_factory):
    """Make a folder of that name once for all processes of a run, and return it."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if 'PYTEST_XDIST_WORKER' in os.environ else base

    def made(name, make):
        folder = shared / f'once_{name}'
        with (shared / f'{name}.lock').open('w') as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not (folder / 'made').exists():
                folder.mkdir()
                make(folder)
                (folder / 'made').touch()
        return folder

    return made


@pytest.fixture(scope='module')
def undrawn():
    """`learn` draws no figures, which take a sixth of its time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('landmark_nav.cli.learn._draw', lambda *_: None)
        yield


@pytest.fixture(scope='session')
def recorded(once):
    """Folder of what `learn` and `evaluate` make of bags/: `map`, `learn.json`, `run.json`."""
    from small import recorded_room

    return once('recorded', recorded_room)
