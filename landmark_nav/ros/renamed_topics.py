"""
Renamed topics: for one release the former names work too, with a warning.

A node with an endpoint at the new name does not use the former one, so no message arrives twice.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher

# New name -> name in the last release.
FORMER_NAMES = {
    'global_localization/pose': 'found_place',
    '~/landmark_visibility': '~/standing',
    '~/triplet_scores': '~/ranking',
}


class RenamedPublisher:
    """Publisher that also serves nodes which subscribe to the former name only."""

    def __init__(
        self,
        node: Node,
        publisher: Publisher[Any],
        former: Publisher[Any],
        warn: Callable[[str], None],
    ) -> None:
        self._node, self._publisher, self._former, self._warn = node, publisher, former, warn

    def __getattr__(self, name: str) -> Any:
        """Delegate other attributes to the publisher at the new name."""
        return getattr(self._publisher, name)

    def publish(self, message: Any) -> None:
        """Publish; also at the former name if a node subscribes only there."""
        self._publisher.publish(message)
        if not self._former.get_subscription_count():
            return
        former, name = self._former.topic_name, self._publisher.topic_name
        if who := _only_former(self._node.get_subscriptions_info_by_topic, former, name):
            self._former.publish(message)
            self._warn(_warning(who, 'subscribes to', former, name))


class FormerSubscription:
    """Callback for the former name of a topic, if a node publishes only there."""

    def __init__(
        self,
        node: Node,
        former: str,
        name: str,
        callback: Callable[[Any], None],
        warn: Callable[[str], None],
    ) -> None:
        self._node, self._former, self._name = node, former, name
        self._callback, self._warn = callback, warn

    def __call__(self, message: Any) -> None:
        """Handle a message."""
        ends = self._node.get_publishers_info_by_topic
        if who := _only_former(ends, self._former, self._name):
            self._warn(_warning(who, 'publishes', self._former, self._name))
            self._callback(message)


def _only_former(ends: Callable[[str], list[Any]], former: str, name: str) -> str:
    """First node with an endpoint at the former name and none at the new one, or ''."""
    old, new = (
        {f'{end.node_namespace.rstrip("/")}/{end.node_name}' for end in ends(topic)}
        for topic in (former, name)
    )
    return min(old - new, default='')


def _warning(who: str, does: str, former: str, name: str) -> str:
    return f'{who} {does} {former}, now called {name}: its old name ends with the next release'
