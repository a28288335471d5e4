"""
Renamed topics: for one release, who uses the former name is served as well, with a warning.

A node that has an end at the new name needs none at the former one, so no message goes both ways.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher

# Name -> that in the last release.
FORMER_NAMES = {
    'global_localization/pose': 'found_place',
    '~/landmark_visibility': '~/standing',
    '~/triplet_scores': '~/ranking',
}


class RenamedPublisher:
    """
    Publisher that also serves those who know its topic by the former name alone.

    Parameters
    ----------
    publisher, former : Publisher
        Of the new name and of the former one.
    warn : callable
        Takes a warning; it logs each once.
    """

    def __init__(
        self,
        node: Node,
        publisher: Publisher[Any],
        former: Publisher[Any],
        warn: Callable[[str], None],
    ) -> None:
        self._node, self._publisher, self._former, self._warn = node, publisher, former, warn

    def __getattr__(self, name: str) -> Any:
        """All but `publish` is that of the publisher of the new name."""
        return getattr(self._publisher, name)

    def publish(self, message: Any) -> None:
        """Publish, also by the former name if somebody knows no other."""
        self._publisher.publish(message)
        if not self._former.get_subscription_count():
            return
        former, name = self._former.topic_name, self._publisher.topic_name
        if who := _only_former(self._node.get_subscriptions_info_by_topic, former, name):
            self._former.publish(message)
            self._warn(_warning(who, 'subscribes to', former, name))


class FormerSubscription:
    """
    Callback for the former name of a topic: takes what a node publishes by that name alone.

    Parameters
    ----------
    former, name : str
        Resolved names of the topic.
    callback : callable
        Takes each message.
    warn : callable
        Takes a warning; it logs each once.
    """

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
        """Use a message."""
        ends = self._node.get_publishers_info_by_topic
        if who := _only_former(ends, self._former, self._name):
            self._warn(_warning(who, 'publishes', self._former, self._name))
            self._callback(message)


def _only_former(ends: Callable[[str], list[Any]], former: str, name: str) -> str:
    """First node, by name, that has an end at the former name and none at the new one, or ''."""
    old, new = (
        {f'{end.node_namespace.rstrip("/")}/{end.node_name}' for end in ends(topic)}
        for topic in (former, name)
    )
    return min(old - new, default='')


def _warning(who: str, does: str, former: str, name: str) -> str:
    return f'{who} {does} {former}, now called {name}: its old name ends with the next release'
