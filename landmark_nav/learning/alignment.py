"""
Alignment of a sweep's frames from what neighbours both show: pan, tilt and roll of each, focal
length and radial distortion of all.

A turning camera sees pure rotations, so that matches between neighbours, with the last and the
first frame closing the turn, fix both (Szeliski and Shum, SIGGRAPH 1997).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.learning.projection import frame_slab, sweep_cylinder
from landmark_nav.parameters import check_parameters, parameter
from landmark_nav.types import CameraFrame, FloatArray, ImageArray, Sweep

__all__ = ['AlignmentConfig', 'SweepAlignment', 'align_sweep']

_POINTS_PER_PAIR = 80
_ROUNDS = 2
# What a tracked point is worth.
_TRACK_SIGMA_PX = 0.5


@dataclass(frozen=True)
class AlignmentConfig:
    """How far the joint angles and the focal length may be off."""

    pan_sigma_rad: float = parameter(
        0.01, 'standard deviation of the given pan angles', minimum=1e-6, maximum=1
    )
    tilt_sigma_rad: float = parameter(
        0.01, 'standard deviation of tilt and roll', minimum=1e-6, maximum=1
    )
    focal_sigma: float = parameter(
        0.02, 'standard deviation of the focal length, relative', minimum=1e-6, maximum=1
    )

    distortion_sigma: float = parameter(
        0.05, 'standard deviation of the first radial distortion', minimum=1e-9, maximum=1
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_parameters(self)


@dataclass(frozen=True, eq=False)
class SweepAlignment:
    """
    A sweep with mended angles.

    `focal_scale` is what its focal length was multiplied by; `residual_px` the median distance
    of matches afterwards, `before_px` before.
    """

    sweep: Sweep
    focal_scale: float
    before_px: float
    residual_px: float


def align_sweep(sweep: Sweep, mount: PanTiltMount, config: AlignmentConfig) -> SweepAlignment:
    """
    Mend pan, tilt and roll of each frame and the common focal length.

    Parameters
    ----------
    sweep : Sweep
        Frames that overlap their neighbours.
    mount : PanTiltMount
        Where the camera turns.
    config : AlignmentConfig
        Prior standard deviations.

    Returns
    -------
    SweepAlignment

    Raises
    ------
    LandmarkNavError
        Fewer than three frames, or no texture that neighbours share.

    """
    if len(sweep.frames) < 3:
        raise LandmarkNavError(f'{len(sweep.frames)} frames are too few to align: take a sweep')
    scale, befores = 1.0, []
    for _ in range(_ROUNDS):
        matches = _matches(sweep, mount)
        if len(matches.pixels) < 6 * len(sweep.frames):
            raise LandmarkNavError(
                f'{len(matches.pixels)} matches between neighbouring frames are too few to '
                'align them: they need to overlap and to show texture'
            )
        unknowns, before, after = _solve(matches, sweep, mount, config)
        befores.append(before)
        sweep, scale = _mended(sweep, unknowns), scale * float(np.exp(unknowns[-2]))
    return SweepAlignment(sweep, scale, befores[0], after)


@dataclass(frozen=True, eq=False)
class _Matches:
    """Pairs of frames (m, 2) and the pixels (m, 2, 2) of one point in both."""

    frames: npt.NDArray[np.intp]
    pixels: FloatArray


def _matches(sweep: Sweep, mount: PanTiltMount) -> _Matches:
    """Track points between the cylinder images of neighbours, where both look alike."""
    cylinder = sweep_cylinder(sweep, mount)
    order = np.argsort([np.mod(frame.pan_rad, 2.0 * np.pi) for frame in sweep.frames])
    slabs = [frame_slab(sweep.frames[k], mount, cylinder) for k in order]
    frames, pixels = [], []
    for n, first in enumerate(slabs):
        second = slabs[(n + 1) % len(slabs)]
        # Columns of the second frame, counted in the first's.
        shift = (second.start - first.start + cylinder.width // 2) % cylinder.width
        shift -= cylinder.width // 2
        low, high = max(0, shift), min(first.width, shift + second.width)
        if high - low < 24:
            continue
        one, other = (
            np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
            for image in (first.image[:, low:high], second.image[:, low - shift : high - shift])
        )
        both = first.inside[:, low:high] & second.inside[:, low - shift : high - shift]
        mask = cv2.erode(both, np.ones((15, 15), np.uint8))
        here = cv2.goodFeaturesToTrack(one, _POINTS_PER_PAIR, 0.01, 8, mask=mask)
        if here is None:
            continue
        there, good = _track(one, other, np.asarray(here, dtype=np.float32))
        offset = np.array([first.start + low, 0.0])
        pair = np.stack([here[good, 0] + offset, there[good, 0] + offset], 1)
        a, b = sweep.frames[order[n]], sweep.frames[order[(n + 1) % len(slabs)]]
        pixels.append(
            np.stack(
                [
                    _to_frame(cylinder.rays(pair[:, side]), f, mount)
                    for side, f in ((0, a), (1, b))
                ],
                1,
            )
        )
        frames.append(np.tile([order[n], order[(n + 1) % len(slabs)]], (int(good.sum()), 1)))
    if not pixels:
        return _Matches(np.zeros((0, 2), dtype=np.intp), np.zeros((0, 2, 2)))
    return _Matches(np.concatenate(frames).astype(np.intp), np.concatenate(pixels))


def _track(
    one: ImageArray, other: ImageArray, here: npt.NDArray[np.float32]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Follow points (n, 1, 2) there and back; which came back to where they were."""
    tracked, found, _ = cv2.calcOpticalFlowPyrLK(one, other, here, here.copy())
    there = np.asarray(tracked, dtype=np.float32)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(other, one, there, here.copy())
    away = np.linalg.norm(np.asarray(back) - here, axis=2)[:, 0]
    return there, (np.ravel(found) == 1) & (np.ravel(returned) == 1) & (away < 0.3)


def _to_frame(rays: FloatArray, frame: CameraFrame, mount: PanTiltMount) -> FloatArray:
    """Normalised image coordinates (n, 2) of rays (n, 3) of the base frame."""
    seen = rays @ _rotation(frame, mount)
    return np.asarray(seen[:, :2] / seen[:, 2:])


class _Misfit:
    """Distances between the two rays of each match, and their derivatives."""

    def __init__(self, matches: _Matches, sweep: Sweep, mount: PanTiltMount) -> None:
        self._frames = matches.frames
        rotations = np.array([_rotation(frame, mount) for frame in sweep.frames])
        self._rotations = rotations[matches.frames]
        ones = np.ones((len(matches.pixels), 2, 1))
        self._rays = np.concatenate([matches.pixels, ones], 2)
        self._focal = sweep.frames[0].camera.fx
        self._count = len(sweep.frames)

    def __call__(self, unknowns: FloatArray) -> FloatArray:
        """Azimuth and tangent differences, pixels (m, 2)."""
        turn = unknowns[:-2].reshape(self._count, 3)[self._frames]
        return self._difference(turn, unknowns[-2:])

    def jacobian(self, unknowns: FloatArray) -> FloatArray:
        """Derivative (2m, unknowns): each match touches its own two frames and the lens."""
        turn = unknowns[:-2].reshape(self._count, 3)[self._frames]
        lens = unknowns[-2:]
        here = self._difference(turn, lens)
        out = np.zeros((len(self._rays), 2, len(unknowns)))
        row, step = np.arange(len(self._rays)), 1e-6
        for side in (0, 1):
            for axis in range(3):
                moved = turn.copy()
                moved[:, side, axis] += step
                slope = (self._difference(moved, lens) - here) / step
                out[row, :, 3 * self._frames[:, side] + axis] += slope
        for k in (0, 1):
            moved = lens.copy()
            moved[k] += step
            out[:, :, k - 2] = (self._difference(turn, moved) - here) / step
        return out.reshape(-1, len(unknowns))

    def _difference(self, turn: FloatArray, lens: FloatArray) -> FloatArray:
        rays = self._rays.copy()
        radius_sq = np.sum(rays[..., :2] ** 2, -1, keepdims=True)
        rays[..., :2] *= np.exp(-lens[0]) * (1.0 - lens[1] * radius_sq)
        # Small turns in the optical frame: tilt about x, pan about -y, roll about z.
        rays = rays + np.cross(turn[..., [1, 0, 2]] * [1.0, -1.0, 1.0], rays)
        base = np.einsum('mkij,mkj->mki', self._rotations, rays)
        azimuth = np.arctan2(base[..., 1], base[..., 0])
        tangent = base[..., 2] / np.hypot(base[..., 0], base[..., 1])
        turned = wrap_rad(azimuth[:, 0] - azimuth[:, 1])
        return self._focal * np.stack([turned, tangent[:, 0] - tangent[:, 1]], 1)


def _solve(
    matches: _Matches, sweep: Sweep, mount: PanTiltMount, config: AlignmentConfig
) -> tuple[FloatArray, float, float]:
    """Corrections (3n + 2,): pan, tilt, roll of each frame, log focal, k1; median misfits."""
    sigma = [config.pan_sigma_rad, config.tilt_sigma_rad, config.tilt_sigma_rad]
    prior = np.array([*sigma * len(sweep.frames), config.focal_sigma, config.distortion_sigma])
    misfit = _Misfit(matches, sweep, mount)

    def residuals(unknowns: FloatArray) -> FloatArray:
        return np.concatenate([misfit(unknowns).ravel() / _TRACK_SIGMA_PX, unknowns / prior])

    def jacobian(unknowns: FloatArray) -> FloatArray:
        return np.concatenate([misfit.jacobian(unknowns) / _TRACK_SIGMA_PX, np.diag(1.0 / prior)])

    start = np.zeros(len(prior))
    fit = least_squares(residuals, start, jac=jacobian, loss='soft_l1', x_scale=prior)
    before, after = (
        float(np.median(np.linalg.norm(misfit(unknowns), axis=1))) for unknowns in (start, fit.x)
    )
    return fit.x, before, after


def _rotation(frame: CameraFrame, mount: PanTiltMount) -> FloatArray:
    return mount.camera_pose_base(frame.pan_rad, frame.tilt_rad, frame.roll_rad)[0]


def _mended(sweep: Sweep, unknowns: FloatArray) -> Sweep:
    scale = float(np.exp(unknowns[-2]))
    turns = unknowns[:-2].reshape(-1, 3)
    return replace(
        sweep,
        frames=tuple(
            replace(
                frame,
                camera=_mended_camera(frame.camera, scale, float(unknowns[-1])),
                pan_rad=frame.pan_rad + float(pan),
                tilt_rad=frame.tilt_rad + float(tilt),
                roll_rad=frame.roll_rad + float(roll),
            )
            for frame, (pan, tilt, roll) in zip(sweep.frames, turns, strict=True)
        ),
    )


def _mended_camera(camera: CameraModel, scale: float, k1: float) -> CameraModel:
    distortion = (*camera.distortion, 0.0, 0.0)
    return replace(
        camera,
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        distortion=(distortion[0] + k1, *distortion[1 : max(1, len(camera.distortion))]),
    )
