"""
Errors of intrinsics and extrinsics that are observable in the images alone.

A camera on a level floor turns about the vertical. Points that are seen in consecutive images then
keep their slope, except for the parallax of a planar motion:

    azimuth after - azimuth before = -turn + nearness (right sin azimuth - ahead cos azimuth) ...

with an independent turn and planar displacement of each pair of images. Each error of the lens or
the mount violates this in a different way. Each is removed separately, with the value that fits
best, and they are compared by likelihood, like the causes of `causes.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize, minimize_scalar

from landmark_nav.arrays import FloatArray, ImageArray, IndexArray
from landmark_nav.diagnosis.motion import ALIKE, CERTAIN, FREEDOM
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount

# Width of the images in which corners are detected, pixels, and greatest number of corners.
_WIDTH, _MOST_CORNERS = 320, 400
# Greatest distance of inliers from the homography, pixels; outliers are mismatches or very near.
_APART_PX, _LEAST_MATCHES = 6.0, 12
# Iterations of the fit.
_ITERATIONS = 8
# Least sigma of tracked points.
_LEAST_SIGMA_PX = 0.1
# Effective number of independent matches of a pair, as their depths are correlated.
_INDEPENDENT = 4
# Tracked points: greatest number, least distance between them, greatest distance from the
# homography.
_MOST_MATCHES, _SPACING_PX, _TRACKED_PX = 50, 12.0, 20.0
# One of this many points is used for the mean solid angle.
_SPARSE = 8
# Least number of pairs of images.
_LEAST_PAIRS = 10
# Greatest range of a constant tilt.
_LEVEL_RAD = 0.02
# Least gain of an error over its standard error by the pairs; least spread of gains.
_SIGNIFICANT, _NO_SPREAD = 3.0, 1e-9


class Corners(NamedTuple):
    """A grey image, its corners (n, 2) and their descriptors (n, 32)."""

    image: ImageArray
    pixels: FloatArray
    described: npt.NDArray[np.uint8]


def corners(image: ImageArray) -> Corners:
    """Detect corners of a grey image (height, width) (Rublee et al., ORB, ICCV 2011)."""
    share = min(1.0, _WIDTH / image.shape[1])
    small = cv2.resize(image, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    finder: Any = cv2.ORB_create(_MOST_CORNERS, fastThreshold=8)  # type: ignore[attr-defined]
    keypoints, described = finder.detectAndCompute(small, None)
    if described is None:
        return Corners(image, np.empty((0, 2)), np.empty((0, 32), np.uint8))
    scale = np.array(image.shape[1::-1]) / small.shape[1::-1]
    pixels = (np.array([k.pt for k in keypoints]) + 0.5) * scale - 0.5
    return Corners(image, pixels, np.asarray(described, np.uint8))


def matched(first: Corners, second: Corners) -> tuple[FloatArray, FloatArray] | None:
    """
    Pixels (m, 2) of points in two images; None if they are few.

    Descriptors give the homography, which requires no calibration. It predicts each point, which
    is then tracked (Bouguet, Pyramidal implementation of the Lucas Kanade feature tracker, 2000).
    """
    if min(len(first.pixels), len(second.pixels)) < _LEAST_MATCHES:
        return None
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    pairs = matcher.match(first.described, second.described)
    if len(pairs) < _LEAST_MATCHES:
        return None
    one = first.pixels[[pair.queryIdx for pair in pairs]]
    two = second.pixels[[pair.trainIdx for pair in pairs]]
    homography, near = cv2.findHomography(one, two, cv2.RANSAC, _APART_PX)
    if homography is None or near.sum() < max(_LEAST_MATCHES, len(pairs) // 4):
        return None
    points = cv2.goodFeaturesToTrack(first.image, _MOST_MATCHES, 0.01, _SPACING_PX)
    if points is None:
        return None
    begin = cv2.perspectiveTransform(points, homography).astype(np.float32)
    search: dict[str, Any] = {'winSize': (15, 15), 'maxLevel': 1}
    search['flags'] = cv2.OPTFLOW_USE_INITIAL_FLOW
    images = first.image, second.image
    found, tracked, _ = cv2.calcOpticalFlowPyrLK(*images, points, begin.copy(), **search)
    near_px = np.linalg.norm(found - begin, axis=2).ravel() < _TRACKED_PX
    kept = (tracked.ravel() > 0) & near_px
    if kept.sum() < _LEAST_MATCHES:
        return None
    return points[kept, 0].astype(np.float64), found[kept, 0].astype(np.float64)


@dataclass(frozen=True, eq=False)
class Matches:
    """
    Points in pairs of images: pixels (m, 2) in the first and second image of their pair.

    `pairs` (m,) are indices of pairs, ascending from 0; pans and tilts (pairs, 2) are those at
    both images.
    """

    before_px: FloatArray
    after_px: FloatArray
    pairs: IndexArray
    pans_rad: FloatArray
    tilts_rad: FloatArray

    @cached_property
    def begins(self) -> IndexArray:
        """Index (pairs,) of the first point of each pair."""
        return np.flatnonzero(np.diff(self.pairs, prepend=-1))


@dataclass(frozen=True)
class CameraSetup:
    """Intrinsics and extrinsics; `tilt_rad` is added to the tilt of the joints."""

    camera: CameraModel
    mount: PanTiltMount
    tilt_rad: float = 0.0


def _mounted(setup: CameraSetup, roll: float = 0.0, pitch: float = 0.0) -> CameraSetup:
    first, second, third = setup.mount.axis_rpy
    rpy = first + roll, second + pitch, third
    return replace(setup, mount=replace(setup.mount, axis_rpy=rpy))


def _rolled(setup: CameraSetup, value: float) -> CameraSetup:
    roll = float(wrap_rad(setup.mount.camera_roll_rad + value))
    return replace(setup, mount=replace(setup.mount, camera_roll_rad=roll))


def _lens(setup: CameraSetup, **change: Any) -> CameraSetup:
    return replace(setup, camera=replace(setup.camera, **change))


def _sized(setup: CameraSetup, share: float) -> CameraSetup:
    """Scale a calibration to images that are `share` times as large."""
    c = setup.camera
    middle = {'cx': share * (c.cx + 0.5) - 0.5, 'cy': share * (c.cy + 0.5) - 0.5}
    return _lens(setup, fx=share * c.fx, fy=share * c.fy, **middle)


# Smaller errors are within the range that localization and learning estimate.
_MATTERS = 0.05
# Start values of a search, as shares of the reach; the best is used if it beats no error.
_TRIED = (-0.5, -0.1, 0.1, 0.5)


@dataclass(frozen=True)
class _Error:
    """Parameter of lens or mount: how a value is added, start values and reach of the search."""

    change: Callable[[CameraSetup, float], CameraSetup]
    reach: float
    starts: tuple[float, ...] = (0.0,)


_QUARTER = 0.5 * np.pi
_ERRORS = {
    'tilt': _Error(lambda s, v: replace(s, tilt_rad=s.tilt_rad + v), _QUARTER),
    'axis pitch': _Error(lambda s, v: _mounted(s, pitch=v), _QUARTER),
    'axis roll': _Error(lambda s, v: _mounted(s, roll=v), _QUARTER),
    # Half a turn is not observable by rotation alone; the sign of the pan shows it.
    'roll': _Error(_rolled, 0.6, starts=(0.0, _QUARTER, -_QUARTER)),
    'focal length': _Error(
        lambda s, v: _lens(s, fx=s.camera.fx * np.exp(v), fy=s.camera.fy * np.exp(v)),
        0.7,
        starts=(0.0, -1.4, 1.4, -2.8, 2.8, 4.2),
    ),
    'size': _Error(lambda s, v: _sized(s, np.exp(v)), 0.7, starts=(0.0, -1.4, 1.4)),
    'fx': _Error(lambda s, v: _lens(s, fx=s.camera.fx * np.exp(v)), 0.7),
    'fy': _Error(lambda s, v: _lens(s, fy=s.camera.fy * np.exp(v)), 0.7),
    'cx': _Error(lambda s, v: _lens(s, cx=s.camera.cx + v * s.camera.fx), 0.6),
    'cy': _Error(lambda s, v: _lens(s, cy=s.camera.cy + v * s.camera.fy), 0.6),
    'distortion': _Error(
        lambda s, v: _lens(
            s, distortion=(s.camera.coefficients[0] + v, *s.camera.coefficients[1:])
        ),
        0.4,
    ),
}


@dataclass(frozen=True)
class CameraError:
    """
    An error of lens or mount: its name, and the correction to add to the given value.

    `also` names equivalent explanations; `setup` is the corrected one.
    """

    name: str
    value: float
    setup: CameraSetup
    also: tuple[str, ...]


def camera_error(matches: Matches, setup: CameraSetup) -> CameraError | None:
    """Find the error that explains the motion of points between images; None if none does."""
    if not len(matches.pairs) or matches.pairs[-1] + 1 < _LEAST_PAIRS:
        return None
    given, setup = setup, _nearly(matches, setup)
    none = _score(matches, setup)
    level = replace(matches, tilts_rad=np.zeros_like(matches.tilts_rad))
    moving = np.ptp(matches.tilts_rad) > _LEVEL_RAD
    if moving and (without := _score(level, setup)) > none + CERTAIN:
        matches, none = level, without  # the tilt is that of another joint
    # Small angles that were fitted with the error in place may be wrong: the search starts from
    # both setups, and the fitted one pays for its angles (Schwarz, Estimating the dimension of a
    # model, 1978).
    price = 1.5 * np.log(_INDEPENDENT * (matches.pairs[-1] + 1))
    starts = ((setup, none, price), (given, _score(matches, given), 0.0))
    none = max(score - cost for _, score, cost in starts)
    found = {}
    for name, error in _ERRORS.items():
        fits = [(*_best(matches, s, error, score), cost, s) for s, score, cost in starts]
        scored = ((error.change(s, value), score - cost) for value, score, cost, s in fits)
        found[name] = max(scored, key=lambda pair: pair[1])
    name = max(found, key=lambda key: found[key][1])
    best, score = found[name]
    if score < none + CERTAIN:
        return None
    value, _ = _best(matches, given, _ERRORS[name], -np.inf)
    # Pairs differ in the depths of what they see: their gains in likelihood say how sure it is
    # (Vuong, Likelihood ratio tests for model selection and non-nested hypotheses, Econometrica
    # 57(2), 1989).
    scores = _scores(matches, best)
    gains = np.array([scores - _scores(matches, without) for without in (given, setup)])
    spread = np.maximum(gains.std(axis=1), _NO_SPREAD)
    least = np.min(gains.mean(axis=1) / spread) * np.sqrt(len(scores))
    if abs(value) < _MATTERS or not least >= _SIGNIFICANT:
        return None
    also = tuple(key for key in found if key != name and found[key][1] > score - ALIKE)
    return CameraError(name, value, _ERRORS[name].change(given, value), also)


def _nearly(matches: Matches, setup: CameraSetup) -> CameraSetup:
    """Return the setup with the best small angles of camera and axis, as of manual mounting."""
    # Otherwise a large error of another kind would explain them in part.

    def turned(angles: FloatArray) -> CameraSetup:
        return _mounted(_rolled(setup, float(angles[0])), *angles[1:].tolist())

    def badness(angles: FloatArray) -> float:
        return -_score(matches, turned(angles))

    bounds, enough = [(-_MATTERS, _MATTERS)] * 3, {'xtol': 1e-2, 'ftol': 1e-3, 'maxiter': 3}
    found = minimize(badness, np.zeros(3), method='Powell', bounds=bounds, options=enough)
    return turned(found.x)


def _best(matches: Matches, setup: CameraSetup, error: _Error, none: float) -> tuple[float, float]:
    """Return the likeliest value and its score; `none` is the score of 0."""

    def badness(value: float) -> float:
        try:
            # With a very wrong value, rays may have no pixel.
            with np.errstate(all='ignore'):
                score = _score(matches, error.change(setup, value))
        except (LandmarkNavError, np.linalg.LinAlgError):
            return np.inf  # impossible intrinsics
        return -score if np.isfinite(score) else np.inf

    tried = [s + d * error.reach for s in error.starts for d in _TRIED]
    scores = [badness(value) for value in tried]
    first = tried[int(np.argmin(scores))]
    if min(scores) > -none:
        return 0.0, none
    bounds, enough = first + 0.5 * error.reach * np.array([-1, 1]), {'xatol': 1e-3, 'maxiter': 15}
    found = minimize_scalar(badness, bounds=bounds, method='bounded', options=enough)
    pairs = matches.pairs[-1] + 1
    return float(found.x), -float(found.fun) - 0.5 * np.log(_INDEPENDENT * pairs)


def _score(matches: Matches, setup: CameraSetup) -> float:
    """Log-likelihood of all pairs."""
    return float(_scores(matches, setup).sum())


def _scores(matches: Matches, setup: CameraSetup) -> FloatArray:
    """Log-likelihood (pairs,) of points; each pair has a turn and a displacement of its own."""
    k = matches.pairs
    before, after, log_area = _rays(matches, setup.camera)
    both = []
    for n, rays_optical in enumerate((before, after)):
        tilts = matches.tilts_rad[:, n] + setup.tilt_rad
        rotation, _ = setup.mount.camera_pose_base(matches.pans_rad[:, n], tilts)
        rays = np.einsum('nij,nj->ni', rotation[k], rays_optical)
        slopes = rays[:, 2] / np.hypot(rays[:, 0], rays[:, 1])
        both.append((np.arctan2(rays[:, 1], rays[:, 0]), slopes))
    (azimuth, slope), (azimuth_after, slope_after) = both
    s, c = np.sin(azimuth), np.cos(azimuth)
    level = 1.0 / (1.0 + slope**2)
    # Rows of azimuth, then of elevation: turn, displacement ahead and to the left.
    columns = np.zeros((len(k), 2, 3))
    columns[:, 0, 0], columns[:, 0, 1], columns[:, 0, 2] = 1.0, s, -c
    columns[:, 1, 1], columns[:, 1, 2] = slope * c * level, slope * s * level
    squares = (columns[..., None] * columns[..., None, :]).reshape(len(k), 2, 9)
    # The turn of a pair may be large: its mean is subtracted before angles are wrapped.
    turn = np.angle(_sums(np.exp(1j * (azimuth_after - azimuth)), matches.begins))
    turned = wrap_rad(azimuth_after - azimuth - turn[k])
    moved = np.stack([turned, (slope_after - slope) * level], -1)
    # Depths disturb azimuths more than elevations, so each has its own sigma. The least sigma is
    # in pixels, as pixels are measured.
    residuals = moved
    least = _LEAST_SIGMA_PX * np.exp(0.5 * log_area)
    sigma = np.maximum(np.median(np.abs(moved), axis=0), least)
    for _ in range(_ITERATIONS):
        weights = (FREEDOM + 1.0) / (FREEDOM + (residuals / sigma) ** 2)
        weighted = (weights / sigma**2)[..., None]
        flat = (weighted * squares).reshape(len(k), 18)
        information = _sums(flat, matches.begins).reshape(-1, 2, 3, 3).sum(1)
        trace = np.trace(information, axis1=1, axis2=2)
        information += (1e-6 * trace[:, None, None] + 1e-12) * np.eye(3)
        pulls = (weighted * moved[..., None] * columns).reshape(len(k), 6)
        right = _sums(pulls, matches.begins).reshape(-1, 2, 3).sum(1)
        local = np.linalg.solve(information, right[..., None])[..., 0]
        residuals = moved - np.einsum('nri,ni->nr', columns, local[k])
        sigma = np.maximum(np.sqrt(np.mean(weights * residuals**2, axis=0)), least)
    each = -np.log(sigma) - 0.5 * (FREEDOM + 1.0) * np.log1p((residuals / sigma) ** 2 / FREEDOM)
    share = 0.5 * _INDEPENDENT * (k[-1] + 1) / len(k)
    return np.asarray(share * _sums(each.sum(1) + log_area, matches.begins))


# Most errors do not change the intrinsics; those that do are tried from two setups of one camera.
@lru_cache(maxsize=32)
def _rays(matches: Matches, camera: CameraModel) -> tuple[FloatArray, FloatArray, float]:
    """Rays (m, 3) of both images in the optical frame; mean log of the solid angle of a pixel."""
    at, aside = matches.after_px[::_SPARSE], np.eye(2)
    pixels = matches.before_px, matches.after_px, at + aside[0], at + aside[1]
    ends = np.cumsum([len(part) for part in pixels])
    before, after, *beside = np.split(camera.unproject(np.concatenate(pixels)), ends[:-1])
    rays = after[::_SPARSE], *beside
    middle, right, down = (ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays)
    area = np.linalg.norm(np.cross(right - middle, down - middle), axis=1)
    return before, after, float(np.mean(np.log(np.maximum(area, 1e-12))))


def _sums(values: FloatArray, begins: IndexArray) -> FloatArray:
    """Sums (pairs, ...) of values (m, ...) over the rows of each pair."""
    return np.asarray(np.add.reduceat(values, begins, axis=0))
