"""
What goes wrong on a robot, put into a recorded drive: when it is told, and when it is over.

``python test/faults_check.py DRIVE --map MAP --robot robot.yaml --start X Y THETA`` spoils the
messages of a drive's bag for some seconds, one way after the other, reads each as ``evaluate``
does, and prints when the state stops saying ``tracking``, why, how long after the fault it is
right again, and how many pictures were sure of a wrong pose later than two seconds after the
fault began. It exits with 1 if there are any, or if the pose does not come back.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
import copy
from dataclasses import dataclass
import logging
from pathlib import Path
import sys
import tempfile
from typing import Any

import cv2
import numpy as np

from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.pipeline import LocalizationConfig, LocalizationUpdate, Localizer
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag, BagWriter, sensor_events
from landmark_nav.storage.bags.topics import relative_name
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.setup_files import load_robot
from landmark_nav.types import FloatArray, OdometrySample, PoseEstimate

CAMERA, INFO = 'camera/image_raw/compressed', 'camera/camera_info'
JOINTS, ODOMETRY, TRUTH = 'joint_states', 'odom', 'ground_truth/odom'
START_SIGMA = np.array([0.05, 0.05, 0.035])
# NEES of a wrong pose that is sure: over 5 sigma. Time within which faults are to be told.
SURE, TOLD_S = 40.0, 2.0
# A pose this near is right again.
RIGHT_M, RIGHT_RAD = 0.05, 0.02
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


def moved(x: float, y: float, turn: float) -> Change:
    """Odometry that starts anew somewhere else."""

    def change(message: Any) -> Any:
        pose = se2.compose([x, y, turn], decode.odometry(message).pose_odom_base)
        at, q = message.pose.pose.position, message.pose.pose.orientation
        at.x, at.y = map(float, pose[:2])
        q.z, q.w = float(np.sin(0.5 * pose[2])), float(np.cos(0.5 * pose[2]))
        return message

    return change


def repeated() -> Change:
    first: list[Any] = []

    def change(message: Any) -> Any:
        first.append(message)
        return copy.deepcopy(first[0])

    return change


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
    """A camera turned about the axes of its picture: right, down and ahead."""
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
        'odometry is not a number': Fault(no_number, (ODOMETRY,)),
        'odometry stamps 30 s back': Fault(later(-30.0), (ODOMETRY,)),
        'picture stamps 30 s back': Fault(later(-30.0), (CAMERA, INFO)),
        'joint stamps 30 s back': Fault(later(-30.0), (JOINTS,)),
        'clock set back 5 s': Fault(later(-5.0), everything, FOR_GOOD_S),
        'clock set back 100 s': Fault(later(-100.0), everything, FOR_GOOD_S),
        'joint states stamped 200 ms late': Fault(later(0.2), (JOINTS,)),
        'joint states come 200 ms late': Fault(same, (JOINTS,), 4.0, NS // 5),
        'joint states missing': Fault(nothing, (JOINTS,)),
        'joint states are not a number': Fault(no_number, (JOINTS,)),
        'camera bumped up 2 deg': Fault(right, (CAMERA,), FOR_GOOD_S),
        'camera bumped aside 2 deg': Fault(down, (CAMERA,), FOR_GOOD_S),
        'camera leans 2 deg': Fault(ahead, (CAMERA,), FOR_GOOD_S),
        'lens covered': Fault(pictured(np.zeros_like), (CAMERA,)),
        'pictures cut off': Fault(cut_off, (CAMERA,)),
        'pictures stop': Fault(nothing, (CAMERA,)),
        'kidnapped': Fault(same, ()),
        'start 1 m wrong': Fault(same, ()),
    }


def spoilt(bag: Bag, name: str, fault: Fault, at_s: float) -> Iterator[tuple[str, Any, int]]:
    """Topic, message and time of recording, in the order of that."""
    out: list[tuple[str, Any, int]] = []
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
                carried = carried or moved(*se2.compose(wheels, se2.inverse(first)))
                message = carried(message)
        elif topic == ODOMETRY and since < 0.0:
            wheels = decode.odometry(message).pose_odom_base
        elif 0.0 <= since < fault.seconds and topic in fault.topics:
            message, log = fault.change(message), log + fault.arrives_late_ns
        if message is not None:
            out.append((topic, message, log))
    yield from sorted(out, key=lambda sent: sent[2])


@dataclass
class Outcome:
    """Seconds until told, and from the end until right again; pictures sure of a wrong pose."""

    told_s: float = np.nan
    back_s: float = np.nan
    wrong: int = 0
    reason: str = ''

    def note(self, after_s: float, status: tuple[str, str]) -> None:
        if after_s >= 0.0 and np.isnan(self.told_s) and status[0] != 'tracking':
            self.told_s, self.reason = after_s, ': '.join(status)

    def judge(self, after_s: float, over_s: float, fused: PoseEstimate, true: FloatArray) -> None:
        """Of a pose that is tracking."""
        error = fused.pose - true
        error[2] = wrap_rad(error[2])
        sure = error @ np.linalg.solve(fused.covariance, error) > SURE
        self.wrong += bool(after_s > TOLD_S and sure)
        right = np.hypot(*error[:2]) < RIGHT_M and abs(error[2]) < RIGHT_RAD
        if np.isnan(self.back_s) and right and after_s >= over_s:
            self.back_s = after_s - over_s


def outcome(
    events: Iterator[Any], localizer: Localizer, start: FloatArray, at_s: float, over_s: float
) -> Outcome:
    """Drive, with a fault from `at_s` on, for `over_s`."""
    done, true, period_s, ticks = Outcome(), np.zeros(3), 0.05, 0
    for event in events:
        if isinstance(event, PoseEstimate):
            # The clock of the truth is never set back.
            true, ticks = event.pose, ticks + 1
            continue
        if localizer.estimate() is None:
            localizer.initialize(PoseEstimate(event.stamp_ns, start, np.diag(START_SIGMA**2)))
        after_s = period_s * (ticks - 1) - at_s
        if isinstance(event, OdometrySample):
            localizer.add_odometry(event)
        else:
            update = localizer.add_frame(event)
            assert isinstance(update, LocalizationUpdate)
            if update.status == 'tracking' and after_s >= 0.0:
                done.judge(after_s, over_s, update.fused, true)
        done.note(after_s, localizer.status)
    return done


def main() -> int:
    """Print a line for each fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('drive')
    parser.add_argument('--map', required=True)
    parser.add_argument('--robot', required=True)
    parser.add_argument('--start', nargs=3, type=float, required=True)
    parser.add_argument('--at', type=float, default=12.0, help='seconds into the drive (12)')
    parser.add_argument('--only', default='', help='faults whose name holds this')
    args = parser.parse_args()
    logging.getLogger('landmark_nav').setLevel(logging.CRITICAL)
    mount, landmarks = load_robot(args.robot), load_map(args.map)
    bag, good = Bag(args.drive), True
    print(f'{"fault":34} told  back  sure and wrong')
    for name, fault in faults(bag).items():
        if args.only not in name:
            continue
        start, at_s = np.array(args.start), args.at
        if name == 'start 1 m wrong':
            start, at_s = np.add(start, [0.8, 0.6, 0.0]), 0.0
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch) / 'drive'
            with BagWriter(path) as written:
                for topic, message, log in spoilt(bag, name, fault, at_s):
                    written.write(topic, message, log)
            over_s = fault.seconds if fault.topics and fault.seconds < FOR_GOOD_S else 0.0
            localizer = Localizer(landmarks, mount, LocalizationConfig())
            done = outcome(sensor_events(Bag(path), mount), localizer, start, at_s, over_s)
        told, back = (f'{s:5.1f}' if s == s else '    -' for s in (done.told_s, done.back_s))
        print(f'{name:34}{told} {back} {done.wrong:5d}  {done.reason[:90]}', flush=True)
        good &= not done.wrong and np.isfinite(done.back_s)
    return 0 if good else 1


if __name__ == '__main__':
    sys.exit(main())
