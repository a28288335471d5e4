"""
A drive's pictures spoiled in many ways: blur, noise, darkness, compression, things in the way.

``python test/spoiled_check.py DRIVE --map MAP --robot robot.yaml --start X Y THETA`` prints a line
for each; it exits with 1 if a wrong pose is told to be sure.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
import logging
import sys

from as_a_user import as_jpeg
import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import ImageArray
from landmark_nav.evaluation.metrics import pose_errors
from landmark_nav.evaluation.replay import Replay, replay
from landmark_nav.localization.pipeline import LocalizationConfig
from landmark_nav.simulation.response import light_of, values_of
from landmark_nav.storage.bags import Bag, sensor_events, SensorEvent
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.setup_files import load_robot
from landmark_nav.types import CameraFrame

Spoil = Callable[[ImageArray, np.random.Generator], ImageArray]

START_SIGMA = np.array([0.05, 0.05, 0.035])
# NEES of a wrong pose that is sure: over 5 sigma.
SURE = 40.0


def _as(picture: npt.NDArray[np.floating]) -> ImageArray:
    return np.asarray(np.clip(picture, 0.0, 255.0), np.uint8)


def _of_light(mix: Callable[[npt.NDArray[np.uint16]], object], image: ImageArray) -> ImageArray:
    """What lens and motion mix is light, not values of pixels."""
    return values_of(np.asarray(mix(light_of(image)), np.uint16))


def blurred(sigma_px: float) -> Spoil:
    return lambda image, _: _of_light(
        lambda light: cv2.GaussianBlur(light, (0, 0), sigma_px), image
    )


def moved(width_px: int) -> Spoil:
    kernel = np.full((1, width_px), 1.0 / width_px, np.float32)
    return lambda image, _: _of_light(lambda light: cv2.filter2D(light, -1, kernel), image)


def noisy(sigma: float) -> Spoil:
    return lambda image, rng: _as(image + rng.normal(0.0, sigma, image.shape))


def dimmed(light: float) -> Spoil:
    return lambda image, _: _as(light * image)


def bent(gamma: float) -> Spoil:
    return lambda image, _: _as(255.0 * (image / 255.0) ** gamma)


def compressed(quality: int) -> Spoil:
    return lambda image, _: as_jpeg(image, quality)


def covered(share: float) -> Spoil:
    def spoil(image: ImageArray, rng: np.random.Generator) -> ImageArray:
        width = round(share * image.shape[1])
        left = int(rng.integers(0, image.shape[1] - width))
        spoilt: ImageArray = image.copy()
        inside = spoilt[:, left : left + width]
        inside[...] = rng.integers(0, 256, inside.shape, dtype=np.uint8)
        return spoilt

    return spoil


CASES: dict[str, Spoil] = {
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
    """Line of the table, and how many wrong poses were told to be sure."""
    error = pose_errors(run.fused, run.truth.at(run.stamps_ns))
    weighted = np.linalg.solve(run.fused_covariances, error[..., None])[..., 0]
    nees = np.sum(error * weighted, axis=1)
    tracking = np.array([update.status == 'tracking' for update in run.updates])
    wrong = int(np.sum((nees > SURE) & tracking))
    away_mm = 1e3 * np.hypot(error[:, 0], error[:, 1])
    heading = np.degrees(np.sqrt(np.mean(error[:, 2] ** 2)))
    used = np.mean([update.fusion.degrees for update in run.updates])
    return (
        f'{name:26} {np.sqrt(np.mean(away_mm**2)):8.1f} {np.quantile(away_mm, 0.95):7.1f} '
        f'{heading:6.3f} {nees.mean():5.1f} {used:5.1f} {wrong:12d}'
    ), wrong


def main() -> int:
    """Print a line for each way to spoil pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('drive')
    parser.add_argument('--map', required=True)
    parser.add_argument('--robot', required=True)
    parser.add_argument('--start', nargs=3, type=float, metavar=('X', 'Y', 'THETA'))
    args = parser.parse_args()
    logging.getLogger('landmark_nav').setLevel(logging.ERROR)
    mount, landmark_map = load_robot(args.robot), load_map(args.map)
    events: list[SensorEvent] = list(sensor_events(Bag(args.drive), mount))
    start = None if args.start is None else np.array(args.start)
    sigma = np.diag(START_SIGMA**2)
    print(f'{"pictures":26}  RMSE mm  p95 mm    deg  NEES  used  sure, wrong')
    wrong_anywhere = 0
    for name, spoil in CASES.items():
        rng = np.random.default_rng(0)
        spoilt = [
            replace(e, image=spoil(e.image, rng)) if isinstance(e, CameraFrame) else e
            for e in events
        ]
        run = replay(spoilt, landmark_map, mount, LocalizationConfig(), start, sigma)
        line, wrong = row(name, run)
        print(line, flush=True)
        wrong_anywhere += wrong
    return int(wrong_anywhere > 0)


if __name__ == '__main__':
    sys.exit(main())
