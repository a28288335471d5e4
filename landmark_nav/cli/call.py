"""`landmark-nav call`: call a service of the nodes."""

from __future__ import annotations

import argparse
import os

from landmark_nav.cli.options import add, add_number, within
from landmark_nav.demo.supervisor import Interruption
from landmark_nav.ros import require_ros

_SERVICES = {
    'capture_sweep': 'turn the camera all around and make a panorama',
    'learn_landmarks': 'make a map out of the panoramas',
    'save_map': 'write the map to its folder',
    'load_map': 'read the map of the folder',
    'clear_panoramas': 'forget the panoramas',
    'relocalize': 'find the place of the robot without a prior',
    'calibrate': 'write what the drive has shown of robot.yaml beside it',
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.description = 'Call a service of the nodes, and print its answer.'
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument('service', choices=_SERVICES, metavar='SERVICE', help='see below')
    add_number(
        parser, '--timeout', within(float, 0.1, 86400), 300.0, 'S', 'how long the answer may take'
    )
    add(parser, '--namespace')
    parser.epilog = 'services:\n' + '\n'.join(
        f'  {name:16} {does}' for name, does in _SERVICES.items()
    )


def run(args: argparse.Namespace) -> int:
    """Wait for the service, call it, and print its answer."""
    require_ros('it')
    from landmark_nav.ros.robot_client import RobotClient

    with (
        Interruption() as interruption,
        RobotClient(
            watch=interruption.check,
            name=f'call_{os.getpid()}',
            namespace=args.namespace,
            drives=False,
            observes=False,
        ) as client,
    ):
        print(client.call(args.service, args.timeout))
    return 0
