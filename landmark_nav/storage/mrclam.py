"""
Reader of the log of one robot of the UTIAS multi-robot data set.

Leung, Halpern, Barfoot and Liu, The UTIAS Multi-Robot Cooperative Localization and Mapping Data
Set, International Journal of Robotics Research 30(8), 2011. A forward camera reads the barcodes of
fifteen posts. Velocities are the commanded ones. Motion capture gives the ground truth.
"""

from __future__ import annotations

from dataclasses import dataclass
import gzip
from io import BytesIO, StringIO
from pathlib import Path
import warnings
import zlib

import numpy as np

from landmark_nav.arrays import IntArray
from landmark_nav.errors import LandmarkNavError, why
from landmark_nav.storage.reading import read_bytes
from landmark_nav.types import Detections, FloatArray, Landmark, LandmarkMap, PoseEstimate

# Greatest number of a subject that is a robot.
_ROBOTS = 5
# Greatest size of an unpacked file, and greatest number in it; stamps are seconds since 1970.
_MAX_BYTES, _LARGEST = 32_000_000, 1e11


@dataclass(frozen=True, eq=False)
class MrclamLog:
    """
    Commands, detections and ground truth of one robot.

    The map has the posts, as points without patches; ids are the subjects of the data set.
    Commands (n, 2) are linear [m/s] and angular [rad/s] velocities; each holds until the next
    stamp. Detections are without other robots; `unknown` is the number of readings that were left
    out because the list has no such barcode.
    """

    landmark_map: LandmarkMap
    command_ns: IntArray
    commands: FloatArray
    detections: tuple[Detections, ...]
    truth: tuple[PoseEstimate, ...]
    unknown: int


def read_mrclam(
    folder: Path | str, robot: int, bearing_sigma_rad: float, landmark_sigma_m: float = 0.0
) -> MrclamLog:
    """
    Read the files of one robot, plain (``.dat``) or compressed (``.dat.gz``).

    The data set does not give the sigma of bearings. `landmark_sigma_m` is that of the systematic
    error of a post in each coordinate, in addition to that of the survey: a post is not a point,
    and the lens is not calibrated well. Raises `LandmarkNavError`: a file is missing or malformed.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise LandmarkNavError(f'{folder}: no folder there: give the one with Barcodes.dat')
    barcodes = _table(folder, 'Barcodes', 2)
    posts = _table(folder, 'Landmark_Groundtruth', 5)
    motion = _table(folder, f'Robot{robot}_Odometry', 3)
    seen = _table(folder, f'Robot{robot}_Measurement', 4)
    truth = _table(folder, f'Robot{robot}_Groundtruth', 4)
    subject_of = {int(code): int(subject) for subject, code in barcodes}
    subjects = np.array([subject_of.get(int(code), 0) for code in seen[:, 1]], dtype=np.int64)
    posted = np.isin(subjects, posts[:, 0].astype(np.int64))
    if not posted.any():
        raise LandmarkNavError(f'{folder}: no landmark was seen by robot {robot}')
    stamps, first = np.unique(_nanoseconds(motion[:, 0]), return_index=True)
    return MrclamLog(
        _landmark_map(posts, folder, landmark_sigma_m),
        stamps,
        motion[first, 1:],
        _detections(seen[posted], subjects[posted], bearing_sigma_rad),
        tuple(
            PoseEstimate(int(stamp), pose, np.zeros((3, 3)))
            for stamp, pose in zip(_nanoseconds(truth[:, 0]), truth[:, 1:], strict=True)
        ),
        int(np.sum(~posted & ((subjects == 0) | (subjects > _ROBOTS)))),
    )


def _table(folder: Path, name: str, columns: int) -> FloatArray:
    """Rows (n, columns) of a file, plain or compressed."""
    plain, packed = folder / f'{name}.dat', folder / f'{name}.dat.gz'
    path = plain if plain.is_file() else packed
    if not path.is_file():
        raise LandmarkNavError(f'{plain}: not there, nor {packed.name}: unpack the data set here')
    data = read_bytes(path)
    try:
        if path == packed:
            with gzip.open(BytesIO(data)) as stream:
                data = stream.read(_MAX_BYTES)
        # A truncated last row would be read as a valid one. No table has a tenth of this size.
        if len(data) == _MAX_BYTES:
            raise LandmarkNavError(f'{path}: {_MAX_BYTES / 1e6:g} MB or more: is it the file?')
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', UserWarning)  # an empty file is refused below
            table = np.loadtxt(StringIO(data.decode('utf-8-sig')), ndmin=2)
    except (OSError, EOFError, zlib.error, ValueError) as error:
        raise LandmarkNavError(f'{path}: cannot be read: {why(error)}') from error
    if not len(table):
        raise LandmarkNavError(f'{path}: is empty')
    if table.shape[1] != columns:
        raise LandmarkNavError(f'{path}: is {table.shape[1]} columns wide, not {columns}')
    if not np.all(np.abs(table) < _LARGEST):
        raise LandmarkNavError(f'{path}: holds something that is not a number below {_LARGEST:g}')
    return table


def _nanoseconds(seconds: FloatArray) -> IntArray:
    """Stamps in nanoseconds, rounded to the milliseconds in which the clock of the data ticks."""
    return np.rint(seconds * 1e3).astype(np.int64) * 1_000_000


def _landmark_map(posts: FloatArray, folder: Path, sigma_m: float) -> LandmarkMap:
    """Map of the posts as points on the floor with independent errors."""
    landmarks = tuple(
        Landmark(
            id=int(subject),
            position=np.array([x, y, 0.0]),
            covariance=np.diag([sigma_x**2 + sigma_m**2, sigma_y**2 + sigma_m**2, 0.0]),
            shared_loading=np.zeros((3, 0)),
            normal=np.array([1.0, 0.0, 0.0]),
            width_m=0.0,
            height_m=0.0,
            patch=np.zeros((0, 0), dtype=np.uint8),
            viewpoint=np.array([x + 1.0, y, 0.0]),
            threshold=0.0,
        )
        for subject, x, y, sigma_x, sigma_y in posts
    )
    return LandmarkMap(landmarks, provenance={'surveyed_in': f'UTIAS MR.CLAM, {folder.name}'})


def _detections(
    seen: FloatArray, subjects: IntArray, bearing_sigma_rad: float
) -> tuple[Detections, ...]:
    """Group readings by image; those of one image share a stamp."""
    stamps, which = np.unique(_nanoseconds(seen[:, 0]), return_inverse=True)
    variances, scores = np.full(len(seen), bearing_sigma_rad**2), np.ones(len(seen))
    arrays = subjects, seen[:, 3], variances, scores, np.zeros((len(seen), 2))
    return tuple(
        Detections(int(stamp), *(array[which == k] for array in arrays))
        for k, stamp in enumerate(stamps)
    )
