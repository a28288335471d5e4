"""Latency of results, for ``/diagnostics``."""

from __future__ import annotations

from collections import deque

import numpy as np

# Number of recent latencies: some seconds of images.
_KEPT = 100
# Beyond this, the stamps are of another clock, such as that of a bag.
_OTHER_CLOCK_NS = 10**10


class Latency:
    """Latencies of the recent results: time from the stamp of an image until its use."""

    def __init__(self) -> None:
        self._ages_ns: deque[int] = deque(maxlen=_KEPT)

    def note(self, age_ns: int) -> None:
        """Add a latency; it is ignored if the clocks differ."""
        if abs(age_ns) < _OTHER_CLOCK_NS:
            self._ages_ns.append(age_ns)

    def values(self) -> dict[str, object]:
        """Median and 95th percentile, for the values of diagnostics."""
        if not self._ages_ns:
            return {}
        ages_ms = 1e-6 * np.array(self._ages_ns)
        return {
            'latency_median_ms': f'{np.median(ages_ms):.0f}',
            'latency_p95_ms': f'{np.percentile(ages_ms, 95):.0f}',
        }
