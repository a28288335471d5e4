"""Base classes of the nodes: life cycle, topics by name, guarded callbacks, services."""

from __future__ import annotations

from collections import Counter
from collections.abc import Awaitable, Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial
import logging
import re
import time
import traceback
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.callback_groups import (
    CallbackGroup,
    MutuallyExclusiveCallbackGroup,
    ReentrantCallbackGroup,
)
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSPolicyKind
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.task import Future
from rclpy.timer import Timer
from std_srvs.srv import Trigger

from landmark_nav.errors import LandmarkNavError, one_line
from landmark_nav.messages import decode
from landmark_nav.parameters import Config, parameter
from landmark_nav.ros import topics
from landmark_nav.ros.health import Health, Level, steady_clock
from landmark_nav.ros.inputs import Inputs, IrrelevantError
from landmark_nav.ros.parameters import declare

_KINDS = ('publisher', 'subscription', 'service', 'client', 'timer')


@dataclass(frozen=True)
class Startup(Config):
    """Parameters of every node."""

    autostart: bool = parameter(
        True, 'configure and activate as the node starts; false: a lifecycle manager does it'
    )


class ManagedNode(LifecycleNodeMixin, Node):
    """
    A node with the states of `rclpy.lifecycle`: unconfigured, inactive, active, finalized.

    Configuration reads parameters and files and creates publishers, subscriptions, services and
    timers (`set_up`); cleanup destroys these. An inactive node keeps its state, drops messages
    except latched ones, and refuses its services. There is no bond: rclpy does not support it.
    """

    def __init__(self, name: str, **options: Any) -> None:
        self._foundation: list[tuple[str, Any]] = []
        self._closing: list[Callable[[], None]] = []
        self._failure: Exception | None = None
        self._destroyed = False
        # Service calls under way, and those among them that wait for other callbacks.
        self._calls = self.calls_that_wait = 0
        Node.__init__(self, name, **options)
        # An own group, so that the manager is answered while callbacks run.
        LifecycleNodeMixin.__init__(self, callback_group=MutuallyExclusiveCallbackGroup())

    def set_up(self) -> None:
        """Create what the node works with; overridden by each node."""

    def close_with(self, action: Callable[[], None]) -> None:
        """Register an action of cleanup, such as the end of a thread, before topics end."""
        self._closing.append(action)

    @property
    def state(self) -> str:
        """Label of the lifecycle state."""
        # Reading the state of a destroyed state machine crashes the process.
        return 'finalized' if self._destroyed else str(self._state_machine.current_state[1])

    @property
    def is_active(self) -> bool:
        """Whether the node handles messages."""
        return self.state == 'active'

    def start(self) -> None:
        """
        Configure and activate, unless ``autostart`` is false; raises exceptions of `set_up`.

        What the node has created before this call works in all states, and cleanup keeps it.
        """
        self._foundation = self._made()
        if declare(self, Startup(), ('autostart',)).autostart:
            for step in (self.trigger_configure, self.trigger_activate):
                if step() != TransitionCallbackReturn.SUCCESS:
                    raise self._failure or LandmarkNavError(f'{self.get_name()} does not start')

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Set up, or stay unconfigured; the reason is logged."""
        try:
            self.set_up()
        except Exception as error:
            self._failure = error
            self._take_down()
            if self.executor is not None:
                # Without an executor, `start` raises the error.
                self.get_logger().error(one_line(f'not configured: {error}'))
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take down, unless a service call is running."""
        if self._calls:
            self.get_logger().warning('not cleaned up: a service is at work')
            return TransitionCallbackReturn.FAILURE
        self._take_down()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take down for good; the process continues until it is ended."""
        self._take_down()
        return TransitionCallbackReturn.SUCCESS

    on_error = on_shutdown

    def destroy_node(self) -> None:
        """Close what the node created, then destroy the node."""
        self._close()
        self._destroyed = True
        super().destroy_node()
        # Otherwise the node stays in the graph until garbage collection.
        self._state_machine.destroy_when_not_in_use()

    def _made(self) -> list[tuple[str, Any]]:
        return [(kind, one) for kind in _KINDS for one in getattr(self, f'{kind}s')]

    def _take_down(self) -> None:
        self._close()
        for kind, one in self._made():
            if (kind, one) not in self._foundation:
                getattr(self, f'destroy_{kind}')(one)

    def _close(self) -> None:
        while self._closing:
            self._closing.pop()()


# Suffixes of parameters with names of files.
_FILES = ('_file', '_folder', 'bag')
# Topics that every node publishes.
_OF_RCLPY = ('/rosout', '/parameter_events', '/diagnostics')
# Largest number of different warnings of a node.
_MOST_LOGGED = 200
# Largest number of incomplete sets of messages; the first that arrived is dropped, whatever its
# stamp.
_MAX_WAITING = 8

# Over a lossy link, only reliable transport delivers large messages.
_OVERRIDABLE = QoSOverridingOptions((QoSPolicyKind.RELIABILITY,))


class LandmarkNode(ManagedNode):
    """
    Base of the package's nodes; `subcomponent` names its task in ``/diagnostics``.

    An error in a callback drops the message, is logged once and is counted in ``/diagnostics``; it
    does not end the node. Errors are bad input (`LandmarkNavError`), or bugs, of which the
    traceback is logged.
    """

    def __init__(self, name: str, subcomponent: str, **options: Any) -> None:
        # Before super().__init__: rclpy subscribes to /clock there.
        self.inputs = Inputs(self)
        self._logged: set[str] = set()
        self._dropped: Counter[str] = Counter()
        self._last_problem = '', ''
        self.internal_errors = 0
        self._awaits = False
        super().__init__(name, **options)
        self._log = logging.getLogger(f'{__name__}.{self.get_name()}')
        self.ended: Future[None] = Future()
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', topics.RELIABLE)
        # Not `LandmarkNode.create_timer`: diagnostics are published in every lifecycle state, by a
        # clock that runs even if ``/clock`` has stopped.
        Node.create_timer(
            self,
            1.0,
            partial(self._publish_health, subcomponent),
            callback_group=ReentrantCallbackGroup(),
            clock=steady_clock(),
        )
        self.start()

    def health(self) -> Health:
        """State of the node; overridden by each node."""
        raise NotImplementedError

    def end(self, failure: LandmarkNavError | None = None) -> None:
        """Make `run_node` end the process; running callbacks see `ended`."""
        if failure is not None and not self.ended.done():
            self.ended.set_exception(failure)
        elif not self.ended.done():
            self.ended.set_result(None)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Log inputs and outputs of the node, if it is in an executor already."""
        if self.executor is not None:
            self.announce()
        return super().on_activate(state)

    def announce(self) -> None:
        """Log that the node is ready: its topics, services and files, and what it waits for."""
        awaited = [one.name for one in self.inputs.awaited()]
        own = {*_OF_RCLPY, *map(self.resolve_topic_name, topics.FORMER_NAMES.values())}
        ends = {
            'takes': [one.name for one in self.inputs if one.name not in own],
            'gives': [one.topic_name for one in self.publishers if one.topic_name not in own],
            'serves': [one.service_name for one in self.services if '/' not in one.srv_name],
            'files': [
                str(parameter.value)
                for name, parameter in self.get_parameters_by_prefix('').items()
                if name.endswith(_FILES) and parameter.value
            ],
            'waits for': awaited,
        }
        words = [f'{what} {", ".join(names)}' for what, names in ends.items() if names]
        self._log.info('ready: %s', '; '.join(words))
        self._awaits = bool(awaited)

    def required(self, name: str, value: str) -> str:
        """Value of a parameter without a default, such as the path of a file."""
        if not value:
            raise LandmarkNavError(
                f'parameter {name} of {self.get_name()} is not set: give it as --ros-args '
                f'-p {name}:=PATH, or in a file with --params-file'
            )
        return value

    def advertise(self, topic: str) -> Publisher[Any]:
        """Create the publisher of a public topic; ``qos_overrides`` may change its reliability."""
        publisher: Publisher[Any] = self._public(self.create_publisher, topic)
        return publisher

    def listen(
        self,
        topic: str,
        callback: Callable[[Any], None],
        *,
        depth: int | None = None,
        group: CallbackGroup | None = None,
        raw: bool = False,
    ) -> Subscription[Any]:
        """
        Subscribe to a public topic; `depth` replaces the length of its queue.

        `raw` messages are serialised. Others without a stamp get the time of arrival. The
        parameters ``qos_overrides`` of ROS may change the reliability.
        """
        # Parts of maps and panoramas are joined by their stamps, also by those of 0.
        is_latched = topics.TOPICS[topic].is_latched
        take = callback if is_latched else self._stamped(topic, callback)
        listen = partial(self._public, self.create_subscription, topic, take)
        subscription: Subscription[Any] = listen(depth=depth, callback_group=group, raw=raw)
        return subscription

    def _public(
        self, create: Any, topic: str, *callback: Any, depth: int | None = None, **options: Any
    ) -> Any:
        """Create a publisher or a subscription of a public topic."""
        spec = topics.TOPICS[topic]
        kind, qos = topics.message_class(spec.type_name), copy(spec.qos)
        qos.depth = qos.depth if depth is None else depth
        try:
            return create(
                kind, topic, *callback, qos, qos_overriding_options=_OVERRIDABLE, **options
            )
        except (RuntimeError, InvalidParameterTypeException) as error:
            raise LandmarkNavError(
                one_line(
                    f'qos_overrides of {topic}: give reliable or best_effort as reliability: '
                    f'{error}'
                )
            ) from error

    def _stamped(self, topic: str, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        def stamped(message: Any) -> None:
            if decode.is_unstamped(message):
                decode.set_stamp(message, self.get_clock().now().nanoseconds)
                self.note(f'{topic} has stamps of 0: the time of arrival is taken')
            callback(message)

        return stamped

    def listen_together(self, names: Sequence[str], callback: Callable[..., None]) -> None:
        """Call back with one message of each topic, in order, when all of a stamp arrived."""
        waiting: dict[int, dict[str, Any]] = {}

        def take(topic: str, message: Any) -> None:
            stamp = decode.stamp_ns(message.header)
            waiting.setdefault(stamp, {})[topic] = message
            if len(waiting[stamp]) == len(names):
                found = waiting.pop(stamp)
                callback(*(found[name] for name in names))
            elif len(waiting) > _MAX_WAITING:
                del waiting[next(iter(waiting))]

        for topic in names:
            self.listen(topic, partial(take, topic))

    def create_subscription(  # type: ignore[override]
        self, msg_type: Any, topic: str, callback: Callable[[Any], None], *args: Any, **given: Any
    ) -> Subscription[Any]:
        """Subscribe as in rclpy; the callback is guarded and registered in `inputs`."""
        # `inputs` reports publishers of another QoS; events would double what every wait costs.
        events = SubscriptionEventCallbacks(use_default_callbacks=False)
        given.setdefault('event_callbacks', events)
        source = self.inputs.expect(topic)
        comes_once = topic in topics.TOPICS and topics.TOPICS[topic].is_latched

        def use(message: Any) -> None:
            try:
                callback(message)
                source.used_s, source.irrelevant = time.monotonic(), ''
            except IrrelevantError as why:
                source.irrelevant = str(why)

        guarded = self.guarded(topic, use)

        def take(message: Any, info: Mapping[str, Any]) -> None:
            source.arrived(message, info)
            if self.is_active or comes_once:
                guarded(message)

        if former := topics.FORMER_NAMES.get(topic):
            late = self.guarded(former, topics.hear_former(self, topic, callback, self._warn_once))
            super().create_subscription(msg_type, former, late, *args, **given)
        return super().create_subscription(msg_type, topic, take, *args, **given)

    def create_publisher(
        self, msg_type: Any, topic: str, *args: Any, **given: Any
    ) -> Publisher[Any]:
        """Create a publisher as in rclpy, with the former name of a renamed topic."""
        events = PublisherEventCallbacks(use_default_callbacks=False)
        given.setdefault('event_callbacks', events)
        made = super().create_publisher(msg_type, topic, *args, **given)
        if topic in topics.FORMER_NAMES:
            former = super().create_publisher(msg_type, topics.FORMER_NAMES[topic], *args, **given)
            topics.publish_both(self, made, former, self._warn_once)
        return made

    def create_timer(  # type: ignore[override]
        self, timer_period_sec: float, callback: Callable[[], None], *args: Any, **given: Any
    ) -> Timer:
        """Create a timer as in rclpy; the callback is guarded and runs in an active node only."""
        guarded = self.guarded(getattr(callback, '__name__', 'timer'), callback)

        def tick() -> None:
            if self.is_active:
                guarded()

        return super().create_timer(timer_period_sec, tick, *args, **given)

    def offer(
        self,
        service: str,
        action: Callable[[], str | Awaitable[str]],
        *,
        group: CallbackGroup | None = None,
    ) -> None:
        """
        Offer a Trigger service: `action` returns the message, or raises `LandmarkNavError`.

        An action that waits for other callbacks is a coroutine in a callback group of its own; it
        must return soon after the node has `ended`.
        """

        async def answer(_request: Any, response: Any) -> Any:
            self._calls += 1
            try:
                if not self.is_active:
                    raise LandmarkNavError(f'{self.get_name()} is {self.state}: activate it')
                done = action()
                if not isinstance(done, str):
                    self.calls_that_wait += 1
                    try:
                        done = await done
                    finally:
                        self.calls_that_wait -= 1
                response.message, response.success = done, True
            except LandmarkNavError as error:
                response.message = str(error)
                self._log.warning('%s refused: %s', service, error)
            except Exception as error:
                response.message = self.fault(service, error)
            finally:
                self._calls -= 1
            return response

        self.create_service(Trigger, service, answer, callback_group=group)

    def drop(self, what: str, error: object) -> None:
        """Report that something, such as a message of a topic, was dropped, and why."""
        self._dropped[what] += 1
        origin = self.inputs.origin(what)
        self.note(f'{what}{origin} dropped: {error}', f'{what} dropped: {error}')

    def note(self, text: str, essence: str = '') -> None:
        """
        Report a problem in the next ``/diagnostics``; each text is logged once.

        Diagnostics omit it if the reason of the node contains the `essence`.
        """
        self._last_problem = one_line(text), essence or text
        self._warn_once(self._last_problem[0])

    def fault(self, what: str, error: Exception) -> str:
        """Text for a bug; the traceback is logged once."""
        self.internal_errors += 1
        where = ''.join(traceback.format_tb(error.__traceback__)[-1:])
        if self._is_new(where):
            self._log.error('%s failed:\n%s', what, ''.join(traceback.format_exception(error)))
        return one_line(f'internal error, please report it: {error!r}')

    def guarded(self, what: str, callback: Callable[..., None]) -> Callable[..., None]:
        """Wrap a callback: errors are reported, and do not end the node."""

        def guarded(*given: Any) -> None:
            try:
                callback(*given)
            except LandmarkNavError as error:
                self.drop(what, error)
            except Exception as error:
                self.drop(what, self.fault(what, error))

        return guarded

    def _warn_once(self, words: str) -> None:
        if self._is_new(re.sub(r'[-+.\d]+', '#', words)):
            self._log.warning('%s', words)

    def _is_new(self, words: str) -> bool:
        """Whether a text was not logged before; False after too many different texts."""
        if words in self._logged or len(self._logged) >= _MOST_LOGGED:
            return False
        self._logged.add(words)
        return True

    def _publish_health(self, subcomponent: str) -> None:
        health = self._checked_health()
        status = DiagnosticStatus(
            level=health.level.value,
            name=f'{self.get_name()}: {subcomponent}',
            message=health.reason,
            hardware_id=self.get_fully_qualified_name(),
            values=[
                KeyValue(key=key, value=f'{value:.6g}' if isinstance(value, float) else str(value))
                for key, value in health.values.items()
            ],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def _checked_health(self) -> Health:
        """State of the node with the problems of its inputs."""
        if not self.is_active:
            return Health(Level.DEGRADED, f'{self.state}: a lifecycle manager activates it')
        try:
            health = self.health()
        except Exception as error:
            health = Health(Level.DEGRADED, self.fault('health', error))
        if self._awaits and not any(one.waits() for one in self.inputs.awaited()):
            self._awaits = False
            self._log.info('has all that it waited for')
        problems = self.inputs.problems()
        for words in problems:
            self._warn_once(words)
        problem, essence = self._last_problem
        if problem and essence not in health.reason:
            problems.append(problem)
        self._last_problem = '', ''
        level = Level.DEGRADED if problems and health.level is Level.OK else health.level
        waits = self.inputs.waits() if level is not Level.OK else ''
        others = [words for words in (*problems, waits) if words and words not in health.reason]
        reason = '; '.join([*filter(None, [health.reason]), *others])
        dropped = {f'dropped: {what}': count for what, count in self._dropped.items()}
        return Health(level, reason, {**health.values, **dropped, **self.inputs.values()})
