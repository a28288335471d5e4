"""Nodes that a lifecycle manager, such as Nav2's, can run."""

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
    """Of every node."""

    autostart: bool = parameter(
        True, 'configure and activate as the node starts; false: a lifecycle manager does it'
    )


class ManagedNode(LifecycleNodeMixin, Node):
    """
    A node with the states of `rclpy.lifecycle`: unconfigured, inactive, active, finalized.

    To configure is to read parameters and files and to make publishers, subscriptions, services
    and timers (`set_up`); to clean up is to destroy these. An inactive node keeps what it has,
    drops what arrives but for latched messages, which come once, and refuses its services.
    There is no bond: rclpy has none.
    """

    def __init__(self, name: str, **options: Any) -> None:
        self._foundation: dict[str, list[Any]] = {}
        self._closing: list[Callable[[], None]] = []
        self._failure: Exception | None = None
        self._destroyed = False
        Node.__init__(self, name, **options)
        # A manager is answered while callbacks are at work.
        LifecycleNodeMixin.__init__(self, callback_group=MutuallyExclusiveCallbackGroup())

    def set_up(self) -> None:
        """Make all that the node works with; overridden by each."""

    def close_with(self, action: Callable[[], None]) -> None:
        """Have something that was set up, such as a thread, ended before the topics are."""
        self._closing.append(action)

    @property
    def state(self) -> str:
        """Label of its state."""
        # A machine that is destroyed ends the process of who asks it.
        return 'finalized' if self._destroyed else str(self._state_machine.current_state[1])

    @property
    def is_active(self) -> bool:
        """Whether it works on what arrives."""
        return self.state == 'active'

    @property
    def is_idle(self) -> bool:
        """Whether nothing would be missing if all were destroyed now; overridden."""
        return True

    def start(self) -> None:
        """
        Configure and activate, unless ``autostart`` is false; raises what `set_up` raises.

        Until then, what the node makes is its foundation: it works in all states, and stays.
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
                # Else the node is just made, and whoever makes it hears of this.
                self.get_logger().error(one_line(f'not configured: {error}'))
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take down, unless a service is at work."""
        if not self.is_idle:
            self.get_logger().warning('not cleaned up: a service is at work')
            return TransitionCallbackReturn.FAILURE
        self._take_down()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take down for good; the process stays until it is ended."""
        self._take_down()
        return TransitionCallbackReturn.SUCCESS

    on_error = on_shutdown

    def destroy_node(self) -> None:
        """Leave nobody behind who publishes."""
        self._close()
        self._destroyed = True
        super().destroy_node()
        # Else it keeps the node in the graph until Python collects both.
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
