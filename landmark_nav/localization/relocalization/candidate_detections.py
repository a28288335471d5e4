"""
Candidate detections without a precise prior: landmarks at any azimuth, range and slant.

With a wide prior, the search is limited to what the prior allows.

The image is resampled onto an upright cylinder around its optical centre. There a patch on a wall
only shrinks with its range and narrows with its slant. A landmark at the height `dz` above the
camera appears at the tangent `dz / range`. So each range is searched in a narrow band of rows, and
the row of a match measures the range.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.se2 import rotation
from landmark_nav.types import (
    CameraFrame,
    FloatArray,
    ImageArray,
    Landmark,
    LandmarkMap,
    PoseEstimate,
)

# Searched ranges, relative to that in the reference view, and foreshortenings: normalized
# cross-correlation tolerates half a step.
_STEP = 1.4
_RELATIVE_RANGES = 0.55 * _STEP ** np.arange(5)
_FORESHORTENINGS = (0.9, 0.6)
# Half a step between ranges, relative.
RANGE_SIGMA = 0.15
# Number of sigmas of the prior that are searched.
_OPEN_SIGMAS = 2.5
# Patches with a stronger foreshortening are not found.
_LEAST_FORESHORTENING = 0.3


class SearchRange(NamedTuple):
    """Possible ranges and foreshortenings of a landmark, and its columns (first, end)."""

    ranges: FloatArray
    foreshortenings: FloatArray
    columns: tuple[int, int]


def any_range(landmark: Landmark, strip: Strip) -> SearchRange:
    """Search range of a landmark without a prior."""
    reference = float(np.hypot(*(landmark.position - landmark.viewpoint)[:2]))
    ranges = np.asarray(reference * _RELATIVE_RANGES, dtype=np.float64)
    return SearchRange(ranges, np.array(_FORESHORTENINGS), (0, len(strip.azimuth)))


def unhidden_ranges(
    prior: PoseEstimate, landmark_map: LandmarkMap, strip: Strip
) -> dict[int, SearchRange]:
    """Search ranges of the landmarks that may be in view, by sigma points of the prior."""
    axes = _OPEN_SIGMAS * np.linalg.cholesky(prior.covariance).T
    poses = prior.pose + np.vstack([np.zeros(3), axes, -axes])
    turned = rotation(poses[:, 2])
    # From the map to the base frame: rows times the rotation apply its inverse.
    place = (landmark_map.positions[:, :2] - poses[:, None, :2]) @ turned - strip.center[:2]
    reach = np.maximum(np.hypot(place[..., 0], place[..., 1]), 0.1)
    aside = strip.aside(np.arctan2(place[..., 1], place[..., 0]))
    normal = landmark_map.normals[:, :2] @ turned
    facing = -np.sum(place * normal, -1) / reach
    reference = np.hypot(*(landmark_map.positions - landmark_map.viewpoints)[:, :2].T)
    nearest = np.maximum(reach.min(axis=0), _RELATIVE_RANGES[0] * reference)
    farthest = np.minimum(reach.max(axis=0), _RELATIVE_RANGES[-1] * reference)
    least, most = np.maximum(facing.min(axis=0), _LEAST_FORESHORTENING), facing.max(axis=0)
    margin = 0.5 * landmark_map.sizes_m[:, 0] / reach.min(axis=0)
    columns = strip.columns(aside.max(axis=0) + margin, aside.min(axis=0) - margin)
    good = (farthest > nearest) & (most > _LEAST_FORESHORTENING) & (columns[1] > columns[0])
    return {
        int(k): SearchRange(
            _steps(nearest[k], farthest[k]), _steps(least[k], most[k]), tuple(columns[:, k])
        )
        for k in np.flatnonzero(good)
    }


def _steps(low: float, high: float) -> FloatArray:
    """Geometric series between low and high, with ratios of at most `_STEP`."""
    count = max(1, int(np.ceil(np.log(high / low) / np.log(_STEP))))
    return np.asarray(low * (high / low) ** ((np.arange(count) + 0.5) / count))


class Strip:
    """An image on an upright cylinder around its optical centre."""

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
        """Angles of azimuths to the left of the middle of the image."""
        return np.asarray(wrap_rad(azimuth - self.middle))

    def columns(self, left: FloatArray, right: FloatArray) -> npt.NDArray[np.intp]:
        """First and end (2, n) of the columns between angles to the left of the middle."""
        bounds = (self.azimuth[0] - self.middle - np.array([left, right])) * self.px_per_rad
        return np.asarray(np.clip(np.rint(bounds), 0, len(self.azimuth)), dtype=np.intp)


def _resampled(image: ImageArray, pixels: FloatArray, resolution: float) -> ImageArray:
    """Grey values at pixels (rows, columns, 2) of an image, after shrinking it."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    small = cv2.resize(grey, None, fx=resolution, fy=resolution, interpolation=cv2.INTER_AREA)
    at = np.nan_to_num((pixels + 0.5) * resolution - 0.5, nan=-1e4).astype(np.float32)
    how: dict[str, Any] = {'borderMode': cv2.BORDER_CONSTANT, 'borderValue': float(small.mean())}
    found = cv2.remap(small, at[..., 0], at[..., 1], cv2.INTER_LINEAR, **how)
    return np.asarray(found, dtype=np.uint8)


# Scale of the searched image, and least size of a template in it, pixels.
_RESOLUTION = 0.5
_MIN_SIZE_PX = 8
# Sigma of the noise of its pixels, grey levels: nothing is recognised where contrast is lower.
_NOISE_GREY = 1.0
# Least correlation of a detection, and most detections of a landmark in an image.
_MIN_SCORE = 0.72
_PER_VIEW = 2
# Sigma of the tangent of elevation.
_TANGENT_SIGMA = 0.004


@dataclass(frozen=True, eq=False)
class CandidateDetections:
    """
    Possible detections of landmarks, arrays over n detections.

    `landmark` (n,) is the column in the map; `azimuth_rad` (n,) and `range_m` (n,), horizontal,
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
        """Return the number of detections."""
        return len(self.landmark)

    @staticmethod
    def joined(parts: Sequence[CandidateDetections]) -> CandidateDetections:
        """Concatenate several, which must share a frame."""
        none = np.zeros(0)
        empty = CandidateDetections(none.astype(np.intp), none, none, none, np.zeros((0, 2)), none)
        names = [field.name for field in fields(CandidateDetections)]
        return CandidateDetections(
            *(np.concatenate([getattr(p, n) for p in (empty, *parts)]) for n in names)
        )


def find_candidate_detections(
    frame: CameraFrame,
    landmark_map: LandmarkMap,
    mount: PanTiltMount,
    prior: PoseEstimate | None = None,
    tilt_sigma_rad: float = 0.0,
) -> CandidateDetections:
    """
    Search every landmark in the whole image.

    Parameters
    ----------
    prior : PoseEstimate, optional
        Pose of the base at the time of the image: the search is limited to what it allows.
    tilt_sigma_rad : float
        Sigma of tilt and roll of the camera, which widens the bands of rows.

    Returns
    -------
    CandidateDetections
        In the base frame at the time of the image; most of them are false.
    """
    strip, landmarks = Strip(frame, mount, _RESOLUTION), landmark_map.landmarks
    if prior is None:
        search_ranges = {k: any_range(landmark, strip) for k, landmark in enumerate(landmarks)}
    else:
        search_ranges = unhidden_ranges(prior, landmark_map, strip)
    sigma = float(np.hypot(_TANGENT_SIGMA, tilt_sigma_rad))
    found = []
    for k, look in search_ranges.items():
        best = _search(landmarks[k], look, strip, sigma)
        found.append(_measured(k, landmarks[k], best, strip, sigma))
    return CandidateDetections.joined(found)


def _search(
    landmark: Landmark, look: SearchRange, strip: Strip, tangent_sigma: float
) -> FloatArray:
    """Score, tangent, range and half width (4, columns) of the best match in each column."""
    best = np.tile([[-1.0], [0.0], [1.0], [1.0]], len(strip.azimuth))
    rise = landmark.position[2] - strip.center[2]
    first, end = look.columns
    for distance in look.ranges:
        height = round(landmark.height_m / distance * strip.px_per_rad)
        # The rows in which its centre can lie, for ranges within half a step.
        steepness = rise / distance * np.exp([-1.5 * RANGE_SIGMA, 1.5 * RANGE_SIGMA])
        spread = 2.0 * tangent_sigma
        top = int(strip.row_of(steepness.max() + spread) - (height - 1) / 2.0)
        bottom = int(np.ceil(strip.row_of(steepness.min() - spread) + (height - 1) / 2.0))
        top, bottom = max(top, 0), min(bottom, len(strip.tangent) - 1)
        if height < _MIN_SIZE_PX or bottom - top + 1 < height:
            continue
        band = strip.image[top : bottom + 1, first:end]
        if cv2.meanStdDev(band)[1][0, 0] < _NOISE_GREY:
            continue
        for foreshortening in look.foreshortenings:
            width = round(landmark.width_m * foreshortening / distance * strip.px_per_rad)
            if not _MIN_SIZE_PX <= width <= end - first:
                continue
            template = cv2.resize(landmark.patch, (width, height), interpolation=cv2.INTER_AREA)
            if not np.ptp(template):
                continue  # OpenCV finds a template of one grey level everywhere
            scores = cv2.matchTemplate(band, template, cv2.TM_CCOEFF_NORMED)
            row = np.argmax(scores, axis=0)
            score = np.take_along_axis(scores, row[None], 0)[0]
            begin = first + (width - 1) // 2
            better = np.flatnonzero(score > best[0, begin : begin + len(score)])
            at = top + row[better] + (height - 1) / 2.0
            tangent = strip.tangent[0] - at / strip.px_per_rad
            best[:, begin + better] = np.broadcast_arrays(
                score[better], tangent, distance, width / 2.0
            )
    return best


def _measured(
    index: int, landmark: Landmark, best: FloatArray, strip: Strip, tangent_sigma: float
) -> CandidateDetections:
    """Detections at the peaks of the best matches of a landmark, with their ranges."""
    columns = _peaks(best[0], best[3])
    score, tangent, reach, _ = best[:, columns]
    rise = landmark.position[2] - strip.center[2]
    # The range by the height, if the landmark is above or below the camera, and by the scale.
    with np.errstate(divide='ignore', invalid='ignore'):
        by_height = rise / tangent
        sigma = np.hypot(tangent_sigma, landmark.covariance[2, 2] ** 0.5 / reach)
        sigma = sigma / np.abs(tangent)
    usable = (by_height > 0.0) & (sigma < 0.5)
    weight = np.where(usable, 1.0 / np.where(usable, sigma, 1.0) ** 2, 0.0)
    by_scale = RANGE_SIGMA**-2
    log_height = np.log(np.where(usable, by_height, 1.0))
    log_range = (weight * log_height + by_scale * np.log(reach)) / (weight + by_scale)
    return CandidateDetections(
        np.full(len(columns), index, dtype=np.intp),
        strip.azimuth[columns],
        np.exp(log_range),
        1.0 / np.sqrt(weight + by_scale),
        np.tile(strip.center[:2], (len(columns), 1)),
        score,
    )


def _peaks(score: FloatArray, half_width: FloatArray) -> npt.NDArray[np.intp]:
    """Columns of the best peaks, more than half a template's width apart."""
    score = score.copy()
    columns: list[int] = []
    for _ in range(_PER_VIEW):
        column = int(np.argmax(score))
        if score[column] < _MIN_SCORE:
            break
        columns.append(column)
        reach = int(np.ceil(half_width[column]))
        score[max(0, column - reach) : column + reach + 1] = -1.0
    return np.array(columns, dtype=np.intp)
