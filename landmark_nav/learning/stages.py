"""Time and memory of each stage of learning."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
import logging
import resource
import time

_LOG = logging.getLogger(__name__)


@dataclass
class StageLog:
    """
    Duration of each stage, s, and peak memory of the process at its end, megabytes.

    Each start of a stage takes an item of `steps`, such as a progress bar.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    peak_memory_mb: dict[str, float] = field(default_factory=dict)
    steps: Iterator[object] = field(default_factory=lambda: iter(()))

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Add the time of the block to a stage."""
        next(self.steps, None)
        _LOG.info('%s', stage)
        start = time.perf_counter()
        try:
            yield
        finally:
            took = time.perf_counter() - start
            self.seconds[stage] = self.seconds.get(stage, 0.0) + took
            # Linux reports kilobytes.
            self.peak_memory_mb[stage] = (
                resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
            )
