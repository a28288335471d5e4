"""Messages of several topics that belong together by their stamp."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from landmark_nav.messages.decode import stamp_ns
from landmark_nav.ros.node import LandmarkNode

__all__ = ['listen_together']

# Sets that may be incomplete at once; the oldest is forgotten first.
_MAX_WAITING = 8


def listen_together(
    node: LandmarkNode, topics: Sequence[str], callback: Callable[..., None]
) -> None:
    """Call back with one message of each topic, in their order, once all of a stamp are there."""
    waiting: dict[int, dict[str, Any]] = {}

    def take(topic: str, message: Any) -> None:
        stamp = stamp_ns(message.header)
        waiting.setdefault(stamp, {})[topic] = message
        if len(waiting[stamp]) == len(topics):
            found = waiting.pop(stamp)
            callback(*(found[name] for name in topics))
        elif len(waiting) > _MAX_WAITING:
            del waiting[min(waiting)]

    for topic in topics:
        node.listen(topic, partial(take, topic))
