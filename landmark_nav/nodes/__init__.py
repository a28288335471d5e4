"""
The ROS nodes: each converts, calls a stage and publishes.

Executables are the modules with a `main`; the others are parts of theirs. An executable imports
this first: it heeds signals from here on, while it imports the rest for a second or so.

Importing any of them without ROS 2 ends the process with one line that says what to install,
because the executables import their node before they run it.
"""

from __future__ import annotations

import os
import sys

from landmark_nav.signals import end_at_once


def _is_program() -> bool:
    """Whether this process is a node: by ``python -m``, or by an executable of a node's name."""
    name = os.path.basename(sys.argv[0])
    return name == '-m' or os.path.isfile(os.path.join(os.path.dirname(__file__), f'{name}.py'))


if _is_program():
    end_at_once(0)

from landmark_nav.errors import LandmarkNavError  # noqa: E402
from landmark_nav.ros import require_ros  # noqa: E402
from landmark_nav.threads import keep_to_one_thread  # noqa: E402

keep_to_one_thread()
try:
    require_ros('this node')
except LandmarkNavError as error:
    raise SystemExit(str(error)) from None
