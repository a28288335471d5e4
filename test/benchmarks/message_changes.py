"""
Changes of recorded messages, as what goes wrong on a robot makes them.

A change gets the messages of its topics in turn and returns a message, several, or None for none.
Many remember what came before: make a new one for each recording.
"""

from collections.abc import Callable
import copy
from itertools import count
from typing import Any

import cv2
import numpy as np

from landmark_nav.geometry import se2
from landmark_nav.messages import decode
from landmark_nav.types import FloatArray

CAMERA, INFO = 'camera/image_raw/compressed', 'camera/camera_info'
JOINTS, ODOMETRY = 'joint_states', 'odom'
NS = 10**9

Change = Callable[[Any], Any]


def first_seen():
    """Return a memory: it gives the first value that it was given, whatever comes later."""
    kept: list[Any] = []

    def first(value):
        kept.append(value)
        return kept[0]

    return first


# When


def same(message):
    return message


def nothing(message):
    return None


def where(chosen, change):
    """Change the messages whose number, from 0, is chosen."""
    number = count()
    return lambda message: change(message) if chosen(next(number)) else message


def from_on(first, change):
    return where(lambda k: k >= first, change)


def each_second(change):
    return where(lambda k: k % 2, change)


def one_in(every, change):
    return where(lambda k: k % every == 0, change)


def chained(first, second):
    return lambda message: second(first(message))


def gone(first, last):
    return where(lambda k: first <= k < last, nothing)


def rarely(every):
    return where(lambda k: k % every, nothing)


def starved():
    """Of each second the end: on a starved machine queues of sensors overflow."""
    return lambda message: message if decode.stamp_ns(message.header) % NS > 0.45 * NS else None


def with_second(every, make, later_ns=7_000_000):
    """Another source sends after each `every`-th message, a little later."""

    def both(message):
        other = make(copy.deepcopy(message))
        return [message, stamped(other, decode.stamp_ns(other.header) + later_ns)]

    return one_in(every, both)


# Stamps


def stamped(message, stamp_ns):
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, NS)
    return message


def stamps(change):
    """Change stamps, in nanoseconds."""
    return lambda message: stamped(message, change(decode.stamp_ns(message.header)))


def later(seconds):
    return stamps(lambda stamp: stamp + round(seconds * NS))


def set_forward(seconds, after_s):
    """The clock of all streams that are changed is set, some time after the first message."""
    first = first_seen()
    return stamps(
        lambda stamp: stamp + round(seconds * NS) * (stamp - first(stamp) > after_s * NS)
    )


def drifting(share):
    first = first_seen()
    return stamps(lambda stamp: first(stamp) + round((stamp - first(stamp)) * (1.0 + share)))


def shaken(spread_s):
    rng = np.random.default_rng(3)
    return stamps(lambda stamp: stamp + round(float(rng.uniform(-spread_s, spread_s)) * NS))


def rounded_stamp(step_s):
    step = round(step_s * NS)
    return stamps(lambda stamp: stamp // step * step)


def in_microseconds(message):
    message.header.stamp.nanosec //= 1000
    return message


# Any field


def field(name, change):
    """Change an array of a message."""

    def altered(message):
        setattr(message, name, change(np.array(getattr(message, name))))
        return message

    return altered


def frozen(name):
    """The value of a field stays, with new stamps."""
    first = first_seen()

    def change(message):
        setattr(message, name, copy.deepcopy(first(copy.deepcopy(getattr(message, name)))))
        return message

    return change


def repeated():
    first = first_seen()
    return lambda message: copy.deepcopy(first(message))


def no_number(message):
    if hasattr(message, 'position'):
        message.position = np.full(len(message.position), np.nan)
    else:
        message.pose.pose.position.x = float('nan')
    return message


class LowPass:
    """First-order low-pass filter of vectors; `turning` is the place of an angle among them."""

    def __init__(self, seconds, turning=None):
        self._seconds, self._turning = seconds, turning
        self._last: tuple[int, FloatArray] | None = None

    def __call__(self, stamp_ns, value):
        if self._last is not None:
            before_ns, before = self._last
            if (k := self._turning) is not None:
                value[k] = before[k] + (value[k] - before[k] + np.pi) % (2.0 * np.pi) - np.pi
            share = 1.0 - np.exp(-(stamp_ns - before_ns) / NS / self._seconds)
            value = before + share * (value - before)
        self._last = stamp_ns, value
        return value


# Joints


def joints(change):
    """Change the positions of all joints."""
    return field('position', change)


def angle(change, joint='pan_joint'):
    """Change the position of one joint."""

    def altered(message):
        position, k = np.array(message.position), list(message.name).index(joint)
        position[k] = change(position[k])
        message.position = position
        return message

    return altered


def times(scale):
    return angle(lambda pan: scale * pan)


def added(angle_rad, joint='pan_joint'):
    return angle(lambda pan: pan + angle_rad, joint)


def nameless(message):
    message.name, message.position = [], np.zeros(0)
    return message


def swapped_names(message):
    message.name = list(message.name)[::-1]
    return message


def speeds_as_angles():
    """Positions of joints that are their speeds."""
    held: list[tuple[int, Any]] = []

    def change(message):
        stamp, position = decode.stamp_ns(message.header), np.array(message.position)
        before, old = held[-1] if held else (stamp - NS, position)
        held.append((stamp, position))
        message.position = (position - old) / max((stamp - before) / NS, 1e-3)
        return message

    return change


def filtered(seconds):
    """Joints behind a low-pass filter."""
    low_pass = LowPass(seconds)

    def change(message):
        stamp = decode.stamp_ns(message.header)
        message.position = low_pass(stamp, np.array(message.position))
        return message

    return change


def held(every):
    """Joints that are measured now and then, and sent with new stamps in between."""
    number, last = count(), np.zeros(0)

    def measured(position):
        nonlocal last
        last = position if next(number) % every == 0 else last
        return last

    return joints(measured)


def against_the_map():
    """The pan has the heading of the odometry in it, as that of a stabilised camera."""
    heading = 0.0

    def change(message):
        nonlocal heading
        if hasattr(message, 'pose'):
            heading = decode.odometry(message).pose_odom_base[2]
            return message
        return added(heading)(message)

    return change


def swept(scale):
    """Pans of a trajectory, scaled."""

    def change(message):
        others = [1.0] * (len(message.joint_names) - 1)
        for point in message.points:
            point.positions = np.array(point.positions) * [scale, *others]
        return message

    return change


def pushed(frame, angle_rad):
    """The base of the first sweep is turned: its pans, from a frame on, are less than seen."""

    def change(message):
        for point in message.points[frame:]:
            point.positions = np.array(point.positions)
            point.positions[0] -= angle_rad
        return message

    return where(lambda k: k == 0, change)


# Odometry


def turned_to(message, heading):
    q = message.pose.pose.orientation
    q.z, q.w = float(np.sin(0.5 * heading)), float(np.cos(0.5 * heading))
    return message


def placed(message, pose):
    """Odometry with another pose (3,)."""
    at = message.pose.pose.position
    at.x, at.y = float(pose[0]), float(pose[1])
    return turned_to(message, float(pose[2]))


def poses(change):
    """Change poses (3,) of odometry."""
    return lambda message: placed(message, change(decode.odometry(message).pose_odom_base))


def moved(x, y, turn):
    """Odometry that starts anew somewhere else."""
    return poses(lambda pose: se2.compose([x, y, turn], pose))


def turned_by_hand(turn):
    """The wheels claim a turn that nobody made, as if it were made without them knowing."""
    first = first_seen()

    def offset(pose):
        return first(se2.compose(se2.compose(pose, [0.0, 0.0, turn]), se2.inverse(pose)))

    return poses(lambda pose: se2.compose(offset(pose), pose))


def jittering(position_m, heading_rad):
    """Odometry whose poses are off by white noise, as those of a scan matcher."""
    rng = np.random.default_rng(1)
    sigma = [position_m, position_m, heading_rad]
    return poses(lambda pose: se2.compose(pose, rng.normal(0.0, sigma)))


def from_zero():
    """Odometry that begins anew where it is."""
    first = first_seen()
    return poses(lambda pose: se2.relative(first(pose), pose))


def driven(x=1.0, y=1.0, yaw=1.0, twist=1.0):
    """Odometry with its numbers scaled; the twist goes with the pose, times `twist`."""
    turned: list[float] = []

    def change(message):
        at = message.pose.pose.position
        turned.append(decode.odometry(message).pose_odom_base[2])
        turned[:] = np.unwrap(turned[-2:]).tolist()
        at.x, at.y = at.x * x, at.y * y
        return twist_times(abs(x) * twist, yaw * twist)(turned_to(message, yaw * turned[-1]))

    return change


def twist_times(linear, angular):
    def change(message):
        message.twist.twist.linear.x *= linear
        message.twist.twist.angular.z *= angular
        return message

    return change


def in_degrees():
    """Odometry whose heading is in degrees, and whose twist is in radians."""
    turned = driven(yaw=57.29578)
    return lambda message: twist_times(1.0, 1.0 / 57.29578)(turned(message))


def at_rest():
    """Odometry that stays where it is and says that it stands."""
    stays = frozen('pose')
    return lambda message: twist_times(0.0, 0.0)(stays(message))


def at_origin(message):
    """Odometry that stands at its origin."""
    return twist_times(0.0, 0.0)(placed(message, np.zeros(3)))


def standing(first, last):
    """Odometry that stands for a while, and goes on from there."""
    true, shown, number = np.zeros(3), np.zeros(3), count()

    def change(message):
        nonlocal true, shown
        k, now = next(number), decode.odometry(message).pose_odom_base
        stands = first <= k < last
        if not k:
            shown = now
        elif not stands:
            shown = se2.compose(shown, se2.relative(true, now))
        true = now
        return twist_times(1.0 - stands, 1.0 - stands)(placed(message, shown))

    return change


def curved(a_second, a_metre):
    """Odometry, pose and twist, that turns in addition by time and by path."""
    last: list[Any] = []

    def change(message):
        sample = decode.odometry(message)
        stamp, pose = sample.stamp_ns, sample.pose_odom_base
        before_ns, before, shown = last or (stamp, pose, pose)
        step = se2.relative(before, pose)
        step[2] += a_second * (stamp - before_ns) / NS + a_metre * np.hypot(*step[:2])
        shown = se2.compose(shown, step)
        last[:] = [stamp, pose, shown]
        twist = message.twist.twist
        twist.angular.z += a_second + a_metre * abs(twist.linear.x)
        return placed(message, shown)

    return change


def odometry_filtered(seconds):
    """Odometry, pose and twist, behind a low-pass filter."""
    low_pass = LowPass(seconds, turning=2)

    def change(message):
        sample, twist = decode.odometry(message), message.twist.twist
        now = np.array([*sample.pose_odom_base, twist.linear.x, twist.angular.z])
        now = low_pass(sample.stamp_ns, now)
        twist.linear.x, twist.angular.z = float(now[3]), float(now[4])
        return placed(message, now)

    return change


def path(by):
    """Multiply positions by a matrix (2, 2); headings stay as they were."""

    def change(message):
        at = message.pose.pose.position
        at.x, at.y = (np.array(by) @ [at.x, at.y]).tolist()
        return message

    return change


exchanged, mirrored = path([[0.0, 1.0], [1.0, 0.0]]), path([[1.0, 0.0], [0.0, -1.0]])


def quaternion(change):
    """Change x, y, z, w of the orientation."""

    def altered(message):
        q = message.pose.pose.orientation
        q.x, q.y, q.z, q.w = map(float, change(q.x, q.y, q.z, q.w))
        return message

    return altered


def yaw_as_z(message):
    """Yaw written into z of the quaternion."""
    yaw = decode.odometry(message).pose_odom_base[2]
    return quaternion(lambda *_: (0.0, 0.0, yaw, 1.0))(message)


def of_the_camera():
    """Odometry that turns with the pan, as that of a camera."""
    pan = 0.0

    def change(message):
        nonlocal pan
        if hasattr(message, 'name'):
            pan = float(message.position[list(message.name).index('pan_joint')])
            return message
        return turned_to(message, decode.odometry(message).pose_odom_base[2] + pan)

    return change


# Images and their calibration


def pictured(draw):
    def drawn(data):
        image = np.ascontiguousarray(draw(cv2.imdecode(data, cv2.IMREAD_UNCHANGED)))
        return cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].ravel()

    return field('data', drawn)


def content(source):
    """Image k shows what image `source(k)` did; none is sent where that is negative."""
    seen: list[Any] = []

    def change(message):
        seen.append(message.data)
        k = source(len(seen) - 1)
        message.data = seen[k]
        return message if k >= 0 else None

    return change


def in_reverse(frames):
    """Images of the first sweep in reverse order."""
    first: list[Any] = []

    def change(message):
        first.append(message)
        if len(first) < frames:
            return None
        data = [one.data for one in first]
        for one, other in zip(first, data[::-1], strict=True):
            one.data = other
        return first

    return where(lambda k: k < frames, change)


cut_off = field('data', lambda data: data[: len(data) // 3])


def zoomed(scale):
    def zoom(image):
        height, width = image.shape[:2]
        grown = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)
        top, left = (grown.shape[0] - height) // 2, (grown.shape[1] - width) // 2
        return grown[top : top + height, left : left + width]

    return pictured(zoom)


def half_black(image):
    covered = image.copy()
    covered[:, : image.shape[1] // 2] = 0
    return covered


def bumped(bag, turn_deg):
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


def lens(fx, fy, cx=1.0, cy=1.0):
    """Calibration with its focal lengths and principal point scaled."""
    return field('k', lambda k: k * [fx, 1.0, cx, 1.0, fy, cy, 1.0, 1.0, 1.0])


def centred(x_px, y_px):
    return field('k', lambda k: np.add(k, [0, 0, x_px, 0, 0, y_px, 0, 0, 0]))


def distorted(scale):
    return field('d', lambda d: scale * d)
