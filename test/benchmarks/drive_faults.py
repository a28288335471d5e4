"""What goes wrong on a robot, as changes of the messages of a recorded drive."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from landmark_nav.geometry import se2
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag, BagWriter
from landmark_nav.storage.bags.topics import relative_name

__all__ = [
    'FOR_GOOD_S',
    'Fault',
    'degraded',
    'displaced_drive',
    'faults',
    'late_drive',
    'starved_drive',
]

CAMERA, INFO = 'camera/image_raw/compressed', 'camera/camera_info'
JOINTS, ODOMETRY = 'joint_states', 'odom'
NS = 10**9
FOR_GOOD_S = 3600.0

# What becomes of a message of some topics while a fault lasts; None where it is not sent.
Change = Callable[[Any], Any]


@dataclass(frozen=True)
class Fault:
    """A change of `topics`; for good, if it lasts longer than the drive."""

    change: Change
    topics: tuple[str, ...]
    seconds: float = 4.0
    arrives_late_ns: int = 0
    copies: int = 1


def later(seconds: float) -> Change:
    def change(message: Any) -> Any:
        stamp = decode.stamp_ns(message.header) + round(seconds * NS)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, NS)
        return message

    return change


def nothing(message: Any) -> None:
    return None


def same(message: Any) -> Any:
    return message


def starved() -> Change:
    """Of each second the end: on a starved machine queues of sensors overflow."""

    def change(message: Any) -> Any:
        return message if decode.stamp_ns(message.header) % NS > 0.45 * NS else None

    return change


def moved(x: float, y: float, turn: float) -> Change:
    """Odometry that starts anew somewhere else."""

    def change(message: Any) -> Any:
        pose = se2.compose([x, y, turn], decode.odometry(message).pose_odom_base)
        at, q = message.pose.pose.position, message.pose.pose.orientation
        at.x, at.y = map(float, pose[:2])
        q.z, q.w = float(np.sin(0.5 * pose[2])), float(np.cos(0.5 * pose[2]))
        return message

    return change


def turned_by_hand(turn: float) -> Change:
    """The wheels claim a turn that nobody made, as if it were made without them knowing."""
    change: list[Change] = []

    def first_then(message: Any) -> Any:
        if not change:
            before = decode.odometry(message).pose_odom_base
            offset = se2.compose(se2.compose(before, [0.0, 0.0, turn]), se2.inverse(before))
            change.append(moved(*offset))
        return change[0](message)

    return first_then


def repeated() -> Change:
    first: list[Any] = []

    def change(message: Any) -> Any:
        first.append(message)
        return copy.deepcopy(first[0])

    return change


def frozen(name: str) -> Change:
    """The value of a field stays, with new stamps."""
    first: list[Any] = []

    def change(message: Any) -> Any:
        first.append(copy.deepcopy(getattr(message, name)))
        setattr(message, name, copy.deepcopy(first[0]))
        return message

    return change


def jittering(position_m: float, heading_rad: float) -> Change:
    """Odometry whose poses are off by white noise, as those of a scan matcher."""
    rng = np.random.default_rng(1)

    def change(message: Any) -> Any:
        x, y, turn = rng.normal(0.0, [position_m, position_m, heading_rad]).tolist()
        pose = decode.odometry(message).pose_odom_base
        return moved(*se2.compose(se2.compose(pose, [x, y, turn]), se2.inverse(pose)))(message)

    return change


def at_rest() -> Change:
    """Odometry that stays where it is and says that it stands."""
    stays = frozen('pose')

    def change(message: Any) -> Any:
        twist = message.twist.twist
        twist.linear.x = twist.angular.z = 0.0
        return stays(message)

    return change


def longer_focus(message: Any) -> Any:
    """A calibration of another zoom, 10 % off."""
    message.k = np.array(message.k) * [1.1, 1.0, 1.0, 1.0, 1.1, 1.0, 1.0, 1.0, 1.0]
    return message


def no_number(message: Any) -> Any:
    if hasattr(message, 'position'):
        message.position = np.full(len(message.position), np.nan)
    else:
        message.pose.pose.position.x = float('nan')
    return message


def pictured(draw: Callable[[Any], Any]) -> Change:
    def change(message: Any) -> Any:
        image = cv2.imdecode(np.frombuffer(bytes(message.data), np.uint8), cv2.IMREAD_UNCHANGED)
        message.data = cv2.imencode('.jpg', draw(image), [cv2.IMWRITE_JPEG_QUALITY, 90])[1].ravel()
        return message

    return change


def cut_off(message: Any) -> Any:
    message.data = message.data[: len(message.data) // 3]
    return message


def bumped(bag: Bag, turn_deg: tuple[float, float, float]) -> Change:
    """A camera turned about the axes of its image: right, down and ahead."""
    info = next(m for m in bag.messages([bag.require(INFO)])).message
    camera = decode.camera_model(info)
    rays = np.insert(camera.ray_grid, 2, 1.0, axis=2) @ cv2.Rodrigues(np.radians(turn_deg))[0]
    seen = camera.project(rays).astype(np.float32)
    return pictured(
        lambda image: cv2.remap(
            image, seen[..., 0], seen[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
        )
    )


def faults(bag: Bag) -> dict[str, Fault]:
    """All of them."""
    right, down, ahead = (bumped(bag, turn) for turn in ((2, 0, 0), (0, 2, 0), (0, 0, 2)))
    everything = (CAMERA, INFO, JOINTS, ODOMETRY)
    return {
        'none': Fault(same, ()),
        'odometry jumps': Fault(moved(5.0, 1.0, 1.0), (ODOMETRY,), FOR_GOOD_S),
        'odometry repeats a sample': Fault(repeated(), (ODOMETRY,)),
        'odometry stops': Fault(nothing, (ODOMETRY,)),
        'odometry freezes': Fault(frozen('pose'), (ODOMETRY,)),
        'odometry freezes and says it stands': Fault(at_rest(), (ODOMETRY,)),
        'odometry is not a number': Fault(no_number, (ODOMETRY,)),
        'odometry jitters by 1 cm': Fault(jittering(0.01, 0.005), (ODOMETRY,), FOR_GOOD_S),
        'odometry stamps 30 s back': Fault(later(-30.0), (ODOMETRY,)),
        'image stamps 30 s back': Fault(later(-30.0), (CAMERA, INFO)),
        'joint stamps 30 s back': Fault(later(-30.0), (JOINTS,)),
        'clock set back 5 s': Fault(later(-5.0), everything, FOR_GOOD_S),
        'clock set back 100 s': Fault(later(-100.0), everything, FOR_GOOD_S),
        'starved machine': Fault(starved(), (CAMERA, JOINTS, ODOMETRY), FOR_GOOD_S),
        'all comes twice': Fault(same, everything, FOR_GOOD_S, copies=2),
        'joint states stamped 200 ms late': Fault(later(0.2), (JOINTS,)),
        'joint states stamped 200 ms late for good': Fault(later(0.2), (JOINTS,), FOR_GOOD_S),
        'joint states come 200 ms late': Fault(same, (JOINTS,), 4.0, NS // 5),
        'joint states missing': Fault(nothing, (JOINTS,)),
        'joint states are not a number': Fault(no_number, (JOINTS,)),
        'joint states freeze': Fault(frozen('position'), (JOINTS,)),
        'camera bumped up 2 deg': Fault(right, (CAMERA,), FOR_GOOD_S),
        'camera bumped aside 2 deg': Fault(down, (CAMERA,), FOR_GOOD_S),
        'camera is rolled by 2 deg': Fault(ahead, (CAMERA,), FOR_GOOD_S),
        'lens covered': Fault(pictured(np.zeros_like), (CAMERA,)),
        'images cut off': Fault(cut_off, (CAMERA,)),
        'images freeze': Fault(frozen('data'), (CAMERA,)),
        'focal length 10 % off': Fault(longer_focus, (INFO,)),
        'focal length 10 % off for good': Fault(longer_focus, (INFO,), FOR_GOOD_S),
        'images stop': Fault(nothing, (CAMERA,)),
        'turned by hand 10 deg': Fault(turned_by_hand(-0.1745), (ODOMETRY,), FOR_GOOD_S),
        'kidnapped': Fault(same, ()),
        'start 1 m wrong': Fault(same, ()),
    }


def degraded(bag: Bag, name: str, fault: Fault, at_s: float) -> Iterator[tuple[str, Any, int]]:
    """Topic, message and time of recording, in the order of that."""
    out: list[tuple[str, Any, int]] = []
    wheels, carried = np.zeros(3), None
    for entry in bag.messages():
        copies = 1
        topic, log, message = relative_name(entry.topic), entry.stamp_ns, entry.message
        since = 1e-9 * (log - bag.start_ns) - at_s
        if name == 'kidnapped' and since >= 0.0:
            # It is where it comes later, and the wheels know nothing of the way there.
            if since < fault.seconds:
                continue
            message, log = later(-fault.seconds)(message), log - round(fault.seconds * NS)
            if topic == ODOMETRY:
                first = decode.odometry(message).pose_odom_base
                carried = carried or moved(*se2.compose(wheels, se2.inverse(first)))
                message = carried(message)
        elif topic == ODOMETRY and since < 0.0:
            wheels = decode.odometry(message).pose_odom_base
        elif 0.0 <= since < fault.seconds and topic in fault.topics:
            message, log = fault.change(message), log + fault.arrives_late_ns
            copies = fault.copies
        if message is not None:
            out += [(topic, message, log)] * copies
    yield from sorted(out, key=lambda sent: sent[2])


def displaced_drive(bag: Bag, path: Path, turn_deg: tuple[float, float, float]) -> Path:
    """Write a drive whose camera was displaced before its first image."""
    return _written(path, bag, Fault(bumped(bag, turn_deg), (CAMERA,), FOR_GOOD_S), 0.0)


def late_drive(bag: Bag, path: Path, late_s: float, since_s: float = 0.0) -> Path:
    """Write a drive whose joint states are stamped late from a time on."""
    return _written(path, bag, Fault(later(late_s), (JOINTS,), FOR_GOOD_S), since_s)


def starved_drive(bag: Bag, path: Path) -> Path:
    """Write a drive as a machine records it that others keep busy."""
    return _written(path, bag, Fault(starved(), (CAMERA, JOINTS, ODOMETRY), FOR_GOOD_S), 0.0)


def _written(path: Path, bag: Bag, fault: Fault, at_s: float) -> Path:
    with BagWriter(path) as written:
        for topic, message, stamp_ns in degraded(bag, 'written', fault, at_s):
            written.write(topic, message, stamp_ns)
    return path
