"""`main` of every node: spin until SIGINT or SIGTERM, then end cleanly."""

from __future__ import annotations

from collections.abc import Callable
import os
from pathlib import Path
import sys
from threading import Thread

import rclpy
from rclpy.exceptions import InvalidHandle
from rclpy.executors import (
    Executor,
    ExternalShutdownException,
    MultiThreadedExecutor,
    SingleThreadedExecutor,
)
from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from landmark_nav.errors import LandmarkNavError
from landmark_nav.ros.logs import forward_logs

__all__ = ['run_node']

_GRACE_S = 1.0


def run_node(make_node: Callable[[], Node], threads: int = 1) -> int:
    """
    Run one node in this process.

    Parameters
    ----------
    make_node : callable
        Makes it; called once ROS is initialised.
    threads : int
        How many callbacks may run at once.

    Returns
    -------
    int
        Exit status: 0 after a signal, 1 if the node could not be made, 2 for wrong usage.

    """
    name = Path(sys.argv[0]).stem
    try:
        _join_ros()
        if own := remove_ros_args(sys.argv)[1:]:
            print(_usage(name, sys.modules[make_node.__module__].__doc__ or ''))
            return 0 if set(own) & {'-h', '--help'} else 2
        node = make_node()
        forward_logs(node.get_logger())
        executor = MultiThreadedExecutor(threads) if threads > 1 else SingleThreadedExecutor()
        executor.add_node(node)
        _spin(executor)
        _leave(executor)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except LandmarkNavError as error:
        print(f'{name}: {error}', file=sys.stderr)
        return 1
    except Exception:
        # After a signal publishers and services have no context any more.
        if rclpy.ok():
            raise
    finally:
        rclpy.try_shutdown()
    return 0


def _usage(name: str, does: str) -> str:
    return (
        f'{does.strip()}\n\n'
        f'usage: {name} [--ros-args [--params-file F.yaml] [-p PARAMETER:=VALUE ...]]\n'
        f'All parameters with their defaults: python -m landmark_nav.nodes.describe {name}'
    )


def _join_ros() -> None:
    """Take the arguments that ROS takes: a parameter file that cannot be read is bad input."""
    try:
        rclpy.init(args=sys.argv)
    except RuntimeError as error:  # RCLError, UnknownROSArgsError
        raise LandmarkNavError(' '.join(str(error).split())) from error


def _spin(executor: Executor) -> None:
    """
    Spin to the end.

    Where a callback closes a subscription as another thread is about to wait for its events,
    rclpy throws; the next wait goes without it.
    """
    while True:
        try:
            return executor.spin()
        except InvalidHandle:
            continue


def _leave(executor: Executor) -> None:
    """
    Wait for callbacks under way, but not for long.

    A stage such as learning takes seconds and can't be interrupted; what it writes appears whole
    or not at all, so the process may end in the midst of it.
    """
    waiter = Thread(target=executor.shutdown, daemon=True)
    waiter.start()
    waiter.join(_GRACE_S)
    if waiter.is_alive():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
