"""
Starts that are off, and given as such: how many landmarks are found, how soon it tracks.

``python test/benchmarks starts DRIVE --map MAP --robot robot.yaml`` begins at several moments of a
drive with a pose that is off by so many metres and degrees, its sigmas as large, and lets nothing
else look for the place. `{seed}` in paths stands for each of ``--seeds``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
import logging

import numpy as np

from landmark_nav.evaluation.tracks import PoseTrack
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.localizer import LocalizationConfig, LocalizationUpdate, Localizer
from landmark_nav.localization.relocalization import RelocalizationConfig
from landmark_nav.localization.triangulation.model import axis_from_base, bearing_residuals
from landmark_nav.localization.triplet import TripletConfig, visible_landmarks
from landmark_nav.storage.bags import Bag, sensor_events, SensorEvent
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.robot_files import load_calibration
from landmark_nav.types import CameraFrame, FloatArray, OdometrySample, PoseEstimate

CASES = ((0.0, 0.0), (0.3, 5.0), (0.3, 15.0), (0.5, 10.0), (0.7, 5.0), (1.0, 10.0))
WATCHED_S, COUNTED_S = 6.0, 2.0
# How far off a start that is right counts as given.
LEAST_SIGMA = np.array([0.02, 0.02, 0.01])
# A bearing off by more, and by more than 5 sigma, is of something else.
WRONG_RAD = 0.006


@dataclass(frozen=True)
class Outcome:
    """Of a start: landmarks in view in the first seconds, found, found wrong; seconds to track."""

    in_view: int
    right: int
    wrong: int
    tracked_s: float
    sure_and_wrong: bool


class Drive:
    """A recorded drive and what it is localized with."""

    def __init__(self, bag: str, map_folder: str, robot: str) -> None:
        self.calibration, self.map = load_calibration(robot), load_map(map_folder)
        self.mount = self.calibration.mount
        events: list[SensorEvent] = list(sensor_events(Bag(bag), self.mount))
        self.truth = PoseTrack.of(
            (e.stamp_ns, e.pose) for e in events if isinstance(e, PoseEstimate)
        )
        self.events = [e for e in events if isinstance(e, CameraFrame | OdometrySample)]

    def started(self, share: float, off: FloatArray, sigma: FloatArray) -> Outcome:
        """Begin after a share of the drive, off by (3,)."""
        first, last = self.events[0].stamp_ns, self.events[-1].stamp_ns
        begin_ns = first + round(share * (last - first))
        search = RelocalizationConfig(when_lost=False)
        config = replace(LocalizationConfig(), relocalization=search)
        localizer: Localizer | None = None
        in_view = right = wrong = 0
        tracked_s, sure_and_wrong = np.inf, False
        for event in self.events:
            seconds = 1e-9 * (event.stamp_ns - begin_ns)
            if not 0.0 <= seconds < WATCHED_S:
                continue
            true = self.truth.at([event.stamp_ns])[0]
            if localizer is None:
                localizer = Localizer(self.map, self.calibration, config)
                localizer.initialize(PoseEstimate(event.stamp_ns, true + off, np.diag(sigma**2)))
            if isinstance(event, OdometrySample):
                localizer.add_odometry(event)
                continue
            update = localizer.add_frame(event)
            assert isinstance(update, LocalizationUpdate)
            if seconds < COUNTED_S:
                counts = self._counts(event, update, true)
                in_view, right, wrong = np.add((in_view, right, wrong), counts).tolist()
            error = update.fused.pose - true
            error[2] = wrap_rad(error[2])
            if update.status == 'tracking':
                nees = error @ np.linalg.solve(update.fused.covariance, error)
                sure_and_wrong |= bool(nees > 40.0)
                close = np.hypot(*error[:2]) < 0.05 and abs(error[2]) < 0.02
                sure = np.trace(update.fused.covariance[:2, :2]) < 0.05**2
                tracked_s = min(tracked_s, seconds if close and sure else np.inf)
        return Outcome(in_view, right, wrong, tracked_s, sure_and_wrong)

    def _counts(
        self, frame: CameraFrame, update: LocalizationUpdate, true: FloatArray
    ) -> tuple[int, int, int]:
        """Landmarks in view, found where they are, found elsewhere."""
        here = PoseEstimate(frame.stamp_ns, true, np.zeros((3, 3)))
        visible = visible_landmarks(
            here,
            self.map,
            frame.camera,
            self.mount,
            frame.pan_rad,
            frame.tilt_rad,
            TripletConfig(),
        )
        found = update.observation.detections
        places = self.map.positions[self.map.indices(found.ids), :2]
        axis = axis_from_base(here, self.mount).pose
        off = np.abs(wrap_rad(bearing_residuals(axis, places, found.bearing_rad)))
        wrong = off > np.maximum(WRONG_RAD, 5.0 * np.sqrt(found.variance_rad2))
        return len(visible), int(np.sum(~wrong)), int(np.sum(wrong))


def row(away_m: float, turned_deg: float, outcomes: Sequence[Outcome]) -> str:
    """Line of the table."""
    table = np.array([astuple(outcome) for outcome in outcomes])
    in_view, right, wrong = table[:, :3].sum(axis=0)
    seconds = table[:, 3]
    p90 = np.quantile(seconds, 0.9, method='nearest')
    return (
        f'{away_m:4.1f} m {turned_deg:4.0f} deg {len(table):7d} {right / in_view:8.3f} '
        f'{wrong:6.0f} {np.isfinite(seconds).sum():8d} {np.median(seconds):9.1f} {p90:6.1f} '
        f'{table[:, 4].sum():6.0f}'
    )


def main() -> int:
    """Print a line for each way to be off."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('bag')
    parser.add_argument('--map', required=True)
    parser.add_argument('--robot', required=True)
    parser.add_argument('--seeds', nargs='+', default=[''])
    parser.add_argument('--starts', type=int, default=5, help='in each drive and case (5)')
    args = parser.parse_args()
    # A displaced tilt that is found is not what this is about.
    logging.getLogger('landmark_nav').setLevel(logging.ERROR)
    outcomes: dict[tuple[float, float], list[Outcome]] = {case: [] for case in CASES}
    for seed in args.seeds:
        drive = Drive(*(path.format(seed=seed) for path in (args.bag, args.map, args.robot)))
        rng = np.random.default_rng(5)
        for (away_m, turned_deg), known in outcomes.items():
            for share in np.linspace(0.02, 0.8, args.starts):
                direction, side = rng.uniform(-np.pi, np.pi), rng.choice([-1.0, 1.0])
                turn = np.radians(turned_deg)
                x, y = away_m * np.cos(direction), away_m * np.sin(direction)
                sigma = np.maximum([away_m, away_m, turn], LEAST_SIGMA)
                known.append(drive.started(float(share), np.array([x, y, side * turn]), sigma))
    print('off by         starts    found  wrong  tracking  median s    p90  wrong and sure')
    for case, several in outcomes.items():
        print(row(*case, several))
    return 0
