"""Client for programs that control the nodes: call services, listen, drive, record."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
import time
from typing import Any

from rcl_interfaces.srv import GetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from landmark_nav.errors import LandmarkNavError, one_line
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages import decode, encode
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.run import join_ros
from landmark_nav.ros.topics import PANORAMA_TOPICS, ros_factory, TOPICS
from landmark_nav.storage.bags import BagWriter
from landmark_nav.storage.bags.transforms import RobotTransforms
from landmark_nav.types import OdometrySample, Panorama, PoseEstimate

_AGAIN_S = 0.5


class ServiceDiscovery:
    """
    Context manager that detects whether the server of a service has discovered this node.

    A client is ready when it has discovered the server. The server may discover the client later,
    and an earlier answer is lost (rmw_fastrtps waits 0.1 s for that; its issue 842). But a node
    announces its endpoints in the order of their creation by one reliable writer: a server that
    answers a client created later has discovered the earlier ones. So ``get_parameters`` of the
    server is called without names until it answers.
    """

    def __init__(self, node: Node, service: str) -> None:
        self._node, self._service = node, node.resolve_service_name(service)
        self._client: Any = None
        self._answers: list[Future[Any]] = []
        self._next_s = 0.0

    def __enter__(self) -> ServiceDiscovery:
        return self

    def __exit__(self, *error: object) -> None:
        if self._client is not None:
            self._node.destroy_client(self._client)

    def is_complete(self) -> bool:
        """Whether the server has discovered this node; repeats the call every `_AGAIN_S`."""
        if self._client is None and (server := self.server()):
            self._client = self._node.create_client(GetParameters, f'{server}/get_parameters')
        ready = self._client is not None and self._client.service_is_ready()
        if ready and time.monotonic() > self._next_s:
            self._next_s = time.monotonic() + _AGAIN_S
            self._answers.append(self._client.call_async(GetParameters.Request()))
        return any(answer.done() for answer in self._answers)

    def server(self) -> str:
        """Full name of the node that offers the service; '' while it is unknown."""
        node = self._node
        for name, space in node.get_node_names_and_namespaces():
            try:
                offered = dict(node.get_service_names_and_types_by_node(name, space))
            except RuntimeError:  # the node has left, or is not fully discovered yet
                continue
            if self._service in offered:
                return f'{space.rstrip("/")}/{name}'
        return ''


_POLL_S = 0.02
# Largest time until the service of a node that was just started is discovered, even if a machine
# starts many nodes at once.
_START_S = 30.0
_RECORDED_DEPTH = 200
# Largest length of the reason of a node in an error.
_REASON_LENGTH = 70
_LEVELS = {level.value: level.name for level in Level}


@dataclass(frozen=True)
class NodeStatus:
    """State of a node by ``/diagnostics``, OK, DEGRADED or LOST, and when it arrived."""

    level: str = ''
    reason: str = ''
    values: Mapping[str, str] = field(default_factory=dict)
    heard_s: float = field(default_factory=time.monotonic)

    @property
    def lost(self) -> bool:
        """Whether the level is LOST."""
        return self.level == Level.LOST.name


class _ClientNode(LandmarkNode):
    def health(self) -> Health:
        """Always OK."""
        return Health(Level.OK, 'conducting')


class RobotClient:
    """
    Context manager with a node `name`; messages are handled in `wait`, not in the background.

    `watch` is called repeatedly meanwhile; an exception ends the wait. The domain is by default
    that of ``ROS_DOMAIN_ID``, else 0. If `drives`, it publishes velocities and start poses; if
    `observes`, it subscribes to odometry, poses and panoramas too, else only to diagnostics.
    `status` has the last `NodeStatus` of each node by its name, without the namespace of the
    client; `fixes` counts triangulated poses, `panoramas` come in the order of arrival.
    """

    def __init__(
        self,
        domain_id: int | None = None,
        watch: Callable[[], None] = lambda: None,
        name: str = 'conductor',
        namespace: str = '',
        drives: bool = True,
        observes: bool = True,
    ) -> None:
        self.name, self._watch = name, watch
        self._context = Context()
        # The caller handles signals, since it has processes to end.
        self._domain_id = join_ros(context=self._context, domain_id=domain_id)
        self._node = _ClientNode(name, 'script', context=self._context, namespace=namespace)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self.status: dict[str, NodeStatus] = {}
        self.odometry: OdometrySample | None = None
        self.fused: PoseEstimate | None = None
        self.fixes = 0
        self.panoramas: list[Panorama] = []
        if drives:
            self._velocity = self._node.advertise('cmd_vel')
            self._initial_pose = self._node.advertise('initialpose')
        self._node.listen('/diagnostics', self._on_diagnostics)
        if not observes:
            return
        self._node.listen('odom', self._on_odometry)
        self._node.listen('odometry/fused', self._on_fused)
        self._node.listen('triangulation/pose', self._on_fix)
        self._node.listen_together(PANORAMA_TOPICS, self._on_panorama)

    def __enter__(self) -> RobotClient:
        return self

    def __exit__(self, *error: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def status_of(self, node: str) -> NodeStatus:
        """Last report of a node; empty before the first."""
        return self.status.get(node, NodeStatus())

    def unheard(self) -> set[str]:
        """Nodes that publish ``/diagnostics``, and of which none has arrived."""
        known = self._node.get_publishers_info_by_topic('/diagnostics')
        names = (f'{one.node_namespace.rstrip("/")}/{one.node_name}' for one in known)
        return {*map(self._local, names)} - {*self.status}

    def _local(self, full_name: str) -> str:
        """Name of a node without the namespace of the client."""
        return full_name.removeprefix(f'{self._node.get_namespace().rstrip("/")}/')

    def wait(
        self, condition: Callable[[], bool], timeout_s: float, what: str, of: str = ''
    ) -> None:
        """
        Handle messages until `condition` is true; `LandmarkNavError` if it takes too long.

        `what` completes "waited 10 s for"; `of` is the node that is waited for, if it is known.
        """
        deadline = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline:
                raise LandmarkNavError(f'waited {timeout_s:g} s for {what}: {self._heard(of)}')
            self._executor.spin_once(timeout_sec=_POLL_S)
            self._watch()

    def pause(self, seconds: float) -> None:
        """Handle messages for some time."""
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            self._executor.spin_once(timeout_sec=min(_POLL_S, seconds))
            self._watch()

    def call(
        self, service: str, timeout_s: float, meanwhile: Callable[[], None] = lambda: None
    ) -> str:
        """
        Call a Trigger service and return its message.

        `meanwhile` is called repeatedly while waiting for the answer.

        Raises `LandmarkNavError`: the service is not found or does not answer in time, or it
        refuses; then with its reason.
        """
        client: Any = self._node.create_client(Trigger, service)
        there = f'the service {service} in ROS domain {self._domain_id}'
        self.wait(client.service_is_ready, min(timeout_s, _START_S), there)
        with ServiceDiscovery(self._node, service) as service_discovery:
            server = self._local(service_discovery.server())
            known = f'the node of {service} to know its client'
            self.wait(service_discovery.is_complete, timeout_s, known, server)
        future = client.call_async(Trigger.Request())

        def answered() -> bool:
            meanwhile()
            return bool(future.done())

        self.wait(answered, timeout_s, f'an answer of {service}', server)
        self._node.destroy_client(client)
        response = future.result()
        assert response is not None
        if not response.success:
            raise LandmarkNavError(f'{service} refused: {response.message}')
        return str(response.message)

    def advertise(self, topic: str) -> Any:
        """Publisher of a public topic."""
        return self._node.advertise(topic)

    def listen(self, topic: str, callback: Callable[[Any], None]) -> Any:
        """Subscribe to a public topic, and return the subscription."""
        return self._node.listen(topic, callback)

    def drive(self, linear_m_s: float, angular_rad_s: float) -> None:
        """Publish ``cmd_vel``."""
        message = ros_factory('geometry_msgs/msg/Twist')
        message.linear.x, message.angular.z = float(linear_m_s), float(angular_rad_s)
        self._velocity.publish(message)

    def start_at(self, estimate: PoseEstimate) -> None:
        """Publish ``initialpose``."""
        self._initial_pose.publish(encode.pose(ros_factory, estimate))

    @contextmanager
    def recording(
        self, path: Path, topics: Sequence[str], mount: PanTiltMount | None = None
    ) -> Iterator[None]:
        """
        Context manager: record public topics without deserialising them.

        With a mount, the bag also holds the transforms of the robot.
        """
        transforms = None if mount is None else RobotTransforms(mount)
        # Transforms are computed at the end, since this thread also steers the robot.
        kept: list[tuple[str, bytes, int]] = []
        with BagWriter(path) as bag:

            def writer(topic: str) -> Callable[[Any], None]:
                def write(data: bytes) -> None:
                    now_ns = time.time_ns()
                    bag.write_serialized(topic, TOPICS[topic].type_name, data, now_ns)
                    if transforms is not None and topic in transforms.topics:
                        kept.append((topic, data, now_ns))

                return write

            subscriptions = [
                self._node.listen(topic, writer(topic), depth=_RECORDED_DEPTH, raw=True)
                for topic in topics
            ]
            try:
                yield
            finally:
                for subscription in subscriptions:
                    self._node.destroy_subscription(subscription)
            if transforms is not None:
                for topic, data, stamp_ns in kept:
                    for name, message in transforms.of(topic, data):
                        bag.write(name, message, stamp_ns)

    def _heard(self, of: str) -> str:
        """Text: the last report of a node, or of the worst one if it is not known."""
        if of and of not in self.status:
            return f'no diagnostics of {of}: it hangs, or is stopped'
        rank = {level: k for k, level in enumerate(_LEVELS.values())}
        others = [(name, status) for name, status in self.status.items() if name != self.name]
        if not others:
            return 'no node is heard: start them: landmark-nav up (or is ROS_DOMAIN_ID theirs?)'
        by_level = max(others, key=lambda one: rank.get(one[1].level, len(rank)))
        name, status = (of, self.status[of]) if of else by_level
        ago_s = time.monotonic() - status.heard_s
        return f'{name} said {ago_s:.0f} s ago: {one_line(status.reason, _REASON_LENGTH)}'

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            name, full_name = status.name.partition(':')[0], str(status.hardware_id)
            if full_name.endswith(f'/{name}'):  # that of a device otherwise
                name = self._local(full_name)
            self.status[name] = NodeStatus(
                _LEVELS.get(bytes(status.level), str(status.level)),
                status.message,
                {pair.key: pair.value for pair in status.values},
            )

    def _on_odometry(self, message: Any) -> None:
        self.odometry = decode.odometry(message)

    def _on_fused(self, message: Any) -> None:
        self.fused = decode.pose_estimate(message)

    def _on_fix(self, _message: Any) -> None:
        self.fixes += 1

    def _on_panorama(self, image: Any, info: Any, pose: Any) -> None:
        self.panoramas.append(decode.panorama(image, info, pose))
