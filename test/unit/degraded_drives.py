"""One drive, rendered once; each test degrades it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from rendered_drives import (
    camera_image,
    drive,
    error_of,
    FRAME_NS,
    MAP,
    MOUNT,
    START,
    START_SIGMA,
    Step,
)

from landmark_nav.calibration import Calibration, UNITS
from landmark_nav.localization.localizer import LocalizationConfig, LocalizationUpdate, Localizer
from landmark_nav.types import CameraFrame, FloatArray, LandmarkMap, PoseEstimate

SECONDS = 12.0
FAULT_S = 3.2

# The mount is measured well, and may be displaced.
KNOWN = Calibration.of_mount(
    MOUNT, {name: 1e-3 if unit == 'm' else 2e-3 for name, unit in UNITS.items() if unit != 's'}
)


def pan_rad(seconds: float) -> float:
    """Look about."""
    return float(1.8 * np.sin(0.6 * seconds))


Sensed = tuple[Step, CameraFrame | None]
Change = Callable[[Step, CameraFrame | None], Sensed]


def sensed_drive() -> list[Sensed]:
    """A drive: truth and odometry, every eighth time an image."""
    rng = np.random.default_rng(5)
    found: list[Sensed] = []
    for step in drive(rng, SECONDS):
        frame = None
        if step.stamp_ns % FRAME_NS == 0:
            frame = camera_image(step.pose, pan_rad(step.stamp_ns * 1e-9), rng)
            frame = replace(frame, stamp_ns=step.stamp_ns)
        found.append((step, frame))
    return found


@dataclass(frozen=True, eq=False)
class Moment:
    """After an image: time since the fault, verdict, error, sigmas, odometry refused by then."""

    after_s: float
    status: str
    reason: str
    error: FloatArray
    sigma: FloatArray
    update: LocalizationUpdate
    refused: int

    @property
    def nees(self) -> float:
        """Of x, y and heading."""
        return float(self.error @ np.linalg.solve(self.update.fused.covariance, self.error))


def run(
    sensed: list[Sensed],
    change: Change,
    landmarks: LandmarkMap = MAP,
    start: FloatArray = START,
    config: LocalizationConfig | None = None,
    late: int = 0,
    calibration: Calibration = KNOWN,
) -> Iterator[Moment]:
    """
    Drive with what `change` makes of each moment after the fault begins; odometry may be None.

    Images come after so many samples of odometry that are newer.
    """
    on_the_way: deque[Sensed] = deque()
    refused = 0
    localizer = Localizer(landmarks, calibration, config or LocalizationConfig())
    localizer.initialize(PoseEstimate(0, start, np.diag(START_SIGMA**2)))
    for step, frame in sensed:
        seconds = step.stamp_ns * 1e-9 - FAULT_S
        if seconds >= 0.0:
            step, frame = change(step, frame)
        if step.odometry is not None:
            refused += localizer.add_odometry(step.odometry) is not None
        on_the_way.append((step, frame))
        if len(on_the_way) <= late:
            continue
        step, frame = on_the_way.popleft()
        if frame is None:
            continue
        seconds = step.stamp_ns * 1e-9 - FAULT_S
        update = localizer.add_frame(frame)
        assert isinstance(update, LocalizationUpdate)
        assert np.isfinite(update.fused.pose).all()
        error = error_of(update.fused, step.pose)
        sigma = np.sqrt(np.diag(update.fused.covariance))
        yield Moment(seconds, update.status, update.reason, error, sigma, update, refused)


def untouched(step: Step, frame: CameraFrame | None) -> Sensed:
    """No fault."""
    return step, frame


def check_consistent(moments: list[Moment]) -> None:
    """No undetected failure: three numbers whose errors are Gaussian reach 40 once in 10^8."""
    for moment in moments:
        assert moment.status != 'tracking' or moment.after_s < 2.0 or moment.nees < 40.0


def first(moments: list[Moment], status: str, since_s: float = 0.0) -> Moment:
    """When a verdict is first given after the fault, or after some other time."""
    return next(m for m in moments if m.after_s >= since_s and m.status == status)
