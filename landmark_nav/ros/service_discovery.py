"""Wait with a request until its answer can come back."""

from __future__ import annotations

import time
from typing import Any

from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.task import Future

_AGAIN_S = 0.5


class ServiceDiscovery:
    """
    Context manager that finds out whether the node of a service has discovered this one.

    A client is ready once it knows the server. The server may come to know the client later, and
    an answer that it gives before is lost (rmw_fastrtps waits 0.1 s for that; its issue 842). But
    a node makes its ends known in the order in which it made them, by one reliable writer: who
    answers a client made later knows the earlier ones too. So every node's ``get_parameters`` is
    asked for nothing, until it answers.

    Parameters
    ----------
    node : Node
        Who has made a client of that service already.
    """

    def __init__(self, node: Node, service: str) -> None:
        self._node, self._service = node, node.resolve_service_name(service)
        self._client: Any = None
        self._answers: list[Future[Any]] = []
        self._next_s = 0.0

    def __enter__(self) -> ServiceDiscovery:
        """Return itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Ask no more."""
        if self._client is not None:
            self._node.destroy_client(self._client)

    def is_complete(self) -> bool:
        """Whether it is; asks again now and then."""
        if self._client is None and (server := self._server()):
            self._client = self._node.create_client(GetParameters, f'{server}/get_parameters')
        ready = self._client is not None and self._client.service_is_ready()
        if ready and time.monotonic() > self._next_s:
            self._next_s = time.monotonic() + _AGAIN_S
            self._answers.append(self._client.call_async(GetParameters.Request()))
        return any(answer.done() for answer in self._answers)

    def _server(self) -> str:
        """Full name of the node that offers the service, '' while that is not known."""
        node = self._node
        for name, space in node.get_node_names_and_namespaces():
            try:
                offered = dict(node.get_service_names_and_types_by_node(name, space))
            except RuntimeError:  # It is gone meanwhile, or not all of it is known yet.
                continue
            if self._service in offered:
                return f'{space.rstrip("/")}/{name}'
        return ''
