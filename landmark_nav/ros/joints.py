"""``joint_states`` as a node hears them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from landmark_nav.errors import one_line
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages import decode
from landmark_nav.ros.inputs import IrrelevantError
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.types import JointSample


def listen_for_joints(
    node: LandmarkNode,
    mount: PanTiltMount,
    on_sample: Callable[[JointSample], None],
    on_tilt: Callable[[int, float], None],
    *,
    depth: int | None = None,
) -> None:
    """
    Call back with pan and tilt; with stamp, ns, and tilt, rad, where the tilt comes by itself.

    Diagnostics list which joints are named as long as that of the pan is not among them.
    """
    names = decode.JointNames(mount)

    def take(message: Any) -> None:
        if taken := names.add(message.name):
            node.get_logger().info(f'joint_states: {taken}')
        sample = decode.joint_sample(message, names.mount)
        if sample is not None:
            on_sample(sample)
            return
        if (tilt := decode.lone_tilt(message, names.mount)) is not None:
            on_tilt(*tilt)
        raise IrrelevantError(one_line(names.missing))

    node.listen('joint_states', take, depth=depth)
