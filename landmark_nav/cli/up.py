"""`landmark-nav up`: start all nodes by one command, for robots without ``ros2 launch``."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
import os
from pathlib import Path
from tempfile import TemporaryDirectory
import time

from landmark_nav.cli.options import add
from landmark_nav.configuration import load_configuration, READS
from landmark_nav.demo.scenario import prepare_room
from landmark_nav.demo.supervisor import Interruption, node_commands, Supervisor
from landmark_nav.errors import UsageError
from landmark_nav.ros import chosen_domain, require_ros
from landmark_nav.storage.setup_files import load_room

_POLL_S = 0.1
# Log format of all nodes, with date and time instead of seconds since 1970.
_LINE = '{date_time_with_ms} [{severity}] {name}: {message}'
_LOG_FORMAT = {'RCUTILS_CONSOLE_OUTPUT_FORMAT': _LINE}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.description = (
        'Start all nodes that learn and localize, print what they log, and end them together at '
        'Ctrl-C. If one of them ends, all do. They are in the ROS domain of ROS_DOMAIN_ID.'
    )
    add(parser, '--robot', type=Path)
    add(parser, '--room', type=Path, help='room.yaml (default: walls and poses are found)')
    text = 'folder that save_map writes; a map in it is loaded at once (default map)'
    add(parser, '--map', type=Path, default=Path('map'), metavar='DIR', help=text)
    text = 'start a simulated robot too; without --robot and --room in a room of its own'
    add(parser, '--sim', action='store_true', help=text)
    add(parser, '--seed', help='draws the simulated room')
    text = 'run all nodes in one process: less memory, but learning holds up localization'
    add(parser, '--composed', action='store_true', help=text)
    add(parser, '--config', '--namespace')


def run(args: argparse.Namespace) -> int:
    """Start the nodes and supervise them."""
    require_ros('it')
    if args.robot is None and (args.room is not None or not args.sim):
        raise UsageError('give --robot, or --sim alone for a simulated robot')
    with ExitStack() as stack:
        interruption = stack.enter_context(Interruption())
        simulator: dict[str, object] | None = {'seed': args.seed} if args.sim else None
        if args.robot is None:
            folder = Path(stack.enter_context(TemporaryDirectory(prefix='landmark_nav_')))
            drawn = prepare_room(folder, args.seed)
            robot, room = drawn.robot_file, drawn.room_file
        else:
            robot, room = args.robot.resolve(), args.room and args.room.resolve()
            # A wrong file gives one error here, and else one from each node.
            load_configuration(args.config, robot, *READS)
            if room is not None:
                load_room(room)
            if simulator is not None and room is not None:
                simulator['room_file'] = str(room)
        commands = node_commands(
            robot,
            room,
            args.map.resolve(),
            simulator=simulator,
            load_on_start=(args.map / 'map.yaml').is_file(),
            image_transport='compressed' if args.sim else '',
            parameter_file=args.config and Path(args.config).resolve(),
            namespace=args.namespace,
            composed=args.composed,
        )
        print(f'ROS domain {chosen_domain() or 0}; robot file {robot}; room file {room or "none"}')
        print('Ctrl-C ends all. In another terminal: landmark-nav status', flush=True)
        nodes = stack.enter_context(Supervisor(None, _LOG_FORMAT | os.environ))
        for name, command in commands.items():
            nodes.start(name, command)
        while True:
            nodes.check()
            interruption.check()
            time.sleep(_POLL_S)
