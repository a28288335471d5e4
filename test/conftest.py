"""What all tests share."""

from __future__ import annotations

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
def shared_data() -> Path:
    """Folder of data that this project did not draw, beside the repository."""
    folder = REPOSITORY.parent / 'shared' / 'data'
    if not folder.is_dir():
        pytest.skip(f'{folder} is not there')
    return folder
