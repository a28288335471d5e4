"""`landmark-nav play`: a bag onto topics with /clock."""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any

from landmark_nav.errors import LandmarkNavError
from landmark_nav.ros import require_ros

__all__ = ['add_parser', 'run']


def add_parser(subparsers: Any) -> None:
    """Declare the arguments."""
    parser = subparsers.add_parser(
        'play',
        help='play a bag onto topics with /clock (ROS)',
        description='Publish the messages of a bag under the names they were recorded with, and '
        '/clock. Ends with the bag.',
    )
    parser.add_argument('bag', metavar='BAG', help='rosbag2 folder or .mcap file')
    parser.add_argument('--rate', type=float, default=1.0, help='speed relative to the recording')
    parser.add_argument(
        '--ros-args',
        nargs=argparse.REMAINDER,
        default=[],
        help='what follows goes to ROS, such as -r /odom:=/robot1/odom',
    )


def run(args: argparse.Namespace) -> int:
    """Play it in this process."""
    require_ros('landmark-nav play')
    from rclpy.parameter import Parameter

    from landmark_nav.nodes.bag_player import BagPlayerNode
    from landmark_nav.ros.run import run_node

    if not 0.01 <= args.rate <= 100.0:
        raise LandmarkNavError(f'--rate {args.rate:g} is out of range: take 0.01 to 100')
    overrides = [
        Parameter('bag', value=args.bag),
        Parameter('rate', value=args.rate),
    ]
    return run_node(partial(BagPlayerNode, parameter_overrides=overrides))
