"""
What goes wrong on a robot, put into a recorded drive: when it is reported, and when it is over.

``python test/benchmarks faults DRIVE --map MAP --robot robot.yaml --start X Y THETA`` spoils the
messages of a drive's bag for some seconds, one way after the other, reads each as ``evaluate``
does, and prints when the state stops saying ``tracking``, why, how long after the fault it is
right again, and how long after its beginning an image was still sure of a wrong pose (over 5
sigma, and `tracking`). It exits with 1 if that is later than two seconds, or if the pose does
not come back.
"""

from dataclasses import dataclass
import logging
from pathlib import Path
import tempfile

from drive_faults import degraded, faults, FOR_GOOD_S, write_bag
from harness import any_of, Drive, drive_parser, START_SIGMA
import numpy as np

from landmark_nav.evaluation.metrics import pose_errors, undetected_failures
from landmark_nav.localization.localizer import LocalizationConfig, LocalizationUpdate, Localizer
from landmark_nav.storage.bags import Bag, sensor_events
from landmark_nav.types import OdometrySample, PoseEstimate

# Time within which faults are to be reported.
REPORTED_S = 2.0
# A pose this near is right again.
RIGHT_M, RIGHT_RAD = 0.05, 0.02


@dataclass
class Outcome:
    """
    Of a fault that lasts `over_s`: seconds from its beginning until it is reported, and to the
    last pose that is wrong without a report; `back_s` from its end, or from the report where it
    has none, until the pose is right again; of the `images` since its beginning those that are
    tracking, and those that are wrong without a report.
    """

    over_s: float
    reported_s: float = np.nan
    back_s: float = np.nan
    wrong_s: float = np.nan
    images: int = 0
    tracking: int = 0
    wrong: int = 0
    reason: str = ''

    def note(self, after_s, status):
        if after_s >= 0.0 and np.isnan(self.reported_s) and status[0] != 'OK':
            self.reported_s, self.reason = after_s, ': '.join(status)

    def judge(self, after_s, update, true):
        self.images += 1
        if update.status != 'OK':
            return
        self.tracking += 1
        error = pose_errors([update.fused.pose], [true])
        if undetected_failures(error, update.fused.covariance[None], np.ones(1, np.bool_)):
            self.wrong_s = after_s
            self.wrong += 1
        right = np.hypot(*error[0, :2]) < RIGHT_M and abs(error[0, 2]) < RIGHT_RAD
        over_s = self.over_s if self.over_s < FOR_GOOD_S else np.nan_to_num(self.reported_s)
        if np.isnan(self.back_s) and right and after_s >= over_s:
            self.back_s = after_s - over_s

    def __str__(self):
        times = (self.reported_s, self.back_s, self.wrong_s)
        reported, back, wrong = (f'{t:5.1f}' if t == t else '    -' for t in times)
        share = self.tracking / max(self.images, 1)
        return f'{reported} {back} {share:9.2f} {wrong} {self.wrong:4d}  {self.reason[:90]}'


def outcome(events, localizer, start, at_s, over_s):
    """Drive, with a fault from `at_s` on, for `over_s`."""
    done, true, period_s, ticks = Outcome(over_s), np.zeros(3), 0.05, 0
    for event in events:
        if isinstance(event, PoseEstimate):
            # The clock of the truth is never set back.
            true, ticks = event.pose, ticks + 1
            continue
        if localizer.fusion.estimate() is None:
            localizer.initialize(PoseEstimate(event.stamp_ns, start, np.diag(START_SIGMA**2)))
        after_s = period_s * (ticks - 1) - at_s
        if isinstance(event, OdometrySample):
            localizer.add_odometry(event)
        else:
            update = localizer.add_frame(event)
            assert isinstance(update, LocalizationUpdate)
            if after_s >= 0.0:
                done.judge(after_s, update, true)
        done.note(after_s, localizer.status())
    return done


def main():
    """Print a line for each fault."""
    parser = drive_parser(__doc__)
    parser.add_argument('--at', type=float, default=12.0, help='seconds into the drive (12)')
    parser.add_argument('--only', nargs='+', help='faults whose name holds one of these')
    args = parser.parse_args()
    logging.getLogger('landmark_nav').setLevel(logging.CRITICAL)
    drive, good = Drive.of(args), True
    print(f'{"fault":44} seen   back  tracking  wrong without a report')
    for name, fault in faults(drive.bag).items():
        if not any_of(args.only, name):
            continue
        start, at_s = drive.start, args.at
        if name == 'start 1 m wrong':
            start, at_s = np.add(start, [0.8, 0.6, 0.0]), 0.0
        with tempfile.TemporaryDirectory() as scratch:
            path = write_bag(Path(scratch) / 'drive', degraded(drive.bag, name, fault, at_s))
            over_s = fault.seconds if fault.topics else 0.0
            localizer = Localizer(drive.landmarks, drive.known, LocalizationConfig())
            done = outcome(sensor_events(Bag(path), drive.mount), localizer, start, at_s, over_s)
        print(f'{name:44}{done}', flush=True)
        good &= not done.wrong_s > REPORTED_S and np.isfinite(done.back_s)
    return 0 if good else 1
