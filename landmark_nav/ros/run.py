"""`main` of the nodes: join ROS, spin until SIGINT or SIGTERM, forward logs, shut down."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
import ctypes
import gc
import logging
import os
from pathlib import Path
from queue import Empty, SimpleQueue
import signal
import struct
import sys
from threading import Event, Thread
import time
from types import FrameType
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.executors import (
    Executor,
    ExternalShutdownException,
    ShutdownException,
    TimeoutException,
)
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future, Task
from rclpy.utilities import remove_ros_args

from landmark_nav.errors import LandmarkNavError, one_line
from landmark_nav.ros import chosen_domain
from landmark_nav.ros.node import LandmarkNode

_SIGEV_THREAD = 2


_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class ShutdownGuard:
    """
    Context manager for the main thread: a signal requests the end and limits the time to it.

    A separate thread waits for the signal and calls `on_signal`: handlers of Python do not run
    while the main thread is in C code, and a KeyboardInterrupt may be lost in a callback. If the
    block has not ended `grace_s` later, the process ends with status 0. This timer does without
    the interpreter lock, which nodes that leave at the same time may hold for tens of seconds:
    Fast DDS waits for a callback whose mutex it takes repeatedly (its issue 6513).
    """

    def __init__(self, on_signal: Callable[[], None], grace_s: float) -> None:
        self._on_signal = on_signal
        self._libc = ctypes.CDLL(None)
        # An itimerspec: no interval, seconds and nanoseconds.
        self._grace = struct.pack('4l', 0, 0, int(grace_s), int(grace_s % 1.0 * 1e9))
        self._timer = ctypes.c_void_p()
        at_once = ctypes.cast(self._libc._exit, ctypes.c_void_p).value
        # A sigevent: value, signal, kind, function, and space for its other fields.
        event = struct.pack('PiiP40x', 0, 0, _SIGEV_THREAD, at_once)
        if self._libc.timer_create(time.CLOCK_MONOTONIC, event, ctypes.byref(self._timer)):
            raise OSError('timer_create failed')
        self._thread = Thread(target=self._watch, name='end signals', daemon=True)

    def __enter__(self) -> ShutdownGuard:
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)
        self._wakeup = signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False)
        self._handlers = {number: signal.signal(number, _noted) for number in _SIGNALS}
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        signal.set_wakeup_fd(self._wakeup)
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        os.close(self._writer)
        self._thread.join()
        os.close(self._reader)
        self._libc.timer_delete(self._timer)

    def expect_end(self) -> None:
        """Start the time limit for the end of the block."""
        self._libc.timer_settime(self._timer, 0, self._grace, None)

    def _watch(self) -> None:
        if os.read(self._reader, 1):
            self.expect_end()
            self._on_signal()


def _noted(_number: int, _frame: FrameType | None) -> None:
    """Do nothing: Python writes to the wakeup pipe only for signals with a handler."""


# Exceptions of waiting without a result. rclpy raises the first one if a callback closes a
# subscription while another thread begins to wait; the next wait is without it.
_NOTHING_TO_DO = InvalidHandle, ExternalShutdownException, ShutdownException, TimeoutException


class CallbackExecutor(Executor):
    """
    Executor that passes each callback to one of `threads` and waits until it has begun.

    The `MultiThreadedExecutor` of rclpy does not wait. A callback that no thread has begun counts
    as ready and is passed on again and again, which takes a core and delays the threads: joint
    states of 50 Hz were not handled for up to two seconds (issue 1452 of rclpy, not fixed in any
    version that the package supports).
    """

    def __init__(self, threads: int) -> None:
        super().__init__()
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self._under_way: set[Task[Any]] = set()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait for one callback and begin it; raises exceptions of finished callbacks."""
        with suppress(*_NOTHING_TO_DO):
            task, _, _ = self.wait_for_ready_callbacks(timeout_sec=timeout_sec)
            self._under_way.add(task)
            self._begin(task)
        self._raise()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Shut down after the running callbacks; raises exceptions of finished callbacks."""
        if self._pool is not None:
            # Running callbacks still need what rclpy destroys at shutdown.
            self._pool.shutdown()
        ended = super().shutdown(timeout_sec)
        self._raise()
        return ended

    def _begin(self, task: Task[Any]) -> None:
        if self._pool is None:
            task()
            return
        begun = Event()

        def run() -> None:
            begun.set()
            task()

        self._pool.submit(run)
        begun.wait()

    def _raise(self) -> None:
        for task in [task for task in self._under_way if task.done()]:
            self._under_way.remove(task)
            task.result()


class LatestOnlyWorker:
    """
    Passes messages to `work`, which must not raise, in a thread of its own, one at a time.

    A waiting message is replaced by a newer one, so there is no queue; `dropped` counts these.
    """

    def __init__(self, work: Callable[[Any], None]) -> None:
        self._work = work
        self._waiting: SimpleQueue[Any] = SimpleQueue()
        self.dropped = 0
        self._thread = Thread(target=self._run, daemon=True)
        self._thread.start()

    def take(self, message: Any) -> None:
        """Hand over a message and return at once."""
        with suppress(Empty):
            self._waiting.get_nowait()
            self.dropped += 1
        self._waiting.put(message)

    def close(self) -> None:
        """
        End the thread after its current message.

        Python aborts a process that ends while such a thread runs C++ code (issue 1484 of rclpy).
        """
        self.take(None)
        self._thread.join()

    def _run(self) -> None:
        while (message := self._waiting.get()) is not None:
            self._work(message)


class _Forwarder(logging.Handler):
    def __init__(self, nodes: Sequence[Node]) -> None:
        super().__init__()
        self._loggers = {node.get_name(): node.get_logger() for node in nodes}
        self._first = nodes[0].get_logger()

    def emit(self, record: logging.LogRecord) -> None:
        """Log at the nearest ROS severity, by the node whose name ends the record's name."""
        logger = self._loggers.get(record.name.rpartition('.')[2], self._first)
        text = self.format(record)
        # rclpy refuses other severities at the same place of a file.
        if record.levelno >= logging.ERROR:
            logger.error(text)
        elif record.levelno >= logging.WARNING:
            logger.warning(text)
        elif record.levelno >= logging.INFO:
            logger.info(text)
        else:
            logger.debug(text)


def join_ros(context: Context | None = None, domain_id: int | None = None) -> int:
    """
    Initialise ROS by the command line, without signal handlers; return the domain.

    Context and domain are by default those of the process and the environment. Raises
    `LandmarkNavError`: ROS refuses the arguments, a parameter file or the environment.
    """
    domain_id = (chosen_domain() or 0) if domain_id is None else domain_id
    try:
        rclpy.init(
            context=context, domain_id=domain_id, signal_handler_options=SignalHandlerOptions.NO
        )
    except RuntimeError as error:  # RCLError, UnknownROSArgsError
        raise LandmarkNavError(' '.join(str(error).split())) from error
    return domain_id


# Time after a signal at which the process ends in any case. A stage such as learning takes seconds
# and cannot be interrupted; files are written atomically, so that ending is safe.
_GRACE_S = 2.0
# Greatest time for which a thread keeps another one from running: images and messages take turns.
_SWITCH_S = 5e-4
_USAGE = """{does}

usage: {name} [--ros-args [--params-file F.yaml] [-p PARAMETER:=VALUE ...]]
Parameters: config/landmark_nav.yaml; all, with ranges: docs/reference/parameters.md"""


def run_node(*make_nodes: Callable[[], LandmarkNode], threads: int = 1) -> int:
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
            print(one_line(f'{name}: {error}'), file=sys.stderr)
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
    # What exists now stays: a full collection takes 1 ms instead of 46 with the lock held.
    gc.freeze()
    sys.setswitchinterval(_SWITCH_S)
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
