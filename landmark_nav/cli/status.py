"""`landmark-nav status`: the diagnostics of all nodes as a table."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
import shutil
import sys
from textwrap import wrap
import time
from typing import TYPE_CHECKING

from landmark_nav.cli.options import robot_client
from landmark_nav.errors import LandmarkNavError
from landmark_nav.ros import chosen_domain

if TYPE_CHECKING:
    from landmark_nav.ros.robot_client import NodeStatus

# Time to gather diagnostics, which nodes publish once a second.
_GATHER_S = 2.5
_REFRESH_S = 1.0
_NO_NODE_S = 10.0
# A node that reports once a second and was not heard for this long has ended, or hangs.
_SILENT_S = 5.0
# Nodes in place of a robot.
_STAND_INS = {'room_simulator', 'bag_player'}
_CLEAR = '\x1b[H\x1b[J'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.description = (
        'Print level and reason of every node, anew each second in a terminal until Ctrl-C, '
        'else once.'
    )
    parser.add_argument('--once', action='store_true', help='print one table and end')
    parser.add_argument('--values', action='store_true', help='print all values, too')


def current(node: NodeStatus, now_s: float) -> NodeStatus:
    """Return the last report of a node, or that it is silent since."""
    silent_s = now_s - node.heard_s
    if silent_s < _SILENT_S:
        return node
    reason = f'nothing heard for {silent_s:.0f} s: it has ended, or hangs'
    return replace(node, level='SILENT', reason=reason, values={})


def table(status: Mapping[str, NodeStatus], width: int, values: bool = False) -> list[str]:
    """Return lines of at most `width` characters: node, level, reason, and values below."""
    names = max((len(name) for name in status), default=0)
    indent = ' ' * (names + 11)
    room = max(20, width - len(indent))
    lines = []
    for name, node in sorted(status.items()):
        first, *more = wrap(node.reason, room) or ['']
        lines += [f'{name:{names}}  {node.level:9}{first}'.rstrip(), *(indent + t for t in more)]
        if values:
            lines += [
                indent + line
                for key, value in node.values.items()
                for line in wrap(f'{key}: {value}', room, subsequent_indent='  ')
            ]
    return lines


def run(args: argparse.Namespace) -> int:
    """Gather diagnostics and print them."""
    once = args.once or not sys.stdout.isatty()

    def others() -> dict[str, NodeStatus]:
        # All nodes except that of this command.
        now_s = time.monotonic()
        return {k: current(node, now_s) for k, node in client.status.items() if k != client.name}

    with robot_client('status', drives=False) as client:
        try:
            client.wait(lambda: bool(others()), _NO_NODE_S, 'diagnostics')
        except LandmarkNavError:
            raise LandmarkNavError(
                f'no node publishes /diagnostics in ROS domain {chosen_domain() or 0}: start the '
                'nodes (landmark-nav up), or set ROS_DOMAIN_ID as theirs is'
            ) from None
        client.pause(_GATHER_S)
        if once:
            # Nodes of others may report by another name.
            with suppress(LandmarkNavError):
                client.wait(lambda: not client.unheard(), _NO_NODE_S, 'all nodes')
        from landmark_nav.configuration import READS

        reason = 'nothing heard: it is not started, is at work, or hangs'
        silent = replace(client.status_of(''), level='SILENT', reason=reason)
        unheard = {name for name in client.unheard() if name.rpartition('/')[2] in READS}
        # Of one that hangs, nothing may be known at all.
        heard = {name.rpartition('/')[2] for name in {*client.status, *unheard}}
        unheard |= READS.keys() - heard - _STAND_INS
        client.status |= dict.fromkeys(unheard, silent)
        while True:
            size = shutil.get_terminal_size((99, 24))
            lines = table(others(), size.columns, args.values)
            if once:
                print('\n'.join(lines))
                return 0
            print(_CLEAR + '\n'.join(lines[: size.lines - 1]), flush=True)
            client.pause(_REFRESH_S)
