"""What all tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

# Nodes that tests start must not talk to other machines, however pytest was called.
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope='session')
def shared_data() -> Path:
    """Folder of data that this project did not draw, beside the repository."""
    folder = REPOSITORY.parent / 'shared' / 'data'
    if not folder.is_dir():
        pytest.skip(f'{folder} is not there')
    return folder
