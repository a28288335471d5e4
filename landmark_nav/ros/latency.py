"""How old things are when they are done, for ``/diagnostics``."""

from __future__ import annotations

from collections import deque

import numpy as np

# The last ones count, some seconds of images.
_KEPT = 100
# An age beyond that is no age: the stamps come from another clock, such as a bag's.
_OTHER_CLOCK_NS = 10**10


class Latency:
    """Ages of the last results: time from an image's stamp until it was used."""

    def __init__(self) -> None:
        self._ages_ns: deque[int] = deque(maxlen=_KEPT)

    def note(self, age_ns: int) -> None:
        """Take an age; none at all if the clocks differ."""
        if abs(age_ns) < _OTHER_CLOCK_NS:
            self._ages_ns.append(age_ns)

    def values(self) -> dict[str, object]:
        """Median and 95th percentile, for diagnostics."""
        if not self._ages_ns:
            return {}
        ages_ms = 1e-6 * np.array(self._ages_ns)
        return {
            'latency_median_ms': f'{np.median(ages_ms):.0f}',
            'latency_p95_ms': f'{np.percentile(ages_ms, 95):.0f}',
        }
