"""The door to ROS 2: messages <-> types, parameters, QoS, diagnostics, main() and shutdown."""

from __future__ import annotations

from importlib.util import find_spec

from landmark_nav.errors import LandmarkNavError

__all__ = ['require_ros']

_PACKAGES = (
    'rclpy',
    'diagnostic_msgs',
    'geometry_msgs',
    'nav_msgs',
    'rosgraph_msgs',
    'sensor_msgs',
    'std_msgs',
    'std_srvs',
    'trajectory_msgs',
    'visualization_msgs',
)


def require_ros(what: str) -> None:
    """
    Check that `what` can run here.

    Raises
    ------
    LandmarkNavError
        rclpy or a message package is not installed.

    """
    missing = [package for package in _PACKAGES if find_spec(package) is None]
    if missing:
        raise LandmarkNavError(
            f'{what} needs ROS 2, and {", ".join(missing)} cannot be imported: '
            f"run pip install '.[ros]' or source a ROS 2 environment"
        )
