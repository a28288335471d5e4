"""
A drive with errors in it: whole streams that are off, then degraded images.

``python test/benchmarks degraded`` takes the recorded room in ``bags/``; ``DRIVE --map MAP
--robot F --room F --start X Y THETA`` another. The first table says for each error of a stream
what ``landmark-nav check`` says and whether that names the cause, the second what localization
makes of degraded images. It exits with 1 if a cause that users reported is not named, if fewer
than nine in ten of the others are, or if there is an undetected failure.
"""

from collections.abc import Callable
from dataclasses import replace
import logging
from pathlib import Path
import re
import tempfile

import cv2
from harness import as_jpeg, BAGS, Drive, drive_parser, learn, start_of, summary
import numpy as np
from stream_errors import of_drives, of_sweeps

from landmark_nav.arrays import ImageArray
from landmark_nav.calibration import Calibration
from landmark_nav.diagnosis import diagnose
from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.metrics import pose_errors
from landmark_nav.simulation.surfaces import light_of, values_of
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.robot_files import load_calibration, save_calibration
from landmark_nav.storage.setup_files import load_room
from landmark_nav.types import CameraFrame

Degradation = Callable[[ImageArray, np.random.Generator], ImageArray]

# NEES of a wrong pose that is sure: over 5 sigma.
SURE = 40.0


def _as(camera_image):
    return np.asarray(np.clip(camera_image, 0.0, 255.0), np.uint8)


def _of_light(mix, image):
    """What lens and motion mix is light, not values of pixels."""
    return values_of(np.asarray(mix(light_of(image)), np.uint16))


def blurred(sigma_px):
    return lambda image, _: _of_light(
        lambda light: cv2.GaussianBlur(light, (0, 0), sigma_px), image
    )


def moved(width_px):
    kernel = np.full((1, width_px), 1.0 / width_px, np.float32)
    return lambda image, _: _of_light(lambda light: cv2.filter2D(light, -1, kernel), image)


def noisy(sigma):
    return lambda image, rng: _as(image + rng.normal(0.0, sigma, image.shape))


def dimmed(light):
    return lambda image, _: _as(light * image)


def bent(gamma):
    return lambda image, _: _as(255.0 * (image / 255.0) ** gamma)


def compressed(quality):
    return lambda image, _: as_jpeg(image, quality)


def covered(share):
    def degrade(image, rng):
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


def row(name, run):
    """Line of the table, and the number of undetected failures."""
    error = pose_errors(run.fused, run.truth.at(run.stamps_ns))
    weighted = np.linalg.solve(run.fused_covariances, error[..., None])[..., 0]
    nees = np.sum(error * weighted, axis=1)
    wrong, off = int(np.sum((nees > SURE) & run.tracking)), summary(error)
    used = np.mean([update.used for update in run.updates])
    return (
        f'{name:26} {off["rmse"]:8.1f} {off["p95"]:7.1f} {off["heading"]:6.3f} '
        f'{nees.mean():5.1f} {used:5.1f} {wrong:12d}'
    ), wrong


def named(drive, error, robot, room):
    """Whether the cause of an error is named, and all that is said; refusals are said, too."""
    known = load_calibration(robot)
    with tempfile.TemporaryDirectory() as scratch:
        path = error.write(drive, Path(scratch) / 'drive')
        try:
            if error.robot:
                given = Path(scratch) / 'robot.yaml'
                save_calibration(Calibration.of_mount(error.robot(known.mount)), given)
                known = load_calibration(given)
            found = diagnose(Bag(path), known, load_room(room))
        except LandmarkNavError as refused:
            hit = bool(error.finding and re.search(error.finding, str(refused)))
            return hit, [str(refused)]
    findings = [*found.errors, *found.warnings]
    hit = any(
        re.match(error.names, f.name) and re.search(error.finding, f.line()) for f in findings
    )
    return hit, [finding.line() for finding in findings]


def table_of_streams(drive, robot, room):
    """Print what is found of each error of a stream; whether enough causes are named."""
    good = True
    lists = {title: (drive, errors) for title, errors in of_drives().items()}
    lists['reported, of sweeps'] = BAGS / 'learn', of_sweeps()
    for title, (bag, errors) in lists.items():
        print(f'{title:30} named  said')
        hits = 0
        for name, error in errors.items():
            hit, findings = named(bag, error, robot, room)
            hits += hit
            said = f'\n{"":38}'.join(findings or ['nothing'])
            print(f'{name:30} {"yes" if hit else "NO":5}  {said}')
        print(f'{hits} of {len(errors)} named\n', flush=True)
        good &= hits >= (1.0 if title.startswith('reported') else 0.9) * len(errors)
    return good


def table_of_images(drive):
    """Print what becomes of degraded images; whether there is no undetected failure."""
    events = drive.events()
    print(f'{"images":26}  RMSE mm  p95 mm    deg  NEES  used  undetected')
    undetected = 0
    for name, degrade in CASES.items():
        rng = np.random.default_rng(0)
        changed = (
            replace(e, image=degrade(e.image, rng)) if isinstance(e, CameraFrame) else e
            for e in events
        )
        line, wrong = row(name, drive.run(changed))
        print(line, flush=True)
        undetected += wrong
    return not undetected


def main():
    """Print both tables."""
    parser = drive_parser(
        __doc__, drive=BAGS / 'drive', map=None, robot=BAGS / 'robot.yaml', start=None
    )
    parser.add_argument('--room', type=Path, default=BAGS / 'room.yaml')
    parser.add_argument('--streams', action='store_true', help='the first table alone')
    args = parser.parse_args()
    logging.getLogger('landmark_nav').setLevel(logging.CRITICAL)
    good = table_of_streams(args.drive, args.robot, args.room)
    if args.streams:
        return int(not good)
    with tempfile.TemporaryDirectory() as scratch:
        if args.map is None:
            args.map, args.start = Path(scratch) / 'map', start_of(BAGS)
            learn(BAGS, args.map)
        good &= table_of_images(Drive.of(args))
    return int(not good)
