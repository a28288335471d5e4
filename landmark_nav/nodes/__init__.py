"""
ROS nodes: each converts messages, calls a stage and publishes the result.

Modules with a `main` are executables; the others are parts of them. An executable imports this
package first and handles signals from here on, as its other imports take about a second.

Without ROS 2, the import of any of them ends the process with a line that says what to install,
because an executable imports its node before it runs.
"""

from __future__ import annotations

import os
import sys

from landmark_nav.signals import end_at_once

# Whether this process is a node: run by ``python -m`` or by an executable of its name.
_NAME = os.path.basename(sys.argv[0])
if _NAME == '-m' or os.path.isfile(os.path.join(os.path.dirname(__file__), f'{_NAME}.py')):
    end_at_once(0)

from landmark_nav.errors import LandmarkNavError  # noqa: E402
from landmark_nav.ros import require_ros  # noqa: E402
from landmark_nav.threads import keep_to_one_thread  # noqa: E402

keep_to_one_thread()
try:
    require_ros('this node')
except LandmarkNavError as error:
    raise SystemExit(str(error)) from None
