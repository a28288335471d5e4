"""How often a pose was contradicted of late: what goes wrong again and again is no accident."""

from __future__ import annotations

from collections import deque

__all__ = ['Contradictions']

# Contradictions of so many seconds count, those closer to each other as one, and so many at most.
_WINDOW_S, _APART_S, _MOST = 30.0, 1.0, 5


class Contradictions:
    """Times at which pictures contradicted a pose."""

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._begun: deque[int] = deque(maxlen=_MOST)

    def forget(self) -> None:
        """Begin anew."""
        self._last_ns = None
        self._begun.clear()

    def note(self, stamp_ns: int) -> int:
        """Take note of one; how many there were of late, with it."""
        while self._begun and abs(stamp_ns - self._begun[0]) > 1e9 * _WINDOW_S:
            self._begun.popleft()
        if self._last_ns is None or abs(stamp_ns - self._last_ns) > 1e9 * _APART_S:
            self._begun.append(stamp_ns)
        self._last_ns = stamp_ns
        return len(self._begun)
