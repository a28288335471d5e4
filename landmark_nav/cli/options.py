"""Options that several commands take."""

from __future__ import annotations

import argparse
import re


def add_overwrite(parser: argparse.ArgumentParser) -> None:
    """Declare ``--overwrite``: without it, what ``--out`` names is not replaced."""
    parser.add_argument(
        '--overwrite', action='store_true', help='replace what --out names, if it is there'
    )


def add_config(parser: argparse.ArgumentParser) -> None:
    """Declare ``--config``, a file that the nodes take as ``--params-file``."""
    parser.add_argument(
        '--config',
        metavar='F',
        help='parameters that differ from the defaults, as for --params-file of the nodes: '
        "config/landmark_nav.yaml (what describes the robot is in the robot's file)",
    )


def add_namespace(parser: argparse.ArgumentParser) -> None:
    """Declare ``--namespace``, that of the nodes."""
    parser.add_argument(
        '--namespace',
        type=_namespace,
        default='',
        metavar='NS',
        help='of the nodes (default none)',
    )


def _namespace(text: str) -> str:
    name = text.strip('/')
    if name and not re.fullmatch(r'[A-Za-z_]\w*(/[A-Za-z_]\w*)*', name, re.ASCII):
        raise argparse.ArgumentTypeError(f'{text} is no namespace of ROS, such as robot1')
    return name
