"""Initialisation of ROS, and synchronised subscriptions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.signals import SignalHandlerOptions

from landmark_nav.errors import LandmarkNavError
from landmark_nav.messages.decode import stamp_ns
from landmark_nav.ros import chosen_domain
from landmark_nav.ros.node import LandmarkNode


def join_ros(context: Context | None = None, domain_id: int | None = None) -> int:
    """
    Initialise ROS by the command line, without signal handlers; return the domain.

    Context and domain are by default those of the process and the environment. Raises
    `LandmarkNavError`: ROS refuses the arguments, a parameter file or the environment.
    """
    domain_id = (chosen_domain() or 0) if domain_id is None else domain_id
    try:
        rclpy.init(
            context=context,
            domain_id=domain_id,
            signal_handler_options=SignalHandlerOptions.NO,
        )
    except RuntimeError as error:  # RCLError, UnknownROSArgsError
        raise LandmarkNavError(' '.join(str(error).split())) from error
    return domain_id


# Largest number of incomplete sets; the first that arrived is dropped, whatever its stamp.
_MAX_WAITING = 8


def listen_together(
    node: LandmarkNode, topics: Sequence[str], callback: Callable[..., None]
) -> None:
    """Call back with one message of each topic, in their order, when all of a stamp arrived."""
    waiting: dict[int, dict[str, Any]] = {}

    def take(topic: str, message: Any) -> None:
        stamp = stamp_ns(message.header)
        waiting.setdefault(stamp, {})[topic] = message
        if len(waiting[stamp]) == len(topics):
            found = waiting.pop(stamp)
            callback(*(found[name] for name in topics))
        elif len(waiting) > _MAX_WAITING:
            del waiting[next(iter(waiting))]

    for topic in topics:
        node.listen(topic, partial(take, topic))
