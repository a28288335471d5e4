"""Bounds that every input keeps: 10 s, 1 GB, no traceback, one line."""

from contextlib import contextmanager
import os
from pathlib import Path
import resource
import signal
from typing import TypeVar

from hypothesis import HealthCheck, settings

from landmark_nav.errors import LandmarkNavError

__all__ = ['FUZZ', 'enter', 'memory_limit', 'time_limit']

MAX_S, MAX_BYTES = 10, 1 << 30
T = TypeVar('T')

# Few in CI, the same from run to run; `make fuzz N=10000` draws more, and others each time.
FUZZ = settings(
    max_examples=int(os.environ.get('FUZZ_N', '25')), derandomize='FUZZ_N' not in os.environ,
    database=None, deadline=None, print_blob=True, suppress_health_check=list(HealthCheck),
)  # fmt: skip


@contextmanager
def memory_limit():
    """Let the process grow by 1 GB: what asks for more fails instead of filling the machine."""
    pages = int(Path('/proc/self/statm').read_text(encoding='ascii').split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    limit = pages * resource.getpagesize() + MAX_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


@contextmanager
def time_limit():
    """Raise `TimeoutError` where an input takes too long."""

    def ring(*_):
        raise TimeoutError(f'an input took over {MAX_S} s')

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(MAX_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def enter(read):
    """Call what reads an input: it returns, or refuses in one line; anything else fails."""
    with time_limit():
        try:
            return read()
        except LandmarkNavError as error:
            line = str(error)
            assert line.isprintable(), line[:300]
            return None
