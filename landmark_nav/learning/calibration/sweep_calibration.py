"""
Self-calibration out of a sweep: what the overlaps of its frames say of camera and mount.

What can be seen in what:

* focal length and pan scale: both in a full turn, whose links must add up to one; in a part of a
  turn they are one number, and the encoder is taken as right;
* tilt and roll of the camera to its axis, and the first radial distortion: in any overlap;
* the optical centre's offset from the axis: once ranges are known, by their variation;
* the joint's zero: not at all, it is the heading of the base by another name; nor a tilt of the
  axis itself, which turns the whole panorama.

A term is used only if it is significant and moves something by a part of a pixel worth naming.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.learning.calibration.overlap_fit import (
    COMMON,
    corrected,
    Fit,
    OverlapProblem,
    Overlaps,
    RangeOfRay,
    track_overlaps,
)
from landmark_nav.parameters import Config
from landmark_nav.quality import CalibrationTerm, PanoramaQuality
from landmark_nav.types import FloatArray, Sweep

_FOCAL, _DISTORTION, _SCALE, _TILT, _ROLL, _FORWARD, _LEFT = range(len(COMMON))

# Fewer matches than this for each link of the chain say nothing.
_LEAST_PER_LINK = 8

# Correlation from which on two terms look alike.
_ALIKE = 0.3

# Walls of rooms are about so far away.
USUAL_RANGE_M = 3.0

# Standard deviations from which on a term is used.
SIGNIFICANT = 4.0

# A term that moves nothing by more pixels than this is not used.
_WORTH_PX = 0.3

# Angles of a single frame of a pan-tilt unit stray so far: encoder steps, a springy head.
_UNIT_SIGMA_RAD = (5e-4, 2e-4, 2e-4)


@dataclass(frozen=True)
class CalibrationConfig(Config):
    """How camera and mount are calibrated out of a sweep."""

    # Whether what is found is used.
    enabled: bool = True


@dataclass(frozen=True, eq=False)
class SweepCalibration:
    """
    A sweep and its mount, corrected by `common` (7,) in the order of `COMMON`, and what was found.

    `overlaps` can be calibrated from again.
    """

    sweep: Sweep
    mount: PanTiltMount
    common: FloatArray
    quality: PanoramaQuality
    overlaps: Overlaps


def calibrate_sweep(
    sweep: Sweep,
    mount: PanTiltMount,
    config: CalibrationConfig,
    range_m: RangeOfRay | None = None,
    overlaps: Overlaps | None = None,
) -> SweepCalibration:
    """
    Calibrate camera and mount out of a sweep of a pan-tilt unit.

    Parameters
    ----------
    mount : PanTiltMount
        As ``robot.yaml`` has it.
    config : CalibrationConfig
        Whether to use what is found.
    range_m : callable, optional
        Horizontal distance from the axis of what is seen at azimuths and tangents (n,). With it
        the optical centre's offset is calibrated; without, everything is taken to be as far as
        walls usually are.
    overlaps : Overlaps, optional
        If they were tracked before.

    Returns
    -------
    SweepCalibration
        The sweep unchanged where too little is seen in two frames.
    """
    if overlaps is None:
        overlaps = track_overlaps(sweep, mount) if len(sweep.frames) > 2 else Overlaps.none()
    links = len(np.unique(overlaps.pair))
    if not links or len(overlaps) < _LEAST_PER_LINK * links or not _one_camera(sweep):
        nothing = np.zeros(len(COMMON)), PanoramaQuality(), Overlaps.none()
        return SweepCalibration(sweep, mount, *nothing)
    camera = sweep.frames[0].camera
    problem = OverlapProblem(overlaps, sweep, mount, range_m or _usual_range)
    free = [_FOCAL, _TILT, _ROLL]
    if overlaps.closed:
        free.append(_SCALE)
    if camera.model != 'equidistant':
        free.append(_DISTORTION)
    if range_m is not None:
        free += [_FORWARD, _LEFT]
    fit, terms = fit_significant(problem, free, _UNIT_SIGMA_RAD, camera)
    common = fit.common
    if not config.enabled:
        common = np.zeros(len(COMMON))
        terms = tuple(replace(term, used=False) for term in terms)
    return SweepCalibration(
        *corrected(sweep, mount, common),
        common,
        PanoramaQuality(
            closure_rad=problem.closure_rad(common, fit.frames, fit.weight),
            gaps_rad=overlaps.gaps_rad,
            residual_px=problem.misfit_px(common),
            before_px=problem.misfit_px(np.zeros(len(COMMON))),
            calibration=terms,
        ),
        overlaps,
    )


def moved_px(one: SweepCalibration, other: SweepCalibration) -> float:
    """By how many pixels two calibrations of a sweep disagree somewhere in its panorama."""
    shift = _shift_px(one.sweep.frames[0].camera)
    return float(np.max(shift * np.abs(one.common - other.common)))


def fit_significant(
    problem: OverlapProblem,
    free: Sequence[int],
    frame_sigma: Sequence[float],
    camera: CameraModel,
) -> tuple[Fit, tuple[CalibrationTerm, ...]]:
    """
    Fit, and leave out the least significant term until all that are left are significant.

    Parameters
    ----------
    free : sequence of int
        Terms to begin with, of `COMMON`.
    frame_sigma : sequence of float, shape (3,)
        How far pan, tilt and roll of a single frame stray, radians.
    """
    free = sorted(free)
    shift_px = _shift_px(camera)
    found: dict[int, tuple[float, float]] = {}
    while True:
        fit = problem.fit(free, frame_sigma)
        found |= {k: (float(fit.common[k]), float(fit.sigma[k])) for k in free}
        worth = {
            k: min(
                abs(fit.common[k]) / fit.sigma[k] / SIGNIFICANT,
                abs(fit.common[k]) * shift_px[k] / _WORTH_PX,
            )
            for k in free
        }
        weak = [k for k in sorted(free, key=lambda k: worth[k]) if worth[k] <= 1.0]
        if not weak:
            break
        # Terms that look alike may cover for each other: only one of them goes at a time.
        scale = np.sqrt(np.diag(fit.covariance))
        gone: list[int] = []
        for k in weak:
            alike = [abs(fit.covariance[k, j]) / (scale[k] * scale[j]) for j in gone]
            if max(alike, default=0.0) < _ALIKE:
                gone.append(k)
        free = [k for k in free if k not in gone]
    if _FOCAL in free and _DISTORTION in free:
        found[_FOCAL] = _effective_focal(fit)
    return fit, tuple(CalibrationTerm(COMMON[k], *found[k], k in free) for k in sorted(found))


def _usual_range(azimuth: FloatArray, tangent: FloatArray) -> FloatArray:
    return np.full(np.broadcast_shapes(azimuth.shape, tangent.shape), USUAL_RANGE_M)


def _one_camera(sweep: Sweep) -> bool:
    return len({frame.camera for frame in sweep.frames}) == 1


def _shift_px(camera: CameraModel) -> FloatArray:
    """By how many pixels a unit of each term moves something in the panorama (7,)."""
    half, near = np.tan(camera.half_fov_rad), 2.0
    return camera.fx * np.array([half, half**3, np.pi, 1.0, half, half / near, 1.0 / near])


def _effective_focal(fit: Fit) -> tuple[float, float]:
    """
    Relative correction of the focal length of the lens without distortion that turns alike.

    That is the combination of focal length and distortion that does not depend on how well the
    distortion is known: what a fit without distortion finds, to first order.
    """
    both = fit.covariance[_FOCAL, _DISTORTION]
    lever = both / fit.covariance[_DISTORTION, _DISTORTION]
    value = fit.common[_FOCAL] - lever * fit.common[_DISTORTION]
    bias = fit.sigma[_FOCAL] ** 2 - fit.covariance[_FOCAL, _FOCAL]
    variance = fit.covariance[_FOCAL, _FOCAL] - lever * both + bias
    return float(np.expm1(value)), float(np.sqrt(variance))
