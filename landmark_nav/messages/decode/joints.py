"""Pan and tilt angles."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

from landmark_nav.errors import inside, LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages.decode.headers import finite, stamp_ns, time_ns
from landmark_nav.types import JointSample

# Number of joint names that are kept; a robot has some tens.
_MAX_NAMES = 200
# Largest joint angle: a continuous joint may count its turns, up to 160,000.
_MAX_RAD = 1e6


class JointNames:
    """
    The pan and tilt joints among the names in joint states, which its `mount` has.

    A joint with the name in ``robot.yaml``, in the given `mount`, is used. Otherwise it is the
    only joint whose name is that name behind a prefix, such as ``robot1/pan_joint`` or
    ``robot1_pan_joint``.
    """

    def __init__(self, mount: PanTiltMount) -> None:
        self._given = self.mount = mount
        self._seen: set[str] = set()

    def add(self, names: Iterable[str]) -> str | None:
        """Add the names of a message; return a line for the log if a prefixed joint is used."""
        new = set(names) - self._seen
        if not new or len(self._seen) >= _MAX_NAMES:
            return None
        self._seen |= new
        before, wanted = self.mount, (self._given.pan_joint, self._given.tilt_joint)
        pan, tilt = (matching_name(name, self._seen) or name for name in wanted)
        self.mount = replace(self._given, pan_joint=pan, tilt_joint=tilt)
        taken = [
            f'{now} for {name}'
            for now, was, name in zip(
                (pan, tilt), (before.pan_joint, before.tilt_joint), wanted, strict=True
            )
            if now not in (was, name)
        ]
        return f'joint {" and ".join(taken)} is taken' if taken else None

    @property
    def missing(self) -> str:
        """Error text: why the pan is unknown, with the names that arrive."""
        names, pan = sorted(self._seen), self._given.pan_joint
        if self.pan_arrives:
            return f'{self.mount.pan_joint} arrives no more: is its driver alive?'
        if could_be := [name for name in names if _is_prefixed(name, pan)]:
            return f'{", ".join(could_be[:5])} could be {pan}: set pan_joint in robot.yaml'
        if not names:
            return 'messages name no joint: publish name and position of each joint'
        more = f' and {len(names) - 5} more' if len(names) > 5 else ''
        return f'{", ".join(names[:5])}{more} arrive, not {pan}: set pan_joint in robot.yaml'

    @property
    def tilt_missing(self) -> str:
        """Text: the tilt joint of robot.yaml does not come with the pan; '' if it does."""
        pan, tilt = self.mount.pan_joint, self.mount.tilt_joint
        if not (self.mount.has_tilt and self.pan_arrives) or tilt in self._seen:
            return ''
        return f'{pan} comes without {tilt}, taken as 0: publish it, or drop it from robot.yaml'

    @property
    def pan_arrives(self) -> bool:
        """Whether the pan joint is among the names that arrived."""
        return self.mount.pan_joint in self._seen


def matching_name(name: str, names: Iterable[str]) -> str | None:
    """Return `name` if it is among `names`, else the only one that is `name` with a prefix."""
    known = set(names)
    found = {name} & known or {other for other in known if _is_prefixed(other, name)}
    return found.pop() if len(found) == 1 else None


def _is_prefixed(name: str, joint: str) -> bool:
    return name.endswith(tuple(f'{separator}{joint}' for separator in '/_.:-'))


def joint_angles(msg: Any, mount: PanTiltMount) -> tuple[int, float | None, float | None]:
    """Stamp, ns, pan and tilt, rad, of a sensor_msgs/JointState; None for a joint it lacks."""
    stamp = stamp_ns(msg.header)
    return stamp, *_angles(list(msg.name), msg.position, stamp, mount, 'joint_states position')


def sweep_trajectory(
    msg: Any, mount: PanTiltMount, drop: Callable[[LandmarkNavError], None] | None = None
) -> tuple[JointSample, ...]:
    """
    Measured angles at the frames of a sweep, out of a trajectory_msgs/JointTrajectory.

    `drop` is called with the reason if a point cannot be used; without it, this is an error, too.
    Raises `LandmarkNavError`: two frames have one stamp, or no point can be used.
    """
    names = list(msg.joint_names)
    joints = JointNames(mount)
    joints.add(names)
    if not joints.pan_arrives:
        raise LandmarkNavError(f'in the sweep trajectory {joints.missing}')
    start = stamp_ns(msg.header)
    samples: dict[int, JointSample] = {}
    errors = []
    for point in msg.points:
        try:
            with inside('time_from_start of the sweep trajectory'):
                stamp = start + time_ns(point.time_from_start)
            where = 'sweep trajectory position'
            pan_rad, tilt_rad = _angles(names, point.positions, stamp, joints.mount, where)
            assert pan_rad is not None, 'pan_arrives'
        except LandmarkNavError as error:
            errors.append(error)
            continue
        sample = JointSample(stamp, pan_rad, tilt_rad or 0.0)
        if samples.setdefault(stamp, sample) != sample:
            raise LandmarkNavError(
                f'two points of the sweep trajectory are at {1e-9 * stamp:.3f} s: set the '
                'time_from_start of each'
            )
    if errors and (drop is None or not samples):
        raise errors[0]
    if drop is not None:
        for one in errors:
            drop(one)
    return tuple(samples.values())


def _angles(
    names: list[str], positions: Any, stamp: int, mount: PanTiltMount, what: str
) -> tuple[float | None, float | None]:
    joints, where = (mount.pan_joint, mount.tilt_joint), f'{what} at {stamp * 1e-9:.3f} s'
    if len(positions) < len(names) and not {*joints}.isdisjoint(names):
        raise LandmarkNavError(
            f'{where} has {len(positions)} values for {len(names)} joints: publish one each'
        )
    if max(map(names.count, joints)) > 1:
        raise LandmarkNavError(f'{where} is of a joint that is named twice: name each once')
    pan_rad, tilt_rad = (
        float(finite(positions[names.index(name)], f'{what} of {name}', stamp, _MAX_RAD))
        if name in names
        else None
        for name in joints
    )
    return pan_rad, tilt_rad
