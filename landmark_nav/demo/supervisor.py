"""Processes of the nodes: command lines, start, supervision and end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from types import FrameType
from typing import Any

from landmark_nav.errors import LandmarkNavError
from landmark_nav.signals import tied_to_parent
from landmark_nav.storage.robot_files import shipped_config

# Period of checks at the end.
_POLL_S = 0.05
# Number of lines of a log in a message.
_LAST_LINES = 4


class ProcessEndedError(LandmarkNavError):
    """Error: a process has ended unexpectedly."""


@dataclass(frozen=True)
class _Child:
    name: str
    process: subprocess.Popen[bytes]
    log: Path | None


class Supervisor:
    """
    Context manager for child processes, each in its own process group, `tied_to_parent`.

    Their outputs go to ``NAME.log`` in `log_folder`, or where those of this process go; after each
    signal they have `grace_s` to end.
    """

    def __init__(
        self, log_folder: Path | None, environment: Mapping[str, str], grace_s: float = 10.0
    ) -> None:
        self._log_folder = log_folder
        self._environment = dict(environment)
        self._grace_s = grace_s
        self._children: list[_Child] = []
        if log_folder is not None:
            log_folder.mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> Supervisor:
        return self

    def __exit__(self, *error: object) -> None:
        """End all processes that still run."""
        self.stop()

    def start(self, name: str, command: Sequence[str]) -> subprocess.Popen[bytes]:
        """Start a process; in its own session it does not receive Ctrl-C of the terminal."""
        log = None if self._log_folder is None else self._log_folder / f'{name}.log'
        with log.open('wb') if log else nullcontext() as output:
            process = subprocess.Popen(
                tied_to_parent(command),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT if log else None,
                env=self._environment,
                start_new_session=True,
            )
        self._children.append(_Child(name, process, log))
        return process

    def check(self) -> None:
        """
        Check that all processes still run.

        Raises `ProcessEndedError` with name, status and last lines of one that has ended.
        """
        for child in self._children:
            status = child.process.poll()
            if status is not None:
                how = f'exit status {status}'
                if status < 0:
                    how = f'signal {signal.Signals(-status).name}'
                words = f': {_last_words(child.log)} (all: {child.log})' if child.log else ''
                raise ProcessEndedError(f'{child.name} ended with {how}{words}')

    def stop(self, gently: signal.Signals = signal.SIGTERM) -> dict[str, int]:
        """
        End all processes by `gently`, and then by SIGKILL; return exit statuses by name.

        SIGINT is not the default, as a process that is still importing may lose the
        KeyboardInterrupt.
        """
        for number in (gently, signal.SIGKILL):
            running = [child for child in self._children if child.process.poll() is None]
            for child in running:
                # The signal is sent to the group, which includes processes started by the child.
                os.killpg(child.process.pid, number)
            deadline = time.monotonic() + self._grace_s
            while running and time.monotonic() < deadline:
                time.sleep(_POLL_S)
                running = [child for child in running if child.process.poll() is None]
        statuses = {child.name: child.process.wait() for child in self._children}
        self._children = []
        return statuses


def _last_words(log: Path) -> str:
    lines = [line.strip() for line in log.read_text(errors='replace').splitlines()]
    last_lines = [line for line in lines if line][-_LAST_LINES:]
    return ' | '.join(last_lines) or 'it printed nothing'


_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interruption:
    """
    Context manager for the main thread: signals are noted, and `check` raises the exception.

    A KeyboardInterrupt that is raised in a destructor is lost. This happens to one signal in forty
    in a program that waits with rclpy.
    """

    def __init__(self) -> None:
        self._noted = 0
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> Interruption:
        """Replace the handlers of the signals."""
        self._handlers = {number: signal.signal(number, self._note) for number in _SIGNALS}
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        """Restore the handlers; without another exception, raise a signal that was noted."""
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        if kind is None:
            self.check()

    def check(self) -> None:
        """Raise `KeyboardInterrupt` with the number of the signal, if there was one."""
        if self._noted:
            raise KeyboardInterrupt(self._noted)

    def _note(self, number: int, _frame: FrameType | None) -> None:
        self._noted = number


_NODES = (
    *('sweep_capture', 'panorama_synthesizer', 'landmark_learner'),
    *('triplet_selector', 'triangulation_localizer', 'odometry_fusion'),
)


def node_command(
    name: str, namespace: str = '', parameter_file: Path | None = None, **parameters: object
) -> list[str]:
    """Command line of a node with parameters and a parameter file, by default the shipped one."""
    # ROS parses values as YAML, of which JSON is a subset; quotes keep names strings.
    settings = [f'{key}:={json.dumps(value)}' for key, value in parameters.items()]
    return [
        *(sys.executable, '-m', f'landmark_nav.nodes.{name}', '--ros-args'),
        *('--params-file', str(parameter_file or shipped_config('landmark_nav.yaml'))),
        *(status for setting in settings for status in ('-p', setting)),
        *(('-r', f'__ns:=/{namespace}') if namespace else ()),
    ]


def node_commands(
    robot_file: Path,
    room_file: Path | None,
    map_folder: Path,
    *,
    simulator: Mapping[str, object] | None = None,
    load_on_start: bool = False,
    image_transport: str = '',
    namespace: str = '',
    composed: bool = False,
    parameter_file: Path | None = None,
) -> dict[str, list[str]]:
    """
    Command line of each process, by its name: one for each node, or one for all if `composed`.

    The simulator is always a separate process. `simulator` holds its parameters besides
    `robot_file`; if it is None, there is no simulator. Without `room_file`, the nodes estimate
    walls and poses. The other arguments are parameters of the nodes.
    """
    # A node reads those of them that it declares.
    parameters: dict[str, object] = {
        'robot_file': str(robot_file),
        'room_file': str(room_file or ''),
        'map_folder': str(map_folder),
        'load_on_start': load_on_start,
    }
    if image_transport:
        parameters['image_transport'] = image_transport
    given = dict.fromkeys(['all_nodes'] if composed else _NODES, parameters)
    if simulator is not None:
        robot = {'robot_file': parameters['robot_file']}
        given = {'room_simulator': {**robot, **simulator}} | given
    return {
        name: node_command(name, namespace, parameter_file, **parameters)
        for name, parameters in given.items()
    }


def node_environment(domain_id: int) -> dict[str, str]:
    """
    Environment of this process, changed to a ROS domain of this machine alone.

    It is complete, as the ROS wheels restart Python with their own variables.
    """
    return {
        **os.environ,
        'ROS_DOMAIN_ID': str(domain_id),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    }
