"""Pan and tilt."""

from __future__ import annotations

from typing import Any

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages.clouds import unpack_cloud
from landmark_nav.messages.decode.headers import duration_ns, finite, seconds, stamp_ns
from landmark_nav.messages.layouts import JOINT_DELAY
from landmark_nav.types import JointSample

__all__ = ['joint_delay', 'joint_sample', 'lone_tilt', 'sweep_trajectory']

# A joint that turns on and on may count its turns, some 160,000 of them.
_MOST_RAD = 1e6


def joint_sample(msg: Any, mount: PanTiltMount) -> JointSample | None:
    """
    Pan and tilt in a sensor_msgs/JointState; None if it is about other joints.

    Raises
    ------
    LandmarkNavError
        Names without positions, or positions that are not numbers.

    """
    names = list(msg.name)
    if mount.pan_joint not in names:
        return None
    return _sample(names, msg.position, stamp_ns(msg.header), mount, 'joint_states position')


def lone_tilt(msg: Any, mount: PanTiltMount) -> tuple[int, float] | None:
    """
    Stamp, ns, and tilt, rad, in a sensor_msgs/JointState of a tilt joint with its own driver.

    None if it tells of the pan, too, or of other joints.

    Raises
    ------
    LandmarkNavError
        Names without positions, or positions that are not numbers.

    """
    names, stamp = list(msg.name), stamp_ns(msg.header)
    if mount.pan_joint in names or mount.tilt_joint not in names:
        return None
    what = 'joint_states position'
    _check(names, msg.position, stamp, what)
    tilt = finite(msg.position[names.index(mount.tilt_joint)], what, stamp, _MOST_RAD)
    return stamp, float(tilt)


def sweep_trajectory(msg: Any, mount: PanTiltMount) -> tuple[JointSample, ...]:
    """
    Measured angles at the frames of a sweep, out of a trajectory_msgs/JointTrajectory.

    Raises
    ------
    LandmarkNavError
        It is not about the pan joint, or holds angles that are not numbers.

    """
    names = list(msg.joint_names)
    if mount.pan_joint not in names:
        raise LandmarkNavError(
            f'sweep trajectory is about {", ".join(names)!r:.60}, not about '
            f'{mount.pan_joint}: set pan_joint in robot.yaml'
        )
    start = stamp_ns(msg.header)
    return tuple(
        _sample(
            names,
            point.positions,
            start + duration_ns(point.time_from_start),
            mount,
            'sweep trajectory position',
        )
        for point in msg.points
    )


def joint_delay(msg: Any) -> tuple[float, float]:
    """
    By how much the joints' stamps are late, and its sigma, out of ``joint_delay``; s.

    Raises
    ------
    LandmarkNavError
        Fields are missing or of another kind, not one point, or values that are not numbers.

    """
    points, stamp = unpack_cloud(msg, JOINT_DELAY), stamp_ns(msg.header)
    if len(points) != 1:
        raise LandmarkNavError(f'joint_delay has {len(points)} points, not 1')
    delay, sigma = seconds(points[0].tolist(), 'joint delay', stamp)
    finite(sigma, 'sigma of the joint delay', stamp, least=0.0)
    return delay, sigma


def _sample(
    names: list[str], positions: Any, stamp: int, mount: PanTiltMount, what: str
) -> JointSample:
    _check(names, positions, stamp, what)
    pan = positions[names.index(mount.pan_joint)]
    tilt = positions[names.index(mount.tilt_joint)] if mount.tilt_joint in names else 0.0
    pan_rad, tilt_rad = finite([pan, tilt], what, stamp, _MOST_RAD).tolist()
    return JointSample(stamp, pan_rad, tilt_rad)


def _check(names: list[str], positions: Any, stamp: int, what: str) -> None:
    if len(positions) < len(names):
        raise LandmarkNavError(
            f'{what} at {stamp * 1e-9:.3f} s has {len(positions)} values for {len(names)} joints'
        )
