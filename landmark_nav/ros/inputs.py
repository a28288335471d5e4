"""State of the inputs of a node, and texts about their problems for diagnostics."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from difflib import SequenceMatcher
import math
import time
from typing import Any

from rclpy.node import Node
from rclpy.qos import qos_check_compatible, QoSCompatibility

from landmark_nav.errors import LandmarkNavError
from landmark_nav.ros.topics import SENSOR_DATA, Topic, TOPICS

# Time without messages after which a stream counts as silent.
_SILENCE_S = 2.0
# If messages of two publishers alternate within this time, both are active.
_ALTERNATION_S = 5.0
# Largest difference of stamps of two streams by the same clock, even on a slow machine; largest
# rate at which a bag is played.
_CLOCK_S, _FASTEST_PLAY = 5.0, 20.0
# Type of pan and tilt; the ROS wheels have no tf2_msgs.
_JOINTS = 'sensor_msgs/msg/JointState'
# Name of a node while the graph knows its publisher alone, by rmw; and what is shown then.
_UNNAMED, _UNKNOWN = '_NODE_NAME_UNKNOWN_', 'an unknown node'
# Largest number of names in a text.
_LISTED = 3
# Topics, besides streams, without which a node that subscribes to them cannot work.
_AWAITED = ('landmarks', 'odometry/fused')
# Topic of the time with `use_sim_time`.
_CLOCK = '/clock'


class IrrelevantError(LandmarkNavError):
    """A valid message without data that the node uses; the text says what it contains."""


class Input:
    """
    One input of a node: a topic, or several topics with the same data in different forms.

    `name` is the resolved name of the first topic. An input that `is_stream` is sensor data, which
    arrive continuously; without one that `is_awaited` the node cannot work.
    """

    def __init__(self, node: Node, topics: Mapping[str, Topic | None]) -> None:
        self._node = node
        self._topics = {node.resolve_topic_name(name): spec for name, spec in topics.items()}
        self.name = next(iter(self._topics))
        self.is_stream = any(spec and spec.qos is SENSOR_DATA for spec in self._topics.values())
        self.is_awaited = self.is_stream or any(name in _AWAITED for name in topics)
        # Why the last message was of no use; when the last one was used.
        self.irrelevant, self.used_s = '', -math.inf
        self.arrived_s = -math.inf
        self._count = self._reported = 0
        self._reported_s = time.monotonic()
        self._stamp_ns = 0
        self._last_source = b''
        self._names: dict[bytes, str] = {}
        self._changes: deque[tuple[float, bytes]] = deque(maxlen=8)

    def arrived(self, message: Any, info: Mapping[str, Any]) -> None:
        """Register a message before it is used."""
        self._count += 1
        self.arrived_s = time.monotonic()
        source = bytes((info.get('publisher_gid') or {}).get('data', b''))
        if source != self._last_source:
            self._last_source = source
            self._changes.append((self.arrived_s, source))
        header = getattr(message, 'header', None)
        if self.is_stream and header is not None:
            self._stamp_ns = int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)

    @property
    def publisher(self) -> str:
        """Name of the node that published the last message; '' before the first."""
        return self._name_of(self._last_source) if self._count else ''

    def moment(self) -> tuple[float, float] | None:
        """Arrival and stamp of the newest message, s; None if the stream is silent."""
        known = self._stamp_ns and self._silent_s() < _SILENCE_S
        return (self.arrived_s, 1e-9 * self._stamp_ns) if known else None

    @property
    def why_silent(self) -> str:
        """Text: why nothing arrives; '' while messages arrive."""
        if not self._count:
            return self._why_none()
        if self.is_stream and self._silent_s() >= _SILENCE_S and self.is_open:
            return f'silent for {self._silent_s():.1f} s'
        return ''

    def waits(self) -> str:
        """Text: the topic, and why nothing arrives; '' while messages arrive."""
        return f'{self.name} ({why})' if (why := self.why_silent) else ''

    def problems(self) -> Iterator[str]:
        """Yield texts about problems of the messages that arrive."""
        now_s = time.monotonic()
        is_unused = now_s - self.used_s >= _SILENCE_S
        if self.irrelevant and is_unused and self._silent_s() < _SILENCE_S:
            yield f'{self.name}: {self.irrelevant}'
        names = self._sources(now_s) if self.is_stream else []
        if len(names) > 1:
            yield f'{self.name} comes from two publishers, {" and ".join(names)}: stop one of them'

    def _sources(self, now_s: float) -> list[str]:
        """Active publishers; several only if they alternate, not after a change of publisher."""
        if not self._last_source:
            # Not every middleware gives the publisher of a message: all known ones count.
            return sorted(set(map(_full_name, self._endpoints())))
        recent = [source for at_s, source in self._changes if now_s - at_s < _ALTERNATION_S]
        alternate = len(set(recent)) < len(recent)
        return sorted(set(map(self._name_of, recent))) if alternate else []

    def report(self) -> str:
        """Short text of the state, for the values of diagnostics."""
        now_s = time.monotonic()
        rate_hz = (self._count - self._reported) / max(now_s - self._reported_s, 1e-3)
        self._reported, self._reported_s = self._count, now_s
        if why := self.why_silent:
            return f'waits: {why}'
        if not self.is_open:
            return 'not listened to now'
        amount = f'{rate_hz:.1f} Hz' if self.is_stream else f'{self._count} messages'
        return f'{amount} from {self.publisher}'

    def _silent_s(self) -> float:
        return time.monotonic() - self.arrived_s

    @property
    def is_open(self) -> bool:
        """Whether the node has a subscription now."""
        return any(sub.topic_name in self._topics for sub in self._node.subscriptions)

    def _why_none(self) -> str:
        """Text: why nothing has arrived yet."""
        ends = self._endpoints()
        if not ends:
            alike = _listed(self._alike()) if self.is_stream else ''
            joints = any(spec and spec.type_name == _JOINTS for spec in self._topics.values())
            if not alike and joints and self._node.count_publishers('/tf'):
                return 'nobody publishes it; angles in /tf are not read: publish a JointState'
            return 'nobody publishes it' + (f'; of its type there is {alike}' if alike else '')
        # QoS of the subscriptions, which `qos_overrides` may have changed.
        asked = {sub.topic_name: sub.qos_profile for sub in self._node.subscriptions}
        for topic, spec in self._topics.items():
            for one in self._node.get_publishers_info_by_topic(topic):
                if spec is not None and one.topic_type != spec.type_name:
                    who = _full_name(one)
                    return f'{who} publishes it as {one.topic_type}, not {spec.type_name}'
                offered, wanted = one.qos_profile, asked.get(topic, spec and spec.qos)
                if wanted and qos_check_compatible(offered, wanted)[0] == QoSCompatibility.ERROR:
                    return f'the quality of service that {_full_name(one)} offers does not suffice'
        return f'nothing came from {_listed(map(_full_name, ends))} yet' if self.is_open else ''

    def _alike(self) -> list[str]:
        """Other published topics of its type, by similarity of their names."""
        types = {spec.type_name for spec in self._topics.values() if spec is not None}
        public = {self._node.resolve_topic_name(name) for name in TOPICS}
        there = [
            topic
            for topic, found in self._node.get_topic_names_and_types()
            if types & set(found) and topic not in public
        ]
        there.sort(key=lambda topic: -SequenceMatcher(None, topic, self.name).ratio())
        return [topic for topic in there if self._node.count_publishers(topic)]

    def _name_of(self, source: bytes) -> str:
        """Full name of the node of a publisher."""
        if source not in self._names:
            self._names |= {
                bytes(one.endpoint_gid): name
                for one in self._endpoints()
                if (name := _full_name(one)) != _UNKNOWN
            }
        unknown = _UNKNOWN if source else _listed(self._names.values())
        return self._names.get(source, unknown)

    def _endpoints(self) -> list[Any]:
        """All publishers."""
        return [
            one for topic in self._topics for one in self._node.get_publishers_info_by_topic(topic)
        ]


class Inputs:
    """All inputs of a node, with checks of clocks and of a second node of the same name."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._by_topic: dict[str, Input] = {}
        self._twin_looks = 0

    def expect(self, *names: str) -> Input:
        """Register and return the input of these topics, which hold the same data."""
        resolved = [self._node.resolve_topic_name(name) for name in names]
        known = next((self._by_topic[k] for k in resolved if k in self._by_topic), None)
        if known is None:
            known = Input(self._node, {name: TOPICS.get(name) for name in names})
            self._by_topic |= dict.fromkeys(resolved, known)
        return known

    def origin(self, topic: str) -> str:
        """`` from NODE``: publisher of the last message of a topic; '' if it is unknown."""
        known = self._by_topic.get(self._node.resolve_topic_name(topic))
        return f' from {name}' if known is not None and (name := known.publisher) else ''

    def __iter__(self) -> Iterator[Input]:
        """Iterate over the inputs."""
        return iter(dict.fromkeys(self._by_topic.values()))

    def why_none(self, topic: str) -> str:
        """``: REASON`` why nothing useful arrives on a topic; '' if it is unknown."""
        known = self.expect(topic)
        why = next(known.problems(), '') or known.waits()
        return f': {why}' if why else ''

    def waits(self) -> str:
        """Text: the streams that do not arrive; '' if all do."""
        streams = [one for one in self if one.is_stream and one.name != _CLOCK]
        waits = [words for one in streams if (words := one.waits())]
        return f'waits for {", ".join(waits)}' if waits else ''

    def awaited(self) -> list[Input]:
        """Inputs without which the node cannot work."""
        return [one for one in self if one.is_awaited and one.name != _CLOCK]

    def values(self) -> dict[str, str]:
        """State of each input, by its resolved name."""
        return {one.name: one.report() for one in self}

    def problems(self) -> list[str]:
        """Texts of problems with what to do; called once a second."""
        found = [words for one in self for words in one.problems()]
        return [*found, *self._clocks(), *self._twins()]

    def _clocks(self) -> Iterator[str]:
        """Yield texts: a missing clock, and streams with stamps of another clock than most."""
        clock = self._by_topic.get(_CLOCK)
        if clock is not None and clock.is_open and clock.arrived_s < 0.0:
            yield f'use_sim_time is set and no time comes on {clock.waits()}'
        moments = {one.name: moment for one in self if (moment := one.moment()) is not None}
        # Between two streams, the clock of the node decides.
        own = time.monotonic(), 1e-9 * self._node.get_clock().now().nanoseconds
        voters = [*moments.values(), own]

        def votes(name: str) -> int:
            return sum(_same_clock(moments[name], voter) for voter in voters)

        right = max(moments, key=votes, default='')
        for name, (arrived_s, stamp_s) in moments.items():
            if not _same_clock(moments[name], moments[right]):
                off_s = stamp_s - moments[right][1] - (arrived_s - moments[right][0])
                yield (
                    f'{name} is stamped {off_s:+.1f} s off {right}: have their publishers take '
                    'one clock (use_sim_time, chrony)'
                )

    def _twins(self) -> Iterator[str]:
        """Yield a text about another node of the same name, if two checks in a row find it."""
        own = self._node.get_name(), self._node.get_namespace()
        several = self._node.get_node_names_and_namespaces().count(own) > 1
        self._twin_looks = self._twin_looks + 1 if several else 0
        if self._twin_looks > 1:
            name = self._node.get_fully_qualified_name()
            yield f'two nodes are named {name}: end one, or rename it (-r __node:=NAME)'


def _same_clock(one: tuple[float, float], other: tuple[float, float]) -> bool:
    """Whether two pairs of arrival and stamp, s, can be by the same clock."""
    apart_s = abs(one[0] - other[0])
    return abs(one[1] - other[1]) < _CLOCK_S + _FASTEST_PLAY * apart_s


def _full_name(endpoint: Any) -> str:
    if endpoint.node_name == _UNNAMED:
        return _UNKNOWN
    return f'{endpoint.node_namespace.rstrip("/")}/{endpoint.node_name}'


def _listed(names: Any) -> str:
    """Text: the first distinct names, and how many more there are."""
    unique = list(dict.fromkeys(names))
    more = f' and {len(unique) - _LISTED} more' if len(unique) > _LISTED else ''
    return ', '.join(unique[:_LISTED]) + more
