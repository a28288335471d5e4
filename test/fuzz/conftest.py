"""Every fuzz test runs under a memory limit."""

from bounds import memory_limit
import pytest


@pytest.fixture(autouse=True)
def _memory():
    with memory_limit():
        yield


@pytest.fixture
def scratch(tmp_path):
    """Folder that the examples of one test share."""
    return tmp_path
