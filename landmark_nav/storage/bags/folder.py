"""A sweep kept as a folder of pictures with ``frames.csv``."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np

from landmark_nav.errors import LandmarkNavError, why
from landmark_nav.geometry.angles import check_one_turn
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.types import CameraFrame, Sweep

__all__ = ['read_sweep_folder']

_COLUMNS = ('file', 'pan_rad', 'focal_px', 'width', 'height')


def read_sweep_folder(folder: Path | str) -> Sweep:
    """
    Read the pictures that ``frames.csv`` (`file,pan_rad,focal_px,width,height`) lists.

    Their centre is the principal point; stamps just count.

    Raises
    ------
    LandmarkNavError
        The list or a picture is missing, or a value does not fit.

    """
    folder = Path(folder)
    path = folder / 'frames.csv'
    try:
        with path.open(newline='', encoding='utf-8') as stream:
            rows = list(csv.DictReader(stream))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise LandmarkNavError(f'{path}: cannot be read: {why(error)}') from error
    missing = [name for name in _COLUMNS if not rows or rows[0].get(name) is None]
    if missing:
        raise LandmarkNavError(
            f'{path}: {"lists no picture" if not rows else "lacks " + ", ".join(missing)}: '
            f'it needs the columns {",".join(_COLUMNS)}'
        )
    frames = [_frame(folder, row, k) for k, row in enumerate(rows)]
    check_one_turn([frame.pan_rad for frame in frames], f'{path}: pan_rad')
    return Sweep(frames[0].stamp_ns, tuple(frames))


def _frame(folder: Path, row: dict[str, str], number: int) -> CameraFrame:
    where = f'{folder / "frames.csv"}: line {number + 2}'
    pan, focal = (_number(row, name, where) for name in ('pan_rad', 'focal_px'))
    width, height = (int(_number(row, name, where)) for name in ('width', 'height'))
    file = folder / row['file']
    if not file.is_file():  # OpenCV would say so too, in words of its own
        raise LandmarkNavError(f'{where}: {row["file"]} is not there')
    picture = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if picture is None:
        raise LandmarkNavError(f'{where}: {row["file"]} is no picture')
    # A camera held upright is often listed by its sensor's size: the picture knows better.
    if sorted(picture.shape[:2]) != sorted((height, width)):
        raise LandmarkNavError(
            f'{where}: {row["file"]} is {picture.shape[1]} x {picture.shape[0]}, '
            f'not {width} x {height}'
        )
    height, width = picture.shape[:2]
    try:
        camera = CameraModel(width, height, focal, focal, (width - 1) / 2.0, (height - 1) / 2.0)
    except LandmarkNavError as error:
        raise LandmarkNavError(f'{where}: {error}') from error
    return CameraFrame(number, np.asarray(picture, dtype=np.uint8), camera, pan)


def _number(row: dict[str, str], name: str, where: str) -> float:
    try:
        value = float(row[name])
    except (TypeError, ValueError):
        value = np.nan
    if not np.isfinite(value):
        raise LandmarkNavError(f'{where}: {name} is {row[name]!r}, not a number')
    return value
