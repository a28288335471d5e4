"""The bag that a command reads."""

from __future__ import annotations

import argparse
from pathlib import Path

from landmark_nav.storage.bags import Bag
from landmark_nav.storage.bags.topics import TOPIC_TYPES


def add_topic_argument(parser: argparse.ArgumentParser) -> None:
    """Declare ``--topic``, of every command that reads a bag."""
    parser.add_argument(
        '--topic',
        action='append',
        default=[],
        type=_renamed,
        metavar='NAME=TOPIC',
        help='topic of the bag that is called otherwise than here, such as '
        'camera/image_raw=/cam0/image; repeatable. joint_states=/tf:FRAME takes the pan from the '
        'transform of FRAME. Names that only have a namespace are found without it',
    )


def open_bag(path: Path | str, args: argparse.Namespace) -> Bag:
    """Open a bag with the topics that ``--topic`` gives."""
    return Bag(path, topics=dict(args.topic))


def _renamed(text: str) -> tuple[str, str]:
    name, given, topic = text.partition('=')
    name = name.strip('/')
    if not given or not topic or name not in TOPIC_TYPES:
        raise argparse.ArgumentTypeError(
            f'{text!r} is not NAME=TOPIC with a NAME such as camera/image_raw, '
            'camera/camera_info, joint_states, odom'
        )
    return name, topic
