"""
Landmarks seen without knowing where one is: each found at any azimuth, range and slant.

Where a prior is known but wide, those are the ones that it leaves open.

A picture is resampled onto an upright cylinder around its optical centre. There a patch on a wall
only shrinks with its range and narrows with its slant, and a landmark that hangs `dz` above the
camera appears at the tangent `dz / range`: every range is searched in its own narrow band of
rows, and the row found tells the range in return.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.se2 import rotation
from landmark_nav.parameters import check_parameters, parameter
from landmark_nav.types import (
    CameraFrame,
    FloatArray,
    ImageArray,
    Landmark,
    LandmarkMap,
    PoseEstimate,
)

__all__ = ['SightingConfig', 'Sightings', 'find_sightings']

# Ranges relative to the one a landmark was learned from, and how much narrower than straight
# ahead: neighbours differ by what normalized cross-correlation forgives.
_STEP = 1.4
_RELATIVE_RANGES = 0.55 * _STEP ** np.arange(5)
_NARROWINGS = (0.9, 0.6)
# Half of a step between them.
_RANGE_SIGMA = 0.15
# What is open is what so many sigmas of a prior reach.
_OPEN_SIGMAS = 2.5
# Patches seen narrower are not found.
_NARROWEST = 0.3


@dataclass(frozen=True)
class SightingConfig:
    """How landmarks are looked for without a prior."""

    resolution: float = parameter(
        0.5, "share of the pictures' resolution to work at", minimum=0.1, maximum=1.0
    )
    min_score: float = parameter(0.72, 'least correlation of a sighting', minimum=0.3, maximum=1.0)
    min_size_px: int = parameter(8, 'least template there, pixels', minimum=5, maximum=100)
    per_view: int = parameter(
        2, 'sightings of a landmark kept in a picture', minimum=1, maximum=20
    )
    tangent_sigma: float = parameter(
        0.004, 'error of the tangent of elevation', minimum=1e-5, maximum=0.5
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_parameters(self)


@dataclass(frozen=True, eq=False)
class Sightings:
    """
    Where landmarks may have been seen, arrays over n sightings.

    `landmark` (n,) is the place in the map; `azimuth_rad` (n,) and `range_m` (n,), horizontal,
    are seen from `center` (n, 2), the optical centre, all in a base frame; `range_sigma` (n,) is
    the range's relative error; `score` (n,) the normalized cross-correlation.
    """

    landmark: npt.NDArray[np.intp]
    azimuth_rad: FloatArray
    range_m: FloatArray
    range_sigma: FloatArray
    center: FloatArray
    score: FloatArray

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.landmark)

    @staticmethod
    def joined(parts: Sequence[Sightings]) -> Sightings:
        """All of several, which must share a frame."""
        names = [field.name for field in fields(Sightings)]
        if not parts:
            none = np.zeros(0)
            return Sightings(none.astype(np.intp), none, none, none, np.zeros((0, 2)), none)
        return Sightings(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


def find_sightings(
    frame: CameraFrame,
    landmark_map: LandmarkMap,
    mount: PanTiltMount,
    config: SightingConfig,
    prior: PoseEstimate | None = None,
) -> Sightings:
    """
    Look for every landmark everywhere in a picture.

    Parameters
    ----------
    frame : CameraFrame
        The picture.
    landmark_map : LandmarkMap
        What was learned.
    mount : PanTiltMount
        Where the camera turns.
    config : SightingConfig
        Parameters.
    prior : PoseEstimate, optional
        Of the base at that time: only what can be seen from where it allows is looked for, where
        and as it may appear.

    Returns
    -------
    Sightings
        In the base frame of the picture's time; most of them are wrong.

    """
    strip = _Strip(frame, mount, config.resolution)
    if prior is None:
        looks = {
            k: _any_look(landmark, strip) for k, landmark in enumerate(landmark_map.landmarks)
        }
    else:
        looks = _open_looks(prior, landmark_map, strip)
    found = [
        _measured(k, landmark, _search(landmark, look, strip, config), strip, config)
        for k, look in looks.items()
        for landmark in [landmark_map.landmarks[k]]
    ]
    return Sightings.joined(found)


class _Strip:
    """A picture on an upright cylinder around its optical centre."""

    def __init__(self, frame: CameraFrame, mount: PanTiltMount, resolution: float) -> None:
        turn, self.center = mount.camera_pose_base(frame.pan_rad, frame.tilt_rad, frame.roll_rad)
        camera = frame.camera
        border = np.linspace(0.0, 1.0, 9)
        size = [camera.width - 1.0, camera.height - 1.0]
        rays = camera.unproject(np.stack(np.meshgrid(border, border), -1) * size) @ turn.T
        self.middle = float(np.arctan2(turn[1, 2], turn[0, 2]))
        aside = self.aside(np.arctan2(rays[..., 1], rays[..., 0]))
        tangent = rays[..., 2] / np.hypot(rays[..., 0], rays[..., 1])
        cylinder = Cylinder.with_resolution(
            resolution * camera.fx, float(tangent.min()), float(tangent.max())
        )
        self.px_per_rad = cylinder.fy
        columns = np.arange(int(np.ceil(np.ptp(aside) * cylinder.fx)) + 1)
        self.azimuth = self.middle + float(aside.max()) - columns / cylinder.fx
        self.tangent = cylinder.tangent(np.arange(cylinder.height))
        directions = np.empty((cylinder.height, len(columns), 3))
        directions[..., 0], directions[..., 1] = np.cos(self.azimuth), np.sin(self.azimuth)
        directions[..., 2] = self.tangent[:, None]
        self.image = _resampled(frame.image, camera.project(directions @ turn), resolution)

    def row_of(self, tangent: float) -> float:
        """Row of a tangent of elevation."""
        return float((self.tangent[0] - tangent) * self.px_per_rad)

    def aside(self, azimuth: FloatArray) -> FloatArray:
        """How far to the left of the middle azimuths are."""
        return np.asarray(wrap_rad(azimuth - self.middle))

    def columns(self, left: FloatArray, right: FloatArray) -> npt.NDArray[np.intp]:
        """First and end (2, n) of the columns between angles aside."""
        bounds = (self.azimuth[0] - self.middle - np.array([left, right])) * self.px_per_rad
        return np.asarray(np.clip(np.rint(bounds), 0, len(self.azimuth)), dtype=np.intp)


def _resampled(image: ImageArray, pixels: FloatArray, resolution: float) -> ImageArray:
    """Grey values at pixels (rows, columns, 2) of a picture, after shrinking it."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    small = cv2.resize(grey, None, fx=resolution, fy=resolution, interpolation=cv2.INTER_AREA)
    at = np.nan_to_num((pixels + 0.5) * resolution - 0.5, nan=-1e4).astype(np.float32)
    return np.asarray(
        cv2.remap(
            small,
            at[..., 0],
            at[..., 1],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=float(np.mean(small)),
        ),
        dtype=np.uint8,
    )


class _Look(NamedTuple):
    """Ranges and narrowings a landmark may have, and the columns (first, end) it may be in."""

    ranges: FloatArray
    narrowings: FloatArray
    columns: tuple[int, int]


def _any_look(landmark: Landmark, strip: _Strip) -> _Look:
    reference = float(np.hypot(*(landmark.position - landmark.viewpoint)[:2]))
    ranges = np.asarray(reference * _RELATIVE_RANGES, dtype=np.float64)
    return _Look(ranges, np.array(_NARROWINGS), (0, len(strip.azimuth)))


def _open_looks(prior: PoseEstimate, landmark_map: LandmarkMap, strip: _Strip) -> dict[int, _Look]:
    """Looks of the landmarks that may be in the picture, as sigma points of the prior have it."""
    axes = _OPEN_SIGMAS * np.linalg.cholesky(prior.covariance).T
    poses = prior.pose + np.vstack([np.zeros(3), axes, -axes])
    turned = rotation(poses[:, 2])
    # From map into the base frame: rows times the rotation are turned back by it.
    place = (landmark_map.positions[:, :2] - poses[:, None, :2]) @ turned - strip.center[:2]
    reach = np.maximum(np.hypot(place[..., 0], place[..., 1]), 0.1)
    aside = strip.aside(np.arctan2(place[..., 1], place[..., 0]))
    normal = landmark_map.normals[:, :2] @ turned
    facing = -np.sum(place * normal, -1) / reach
    reference = np.hypot(*(landmark_map.positions - landmark_map.viewpoints)[:, :2].T)
    nearest, farthest = reach.min(axis=0), reach.max(axis=0)
    nearest = np.maximum(nearest, _RELATIVE_RANGES[0] * reference)
    farthest = np.minimum(farthest, _RELATIVE_RANGES[-1] * reference)
    least, most = np.maximum(facing.min(axis=0), _NARROWEST), facing.max(axis=0)
    margin = 0.5 * landmark_map.sizes_m[:, 0] / reach.min(axis=0)
    columns = strip.columns(aside.max(axis=0) + margin, aside.min(axis=0) - margin)
    return {
        int(k): _Look(
            _steps(nearest[k], farthest[k]), _steps(least[k], most[k]), tuple(columns[:, k])
        )
        for k in np.flatnonzero(
            (farthest > nearest) & (most > _NARROWEST) & (columns[1] > columns[0])
        )
    }


def _steps(low: float, high: float) -> FloatArray:
    """Values from low to high, apart by a step at most and half of that from the ends."""
    count = max(1, int(np.ceil(np.log(high / low) / np.log(_STEP))))
    return np.asarray(low * (high / low) ** ((np.arange(count) + 0.5) / count))


@dataclass(frozen=True, eq=False)
class _Profile:
    """The best of all ranges and slants in every column: score, tangent, range, half width."""

    score: npt.NDArray[np.float32]
    tangent: FloatArray
    reach: FloatArray
    half_width: FloatArray


def _search(landmark: Landmark, look: _Look, strip: _Strip, config: SightingConfig) -> _Profile:
    columns = len(strip.azimuth)
    best = np.full(columns, -1.0, np.float32)
    tangent, reach, half_width = np.zeros(columns), np.ones(columns), np.ones(columns)
    rise = landmark.position[2] - strip.center[2]
    first, end = look.columns
    for distance in look.ranges:
        height = round(landmark.height_m / distance * strip.px_per_rad)
        # The rows where its centre can be, for ranges up to half a step to the next one.
        steepness = rise / distance * np.exp([-1.5 * _RANGE_SIGMA, 1.5 * _RANGE_SIGMA])
        spread = 2.0 * config.tangent_sigma
        top = int(strip.row_of(steepness.max() + spread) - (height - 1) / 2.0)
        bottom = int(np.ceil(strip.row_of(steepness.min() - spread) + (height - 1) / 2.0))
        top, bottom = max(top, 0), min(bottom, len(strip.tangent) - 1)
        if height < config.min_size_px or bottom - top + 1 < height:
            continue
        band = strip.image[top : bottom + 1, first:end]
        for narrowing in look.narrowings:
            width = round(landmark.width_m * narrowing / distance * strip.px_per_rad)
            if not config.min_size_px <= width <= end - first:
                continue
            template = cv2.resize(landmark.patch, (width, height), interpolation=cv2.INTER_AREA)
            scores = cv2.matchTemplate(band, template, cv2.TM_CCOEFF_NORMED)
            row = np.argmax(scores, axis=0)
            score = np.take_along_axis(scores, row[None], 0)[0]
            begin = first + (width - 1) // 2
            place = slice(begin, begin + len(score))
            better = score > best[place]
            best[place][better] = score[better]
            at = top + row[better] + (height - 1) / 2.0
            tangent[place][better] = strip.tangent[0] - at / strip.px_per_rad
            reach[place][better] = distance
            half_width[place][better] = width / 2.0
    return _Profile(best, tangent, reach, half_width)


def _measured(
    index: int, landmark: Landmark, profile: _Profile, strip: _Strip, config: SightingConfig
) -> Sightings:
    """The best peaks of a landmark's profile, with the range that they tell."""
    columns = _peaks(profile, config)
    tangent, reach = profile.tangent[columns], profile.reach[columns]
    rise = landmark.position[2] - strip.center[2]
    # Range by height, where the landmark hangs above or below the camera, and by scale.
    with np.errstate(divide='ignore', invalid='ignore'):
        by_height = rise / tangent
        sigma = np.hypot(config.tangent_sigma, landmark.covariance[2, 2] ** 0.5 / reach)
        sigma = sigma / np.abs(tangent)
    usable = (by_height > 0.0) & (sigma < 0.5)
    weight = np.where(usable, 1.0 / np.where(usable, sigma, 1.0) ** 2, 0.0)
    by_scale = _RANGE_SIGMA**-2
    log_height = np.log(np.where(usable, by_height, 1.0))
    log_range = (weight * log_height + by_scale * np.log(reach)) / (weight + by_scale)
    return Sightings(
        np.full(len(columns), index, dtype=np.intp),
        strip.azimuth[columns],
        np.exp(log_range),
        1.0 / np.sqrt(weight + by_scale),
        np.tile(strip.center[:2], (len(columns), 1)),
        profile.score[columns].astype(np.float64),
    )


def _peaks(profile: _Profile, config: SightingConfig) -> npt.NDArray[np.intp]:
    """Columns of the best peaks, apart by more than half their template's width."""
    score = profile.score.copy()
    columns: list[int] = []
    for _ in range(config.per_view):
        column = int(np.argmax(score))
        if score[column] < config.min_score:
            break
        columns.append(column)
        reach = int(np.ceil(profile.half_width[column]))
        score[max(0, column - reach) : column + reach + 1] = -1.0
    return np.array(columns, dtype=np.intp)
