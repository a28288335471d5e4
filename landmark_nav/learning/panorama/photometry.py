"""
Exposure of each frame and vignetting of the lens, estimated where frames overlap.

The logarithm of a grey level is the sum of the log radiance of the scene point, the log gain of
the frame and a polynomial in the squared radius (Goldman, PAMI 32(12), 2010). All gains and the
polynomial are fitted robustly in one least-squares problem; the radiances are eliminated.
Corrections that are not significant are left out. A dark sweep is brightened as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array, IndexArray
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.learning.panorama.synthesis import sweep_cylinder
from landmark_nav.types import FloatArray, Sweep

# Factor by which frames are reduced, and sampled directions: step of azimuth, number of rows.
_REDUCTION = 8
_STEP_RAD = np.radians(2.5)
_ROWS = 14
# Usable grey levels: darker ones are mostly noise, brighter ones may be clipped.
_LEVELS = (15.0, 225.0)
_ROUNDS = 5
_SIGNIFICANCE = 4.0
# A sweep is brightened if its 90 % quantile of grey levels is between these two: contrast is
# judged in grey levels, and darker sweeps are mostly noise.
_BRIGHT, _DARKEST = 120.0, 10.0
# Smallest relative correction: one grey level.
_MIN_CORRECTION = 0.004
_MIN_SAMPLES = 200


@dataclass(frozen=True, eq=False)
class Photometry:
    """
    Relative brightness: `gain` (n,) of each frame, `falloff` (2,) of the lens, `exposure` of all.

    The lens multiplies a pixel at radius r, relative to the farthest corner, by
    ``exp(falloff[0] r^2 + falloff[1] r^4)``. Gains that are not significant are 1, falloffs 0;
    `exposure` is 1 unless the whole sweep is dark.
    """

    gain: FloatArray
    falloff: FloatArray
    exposure: float = 1.0

    @classmethod
    def none(cls, count: int, exposure: float = 1.0) -> Photometry:
        """Photometry of `count` equal frames without vignetting."""
        return cls(np.ones(count), np.zeros(2), exposure)

    @property
    def vignetting(self) -> float:
        """Share of light lost in the corners."""
        return float(-np.expm1(np.sum(self.falloff)))

    @property
    def gain_spread(self) -> float:
        """Standard deviation of the exposures, relative."""
        return float(np.std(np.log(self.gain)))


def measure_photometry(sweep: Sweep, mount: PanTiltMount) -> Photometry:
    """Measure gains and vignetting of frames that overlap, with angles good to a few pixels."""
    count = len(sweep.frames)
    direction, frame, square, level = _samples(sweep, mount)
    bright = float(np.quantile(level, 0.9)) if len(level) else 0.0
    exposure = bright / _BRIGHT if _DARKEST < bright < _BRIGHT else 1.0
    nothing = Photometry.none(count, exposure)
    usable = (level > _LEVELS[0]) & (level < _LEVELS[1])
    direction, frame = direction[usable], frame[usable]
    square, level = square[usable], level[usable]
    if len(level) < _MIN_SAMPLES:
        return nothing
    for powers in (2, 0):
        terms = np.stack([square, square**2], 1)[:, :powers]
        found = _fit(direction, frame, terms, np.log(level), count)
        if found is None:
            return nothing
        values, covariance = found
        # In the corners.
        falloff, variance = values[count:].sum(), covariance[count:, count:].sum()
        if abs(falloff) > max(_SIGNIFICANCE * np.sqrt(variance), _MIN_CORRECTION):
            break
    sigma = np.sqrt(np.diag(covariance)[:count])
    gain = values[:count]
    used = (np.abs(gain) > _SIGNIFICANCE * sigma) & (np.abs(gain) > _MIN_CORRECTION)
    falloffs = np.append(values[count:], np.zeros(2))[:2]
    return Photometry(np.where(used, np.exp(gain), 1.0), falloffs, exposure)


def even_out(sweep: Sweep, photometry: Photometry) -> Sweep:
    """Return the sweep with exposures and vignetting corrected."""
    gains = photometry.exposure * photometry.gain
    if not photometry.falloff.any() and np.all(gains == 1.0):
        return sweep

    @cache
    def flat_field(camera: CameraModel, shape: tuple[int, ...]) -> Float32Array:
        u, v = np.meshgrid(np.arange(float(shape[1])), np.arange(float(shape[0])))
        square = _square_radius(camera, u, v)
        first, second = photometry.falloff
        field = np.exp(-square * (first + second * square)).astype(np.float32)
        return field if len(shape) == 2 else np.repeat(field[..., None], 3, axis=2)

    frames = []
    for frame, gain in zip(sweep.frames, gains, strict=True):
        scale = 1.0 / float(gain)
        if photometry.falloff.any():
            flat = flat_field(frame.camera, frame.image.shape)
            image = cv2.multiply(frame.image, flat, scale=scale, dtype=cv2.CV_8U)
        else:
            image = cv2.convertScaleAbs(frame.image, alpha=scale)
        frames.append(replace(frame, image=np.asarray(image, dtype=np.uint8)))
    return replace(sweep, frames=tuple(frames))


def _square_radius(camera: CameraModel, u: FloatArray, v: FloatArray) -> FloatArray:
    """Squared distance from the principal point, relative to that of the farthest corner."""
    far = max(camera.cx, camera.width - 1.0 - camera.cx) ** 2
    far += max(camera.cy, camera.height - 1.0 - camera.cy) ** 2
    return np.asarray(((u - camera.cx) ** 2 + (v - camera.cy) ** 2) / far)


def _samples(
    sweep: Sweep, mount: PanTiltMount
) -> tuple[IndexArray, IndexArray, FloatArray, FloatArray]:
    """Direction, frame, squared radius and grey level of each sample."""
    cylinder = sweep_cylinder(sweep, mount)
    azimuth = np.arange(-np.pi, np.pi, _STEP_RAD)
    tangent = cylinder.tangent(np.linspace(0, cylinder.height - 1, _ROWS + 2)[1:-1])
    at = np.stack(np.meshgrid(azimuth, tangent), -1).reshape(-1, 2)
    rays = np.column_stack([np.cos(at[:, 0]), np.sin(at[:, 0]), at[:, 1]])
    samples = []
    for k, frame in enumerate(sweep.frames):
        rotation, _ = mount.camera_pose_base(frame.pan_rad, frame.tilt_rad, frame.roll_rad)
        seen = rays @ rotation
        ahead = np.flatnonzero(seen[:, 2] > 0.3)
        pixels = frame.camera.project(seen[ahead])
        inside = frame.camera.contains(pixels, float(_REDUCTION))
        u, v = pixels[inside].T
        scale = 1 / _REDUCTION
        small = cv2.resize(frame.image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        grey = cv2.cvtColor(small, cv2.COLOR_BGR2GRAY) if small.ndim == 3 else small
        at_small = (np.column_stack([u, v]) + 0.5) / _REDUCTION - 0.5
        column, row = at_small.astype(np.float32).T
        level = cv2.remap(np.float32(grey), column, row, cv2.INTER_LINEAR)
        square, levels = _square_radius(frame.camera, u, v), np.ravel(level).astype(np.float64)
        samples.append((ahead[inside], np.full(len(u), k), square, levels))
    direction, number, square, levels = map(np.concatenate, zip(*samples, strict=True))
    return direction, number, square, levels


def _fit(
    direction: IndexArray,
    frame: IndexArray,
    terms: FloatArray,
    brightness: FloatArray,
    count: int,
) -> tuple[FloatArray, FloatArray] | None:
    """Log gains of `count` frames (mean 0), then coefficients of `terms`; and their covariance."""
    size, directions = count + terms.shape[1], int(direction.max()) + 1
    weight = np.ones(len(brightness))
    for _ in range(_ROUNDS):
        total = np.maximum(np.bincount(direction, weight, directions), 1e-12)
        mean = np.bincount(direction, weight * brightness, directions) / total
        centred = brightness - mean[direction]
        # Sums over the samples of each direction, by which its radiance is eliminated.
        by_direction = np.zeros((directions, size))
        np.add.at(by_direction, (direction, frame), weight)
        for k in range(terms.shape[1]):
            by_direction[:, count + k] = np.bincount(direction, weight * terms[:, k], directions)
        weighted = weight[:, None] * terms
        cross = np.zeros((count, terms.shape[1]))
        np.add.at(cross, frame, weighted)
        full = np.block(
            [[np.diag(np.bincount(frame, weight, count)), cross], [cross.T, terms.T @ weighted]]
        )
        normal = full - by_direction.T @ (by_direction / total[:, None])
        normal[:count, :count] += np.mean(np.diag(normal)[:count])
        # What no overlap determines stays near 0, with a large variance.
        normal += 1e-9 * np.mean(np.diag(normal)) * np.eye(size)
        right = np.concatenate([np.bincount(frame, weight * centred, count), weighted.T @ centred])
        try:
            values = np.linalg.solve(normal, right)
        except np.linalg.LinAlgError:
            return None
        model = values[frame] + terms @ values[count:]
        mean = np.bincount(direction, weight * model, directions) / total
        off = centred - model + mean[direction]
        sigma = max(float(np.median(np.abs(off))) / 0.6745, 1e-4)
        weight = 1.0 / (1.0 + (off / (2.0 * sigma)) ** 2)
    # Errors of neighbouring samples are correlated: one of four counts.
    return values, 4.0 * sigma**2 * np.linalg.inv(normal)
