"""Subscription to images, raw or compressed, whichever is published."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.subscription import Subscription

from landmark_nav.ros.node import LandmarkNode


def image_topics(topic: str, transport: str) -> list[str]:
    """Topics with the images of `topic` by a transport; both for ``auto``."""
    topics = {'raw': topic, 'compressed': f'{topic}/compressed'}
    return [topics[transport]] if transport in topics else list(topics.values())


class ImageSource:
    """
    Subscription to the images of `topic` or of ``topic/compressed``.

    With the transport ``auto`` both are subscribed. Raw images are used until the first compressed
    one; then the raw subscription ends: that saves bandwidth, and common middleware loses large
    messages. A repeated image is handled once.
    """

    def __init__(
        self,
        node: LandmarkNode,
        topic: str,
        callback: Callable[[Any], None],
        transport: str = 'auto',
        *,
        depth: int | None = None,
    ) -> None:
        self._node = node
        self._last: Any = None
        self._raw = topic
        self._subscriptions: dict[str, Subscription[Any]] = {}
        for name in image_topics(topic, transport):
            self._subscriptions[name] = node.listen(name, self._only(name, callback), depth=depth)

    def close(self) -> None:
        """End the subscription."""
        self._keep(None)

    def _only(self, name: str, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        def take(message: Any) -> None:
            if name in self._subscriptions and message != self._last:
                if name != self._raw:
                    self._keep(name)
                self._last = message
                callback(message)

        return take

    def _keep(self, name: str | None) -> None:
        for other in list(self._subscriptions):
            # Another thread may close it at the same time.
            if other != name and (ended := self._subscriptions.pop(other, None)) is not None:
                self._node.destroy_subscription(ended)
