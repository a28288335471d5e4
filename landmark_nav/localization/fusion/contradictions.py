"""For how long images have contradicted the pose lately."""

from __future__ import annotations

from collections import deque

__all__ = ['Contradictions']

# They count for so long; those closer together than the second time are one, and each lasts at
# least the third.
_WINDOW_NS, _APART_NS, _LEAST_NS = 30 * 10**9, 10**9, 250 * 10**6


class Contradictions:
    """Times in which images contradicted a pose."""

    def __init__(self) -> None:
        self._spans: deque[tuple[int, int]] = deque()

    def note(self, stamp_ns: int) -> float:
        """Take note of a contradiction; return `seconds`."""
        begin, end = self._spans[-1] if self._spans else (stamp_ns, stamp_ns)
        if self._spans and abs(stamp_ns - end) <= _APART_NS:
            self._spans[-1] = (begin, stamp_ns)
        else:
            self._spans.append((stamp_ns, stamp_ns))
        while abs(stamp_ns - self._spans[0][1]) > _WINDOW_NS:
            self._spans.popleft()
        return self.seconds

    @property
    def seconds(self) -> float:
        """Total time of the contradictions, up to the last one."""
        return 1e-9 * sum(abs(end - begin) + _LEAST_NS for begin, end in self._spans)
