"""The content of a `robot.yaml` by the URDF of a robot: where its camera is, and how it turns."""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from landmark_nav.errors import LandmarkNavError, shown
from landmark_nav.geometry.camera import BODY_FROM_OPTICAL
from landmark_nav.geometry.se2 import rot_y, rot_z, rotation_rpy
from landmark_nav.types import FloatArray

# Frames of REP-103 and REP-105: those of cameras, of the robot, and of its base on the floor.
_OPTICAL, _BASE, _FLOOR = '_optical_frame', 'base_link', 'base_footprint'
_TURNING = ('revolute', 'continuous')
# Least cosine of the angle between the pan axis and a vertical line, and between the tilt axis and
# the left of the view.
_ALIGNED = math.cos(math.radians(20.0))


class _Joint(NamedTuple):
    """A joint: `translation` (3,) and `rotation` (3, 3) of its frame in that of its parent."""

    name: str
    kind: str
    parent: str
    translation: FloatArray
    rotation: FloatArray
    element: ElementTree.Element

    @property
    def axis(self) -> FloatArray:
        """Unit vector (3,) along the axis, in the frame of the joint."""
        axis = _numbers(self.element, 'axis', 'xyz', '1 0 0', self.name)
        length = float(np.linalg.norm(axis))
        if not length:
            raise LandmarkNavError(f'joint {shown(self.name)}: its axis has no direction')
        return axis / length

    def limit(self, key: str) -> float:
        """Value of a limit, 0 if there is none."""
        return float(_numbers(self.element, 'limit', key, '0', self.name, 1)[0])


def robot_of_urdf(text: str, camera_frame: str = '') -> dict[str, Any]:
    """
    Return the fields of `robot.yaml` that a URDF defines; sigmas are not among them.

    The pan joint is the upright one between ``base_link`` and the optical frame of the camera, a
    tilt joint may follow it. Heights are above ``base_footprint``, if there is one.

    Raises `LandmarkNavError`: the text is no URDF, no camera or several turn about an upright
    axis, or other joints move it.

    Parameters
    ----------
    text : str
        URDF, without macros.
    camera_frame : str
        Optical frame of the camera; by default the only one that a joint turns.
    """
    joints = _joints(text)
    optical = [name for name in joints if _OPTICAL in name]
    if camera_frame and camera_frame not in joints:
        which = f'take one of {shown(optical)}' if optical else f'name one with {_OPTICAL}'
        raise LandmarkNavError(f'no joint holds a frame {shown(camera_frame)}: {which}')
    parents = {joint.parent for joint in joints.values()}
    if joints and _BASE not in parents:
        roots = shown(sorted(parents - joints.keys()))
        how = f'call the base of the robot so (the first frames are {roots}), or write robot.yaml'
        raise LandmarkNavError(f'no joint hangs on a frame {_BASE}: {how}')
    frames = [camera_frame] if camera_frame else optical
    chains = {name: _chain(joints, name) for name in frames}
    # A camera on a lift or gripper is another one, unless it is named.
    chains = {
        name: chain
        for name, chain in chains.items()
        if (camera_frame or not _sliding(chain)) and _turning(chain)
    }
    if len(chains) != 1:
        what = f'{", ".join(chains)} turn' if chains else 'no joint turns a camera'
        how = f'give FILE:FRAME, with the optical frame of one camera that turns on {_BASE}'
        raise LandmarkNavError(f'{what}: {how}')
    (chain,) = chains.values()
    pan, *others = _turning(chain)
    number = chain.index(pan)
    place, turn = _along(chain[: number + 1])
    place[2] += _height(joints)
    of_axis = _onto(pan.axis)
    upright = turn @ of_axis
    if abs(upright[2, 2]) < _ALIGNED:
        raise LandmarkNavError(f'{pan.name} turns the camera about no upright axis')
    center, camera = _along(chain[number + 1 :])
    # In a frame with z along the pan axis. The yaw of the camera in it adds to the pan.
    center, camera = of_axis.T @ center, of_axis.T @ camera @ BODY_FROM_OPTICAL.T
    roll, pitch, yaw = _rpy(camera)
    tilt = -pitch
    if abs(tilt) > math.pi / 4.0:
        (frame,) = chains
        how = 'give a frame with z along the view, x to the right'
        raise LandmarkNavError(f'{shown(frame)} looks {math.degrees(tilt):+.0f} deg up: {how}')
    for other in others:
        between = chain[number + 1 : chain.index(other) + 1]
        left = rot_z(-yaw) @ of_axis.T @ _along(between)[1] @ other.axis
        if len(others) > 1 or abs(left[1]) < _ALIGNED:
            raise LandmarkNavError(f'{other.name} moves the camera too: neither pan nor tilt')
        if left[1] > 0.0:
            # Both axes of a unit that hangs upside down are turned over.
            way = f'downwards, as {pan.name} points down' if upright[2, 2] < 0.0 else 'upwards'
            raise LandmarkNavError(
                f'{other.name}: its angles have to be positive {way}: turn its axis, and what '
                'drives it, round; if it never moves, make it fixed'
            )
    if others:
        # The tilt turns the camera about the origin of the mount: it is put as high as its axis.
        to_tilt, _ = _along(chain[number + 1 : chain.index(others[0]) + 1])
        rise = np.array([0.0, 0.0, (of_axis.T @ to_tilt)[2]])
        place, center = place + upright @ rise, center - rise
    axis = upright @ rot_z(yaw)
    document: dict[str, Any] = {
        'base_frame': _BASE,
        'pan_joint': pan.name,
        'pan_axis': {'xyz': place.tolist(), 'rpy': _rpy(axis)},
        'optical_center_offset': (rot_y(tilt) @ rot_z(-yaw) @ center).tolist(),
        'camera_roll': roll,
        'camera_tilt': tilt,
    }
    if others:
        document['tilt_joint'] = others[0].name
    low, high, rate = map(pan.limit, ('lower', 'upper', 'velocity'))
    if pan.kind == 'revolute' and -math.tau <= low < high <= math.tau:
        document |= {'pan_min': low, 'pan_max': high}
    if rate:
        document['pan_rate'] = rate
    return document


def _joints(text: str) -> dict[str, _Joint]:
    """Joints by the frame that they hold."""
    # Entities could expand without bound; no URDF has any.
    if '<!DOCTYPE' in text or '<!ENTITY' in text:
        raise LandmarkNavError('a URDF without a document type is expected')
    try:
        robot = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise LandmarkNavError(f'not a URDF: {error}') from error
    joints = {}
    for joint in robot.iterfind('joint'):
        name = joint.get('name', '')
        parent, child = (_attribute(joint, tag, 'link') for tag in ('parent', 'child'))
        xyz, rpy = (_numbers(joint, 'origin', key, '0 0 0', name) for key in ('xyz', 'rpy'))
        joints[child] = _Joint(
            name, joint.get('type', 'fixed'), parent, xyz, rotation_rpy(rpy), joint
        )
    return joints


def _attribute(joint: ElementTree.Element, tag: str, key: str, default: str = '') -> str:
    element = joint.find(tag)
    return default if element is None else element.get(key, default)


def _numbers(
    joint: ElementTree.Element, tag: str, key: str, default: str, name: str, count: int = 3
) -> FloatArray:
    text = _attribute(joint, tag, key, default)
    try:
        numbers = np.array([float(part) for part in text.split()])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != count or not np.isfinite(numbers).all():
        how = f'give {count} number{"s" * (count > 1)}; expand macros with xacro'
        raise LandmarkNavError(f'joint {shown(name)}: {tag} {key} is {shown(text)}: {how}')
    return numbers


def _chain(joints: dict[str, _Joint], frame: str) -> list[_Joint]:
    """Joints from the base to a frame; none if it is not fixed to the base."""
    chain: list[_Joint] = []
    while frame != _BASE:
        if frame not in joints or len(chain) > len(joints):
            return []
        chain.append(joints[frame])
        frame = chain[-1].parent
    return chain[::-1]


def _sliding(chain: Sequence[_Joint]) -> list[str]:
    """Names of the joints of a chain that may move otherwise than by turning."""
    return [joint.name for joint in chain if joint.kind not in (*_TURNING, 'fixed')]


def _turning(chain: Sequence[_Joint]) -> list[_Joint]:
    """Joints of a chain that may move."""
    if sliding := _sliding(chain):
        raise LandmarkNavError(f'{sliding[0]} moves the camera too: only pan and tilt may')
    return [joint for joint in chain if joint.kind in _TURNING]


def _along(chain: Sequence[_Joint]) -> tuple[FloatArray, FloatArray]:
    """Translation (3,) and rotation (3, 3) along joints that are at zero."""
    translation, rotation = np.zeros(3), np.eye(3)
    for joint in chain:
        translation = translation + rotation @ joint.translation
        rotation = rotation @ joint.rotation
    return translation, rotation


def _height(joints: dict[str, _Joint]) -> float:
    """Height of the base above the floor, m."""
    if _FLOOR in joints and joints[_FLOOR].parent == _BASE:
        return -float(joints[_FLOOR].translation[2])
    if _BASE in joints and joints[_BASE].parent == _FLOOR:
        return float(joints[_BASE].translation[2])
    return 0.0


def _onto(axis: FloatArray) -> FloatArray:
    """Rotation (3, 3) of z onto a direction (3,)."""
    yaw, down = math.atan2(axis[1], axis[0]), math.acos(min(max(float(axis[2]), -1.0), 1.0))
    return np.asarray(rot_z(yaw) @ rot_y(down) @ rot_z(-yaw))


def _rpy(rotation: FloatArray) -> list[float]:
    """Roll, pitch, yaw of a rotation (3, 3), as `rotation_rpy`."""
    angles: list[float] = Rotation.from_matrix(rotation).as_euler('xyz').tolist()
    return angles
