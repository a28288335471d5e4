"""Options that several commands share, the bag that they read, and lines that they print."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager
import logging
from math import inf
import os
from pathlib import Path
import re
import shlex
import shutil
import sys
from textwrap import fill
from threading import Event, Thread
import time
from typing import Any, ClassVar, TYPE_CHECKING, TypeVar

from tqdm import tqdm

from landmark_nav.ros import require_ros
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.bags.definitions import TOPIC_TYPES
from landmark_nav.types import FloatArray

_LOG = logging.getLogger(__name__)

if TYPE_CHECKING:  # the import needs ROS
    from landmark_nav.ros.robot_client import RobotClient


def add(parser: argparse.ArgumentParser, *names: str, **special: Any) -> None:
    """
    Declare arguments; `special` goes before the settings of those that several commands share.

    The help of a number ends with its default.
    """
    for name in names:
        settings = {**_COMMON.get(name, {}), **special}
        if isinstance(settings.get('default'), int | float):
            settings['help'] += ' (default %(default)g)'
        parser.add_argument(name, **settings)


def _namespace(text: str) -> str:
    name = text.strip('/')
    if name and not re.fullmatch(r'[A-Za-z_]\w*(/[A-Za-z_]\w*)*', name, re.ASCII):
        raise argparse.ArgumentTypeError(f'{text} is no namespace of ROS, such as robot1')
    return name


def within(
    kind: type[int] | type[float], least: float, most: float = inf
) -> Callable[[str], float]:
    """Argument type: a number from `least` to `most`."""

    def number(text: str) -> float:
        value = kind(text)
        if not least <= value <= most or value == inf:
            what = f'{least:g} or more' if most == inf else f'from {least:g} to {most:g}'
            raise argparse.ArgumentTypeError(f'{text} is not {what}')
        return value

    return number


@contextmanager
def robot_client(command: str, **options: Any) -> Iterator[RobotClient]:
    """
    Join the ROS graph for a command until it ends or a signal comes.

    `options` are those of `RobotClient`. Raises `LandmarkNavError`: ROS is not available.
    """
    require_ros('it')
    from landmark_nav.demo.supervisor import Interruption
    from landmark_nav.ros.robot_client import RobotClient

    with Interruption() as interruption:
        options |= {'watch': interruption.check, 'name': f'{command}_{os.getpid()}'}
        with RobotClient(observes=False, **options) as client:
            yield client


def open_bag(path: Path | str, args: argparse.Namespace) -> Bag:
    """Open a bag with the topics given by ``--topic``."""
    bag = Bag(path, topics=dict(args.topic))
    _LOG.info('%s: %d messages', path, sum(bag.counts.values()))
    return bag


def _renamed(text: str) -> tuple[str, str]:
    name, given, topic = text.partition('=')
    name = name.strip('/')
    if not given or not topic or name not in TOPIC_TYPES:
        raise argparse.ArgumentTypeError(
            f'{text!r} is not NAME=TOPIC with a NAME such as camera/image_raw, '
            'camera/camera_info, joint_states, odom'
        )
    return name, topic


_COMMON: dict[str, dict[str, Any]] = {
    'bag': {'metavar': 'BAG', 'help': 'rosbag2 folder or .mcap file'},
    '--topic': {
        'action': 'append',
        'default': [],
        'type': _renamed,
        'metavar': 'NAME=TOPIC',
        'help': 'topic of the bag that is called otherwise than here, such as '
        'camera/image_raw=/cam0/image; repeatable. joint_states=/tf:FRAME takes the pan from the '
        'transform of FRAME. Names that only have a namespace are found without it',
    },
    '--robot': {'metavar': 'F', 'help': 'robot.yaml, or a URDF: how the camera is mounted'},
    '--room': {'metavar': 'F', 'help': 'room.yaml: walls, and papers or markers'},
    '--map': {'metavar': 'MAP', 'help': 'map folder, of learn'},
    '--out': {'metavar': 'DIR', 'type': Path, 'help': 'folder to write'},
    '--overwrite': {'action': 'store_true', 'help': 'replace what --out names, if it is there'},
    '--config': {
        'metavar': 'F',
        'help': 'parameters that differ from the defaults, as for --params-file of the nodes: '
        "config/landmark_nav.yaml (what describes the robot is in the robot's file)",
    },
    '--seed': {'type': within(int, 0, 2**63 - 1), 'default': 1, 'metavar': 'N'},
    '--json': {'metavar': 'F', 'type': Path, 'help': 'write the figures to F'},
    '--report': {'metavar': 'F.html', 'type': Path, 'help': 'write a page to F.html'},
    '--namespace': {
        'type': _namespace,
        'default': '',
        'metavar': 'NS',
        'help': 'of the nodes (default none)',
    },
}


_WIDTH = 99
_LEAST_WIDTH = 60


def wrapped(lines: Iterable[str]) -> str:
    """Join lines to a text; long lines are wrapped with a deeper indent."""
    columns = shutil.get_terminal_size((_WIDTH, 24)).columns
    width = min(max(columns, _LEAST_WIDTH), _WIDTH)
    whole: dict[str, Any] = {'break_long_words': False, 'break_on_hyphens': False}
    filled = []
    for line in lines:
        deeper = ' ' * (len(line) - len(line.lstrip()) + 4)
        filled.append(fill(line, width, subsequent_indent=deeper, **whole))
    return '\n'.join(filled)


# First characters of numbers, and of a cell without one; most rows of a table of a report.
_DIGITS, _MOST_LINES = ('', *'0123456789'), 30


def table_lines(table: Mapping[str, Any]) -> list[str]:
    """Lines of a table and its note for a terminal, of which the first rows are shown."""
    rows = [row['cells'] for row in table['rows']]
    lines = aligned(table['head'], rows) if rows else []
    more = [f'... {len(rows) - _MOST_LINES} more'] if len(rows) > _MOST_LINES else []
    return [*lines[: _MOST_LINES + 1], *more, *filter(None, [table['note']])]


def aligned(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a head and of rows of cells in columns; those of numbers are right-aligned."""
    columns = []
    for name, *cells in zip(head, *rows, strict=True):
        numbers = all(cell.lstrip('+-')[:1] in _DIGITS for cell in cells)
        width = max(map(len, (name, *cells)))
        side = '>' if numbers else '<'
        columns.append([f'{cell:{side}{width}}' for cell in (name, *cells)])
    return ['  '.join(line).rstrip() for line in zip(*columns, strict=True)]


def text_of(verdict: Mapping[str, str], tables: Iterable[Mapping[str, Any]]) -> list[str]:
    """Lines of a verdict and of its tables for a terminal."""
    return [verdict['text'], *(line for table in tables for line in ('', *table_lines(table)))]


def evaluate_line(
    bag: Path, map_folder: Path, robot: Path, start: FloatArray, config: Path | None = None
) -> str:
    """Return the shell command that evaluates a drive with a map from a pose (3,)."""
    words = ['landmark-nav', 'evaluate', str(bag), '--map', str(map_folder)]
    words += ['--robot', str(robot), *(['--config', str(config)] if config else [])]
    return shlex.join([*words, '--start', *(f'{value:.4f}' for value in start)])


T = TypeVar('T')

# Delay of the first progress bar on a terminal; interval of the lines elsewhere.
_FIRST_S, _LINE_EVERY_S = 2.0, 10.0


class _Shown:
    """Times of the start of the command and of its last line of progress; ends of open loops."""

    begin_s = line_s = time.monotonic()
    loops: ClassVar[list[Event]] = []


def progress(iterable: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
    """
    Yield items, and show progress and remaining time on stderr.

    A terminal shows a bar once the command has taken two seconds; other outputs get a line every
    ten seconds. If warnings are disabled, nothing is shown.
    """
    if not logging.getLogger().isEnabledFor(logging.WARNING):
        yield from iterable
    elif sys.stderr is not None and sys.stderr.isatty():
        bar: Any = {'desc': description, 'total': total, 'leave': False}
        delay_s = max(0.0, _Shown.begin_s + _FIRST_S - time.monotonic())
        yield from tqdm(iterable, delay=delay_s, file=sys.stderr, **bar)
    else:
        total = len(iterable) if total is None and isinstance(iterable, Sized) else total
        done, ended = [0], Event()
        _Shown.loops.append(ended)
        Thread(target=_lines, args=(description, done, total, ended), daemon=True).start()
        try:
            for item in iterable:
                yield item
                done[0] += 1
        finally:
            ended.set()
            _Shown.loops.remove(ended)


def _lines(description: str, done: list[int], total: Any, ended: Event) -> None:
    """Print a line of progress every ten seconds in a loop, except while one inside it runs."""
    begin = time.monotonic()
    # Short waits, as the last line may be that of another loop.
    while not ended.wait(1.0):
        now = time.monotonic()
        is_due = now - _Shown.line_s > _LINE_EVERY_S and _Shown.loops[-1:] == [ended]
        if is_due and sys.stderr is not None:
            _Shown.line_s = now
            line = tqdm.format_meter(done[0], total, now - begin, 80, prefix=description)
            print(line, file=sys.stderr, flush=True)
