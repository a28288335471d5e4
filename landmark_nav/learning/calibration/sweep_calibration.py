"""
Self-calibration of camera and mount from the overlaps of a sweep's frames.

Observability:

* focal length and pan scale: both in a full turn, whose links must add up to one; in a part of a
  turn only their product, and the encoder is assumed correct;
* tilt and roll of the camera on its axis, and the first radial distortion: in any overlap;
* the offset of the optical centre from the axis: by the variation of ranges, once these are known,
  and with it that of the principal point, which looks like it at a single range;
* the zero of the joint: not at all, it is equivalent to the heading of the base; nor a tilt of the
  axis itself, which rotates the whole panorama.

A term is used only if it is significant and moves pixels by a relevant amount.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from landmark_nav.errors import LandmarkNavError
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
from landmark_nav.quality import CalibrationTerm, PanoramaQuality
from landmark_nav.types import FloatArray, Sweep

_FOCAL, _DISTORTION, _SCALE, _TILT, _ROLL, _FORWARD, _LEFT, _PRINCIPAL = range(len(COMMON))

# Fewest matches per link of the chain.
_LEAST_PER_LINK = 8

# Correlation above which two terms may replace each other.
_ALIKE = 0.3

# Usual and greatest range of walls in a room; parallax is negligible beyond it.
_USUAL_RANGE_M, FAR_M = 3.0, 50.0

# Least significance of a term, in sigmas.
SIGNIFICANT = 4.0

# Least effect of a term in the panorama, pixels.
_WORTH_PX = 0.3

# Sigmas of pan, tilt and roll of a single frame: of a pan-tilt unit, by encoder steps and
# elasticity, and of rough angles; rounds in which these are aligned, and matches that this needs.
_UNIT_SIGMA_RAD, _ROUGH_SIGMA_RAD = (5e-4, 2e-4, 2e-4), (0.03, 0.01, 0.01)
_ROUNDS, _LEAST_PER_FRAME = 2, 6


@dataclass(frozen=True, eq=False)
class SweepCalibration:
    """
    A sweep and its mount, corrected by `common` (8,) in the order of `COMMON`.

    `whole` is the fit of all terms, used in the panorama or not.
    """

    sweep: Sweep
    mount: PanTiltMount
    common: FloatArray
    quality: PanoramaQuality
    whole: Fit | None = None


def calibrate_sweep(
    sweep: Sweep,
    mount: PanTiltMount,
    range_m: RangeOfRay | None = None,
    found: SweepCalibration | None = None,
) -> SweepCalibration:
    """
    Calibrate camera and mount from a sweep of a pan-tilt unit.

    Parameters
    ----------
    mount : PanTiltMount
        Extrinsics of ``robot.yaml``.
    range_m : callable, optional
        Horizontal range from the axis at azimuths and tangents (n,). With it the offset of the
        optical centre is calibrated; without it a usual range is assumed.
    found : SweepCalibration, optional
        A former calibration, with which the overlaps are tracked: patches that are scaled or
        sheared against each other are tracked with a bias.

    Returns
    -------
    SweepCalibration
        The unchanged sweep if frames share too little.
    """
    seen = (found.sweep, found.mount) if found else (sweep, mount)
    overlaps = track_overlaps(*seen) if len(sweep.frames) > 2 else Overlaps.none()
    links = len(np.unique(overlaps.pair))
    if not links or len(overlaps) < _LEAST_PER_LINK * links or not _one_camera(sweep):
        return SweepCalibration(sweep, mount, np.zeros(len(COMMON)), PanoramaQuality())
    camera = sweep.frames[0].camera
    given = range_m is not None
    problem = OverlapProblem(overlaps, sweep, mount, range_m or _usual_range, objects=given)
    free = [_FOCAL, _TILT, _ROLL]
    if overlaps.closed:
        free.append(_SCALE)
    if camera.model != 'equidistant':
        free.append(_DISTORTION)
    if range_m is not None:
        free += [_FORWARD, _LEFT, _PRINCIPAL]
    whole, fit, terms = fit_significant(problem, free, _UNIT_SIGMA_RAD, camera)
    quality = _quality(problem, overlaps, fit, problem.misfit_px(fit.common), terms)
    used = corrected(sweep, mount, fit.common)
    return SweepCalibration(*used, fit.common, quality, whole)


def align_sweep(sweep: Sweep, mount: PanTiltMount) -> SweepCalibration:
    """
    Correct pan, tilt and roll of each frame, and the common camera, of images at rough angles.

    The given focal length is the median over the frames; the one of `quality` is that of the lens
    without distortion that gives the same rotations.

    Raises `LandmarkNavError`: fewer than three frames, or too little texture in the overlaps.
    """
    if len(sweep.frames) < 3:
        raise LandmarkNavError(f'{len(sweep.frames)} frames are too few to align: take a sweep')
    fx, fy = np.median([(f.camera.fx, f.camera.fy) for f in sweep.frames], axis=0).tolist()
    camera = replace(sweep.frames[0].camera, fx=fx, fy=fy)
    given = aligned = replace(
        sweep, frames=tuple(replace(frame, camera=camera) for frame in sweep.frames)
    )
    free = [_FOCAL] if camera.model == 'equidistant' else [_FOCAL, _DISTORTION]
    for _ in range(_ROUNDS):
        overlaps = track_overlaps(aligned, mount, every_frame=True)
        if len(overlaps) < _LEAST_PER_FRAME * len(sweep.frames):
            raise LandmarkNavError(
                f'{len(overlaps)} matches between neighbouring frames are too few to '
                'align them: they need to overlap and to show texture'
            )
        problem = OverlapProblem(overlaps, given, mount)
        _, fit, terms = fit_significant(problem, free, _ROUGH_SIGMA_RAD, camera)
        aligned, _ = corrected(given, mount, fit.common, fit.frames)
    residual_px = problem.misfit_px(fit.common, fit.frames)
    quality = _quality(problem, overlaps, fit, residual_px, terms)
    return SweepCalibration(aligned, mount, fit.common, quality)


def _quality(
    problem: OverlapProblem,
    overlaps: Overlaps,
    fit: Fit,
    residual_px: float,
    terms: tuple[CalibrationTerm, ...],
) -> PanoramaQuality:
    return PanoramaQuality(
        closure_rad=problem.closure_rad(fit),
        gaps_rad=overlaps.gaps_rad,
        residual_px=residual_px,
        before_px=problem.misfit_px(np.zeros(len(COMMON))),
        calibration=terms,
    )


def moved_px(one: SweepCalibration, other: SweepCalibration) -> float:
    """Greatest difference of two calibrations of a sweep in its panorama, pixels."""
    shift = _shift_px(one.sweep.frames[0].camera)
    return float(np.max(shift * np.abs(one.common - other.common)))


def fit_significant(
    problem: OverlapProblem, free: Sequence[int], frame_sigma: Sequence[float], camera: CameraModel
) -> tuple[Fit, Fit, tuple[CalibrationTerm, ...]]:
    """
    Fit all terms; then remove the least significant terms until all that remain are significant.

    Parameters
    ----------
    free : sequence of int
        Initial terms, indices in `COMMON`.
    frame_sigma : sequence of float, shape (3,)
        Sigmas of pan, tilt and roll of a single frame, rad.

    Returns
    -------
    whole, fit : Fit
        With all terms, and with those that remain.
    terms : tuple of CalibrationTerm
        Each by the last fit in which it was free.
    """
    free = sorted(free)
    shift_px = _shift_px(camera)
    found: dict[int, tuple[float, float]] = {}
    whole = fit = problem.fit(free, frame_sigma)
    while True:
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
        # Of correlated terms only one is removed at a time, as one may replace the other.
        scale = np.sqrt(np.diag(fit.covariance))
        gone: list[int] = []
        for k in weak:
            alike = [abs(fit.covariance[k, j]) / (scale[k] * scale[j]) for j in gone]
            if max(alike, default=0.0) < _ALIKE:
                gone.append(k)
        free = [k for k in free if k not in gone]
        fit = problem.fit(free, frame_sigma)
    if _FOCAL in free and _DISTORTION in free:
        found[_FOCAL] = _effective_focal(fit)
    terms = tuple(CalibrationTerm(COMMON[k], *found[k], k in free) for k in sorted(found))
    return whole, fit, terms


def _usual_range(azimuth: FloatArray, tangent: FloatArray) -> FloatArray:
    return np.full(np.broadcast_shapes(azimuth.shape, tangent.shape), _USUAL_RANGE_M)


def _one_camera(sweep: Sweep) -> bool:
    return len({frame.camera for frame in sweep.frames}) == 1


def _shift_px(camera: CameraModel) -> FloatArray:
    """Greatest shift in the panorama by a unit of each term (8,), pixels."""
    half, near = np.tan(camera.half_fov_rad), 2.0
    lens, angles, offset = (half, half**3), (np.pi, 1.0, half), (half / near, 1.0 / near)
    return camera.fx * np.array([*lens, *angles, *offset, half**2])


def _effective_focal(fit: Fit) -> tuple[float, float]:
    """
    Relative correction of the focal length of an equivalent lens without distortion.

    It is the combination of focal length and distortion that does not depend on the uncertainty of
    the distortion: to first order the result of a fit without distortion.
    """
    both = fit.covariance[_FOCAL, _DISTORTION]
    lever = both / fit.covariance[_DISTORTION, _DISTORTION]
    value = fit.common[_FOCAL] - lever * fit.common[_DISTORTION]
    bias = fit.sigma[_FOCAL] ** 2 - fit.covariance[_FOCAL, _FOCAL]
    variance = fit.covariance[_FOCAL, _FOCAL] - lever * both + bias
    return float(np.expm1(value)), float(np.sqrt(variance))
