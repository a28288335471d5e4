"""Lifecycle nodes, which a lifecycle manager such as that of Nav2 can control."""

# rclpy is not typed in every distribution: its Node may be Any here.
# mypy: disallow_subclassing_any=False

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node

from landmark_nav.errors import LandmarkNavError, one_line
from landmark_nav.parameters import Config, parameter
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
        self._foundation: dict[str, list[Any]] = {}
        self._closing: list[Callable[[], None]] = []
        self._failure: Exception | None = None
        self._destroyed = False
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

    @property
    def is_idle(self) -> bool:
        """Whether cleanup is possible now; overridden."""
        return True

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
        if not self.is_idle:
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

    def _made(self) -> dict[str, list[Any]]:
        return {kind: list(getattr(self, f'{kind}s')) for kind in _KINDS}

    def _take_down(self) -> None:
        self._close()
        for kind, made in self._made().items():
            for one in made:
                if one not in self._foundation[kind]:
                    getattr(self, f'destroy_{kind}')(one)

    def _close(self) -> None:
        while self._closing:
            self._closing.pop()()
