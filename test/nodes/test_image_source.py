"""Images of whichever topic has them."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from landmark_nav.ros.image_source import ImageSource

RAW, COMPRESSED = 'camera/image_raw', 'camera/image_raw/compressed'


class Listener:
    """Keeps who listens to what, as a node; `meanwhile` is what another thread does."""

    def __init__(self) -> None:
        self.heard: dict[str, Callable[[Any], None]] = {}
        self.meanwhile: Callable[[], None] = lambda: None

    def listen(self, topic: str, callback: Callable[[Any], None], **_: Any) -> Any:
        self.heard[topic] = callback
        return SimpleNamespace(topic=topic)

    def destroy_subscription(self, subscription: Any) -> None:
        del self.heard[subscription.topic]
        self.meanwhile()


def test_the_first_that_delivers_stays() -> None:
    node: Any = Listener()
    images: list[Any] = []
    ImageSource(node, RAW, images.append)
    late = node.heard[RAW]
    node.heard[COMPRESSED]('jpeg')
    late('raw')
    assert images == ['jpeg']
    assert list(node.heard) == [COMPRESSED]


def test_a_source_that_two_threads_close_is_closed() -> None:
    node: Any = Listener()
    source = ImageSource(node, RAW, lambda _: None)
    node.meanwhile = source.close
    source.close()
    assert not node.heard
