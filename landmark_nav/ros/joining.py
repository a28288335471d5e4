"""The way into a ROS graph."""

from __future__ import annotations

import rclpy
from rclpy.context import Context
from rclpy.signals import SignalHandlerOptions

from landmark_nav.errors import LandmarkNavError
from landmark_nav.ros import chosen_domain

__all__ = ['join_ros']


def join_ros(context: Context | None = None, domain_id: int | None = None) -> int:
    """
    Initialise ROS by the command line, signals left alone; return the domain.

    Parameters
    ----------
    context : Context, optional
        The process's own by default.
    domain_id : int, optional
        That of the environment by default.

    Raises
    ------
    LandmarkNavError
        ROS refuses the arguments, a parameter file or the environment.

    """
    domain_id = (chosen_domain() or 0) if domain_id is None else domain_id
    try:
        rclpy.init(
            context=context,
            domain_id=domain_id,
            signal_handler_options=SignalHandlerOptions.NO,
        )
    except RuntimeError as error:  # RCLError, UnknownROSArgsError
        raise LandmarkNavError(' '.join(str(error).split())) from error
    return domain_id
