"""`landmark-nav play`: publish a bag on topics with /clock."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys

from landmark_nav.cli.options import add, within
from landmark_nav.ros import require_ros
from landmark_nav.signals import ENDING


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.description = (
        'Publish the messages of a bag under the names they were recorded with, and '
        '/clock. Ends with the bag.'
    )
    add(parser, 'bag', '--topic')
    text = 'speed relative to the recording, 0.01 to 100'
    add(parser, '--rate', type=within(float, 0.01, 100), default=1.0, metavar='R', help=text)
    text = 'what follows goes to ROS, such as -r /odom:=/robot1/odom'
    add(parser, '--ros-args', nargs=argparse.REMAINDER, default=[], help=text)


def run(args: argparse.Namespace) -> int:
    """Replace this process by the node ``bag_player``."""
    require_ros('it')
    # ROS parses values as YAML: quotes keep a folder such as 12 a string.
    parameters = ['-p', f'bag:={json.dumps(args.bag)}', '-p', f'rate:={args.rate!r}']
    for name, topic in args.topic:
        parameters += ['-r', f'{topic}:=/{name}']
    command = ['-m', 'landmark_nav.nodes.bag_player', '--ros-args', *parameters, *args.ros_args]
    sys.stdout.flush()
    # Signals are blocked until the node handles them.
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    os.execv(sys.executable, [sys.executable, *command])
