"""For how long a pose was contradicted of late: what stays wrong is no accident."""

from __future__ import annotations

from collections import deque

__all__ = ['Contradictions']

# So far back they count, those closer to each other than this as one; each lasts at least so long.
_WINDOW_NS, _APART_NS, _LEAST_NS = 30 * 10**9, 10**9, 250 * 10**6


class Contradictions:
    """Times in which pictures contradicted a pose."""

    def __init__(self) -> None:
        self._spans: deque[tuple[int, int]] = deque()

    def note(self, stamp_ns: int) -> float:
        """Take note of one; for how many seconds of late there were any, with it."""
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
        """How long there were any of late, as of the last."""
        return 1e-9 * sum(abs(end - begin) + _LEAST_NS for begin, end in self._spans)
