"""
The ROS nodes: each converts, calls a stage and publishes.

Executables are the modules with a `main`; the others are parts of theirs.

Importing any of them without ROS 2 ends the process with one line that says what to install,
because the executables import their node before they run it.
"""

from __future__ import annotations

import sys

from landmark_nav.signals import end_at_once

if sys.argv[:1] == ['-m']:
    # `python -m landmark_nav.nodes.NAME` imports this first, then all that the node needs.
    end_at_once(0)

from landmark_nav.errors import LandmarkNavError
from landmark_nav.ros import require_ros
from landmark_nav.threads import keep_to_one_thread

try:
    require_ros('this node')
except LandmarkNavError as error:
    raise SystemExit(str(error)) from None
keep_to_one_thread()
