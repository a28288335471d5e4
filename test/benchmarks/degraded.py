"""
A drive with errors in it: whole streams that are off, then degraded images.

``python test/benchmarks degraded`` takes the recorded room in ``bags/``; ``DRIVE --map MAP
--robot F --room F --start X Y THETA`` another. The first table says for each error of a stream
what ``landmark-nav check`` says and whether that names the cause, the second what localization
makes of degraded images. It exits with 1 if a cause that users reported is not named, if fewer
than nine in ten of the others are, or if there is an undetected failure.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
import json
import logging
from pathlib import Path
import re
import tempfile

from as_a_user import as_jpeg, command
import cv2
import numpy as np
import numpy.typing as npt
from stream_errors import (
    FIFTH,
    FOURTH,
    FURTHER,
    OTHERS,
    REPORTED,
    SEVENTH,
    SIXTH,
    StreamError,
    SWEEPS,
    THIRD,
    write_drive,
)

from landmark_nav.arrays import ImageArray
from landmark_nav.calibration import Calibration
from landmark_nav.diagnosis import diagnose
from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.metrics import pose_errors
from landmark_nav.evaluation.replay import Replay, replay
from landmark_nav.localization.localizer import LocalizationConfig
from landmark_nav.simulation.surfaces import light_of, values_of
from landmark_nav.storage.bags import Bag, sensor_events, SensorEvent
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.robot_files import load_calibration, save_calibration
from landmark_nav.storage.setup_files import load_robot, load_room
from landmark_nav.types import CameraFrame

BAGS = Path(__file__).resolve().parents[2] / 'bags'

Degradation = Callable[[ImageArray, np.random.Generator], ImageArray]

START_SIGMA = np.array([0.05, 0.05, 0.035])
# NEES of a wrong pose that is sure: over 5 sigma.
SURE = 40.0


def _as(camera_image: npt.NDArray[np.floating]) -> ImageArray:
    return np.asarray(np.clip(camera_image, 0.0, 255.0), np.uint8)


def _of_light(mix: Callable[[npt.NDArray[np.uint16]], object], image: ImageArray) -> ImageArray:
    """What lens and motion mix is light, not values of pixels."""
    return values_of(np.asarray(mix(light_of(image)), np.uint16))


def blurred(sigma_px: float) -> Degradation:
    return lambda image, _: _of_light(
        lambda light: cv2.GaussianBlur(light, (0, 0), sigma_px), image
    )


def moved(width_px: int) -> Degradation:
    kernel = np.full((1, width_px), 1.0 / width_px, np.float32)
    return lambda image, _: _of_light(lambda light: cv2.filter2D(light, -1, kernel), image)


def noisy(sigma: float) -> Degradation:
    return lambda image, rng: _as(image + rng.normal(0.0, sigma, image.shape))


def dimmed(light: float) -> Degradation:
    return lambda image, _: _as(light * image)


def bent(gamma: float) -> Degradation:
    return lambda image, _: _as(255.0 * (image / 255.0) ** gamma)


def compressed(quality: int) -> Degradation:
    return lambda image, _: as_jpeg(image, quality)


def covered(share: float) -> Degradation:
    def degrade(image: ImageArray, rng: np.random.Generator) -> ImageArray:
        width = round(share * image.shape[1])
        left = int(rng.integers(0, image.shape[1] - width))
        degraded: ImageArray = image.copy()
        inside = degraded[:, left : left + width]
        inside[...] = rng.integers(0, 256, inside.shape, dtype=np.uint8)
        return degraded

    return degrade


CASES: dict[str, Degradation] = {
    'as it is': lambda image, _: image,
    'blurred, sigma 1.5 px': blurred(1.5),
    'blurred, sigma 3 px': blurred(3.0),
    'moved along rows by 9 px': moved(9),
    'noise of 10 grey levels': noisy(10.0),
    'noise of 25 grey levels': noisy(25.0),
    'a quarter of the light': dimmed(0.25),
    'a twelfth of the light': dimmed(0.08),
    'gamma 0.5': bent(0.5),
    'gamma 2': bent(2.0),
    'JPEG of quality 20': compressed(20),
    'two fifths covered': covered(0.4),
}


def row(name: str, run: Replay) -> tuple[str, int]:
    """Line of the table, and the number of undetected failures."""
    error = pose_errors(run.fused, run.truth.at(run.stamps_ns))
    weighted = np.linalg.solve(run.fused_covariances, error[..., None])[..., 0]
    nees = np.sum(error * weighted, axis=1)
    tracking = np.array([update.status == 'tracking' for update in run.updates])
    wrong = int(np.sum((nees > SURE) & tracking))
    away_mm = 1e3 * np.hypot(error[:, 0], error[:, 1])
    heading = np.degrees(np.sqrt(np.mean(error[:, 2] ** 2)))
    used = np.mean([update.used for update in run.updates])
    return (
        f'{name:26} {np.sqrt(np.mean(away_mm**2)):8.1f} {np.quantile(away_mm, 0.95):7.1f} '
        f'{heading:6.3f} {nees.mean():5.1f} {used:5.1f} {wrong:12d}'
    ), wrong


def named(drive: str, error: StreamError, robot: str, room: str) -> tuple[bool, list[str]]:
    """Whether the cause of an error is named, and all that is said; refusals are said, too."""
    mount = load_robot(robot)
    with tempfile.TemporaryDirectory() as scratch:
        path = write_drive(Bag(drive), Path(scratch) / 'drive', error)
        try:
            if error.robot:
                given = Path(scratch) / 'robot.yaml'
                save_calibration(Calibration.of_mount(error.robot(mount)), given)
                mount = load_robot(given)
            found = diagnose(Bag(path), mount, load_room(room))
        except LandmarkNavError as refused:
            hit = bool(error.finding and re.search(error.finding, str(refused)))
            return hit, [str(refused)]
    findings = [*found.errors, *found.warnings]
    hit = any(
        re.match(error.names, f.name) and re.search(error.finding, f.line()) for f in findings
    )
    return hit, [finding.line() for finding in findings]


def table_of_streams(drive: str, robot: str, room: str) -> bool:
    """Print what is found of each error of a stream; whether enough causes are named."""
    good = True
    for title, bag, errors, least in (
        ('reported', drive, REPORTED, 1.0),
        ('reported, of sweeps', str(BAGS / 'learn'), SWEEPS, 1.0),
        ('others', drive, OTHERS, 0.9),
        ('further', drive, FURTHER, 0.9),
        ('third', drive, THIRD, 0.9),
        ('fourth', drive, FOURTH, 0.9),
        ('fifth', drive, FIFTH, 0.9),
        ('sixth', drive, SIXTH, 0.9),
        ('seventh', drive, SEVENTH, 0.9),
    ):
        print(f'{title:30} named  said')
        hits = 0
        for name, error in errors.items():
            hit, findings = named(bag, error, robot, room)
            hits += hit
            print(
                f'{name:30} {"yes" if hit else "NO":5}  {findings[0] if findings else "nothing"}'
            )
            for line in findings[1:]:
                print(f'{"":38}{line}')
        print(f'{hits} of {len(errors)} named\n', flush=True)
        good &= hits >= least * len(errors)
    return good


def table_of_images(drive: str, map_folder: str, robot: str, start: list[float] | None) -> bool:
    """Print what becomes of degraded images; whether there is no undetected failure."""
    calibration, landmark_map = load_calibration(robot), load_map(map_folder)
    events: list[SensorEvent] = list(sensor_events(Bag(drive), calibration.mount))
    pose = None if start is None else np.array(start)
    sigma = np.diag(START_SIGMA**2)
    print(f'{"images":26}  RMSE mm  p95 mm    deg  NEES  used  undetected')
    undetected = 0
    for name, degrade in CASES.items():
        rng = np.random.default_rng(0)
        degraded = [
            replace(e, image=degrade(e.image, rng)) if isinstance(e, CameraFrame) else e
            for e in events
        ]
        run = replay(degraded, landmark_map, calibration, LocalizationConfig(), pose, sigma)
        line, wrong = row(name, run)
        print(line, flush=True)
        undetected += wrong
    return not undetected


def main() -> int:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('drive', nargs='?', default=str(BAGS / 'drive'))
    parser.add_argument('--map', help='default: learned from bags/learn')
    parser.add_argument('--robot', default=str(BAGS / 'robot.yaml'))
    parser.add_argument('--room', default=str(BAGS / 'room.yaml'))
    parser.add_argument('--start', nargs=3, type=float, metavar=('X', 'Y', 'THETA'))
    parser.add_argument('--streams', action='store_true', help='the first table alone')
    args = parser.parse_args()
    logging.getLogger('landmark_nav').setLevel(logging.CRITICAL)
    good = table_of_streams(args.drive, args.robot, args.room)
    if args.streams:
        return int(not good)
    with tempfile.TemporaryDirectory() as scratch:
        if args.map is None:
            args.map, args.start = (
                f'{scratch}/map',
                json.loads((BAGS / 'start.json').read_text())['pose'],
            )
            files = ('--room', args.room, '--robot', args.robot)
            command('learn', BAGS / 'learn', *files, '--out', args.map)
        good &= table_of_images(args.drive, args.map, args.robot, args.start)
    return int(not good)
