"""What unit tests share."""

from __future__ import annotations

from degraded_drives import Sensed, sensed_drive
import pytest


@pytest.fixture(scope='session')
def sensed() -> list[Sensed]:
    """A drive that nothing has degraded yet."""
    return sensed_drive()
