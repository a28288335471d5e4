"""Former names of topics, which serve nodes that do not know the new ones, with a warning."""

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


def publish_both(
    node: Node, publisher: Publisher[Any], former: Publisher[Any], warn: Callable[[str], None]
) -> None:
    """Make `publisher` publish at the former name, too, if a node subscribes only there."""
    publish, old, new = publisher.publish, former.topic_name, publisher.topic_name

    def publish_at_both(message: Any) -> None:
        publish(message)
        if former.get_subscription_count() and (
            who := _only_former(node.get_subscriptions_info_by_topic, old, new)
        ):
            former.publish(message)
            warn(_warning(who, 'subscribes to', old, new))

    publisher.publish = publish_at_both  # type: ignore[method-assign, assignment]


def hear_former(
    node: Node, topic: str, callback: Callable[[Any], None], warn: Callable[[str], None]
) -> Callable[[Any], None]:
    """Return the callback for the former name of a topic: for nodes that publish only there."""
    old, new = map(node.resolve_topic_name, (FORMER_NAMES[topic], topic))

    def take(message: Any) -> None:
        if who := _only_former(node.get_publishers_info_by_topic, old, new):
            warn(_warning(who, 'publishes', old, new))
            callback(message)

    return take


def _only_former(ends: Callable[[str], list[Any]], former: str, name: str) -> str:
    """First node with an endpoint at the former name and none at the new one, or ''."""
    old, new = (
        {f'{end.node_namespace.rstrip("/")}/{end.node_name}' for end in ends(topic)}
        for topic in (former, name)
    )
    return min(old - new, default='')


def _warning(who: str, does: str, former: str, name: str) -> str:
    return f'{who} {does} {former}, now called {name}: its old name ends with the next release'
