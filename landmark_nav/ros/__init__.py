"""Interface to ROS 2: topics, parameters, QoS, diagnostics, executors, `main` and shutdown."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
import os

from landmark_nav.errors import LandmarkNavError

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
# Largest domain: for larger ones, ports by DDS-RTPS, section 9.6.2, exceed 65535.
_LAST_DOMAIN = 232


def require_ros(what: str) -> None:
    """
    Check that ROS is available for `what`.

    Raises `LandmarkNavError`: rclpy or a message package cannot be imported.
    """
    missing = [package for package in _PACKAGES if find_spec(package) is None]
    if missing:
        raise LandmarkNavError(
            f'{what} needs ROS 2, and {", ".join(missing)} cannot be imported: '
            f"run pip install '.[ros]' or source a ROS 2 environment"
        )
    try:
        import_module('rclpy')
    except ImportError as error:
        raise LandmarkNavError(
            f'{what} needs ROS 2, and rclpy cannot be imported: {str(error).splitlines()[0]}: '
            f'source the ROS 2 environment that this Python belongs to'
        ) from None


def chosen_domain() -> int | None:
    """
    ROS domain by the environment variable ``ROS_DOMAIN_ID``; None if it is not set.

    Raises `LandmarkNavError`: the value is not a domain; Fast DDS would end the process.
    """
    text = os.environ.get('ROS_DOMAIN_ID', '').strip()
    if not text:
        return None
    if not text.isdecimal() or len(text) > 3 or int(text) > _LAST_DOMAIN:
        raise LandmarkNavError(
            f'ROS_DOMAIN_ID is {text[:20]!r}: set it to a number from 0 to {_LAST_DOMAIN}'
        )
    return int(text)
