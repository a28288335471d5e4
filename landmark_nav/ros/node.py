"""What all nodes of the package share: topics by name, guarded callbacks, services, health."""

# rclpy is not typed in every distribution: its Node may be Any here.
# mypy: disallow_subclassing_any=False

from __future__ import annotations

from collections.abc import Awaitable, Callable
import logging
import re
import traceback
from typing import Any, TypeVar

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from rclpy.task import Future
from std_srvs.srv import Trigger

from landmark_nav.errors import LandmarkNavError
from landmark_nav.messages import decode
from landmark_nav.ros.factory import message_class
from landmark_nav.ros.health import Health, Level, publish_health
from landmark_nav.ros.parameters import declare, misspelt
from landmark_nav.ros.topics import TOPICS, with_depth

__all__ = ['LandmarkNode']

T = TypeVar('T')

_LOG = logging.getLogger(__name__)


class LandmarkNode(Node):
    """
    Base of the package's nodes.

    Bad input in a callback (`LandmarkNavError`) drops that message, is logged once and shows in
    ``/diagnostics``; it never ends the node.

    Parameters
    ----------
    name : str
        Name of the node, also that of its executable.
    subcomponent : str
        What ``/diagnostics`` calls its work.
    **options
        Passed on to `rclpy.node.Node`, such as `context` or `parameter_overrides`.

    """

    def __init__(self, name: str, subcomponent: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.ended: Future[None] = Future()
        self.calls_that_wait = 0
        self._warned: set[str] = set()
        self._last_problem = ''
        publish_health(self, subcomponent, self._checked_health)

    def health(self) -> Health:
        """How well the node does; overridden by each."""
        raise NotImplementedError

    def end(self, failure: LandmarkNavError | None = None) -> None:
        """Have `run_node` end the process, tell a failure; callbacks under way see `ended`."""
        if self.ended.done():
            return
        if failure is None:
            self.ended.set_result(None)
        else:
            self.ended.set_exception(failure)

    def configure(self, config_class: type[T]) -> T:
        """Declare a dataclass as parameters and return it filled."""
        config = declare(self, config_class)
        for name, meant in misspelt(self).items():
            self.get_logger().warning(f'no parameter {name}: did you mean {meant}?')
        return config

    def required(self, name: str, value: str) -> str:
        """Value of a parameter that has no sensible default, such as the path of a file."""
        if not value:
            raise LandmarkNavError(
                f'parameter {name} of {self.get_name()} is not set: give it as --ros-args '
                f'-p {name}:=PATH, or in a file with --params-file'
            )
        return value

    def advertise(self, topic: str) -> Publisher[Any]:
        """Publisher of a public topic."""
        spec = TOPICS[topic]
        return self.create_publisher(message_class(spec.type_name), topic, spec.qos)

    def listen(
        self,
        topic: str,
        callback: Callable[[Any], None],
        *,
        depth: int | None = None,
        group: CallbackGroup | None = None,
    ) -> Subscription[Any]:
        """Subscribe to a public topic; `depth` replaces the length of its queue."""
        callback = self._stamped(topic, callback)
        spec = TOPICS[topic]
        return self.create_subscription(
            message_class(spec.type_name),
            topic,
            self.guarded(topic, callback),
            spec.qos if depth is None else with_depth(spec.qos, depth),
            callback_group=group,
        )

    def _stamped(self, topic: str, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        """Callback whose messages have the time of arrival where they have no stamp."""

        def stamped(message: Any) -> None:
            if decode.is_unstamped(message):
                decode.set_stamp(message, self.get_clock().now().nanoseconds)
                self.note(f'{topic} has stamps of 0: the time of arrival is taken')
            callback(message)

        return stamped

    def offer(
        self,
        service: str,
        action: Callable[[], str | Awaitable[str]],
        *,
        group: CallbackGroup | None = None,
    ) -> None:
        """
        Offer a Trigger service: `action` returns what it did or raises why it could not.

        One that waits for what other callbacks do is a coroutine in a group of its own, which
        leaves soon once the node has `ended`.
        """

        async def answer(_request: Any, response: Any) -> Any:
            try:
                done = action()
                response.message = done if isinstance(done, str) else await self._awaited(done)
                response.success = True
            except LandmarkNavError as error:
                response.message = str(error)
                _LOG.warning('%s refused: %s', service, error)
            except Exception as error:
                response.message = f'internal error, please report it: {error!r}'
                _LOG.error('%s failed:\n%s', service, traceback.format_exc())
            return response

        self.create_service(Trigger, service, answer, callback_group=group)

    async def _awaited(self, action: Awaitable[str]) -> str:
        self.calls_that_wait += 1
        try:
            return await action
        finally:
            self.calls_that_wait -= 1

    def drop(self, what: str, error: object) -> None:
        """Note that something was not used, and why."""
        self.note(f'{what} dropped: {error}')

    def note(self, text: str) -> None:
        """Tell a problem in ``/diagnostics``; the same words are logged once."""
        self._last_problem = text
        words = re.sub(r'[-+.\d]+', '#', text)
        if words not in self._warned:
            self._warned.add(words)
            _LOG.warning('%s', text)

    def guarded(self, topic: str, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        """Callback that drops bad input and notes why."""

        def guarded(message: Any) -> None:
            try:
                callback(message)
            except LandmarkNavError as error:
                self.drop(topic, error)

        return guarded

    def _checked_health(self) -> Health:
        health = self.health()
        problem, self._last_problem = self._last_problem, ''
        if not problem or problem in health.reason:
            return health
        level = Level.DEGRADED if health.level is Level.OK else health.level
        return Health(level, f'{health.reason}; {problem}', health.values)
