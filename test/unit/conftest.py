"""What unit tests share."""

from __future__ import annotations

import pytest
from spoiled_drives import Sensed, sensed_drive


@pytest.fixture(scope='session')
def sensed() -> list[Sensed]:
    """A drive that nothing has spoiled yet."""
    return sensed_drive()
