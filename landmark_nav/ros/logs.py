"""The core logs with `logging`; this hands its records to the loggers of nodes."""

from __future__ import annotations

from collections.abc import Sequence
import logging

from rclpy.node import Node


class _Forwarder(logging.Handler):
    def __init__(self, nodes: Sequence[Node]) -> None:
        super().__init__()
        self._loggers = {node.get_name(): node.get_logger() for node in nodes}
        self._first = nodes[0].get_logger()

    def emit(self, record: logging.LogRecord) -> None:
        """Log at the nearest ROS severity, as the node whose name ends that of the record."""
        logger = self._loggers.get(record.name.rpartition('.')[2], self._first)
        text = self.format(record)
        if record.levelno >= logging.ERROR:
            logger.error(text)
        elif record.levelno >= logging.WARNING:
            logger.warning(text)
        elif record.levelno >= logging.INFO:
            logger.info(text)
        else:
            logger.debug(text)


def forward_logs(nodes: Sequence[Node]) -> None:
    """Send what the package logs to the loggers of nodes, instead of where it went before."""
    package = logging.getLogger('landmark_nav')
    package.handlers = [_Forwarder(nodes)]
    package.setLevel(logging.INFO)
    package.propagate = False
