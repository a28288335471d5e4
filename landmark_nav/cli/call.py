"""`landmark-nav call`: call a service of the nodes."""

from __future__ import annotations

import argparse

from landmark_nav.cli.options import add, robot_client, within

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
    timeout = {'type': within(float, 0.1, 86400), 'default': 300.0, 'metavar': 'S'}
    add(parser, '--timeout', **timeout, help='how long the answer may take')
    add(parser, '--namespace')
    lines = (f'  {name:16} {does}' for name, does in _SERVICES.items())
    parser.epilog = '\n'.join(['services:', *lines])


def run(args: argparse.Namespace) -> int:
    """Wait for the service, call it, and print its answer."""
    with robot_client('call', namespace=args.namespace, drives=False) as client:
        print(client.call(args.service, args.timeout))
    return 0
