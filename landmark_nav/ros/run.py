"""`main` of the nodes: spin until SIGINT or SIGTERM, forward logs to ROS, shut down."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import logging
from pathlib import Path
import sys

import rclpy
from rclpy.node import Node
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

from landmark_nav.errors import LandmarkNavError
from landmark_nav.ros.executor import CallbackExecutor
from landmark_nav.ros.joining import join_ros
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.shutdown_guard import ShutdownGuard


class _Forwarder(logging.Handler):
    def __init__(self, nodes: Sequence[Node]) -> None:
        super().__init__()
        self._loggers = {node.get_name(): node.get_logger() for node in nodes}
        self._first = nodes[0].get_logger()

    def emit(self, record: logging.LogRecord) -> None:
        """Log at the nearest ROS severity, by the node whose name ends the record's name."""
        logger = self._loggers.get(record.name.rpartition('.')[2], self._first)
        text = self.format(record)
        if record.levelno >= logging.ERROR:
            logger.error(text)
        elif record.levelno >= logging.WARNING:
            logger.warning(text)
        elif record.levelno >= logging.INFO:
            logger.info(text)
        else:
            logger.debug(text)


# Time after a signal at which the process ends in any case. A stage such as learning takes seconds
# and cannot be interrupted; files are written atomically, so that ending is safe.
_GRACE_S = 2.0
_USAGE = """{does}

usage: {name} [--ros-args [--params-file F.yaml] [-p PARAMETER:=VALUE ...]]
Parameters: config/landmark_nav.yaml; all, with ranges: docs/reference/parameters.md"""


def run_node(make_node: Callable[[], LandmarkNode], threads: int = 1) -> int:
    """Run one node in this process; see `run_nodes`."""
    return run_nodes([make_node], threads)


def run_nodes(make_nodes: Sequence[Callable[[], LandmarkNode]], threads: int) -> int:
    """
    Run nodes in this process with one executor; the end of one node ends all.

    `make_nodes` create them after the initialisation of ROS. Returns the exit status: 0 after a
    signal or the end of a node, 1 if a node could not be created or failed, 2 for wrong usage.
    """
    name = Path(sys.argv[0]).stem
    asked: Future[None] = Future()
    with ShutdownGuard(lambda: asked.set_result(None), _GRACE_S) as shutdown_guard:
        try:
            join_ros()
            if own := remove_ros_args(sys.argv)[1:]:
                does = sys.modules[make_nodes[0].__module__].__doc__ or ''
                print(_USAGE.format(does=does.strip(), name=name))
                return 0 if set(own) & {'-h', '--help'} else 2
            nodes = [make() for make in make_nodes]
            asked.add_done_callback(lambda _: nodes[0].end())
            package = logging.getLogger('landmark_nav')
            package.handlers, package.propagate = [_Forwarder(nodes)], False
            package.setLevel(logging.INFO)
            for node in nodes:
                if node.is_active:
                    node.announce()
            _spin(nodes, threads, shutdown_guard)
        except LandmarkNavError as error:
            print(f'{name}: {error}', file=sys.stderr)
            return 1
        finally:
            rclpy.try_shutdown()
    return 0


def _spin(nodes: Sequence[LandmarkNode], threads: int, shutdown_guard: ShutdownGuard) -> None:
    """Spin until one node ends; then end all."""
    executor = CallbackExecutor(threads)

    def wake(_: object) -> None:
        for node in nodes:
            node.end()
        # A task wakes the executor up.
        executor.create_task(bool)

    for node in nodes:
        executor.add_node(node)
        # Not `spin_until_future_complete`: in Jazzy it adds another callback in every iteration.
        node.ended.add_done_callback(wake)
    try:
        # Waiting service calls see the end, and are answered.
        while any(not node.ended.done() or node.calls_that_wait for node in nodes):
            executor.spin_once()
        for node in nodes:
            node.ended.result()
        # Not after a failure, which the exit status must show.
        shutdown_guard.expect_end()
    finally:
        for node in nodes:
            node.end()
        try:
            # Waits for running callbacks, which still need publishers and services.
            executor.shutdown()
        finally:
            for node in nodes:
                # Not every version of rclpy does that at shutdown.
                node.destroy_node()
