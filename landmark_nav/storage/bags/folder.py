"""Reader of a sweep that is a folder of images with ``frames.csv``."""

from __future__ import annotations

import csv
from io import StringIO
from pathlib import Path

import numpy as np

from landmark_nav.errors import inside, LandmarkNavError, shown
from landmark_nav.geometry.angles import check_one_turn
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.storage.reading import read_image, read_text
from landmark_nav.types import CameraFrame, Sweep

_COLUMNS = ('file', 'pan_rad', 'focal_px', 'width', 'height')
# Greatest size of a list, and greatest number of pixels of all its images (36 of 8 million).
_MAX_LIST_BYTES, _MAX_SWEEP_PIXELS = 1_000_000, 300_000_000


def read_sweep_folder(folder: Path | str) -> Sweep:
    """
    Read the images listed in ``frames.csv`` (`file,pan_rad,focal_px,width,height`).

    The principal point is the centre of the image. Stamps are the numbers of the rows.

    Raises `LandmarkNavError`: the list or an image is missing, or a value is invalid.
    """
    folder = Path(folder)
    path = folder / 'frames.csv'
    try:
        lines = StringIO(read_text(path, _MAX_LIST_BYTES), newline='')
        rows = list(csv.DictReader(lines, skipinitialspace=True))
    except csv.Error as error:
        raise LandmarkNavError(f'{path}: cannot be read: {error}') from error
    missing = [name for name in _COLUMNS if not rows or rows[0].get(name) is None]
    if missing:
        raise LandmarkNavError(
            f'{path}: {"lists no image" if not rows else "lacks " + ", ".join(missing)}: '
            f'it needs the columns {",".join(_COLUMNS)}'
        )
    frames: list[CameraFrame] = []
    pixels = 0
    for k, row in enumerate(rows):
        where = f'{path}: line {k + 2}'
        frames.append(_frame(folder, row, k, where))
        pixels += frames[-1].camera.width * frames[-1].camera.height
        if pixels > _MAX_SWEEP_PIXELS:
            raise LandmarkNavError(
                f'{where}: the images up to here have over {_MAX_SWEEP_PIXELS / 1e6:.0f} million '
                'pixels: reduce them'
            )
    check_one_turn([frame.pan_rad for frame in frames], f'{path}: pan_rad')
    return Sweep(frames[0].stamp_ns, tuple(frames))


def _frame(folder: Path, row: dict[str, str], number: int, where: str) -> CameraFrame:
    pan, focal = (_number(row, name, where) for name in ('pan_rad', 'focal_px'))
    width, height = (int(_number(row, name, where)) for name in ('width', 'height'))
    file = row['file'] or ''
    with inside(where):
        image = read_image(folder / file)
    # For a camera in portrait orientation the list often has the size of the sensor; that of the
    # image is used.
    if sorted(image.shape[:2]) != sorted((height, width)):
        raise LandmarkNavError(
            f'{where}: {shown(file)} is {image.shape[1]} x {image.shape[0]}, '
            f'not {width} x {height}'
        )
    height, width = image.shape[:2]
    with inside(where):
        camera = CameraModel(width, height, focal, focal, (width - 1) / 2.0, (height - 1) / 2.0)
    return CameraFrame(number, image, camera, pan)


def _number(row: dict[str, str], name: str, where: str) -> float:
    try:
        value = float(row[name])
    except (TypeError, ValueError):
        value = np.nan
    if not np.isfinite(value):
        raise LandmarkNavError(f'{where}: {name} is {shown(row[name])}, not a number')
    return value
