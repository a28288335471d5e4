"""What goes wrong on a robot while it drives, put into the messages of a recorded drive."""

from dataclasses import dataclass

import message_changes as change
from message_changes import CAMERA, INFO, JOINTS, later, NS, ODOMETRY
import numpy as np

from landmark_nav.geometry import se2
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag, BagWriter
from landmark_nav.storage.bags.definitions import relative_name

FOR_GOOD_S = 3600.0
EVERYTHING = (CAMERA, INFO, JOINTS, ODOMETRY)
SENSORS = (CAMERA, JOINTS, ODOMETRY)


@dataclass(frozen=True)
class Fault:
    """A change of `topics`; for good, if it lasts longer than the drive."""

    change: change.Change
    topics: tuple[str, ...]
    seconds: float = 4.0
    arrives_late_ns: int = 0
    copies: int = 1


def faults(bag):
    """All of them."""
    right, down, ahead = (change.bumped(bag, turn) for turn in ((2, 0, 0), (0, 2, 0), (0, 0, 2)))
    black = change.pictured(np.zeros_like)
    return {
        'none': Fault(change.same, ()),
        'odometry jumps': Fault(change.moved(5.0, 1.0, 1.0), (ODOMETRY,), FOR_GOOD_S),
        'odometry repeats a sample': Fault(change.repeated(), (ODOMETRY,)),
        'odometry stops': Fault(change.nothing, (ODOMETRY,)),
        'odometry freezes': Fault(change.frozen('pose'), (ODOMETRY,)),
        'odometry freezes and says it stands': Fault(change.at_rest(), (ODOMETRY,)),
        'odometry is not a number': Fault(change.no_number, (ODOMETRY,)),
        'odometry jitters by 1 cm': Fault(change.jittering(0.01, 0.005), (ODOMETRY,), FOR_GOOD_S),
        'odometry stamps 30 s back': Fault(later(-30.0), (ODOMETRY,)),
        'image stamps 30 s back': Fault(later(-30.0), (CAMERA, INFO)),
        'joint stamps 30 s back': Fault(later(-30.0), (JOINTS,)),
        'clock set back 5 s': Fault(later(-5.0), EVERYTHING, FOR_GOOD_S),
        'clock set back 100 s': Fault(later(-100.0), EVERYTHING, FOR_GOOD_S),
        'starved machine': Fault(change.starved(), SENSORS, FOR_GOOD_S),
        'all comes twice': Fault(change.same, EVERYTHING, FOR_GOOD_S, copies=2),
        'joint states stamped 200 ms late': Fault(later(0.2), (JOINTS,)),
        'joint states stamped 200 ms late for good': Fault(later(0.2), (JOINTS,), FOR_GOOD_S),
        'joint states come 200 ms late': Fault(change.same, (JOINTS,), 4.0, NS // 5),
        'joint states missing': Fault(change.nothing, (JOINTS,)),
        'joint states are not a number': Fault(change.no_number, (JOINTS,)),
        'joint states freeze': Fault(change.frozen('position'), (JOINTS,)),
        'camera bumped up 2 deg': Fault(right, (CAMERA,), FOR_GOOD_S),
        'camera bumped aside 2 deg': Fault(down, (CAMERA,), FOR_GOOD_S),
        'camera is rolled by 2 deg': Fault(ahead, (CAMERA,), FOR_GOOD_S),
        'lens covered': Fault(black, (CAMERA,)),
        'images cut off': Fault(change.cut_off, (CAMERA,)),
        'images freeze': Fault(change.frozen('data'), (CAMERA,)),
        'focal length 10 % off': Fault(change.lens(1.1, 1.1), (INFO,)),
        'focal length 10 % off for good': Fault(change.lens(1.1, 1.1), (INFO,), FOR_GOOD_S),
        'images stop': Fault(change.nothing, (CAMERA,)),
        'nothing comes for 10 s': Fault(change.nothing, EVERYTHING, 10.0),
        'turned by hand 10 deg': Fault(change.turned_by_hand(-0.1745), (ODOMETRY,), FOR_GOOD_S),
        'kidnapped': Fault(change.same, ()),
        'start 1 m wrong': Fault(change.same, ()),
    }


def degraded(bag, name, fault, at_s):
    """Yield topic, message and time of recording."""
    wheels, carried = np.zeros(3), None
    for entry in bag.messages():
        topic, log, message = relative_name(entry.topic), entry.stamp_ns, entry.message
        since = 1e-9 * (log - bag.start_ns) - at_s
        if name == 'kidnapped' and since >= 0.0:
            # It is where it comes later, and the wheels know nothing of the way there.
            if since < fault.seconds:
                continue
            message, log = later(-fault.seconds)(message), log - round(fault.seconds * NS)
            if topic == ODOMETRY:
                first = decode.odometry(message).pose_odom_base
                carried = carried or change.moved(*se2.compose(wheels, se2.inverse(first)))
                message = carried(message)
        elif topic == ODOMETRY and since < 0.0:
            wheels = decode.odometry(message).pose_odom_base
        elif 0.0 <= since < fault.seconds and topic in fault.topics:
            message, log = fault.change(message), log + fault.arrives_late_ns
            if message is not None:
                yield from [(topic, message, log)] * (fault.copies - 1)
        if message is not None:
            yield topic, message, log


def recorded(path):
    """Topics, messages and times of recording of a bag, to be changed and written again."""
    return [(entry.topic, entry.message, entry.stamp_ns) for entry in Bag(path).messages()]


def write_bag(path, messages):
    """Write messages, each with its topic and time of recording, in the order of that."""
    with BagWriter(path) as written:
        for message in sorted(messages, key=lambda sent: sent[2]):
            written.write(*message)
    return path


def rewritten(source, path, topics, change, recorded=False):
    """Write a bag again with messages of `topics` changed; if `recorded`, log times as stamps."""

    def altered():
        for entry in Bag(source).messages():
            topic, message, logged = relative_name(entry.topic), entry.message, entry.stamp_ns
            if topic in topics:
                stamp = decode.stamp_ns(message.header)
                message = change(message)
                if recorded and message is not None:
                    logged += decode.stamp_ns(message.header) - stamp
            messages = message if isinstance(message, list) else [message]
            yield from ((topic, m, logged + k) for k, m in enumerate(messages) if m is not None)

    return write_bag(path, altered())


def displaced_drive(bag, path, turn_deg):
    """Write a drive whose camera was displaced before its first image."""
    fault = Fault(change.bumped(bag, turn_deg), (CAMERA,), FOR_GOOD_S)
    return write_bag(path, degraded(bag, 'displaced', fault, 0.0))


def late_drive(bag, path, late_s, since_s=0.0):
    """Write a drive whose joint states are stamped late from a time on."""
    fault = Fault(later(late_s), (JOINTS,), FOR_GOOD_S)
    return write_bag(path, degraded(bag, 'late', fault, since_s))


def starved_drive(bag, path):
    """Write a drive as a machine records it that others keep busy."""
    fault = Fault(change.starved(), SENSORS, FOR_GOOD_S)
    return write_bag(path, degraded(bag, 'starved', fault, 0.0))
