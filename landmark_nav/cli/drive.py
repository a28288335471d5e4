"""`landmark-nav drive`: publish ``cmd_vel`` by keys of the terminal."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
import os
import select
import shutil
import sys
import termios
import time
import tty

from landmark_nav.cli.options import add, robot_client, within
from landmark_nav.errors import UsageError
from landmark_nav.ros import require_ros

# Duration of a motion after a key. Terminals do not report released keys; a key that is held down
# repeats after at most 0.7 s.
_HOLD_S = 0.8
_PERIOD_S = 0.05
_FASTER = 1.25
_ARROWS = {'\x1b[A': 'w', '\x1b[B': 's', '\x1b[C': 'd', '\x1b[D': 'a'}
_MOTIONS = {
    'w': (1, 0), 's': (-1, 0), 'a': (0, 1), 'd': (0, -1),
    'q': (1, 1), 'e': (1, -1),
}  # fmt: skip
_HELP = 'w s or up, down: ahead, back; a d or left, right: turn; q e: curves; + -: speed; x: end'


class Keys:
    """
    Velocities by keys; the robot stops if no key is pressed for 0.8 s, or at any other key.

    `ended` is set by the key for the end.
    """

    def __init__(self, linear_m_s: float, angular_rad_s: float) -> None:
        self._speeds = linear_m_s, angular_rad_s
        self._motion, self._until_s = (0, 0), 0.0
        self.ended = False

    def press(self, text: str, now_s: float) -> None:
        """Process the typed keys at a time."""
        for arrow, key in _ARROWS.items():
            text = text.replace(arrow, key)
        for key in text.lower():
            if key in '+-':
                factor = _FASTER if key == '+' else 1.0 / _FASTER
                self._speeds = self._speeds[0] * factor, self._speeds[1] * factor
                continue
            self._motion, self._until_s = _MOTIONS.get(key, (0, 0)), now_s + _HOLD_S
            self.ended |= key == 'x'

    def velocity(self, now_s: float) -> tuple[float, float]:
        """Return linear (m/s) and angular (rad/s) velocity at a time."""
        ahead, left = self._motion if now_s < self._until_s else (0, 0)
        return ahead * self._speeds[0], left * self._speeds[1]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.description = f'Drive by keys of the terminal, on the topic cmd_vel. {_HELP}.'
    add(parser, '--speed', type=within(float, 0.01, 2), default=0.2, metavar='V', help='m/s')
    add(parser, '--turn', type=within(float, 0.01, 4), default=0.5, metavar='W', help='rad/s')
    add(parser, '--namespace')


def run(args: argparse.Namespace) -> int:
    """Publish velocities until the key for the end is pressed, then stop the robot."""
    require_ros('it')
    if not sys.stdin.isatty():
        raise UsageError('it reads keys: start it in a terminal')
    keys = Keys(args.speed, args.turn)
    with robot_client('drive', namespace=args.namespace) as client, _unbuffered():
        print(_HELP, flush=True)
        try:
            while not keys.ended:
                client.pause(_PERIOD_S)
                while select.select([sys.stdin], [], [], 0.0)[0]:
                    typed = os.read(sys.stdin.fileno(), 256)
                    if not typed:  # the terminal is closed
                        return 0
                    keys.press(typed.decode(errors='replace'), time.monotonic())
                linear_m_s, angular_rad_s = keys.velocity(time.monotonic())
                client.drive(linear_m_s, angular_rad_s)
                node = client.status_of('odometry_fusion')
                speeds = f'{linear_m_s:5.2f} m/s {angular_rad_s:5.2f} rad/s'
                columns = shutil.get_terminal_size().columns - 1
                line = f'{speeds}  {node.level} {node.reason}'[:columns]
                print(f'\r\x1b[K{line}', end='', flush=True)
        finally:
            client.drive(0.0, 0.0)
            print()
    return 0


@contextmanager
def _unbuffered() -> Iterator[None]:
    """Read keys immediately and without echo; Ctrl-C remains a signal."""
    before = termios.tcgetattr(sys.stdin)
    try:
        tty.setcbreak(sys.stdin)
        yield
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
