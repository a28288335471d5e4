"""Every fuzz test runs under a memory limit."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from bounds import memory_limit
import pytest


@pytest.fixture(autouse=True)
def _memory() -> Iterator[None]:
    with memory_limit():
        yield


@pytest.fixture
def scratch(tmp_path: Path) -> Path:
    """Folder that the examples of one test share."""
    return tmp_path
