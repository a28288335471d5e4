"""
Least squares of a sweep's calibration over the overlaps of its frames.

A camera that rotates about its optical centre sees pure rotations, and the last frame of a turn
overlaps the first: this determines angles and focal length (Szeliski and Shum, SIGGRAPH 1997). The
fit is robust, with sigmas from the scatter of the residuals.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from landmark_nav.arrays import IndexArray
from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.learning.least_squares import covariance_of, Damping, solve_positive
from landmark_nav.learning.panorama.photometry import even_out, measure_photometry
from landmark_nav.learning.panorama.synthesis import (
    frame_slab,
    FrameSlab,
    grey_frame,
    sweep_cylinder,
)
from landmark_nav.types import CameraFrame, FloatArray, Sweep

_POINTS_PER_PAIR = 60
_SPACING_PX = 14
_LEAST_PER_PAIR = 6
# Consecutive frames of a chain are up to this share of the field of view apart.
_LEAP = 0.42


@dataclass(frozen=True, eq=False)
class Overlaps:
    """
    Matches between consecutive frames of a chain, counter-clockwise.

    `frames` (m, 2) are indices in the sweep, the later one in pan first; `pixels` (m, 2, 2) are
    those of the point in both; `pair` (m,) is the link of the chain; `closed` is set if the chain
    is a full turn. `gaps_rad` are the pans where a full turn lacks a link, for want of texture.
    """

    frames: IndexArray
    pixels: FloatArray
    pair: IndexArray
    closed: bool
    gaps_rad: tuple[float, ...] = ()

    def __len__(self) -> int:
        """Return the number of matches."""
        return len(self.frames)

    @classmethod
    def none(cls) -> Overlaps:
        """Return an empty set."""
        nobody = np.zeros(0, np.intp)
        return cls(nobody.reshape(0, 2), np.zeros((0, 2, 2)), nobody, False)


def track_overlaps(sweep: Sweep, mount: PanTiltMount, every_frame: bool = False) -> Overlaps:
    """
    Track points between frames of a sweep.

    Angles are correct to a few pixels. The chain has `every_frame`, or as many as it needs.
    """
    chain, closed = _chain(sweep, every_frame)
    cylinder = sweep_cylinder(sweep, mount)
    used = sorted(set(chain))
    # A change of brightness across a point looks like a shift of it.
    shown = replace(sweep, frames=tuple(grey_frame(sweep.frames[k]) for k in used))
    shown = even_out(shown, measure_photometry(shown, mount))
    slabs = (frame_slab(frame, mount, cylinder) for frame in shown.frames)
    grey = dict(zip(used, slabs, strict=True))
    frames, pixels, pairs, gaps = [], [], [], []
    for link, (a, b) in enumerate(pairwise(chain)):
        columns = _track(grey[a], grey[b], cylinder)
        if columns is None or len(columns) < _LEAST_PER_PAIR:
            start, end = sweep.frames[a].pan_rad, sweep.frames[b].pan_rad
            gaps.append(float(wrap_rad(start + 0.5 * wrap_rad(end - start))))
            continue
        rays = cylinder.rays(columns)
        ends = [_pixels(sweep.frames[k], rays[:, side], mount) for side, k in enumerate((a, b))]
        pixels.append(np.stack(ends, 1))
        frames.append(np.tile([a, b], (len(columns), 1)))
        pairs.append(np.full(len(columns), link))
    if not frames:
        return Overlaps.none()
    seen = np.isfinite(np.concatenate(pixels)).all(axis=(1, 2))
    every, points, links = (np.concatenate(parts)[seen] for parts in (frames, pixels, pairs))
    gaps_rad = tuple(gaps) if closed else ()
    return Overlaps(every, points, links, closed and not gaps, gaps_rad)


def _chain(sweep: Sweep, every_frame: bool) -> tuple[list[int], bool]:
    """Frames in the order of their pan, some left out, and whether the last meets the first."""
    pan = np.array([frame.pan_rad for frame in sweep.frames])
    field = 2.0 * sweep.frames[0].camera.half_fov_rad
    order = np.argsort(np.mod(pan, 2.0 * np.pi), kind='stable')
    step = np.mod(np.diff(pan[order], append=pan[order[0]]), 2.0 * np.pi)
    # The chain starts after the widest gap, so that a part of a turn is one chain.
    order = np.roll(order, -1 - int(np.argmax(step)))
    step = np.roll(step, -1 - int(np.argmax(step)))
    closed = bool(step[-1] < 0.8 * field) and len(order) > 2
    chain, since = [int(order[0])], 0.0
    ends = len(order) if closed else len(order) - 1
    for n in range(ends):
        since += float(step[n])
        last = n == ends - 1
        ahead = float(step[n + 1]) if not last else 0.0
        if every_frame or last or since + ahead > _LEAP * field:
            chain.append(int(order[(n + 1) % len(order)]))
            since = 0.0
    return chain, closed


def _pixels(frame: CameraFrame, rays: FloatArray, mount: PanTiltMount) -> FloatArray:
    turned = mount.camera_pose_base(frame.pan_rad, frame.tilt_rad, frame.roll_rad)[0]
    return frame.camera.project(rays @ turned)


def _track(first: FrameSlab, second: FrameSlab, cylinder: Cylinder) -> FloatArray | None:
    """Cylinder pixels (n, 2, 2) of points in two slabs; None if they share none."""
    # Columns of the second frame, in the numbering of the first.
    shift = (second.start - first.start + cylinder.width // 2) % cylinder.width
    shift -= cylinder.width // 2
    low, high = max(0, shift), min(first.width, shift + second.width)
    if high - low < 24:
        return None
    here, there = slice(low, high), slice(low - shift, high - shift)
    both = first.inside[:, here] & second.inside[:, there]
    mask = cv2.erode(both, np.ones((15, 15), np.uint8))
    one, other = first.image[:, here].copy(), second.image[:, there].copy()
    corners = cv2.goodFeaturesToTrack(one, _POINTS_PER_PAIR, 0.01, _SPACING_PX, mask=mask)
    if corners is None:
        return None
    # Forth and back: points that do not come back are left out.
    begin = np.asarray(corners, dtype=np.float32)
    tracked, found, _ = cv2.calcOpticalFlowPyrLK(one, other, begin, begin.copy())
    ends = np.asarray(tracked, dtype=np.float32)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(other, one, ends, begin.copy())
    away = np.linalg.norm(np.asarray(back) - begin, axis=2)[:, 0]
    good = (np.ravel(found) == 1) & (np.ravel(returned) == 1) & (away < 0.3)
    offset = np.array([first.start + low, 0.0])
    return np.stack([corners[good, 0] + offset, ends[good, 0] + offset], 1)


# Terms that all frames share -> the quantity of a `Calibration` that they correct.
COMMON = {
    'focal_length': 'focal_scale',
    'distortion': 'distortion',
    'pan_scale': 'pan_scale',
    'tilt': 'camera_tilt',
    'roll': 'camera_roll',
    'forward': 'center_x',
    'left': 'center_y',
    'principal_point': 'principal_point',
}
CORRECTED = [NAMES.index(name) for name in COMMON.values()]
_OFFSET = [list(COMMON).index(name) for name in ('forward', 'left')]
_STEPS = np.array([1e-5, 1e-4, 1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-5])
_ITERATIONS, _NOISE_ROUNDS = 12, 3
_CONVERGED_PX = 5e-3
_NEAR_PX = 0.3
# Bias of tracking in any pattern, which does not decrease with the number of points.
_BIAS_PX = 0.003
# What a match shows is on the wall behind it, outside of a window, or anywhere: prior
# probabilities, which count as this number of matches in each cell. What is off the wall is on it
# with less than the last share of the probability: otherwise the noise of a match would choose.
# What hangs on a wall is 10 cm off it at 3 m; what is outside is 30 m away, from 15 m on; all else
# is from 1.5 m on.
_KINDS, _PRIOR_MATCHES, _OFF_WALL = np.array([0.7, 0.15, 0.15]), 10.0, 0.01
_WALL_SHARE, _OUTSIDE_M, _NEAREST_M = 0.03, 30.0, 1.5
_ANYWHERE = len(_KINDS) - 1
# What is of one kind in a cell has one range; a cell is 0.6 m at 3 m.
_CELL_RAD, _LEAST_INVERSE = 0.2, 1e-3
# Relative sigma of all ranges: 10 cm in front of the walls, at 3 m; of ranges that are a guess.
_ROOM_SHARE, _GUESS_SHARE = 0.03, 0.5
# Offsets from the axis that fits start with, m, and ratios of offsets to the best of these;
# iterations with free ranges before the offset is free, and those after which the best is known.
_OFFSETS_M, _DIRECTIONS, _HELD, _FIRST = 0.02, 8, 2, 4
_RATIOS = 0.2, 0.33, 0.5, 0.7, 1.4, 2.0, 3.0, 5.0

RangeOfRay = Callable[[FloatArray, FloatArray], FloatArray]
Whitening = Callable[[FloatArray], FloatArray]
# Unknowns, residuals (m, 2), and their derivatives (m, 2) by the relative inverse range.
_State = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class Fit:
    """
    The best fit.

    `common` (8,) are the values of `COMMON`, with their covariance (8, 8), zero for fixed terms,
    by the scatter of the matches and by biases of tracking in any pattern; `frames` (n, 3) are
    pan, tilt and roll of each frame, zero without matches; `weight` (m,) are those of the matches.
    `cells` (k, 2) are those of azimuth and tangent that show most often what is off the walls, and
    `farther` (k,) by how much their inverse range is less than that of the walls, relative to it.
    """

    common: FloatArray
    covariance: FloatArray
    frames: FloatArray
    weight: FloatArray
    cells: IndexArray = field(default_factory=lambda: np.zeros((0, 2), np.intp))
    farther: FloatArray = field(default_factory=lambda: np.zeros(0))

    def range_m(self, wall_m: FloatArray, azimuth: FloatArray, tangent: FloatArray) -> FloatArray:
        """Range of what is seen in directions (...) with walls at `wall_m` (...), of any shape."""
        place = _cells(azimuth, tangent)
        inverse: FloatArray = np.ones(place.shape[:-1])
        for cell, farther in zip(self.cells, self.farther, strict=True):
            inverse[(place == cell).all(-1)] = 1.0 - farther
        return np.asarray(wall_m / np.maximum(inverse, _LEAST_INVERSE))


@dataclass(frozen=True, eq=False)
class _Noise:
    """
    Errors of matches and of ranges at one set of unknowns.

    `weight` (m,) are those of matches, `rest` (m, 2) their residuals without what ranges of
    objects explain, and `mean` (m,) the expected share by which the inverse range of their kind is
    less than that of the wall. An object is what is of one kind in one cell: `place` (m,) are
    those of the matches, `variance` (n,) those of their ranges, and `by_range` (m, 2) the
    derivatives of residuals by these. A cell is `farther` (k,) than the wall, or 0 on it. The
    last four are None without ranges. `cost` is minus twice the logarithm of the likelihood.
    """

    sigma_px: float
    weight: FloatArray
    rest: FloatArray
    cost: float
    mean: FloatArray
    by_range: FloatArray | None = None
    place: IndexArray | None = None
    variance: FloatArray | None = None
    farther: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class _Optimum:
    """Unknowns of a local optimum, with its noise, whitened Jacobian and normal equations."""

    cost: float
    x: FloatArray
    noise: _Noise
    flat: FloatArray
    normal: FloatArray


class OverlapProblem:
    """
    Matches of a sweep, whose frames have one camera, as functions of corrections of a calibration.

    The sweep has camera and joints as given. `range_m` gives the horizontal range from the axis,
    m, at azimuths and tangents (n,); it may be `guessed`, not that of walls.
    """

    def __init__(
        self,
        overlaps: Overlaps,
        sweep: Sweep,
        prior: Calibration,
        range_m: RangeOfRay | None = None,
        guessed: bool = False,
    ) -> None:
        self._overlaps, self._prior = overlaps, prior
        self._camera = sweep.frames[0].camera
        self._used, links = np.unique(overlaps.frames, return_inverse=True)
        self._links = links.reshape(-1, 2)
        self._count = len(sweep.frames)
        self._angles = _angles(sweep)[self._used]
        self._rays: dict[tuple[float, float, float], FloatArray] = {}
        self._last = np.zeros(len(COMMON) + 3 * len(self._used))
        self._slopes: tuple[FloatArray, FloatArray] | None = None
        self._range: FloatArray | None = None
        self._room_share = _GUESS_SHARE if guessed else _ROOM_SHARE
        # Of what is of each kind in each cell: by which share the inverse range is less than that
        # of the wall, mean and variance (k, 3).
        self._cell: IndexArray | None = None
        self._mean = self._variance = np.zeros((0, len(_KINDS)))
        self._cells = np.zeros((0, 2), np.intp)
        if range_m is not None:
            azimuth, tangent = self._seen(self._last)[0][..., 0].T
            self._range = range_m(azimuth, tangent)
            cells = np.unique(_cells(azimuth, tangent), axis=0, return_inverse=True)
            self._cells, self._cell = cells[0], cells[1].ravel()
            wall_m = np.bincount(self._cell, self._range) / np.bincount(self._cell)
            outside = np.minimum(wall_m / _OUTSIDE_M, 0.5)
            wall, thing = np.full_like(wall_m, _WALL_SHARE), np.maximum(wall_m / _NEAREST_M, 1.0)
            sigma = np.stack([wall, outside, thing], 1)
            self._variance = np.maximum(sigma, _GUESS_SHARE if guessed else 0.0) ** 2
            self._mean = np.stack([0.0 * wall, 1.0 - outside, 0.0 * wall], 1)

    def fit(self, free: Sequence[int], frame_sigma: Sequence[float]) -> Fit:
        """
        Fit `free` common terms, indices in `COMMON`, and the angles of frames.

        `frame_sigma` (3,) are sigmas of pan, tilt and roll of a frame about the given ones, rad.
        """
        every = np.arange(len(self._last))
        index = np.concatenate([np.asarray(free, np.intp), every[len(COMMON) :]])
        start = np.where(np.isin(every, index), self._last, 0.0)
        precision = np.zeros(len(start))
        precision[len(COMMON) :] = np.tile(1.0 / np.square(frame_sigma), len(self._angles))
        found = [self._optimum(start, index, precision, _ITERATIONS)]
        # Things before or beyond the walls look like another offset of the camera, which is a
        # local optimum: the likeliest of several is the result.
        if self._range is not None and set(_OFFSET) <= set(free):
            for around in 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS:
                start = np.zeros(len(every))
                start[_OFFSET] = _OFFSETS_M * np.array([np.cos(around), np.sin(around)])
                found.append(self._optimum(start, index, precision, _FIRST, _HELD))
            # Parallax shows the product of offset and inverse range: if most of what is seen is
            # outside, it looks like the walls of a camera with a smaller offset.
            likeliest = min(found, key=lambda optimum: optimum.cost).x
            for ratio in _RATIOS:
                start = likeliest.copy()
                start[_OFFSET] *= ratio
                found.append(self._optimum(start, index, precision, _FIRST, _HELD))
        best = min(found, key=lambda optimum: optimum.cost)
        if best is not found[0]:
            best = self._optimum(best.x, index, precision, _ITERATIONS)
        self._last, noise = best.x, best.noise
        weight, spread = noise.weight, covariance_of(best.normal)
        by_pattern = float(weight.sum()) * (_BIAS_PX / noise.sigma_px) ** 2
        spread += by_pattern * spread @ (best.flat.T @ best.flat) @ spread
        covariance, own = np.zeros((len(COMMON), len(COMMON))), index[: len(free)]
        covariance[np.ix_(own, own)] = spread[: len(free), : len(free)]
        turns = np.zeros((self._count, 3))
        turns[self._used] = self._last[len(COMMON) :].reshape(-1, 3)
        common, cells, farther = self._last[: len(COMMON)], self._cells, noise.farther
        if farther is not None:
            cells, farther = cells[farther != 0.0], farther[farther != 0.0]
            return Fit(common, covariance, turns, weight, cells, farther)
        return Fit(common, covariance, turns, weight)

    def _optimum(
        self,
        x: FloatArray,
        index: IndexArray,
        precision: FloatArray,
        iterations: int,
        held: int = 0,
    ) -> _Optimum:
        """Local optimum; the unknowns at `index` are free, the offset not in those `held`."""
        focal, damping, at = self._camera.fx, Damping(), (x, *self._misfit(x))
        for n in range(iterations + held):
            which = np.setdiff1d(index, _OFFSET) if n < held else index
            noise = self._noise(*at[1:], n < held)
            # Parallax is less outside. What is anywhere has the slopes of the wall: its range is
            # noisy.
            slopes = self._slopes_at(at[0], at[1]).copy()
            slopes[..., _OFFSET] *= (1.0 - noise.mean)[:, None, None]
            scale = np.sqrt(noise.weight) * focal / noise.sigma_px
            whiten = self._whitening(noise, scale)

            def residuals(
                off: FloatArray,
                by_range: FloatArray,
                mean: FloatArray = noise.mean,
                scale: FloatArray = scale,
                whiten: Whitening = whiten,
            ) -> FloatArray:
                return whiten(((off - by_range * mean[:, None]) * scale[:, None]).ravel())

            flat = whiten((slopes[..., which] * scale[:, None, None]).reshape(-1, len(which)))
            normal = flat.T @ flat + np.diag(precision[which])
            pull = flat.T @ residuals(*at[1:]) + precision[which] * at[0][which]
            stepped = partial(self._stepped, at[0], which, normal, pull)

            def cost(there: _State, residuals: Callable[..., FloatArray] = residuals) -> float:
                return float(np.sum(residuals(*there[1:]) ** 2) + precision @ there[0] ** 2)

            before, at = at, damping.step(at, stepped, cost)
            if n >= held and focal * np.abs(at[0] - before[0]).max() < _CONVERGED_PX:
                break
        noise = self._noise(*at[1:])
        return _Optimum(noise.cost + float(precision @ at[0] ** 2), at[0], noise, flat, normal)

    def _stepped(
        self,
        x: FloatArray,
        index: IndexArray,
        normal: FloatArray,
        pull: FloatArray,
        damping: float,
    ) -> _State:
        """Unknowns after a damped step of those at `index`, with the misfit there."""
        there = x.copy()
        there[index] -= solve_positive(normal + damping * np.diag(np.diag(normal)), pull)
        return there, *self._misfit(there)

    def _noise(self, off: FloatArray, by_range: FloatArray, anywhere: bool = False) -> _Noise:
        """
        Errors of matches by what ranges of their own leave of residuals (m, 2).

        All is `anywhere`, or of the likeliest kind: things that nobody expects show their own
        range, and do not bend the lens.
        """
        focal = self._camera.fx
        shown = np.maximum(np.sum(by_range**2, 1), 1e-12)
        seen = np.minimum(np.sum(by_range * off, 1) / shown, 1.0)
        rest, where = off - by_range * seen[:, None], np.tile(_KINDS, (len(self._cells), 1))
        for _ in range(_NOISE_ROUNDS):
            distance = focal * np.linalg.norm(rest, axis=1)
            # Median of a Rayleigh distribution.
            sigma_px = max(float(np.median(distance)) / 1.1774, 1e-3)
            square = (distance / (2.0 * sigma_px)) ** 2
            # Student's t with four degrees of freedom, in the plane.
            weight = 1.0 / (1.0 + square)
            cost = float(4.0 * len(off) * np.log(sigma_px) + 6.0 * np.sum(np.log1p(square)))
            if self._cell is None:
                return _Noise(sigma_px, weight, rest, cost, np.zeros(len(off)))
            size = weight * (focal / sigma_px) ** 2 * shown
            away = seen[:, None] - self._mean[self._cell]
            spread = self._variance[self._cell] + 1.0 / size[:, None]
            likely = np.log(where[self._cell]) - 0.5 * (np.log(spread) + away**2 / spread)
            likely[:, 0] -= np.log(_OFF_WALL)
            kind = np.full(len(off), _ANYWHERE) if anywhere else np.argmax(likely, 1)
            place = len(_KINDS) * self._cell + kind
            mean = self._mean[self._cell, kind]

            def of_objects(values: FloatArray, place: IndexArray = place) -> FloatArray:
                found = np.bincount(place, values, len(_KINDS) * len(self._cells))
                return np.asarray(found.reshape(-1, len(_KINDS)), np.float64)

            sizes, count = of_objects(size), of_objects(np.ones(len(off)))
            # Nothing is beyond infinity.
            moved = of_objects(size * (seen - mean)) / (sizes + 1.0 / self._variance)
            ranges = np.minimum(self._mean + moved, 1.0)
            rest = off - by_range * ranges.ravel()[place][:, None]
            where = _PRIOR_MATCHES * _KINDS + count
            where /= where.sum(1, keepdims=True)
            cost += float(np.sum(np.log1p(self._variance * sizes) + moved**2 / self._variance))
            cost -= 2.0 * float(np.sum((_PRIOR_MATCHES * _KINDS + count) * np.log(where)))
        most = np.argmax(count, 1)
        farther = np.where(most == 0, 0.0, ranges[np.arange(len(most)), most])
        variance = self._variance.ravel()
        return _Noise(sigma_px, weight, rest, cost, mean, by_range, place, variance, farther)

    def _whitening(self, noise: _Noise, scale: FloatArray) -> Whitening:
        """Return a function that whitens residuals and slopes (2 m, ...) for errors of ranges."""
        # One error is common to all matches of an object, another to all of the room, as most
        # things stand in front of walls: with derivatives j by the error of an object, the
        # covariance of their residuals is ``1 + v j j^T``.
        if noise.by_range is None or noise.variance is None or noise.place is None:
            return lambda rows: rows
        by_range = noise.by_range * scale[:, None]
        objects = len(noise.variance)
        square = np.bincount(noise.place, np.sum(by_range**2, 1), objects)
        place = np.repeat(noise.place, 2), np.arange(by_range.size)
        along = csr_array((by_range.ravel(), place), (objects, by_range.size))
        share = _whitening_share(noise.variance, square)

        def by_object(rows: FloatArray) -> FloatArray:
            return np.asarray(rows - along.T @ ((share * (along @ rows).T).T))

        # The same for one error of all ranges.
        every = by_object((by_range * (1.0 - noise.mean)[:, None]).ravel())
        common = _whitening_share(self._room_share**2, every @ every) * every

        def whiten(rows: FloatArray) -> FloatArray:
            own = by_object(rows)
            return own - np.multiply.outer(common, every @ own)

        return whiten

    def misfit_px(self, common: FloatArray, frames: FloatArray | None = None) -> float:
        """Median distance of the two rays of a match, pixels."""
        off = np.linalg.norm(self._rest(common, frames), axis=1)
        return self._camera.fx * float(np.median(off))

    def closure_rad(self, fit: Fit) -> float | None:
        """Closure error: sum of the links of the chain, each by its matches, minus a full turn."""
        if not self._overlaps.closed:
            return None
        pair = self._overlaps.pair
        off = self._rest(fit.common, fit.frames)[:, 0]
        total = np.bincount(pair, fit.weight * off)
        return float(np.sum(total / np.maximum(np.bincount(pair, fit.weight), 1e-9)))

    def _rest(self, common: FloatArray, frames: FloatArray | None) -> FloatArray:
        """Residuals (m, 2) without what the ranges of objects explain."""
        turns = np.zeros_like(self._angles) if frames is None else frames[self._used]
        return self._noise(*self._misfit(np.append(common, turns))).rest

    def _misfit(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """
        Differences between the two rays of each match, and their derivatives by the range.

        Both are (m, 2), of azimuth and tangent; the latter by the relative inverse range.
        """
        seen, by_range = self._seen(x)
        off = seen[..., 0] - seen[..., 1]
        off[:, 0] = wrap_rad(off[:, 0])
        return off, by_range[..., 0] - by_range[..., 1]

    def _seen(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """
        Directions of both rays of each match at the axis, and derivatives by the range.

        Both are (m, 2, 2): azimuth and tangent of both rays.
        """
        common, turns = x[: len(COMMON)], x[len(COMMON) :].reshape(-1, 3)
        known = corrected(self._prior, common)
        mount = known.mount
        rotation, center = mount.camera_pose_base(*(_calibrated(self._angles, known) + turns).T)
        lens = (float(common[0]), float(common[1]), float(common[7]))
        if lens not in self._rays:
            self._rays[lens] = known.camera(self._camera).unproject(self._overlaps.pixels)
        x, y, z = np.einsum('mkij,mkj->imk', rotation[self._links], self._rays[lens])
        if self._range is None:
            seen = np.stack([np.arctan2(y, x), z / np.hypot(x, y)], 1)
            return seen, np.zeros_like(seen)
        start = (center - np.asarray(mount.axis_xyz))[self._links]
        out, square = self._range[:, None], x**2 + y**2
        along = (start[..., 0] * x + start[..., 1] * y) / square
        reach = (out**2 - np.sum(start[..., :2] ** 2, -1)) / square
        root = np.sqrt(np.maximum(along**2 + reach, 1e-9))
        at = [start[..., k] + (root - along) * ray for k, ray in enumerate((x, y, z))]
        nearer = -(out**2) / (square * root)
        turn = nearer * (at[0] * y - at[1] * x) / out**2
        seen = np.stack([np.arctan2(at[1], at[0]), at[2] / out], 1)
        return seen, np.stack([turn, (nearer * z + at[2]) / out], 1)

    def _slopes_at(self, x: FloatArray, here: FloatArray) -> FloatArray:
        """Jacobian at `x`, or at a nearby point, where it is as good."""
        if self._slopes is None or self._camera.fx * np.abs(x - self._slopes[0]).max() > _NEAR_PX:
            self._slopes = x, self._jacobian(x, here)
        return self._slopes[1]

    def _jacobian(self, x: FloatArray, here: FloatArray) -> FloatArray:
        """Jacobian (m, 2, 8 + 3n): a match depends on the common terms and its two frames."""
        out = np.zeros((*here.shape, len(x)))
        for k, step in enumerate(_STEPS):
            moved = x.copy()
            moved[k] += step
            out[..., k] = (self._misfit(moved)[0] - here) / step
        seen, _ = self._seen(x)
        row, step = np.arange(len(here)), 1e-6
        for axis in range(3):
            # All frames turn at once; each side of a match depends on its own frame only.
            turned = x.copy()
            turned[len(COMMON) + axis :: 3] += step
            change = self._seen(turned)[0] - seen
            change[:, 0] = wrap_rad(change[:, 0])
            for side, sign in ((0, 1.0), (1, -1.0)):
                column = len(COMMON) + 3 * self._links[:, side] + axis
                out[row, :, column] += sign / step * change[..., side]
        return out


def _cells(azimuth: FloatArray, tangent: FloatArray) -> IndexArray:
    """Cells (..., 2) of directions; what one cell shows is one object."""
    place = np.stack(np.broadcast_arrays(wrap_rad(azimuth), tangent), -1) / _CELL_RAD
    return np.floor(place).astype(np.intp)


def _whitening_share(variance: npt.ArrayLike, square: npt.ArrayLike) -> FloatArray:
    """Factor a of ``1 - a j j^T``, which whitens ``1 + v j j^T`` for j of this squared length."""
    size = np.maximum(square, 1e-12)
    return np.asarray((1.0 - 1.0 / np.sqrt(1.0 + np.asarray(variance) * size)) / size)


def corrected(calibration: Calibration, common: FloatArray) -> Calibration:
    """Return a calibration with corrections (8,), in the order of `COMMON`."""
    values = calibration.values.copy()
    values[CORRECTED] += common
    return replace(calibration, values=values)


def as_calibrated(
    sweep: Sweep, calibration: Calibration, turns: FloatArray | float = 0.0
) -> Sweep:
    """Return a sweep with camera and joints as calibrated, each frame turned by `turns` (n, 3)."""
    camera = cache(calibration.camera)
    frames = (
        replace(frame, camera=camera(frame.camera), pan_rad=pan, tilt_rad=tilt, roll_rad=roll)
        for frame, (pan, tilt, roll) in zip(
            sweep.frames, (_calibrated(_angles(sweep), calibration) + turns).tolist(), strict=True
        )
    )
    return replace(sweep, frames=tuple(frames))


def _angles(sweep: Sweep) -> FloatArray:
    """Pan, tilt and roll (n, 3) of the frames."""
    return np.array([(f.pan_rad, f.tilt_rad, f.roll_rad) for f in sweep.frames])


def _calibrated(angles: FloatArray, known: Calibration) -> FloatArray:
    scale, tilt = known['pan_scale'][0], known['camera_tilt'][0]
    return np.asarray(angles * [1.0 + scale, 1.0, 1.0] + [0.0, tilt, 0.0])
