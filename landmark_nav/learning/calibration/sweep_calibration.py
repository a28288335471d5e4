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

The corrections are the posterior of the prior calibration and the overlaps, if these contradict
the values of the prior: otherwise a calibrated camera would get the noise of tracking.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from landmark_nav.calibration import Calibration
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.learning.calibration.combined import as_calibrated, as_corrected, posterior_terms
from landmark_nav.learning.calibration.overlap_fit import (
    COMMON,
    corrected,
    Fit,
    OverlapProblem,
    Overlaps,
    RangeOfRay,
    track_overlaps,
)
from landmark_nav.learning.least_squares import solve_positive
from landmark_nav.quality import CalibrationTerm, PanoramaQuality
from landmark_nav.types import FloatArray, Sweep

_FOCAL, _DISTORTION, _SCALE, _TILT, _ROLL, _FORWARD, _LEFT, _PRINCIPAL = range(len(COMMON))

# Fewest matches per link of the chain.
_LEAST_PER_LINK = 8

# Probability of a misfit by chance with which a camera is as given.
_CHANCE = 1e-3

# Usual and greatest range of walls in a room; parallax is negligible beyond it.
_USUAL_RANGE_M, FAR_M = 3.0, 50.0

# Sigmas of pan, tilt and roll of a single frame: of a pan-tilt unit, by encoder steps and
# elasticity, and of rough angles; rounds in which these are aligned, and matches that this needs.
_UNIT_SIGMA_RAD, _ROUGH_SIGMA_RAD = (5e-4, 2e-4, 2e-4), (0.03, 0.01, 0.01)
_ROUNDS, _LEAST_PER_FRAME = 2, 6


@dataclass(frozen=True, eq=False)
class SweepCalibration:
    """
    A sweep as calibrated: with corrections `common` (8,) of the prior in the order of `COMMON`.

    `calibration` has the corrected values, and the covariance of the prior; `fit` is that of the
    overlaps alone.
    """

    sweep: Sweep
    calibration: Calibration
    common: FloatArray
    quality: PanoramaQuality
    fit: Fit | None = None

    @property
    def mount(self) -> PanTiltMount:
        """Corrected extrinsics."""
        return self.calibration.mount


def calibrate_sweep(
    sweep: Sweep,
    prior: Calibration,
    range_m: RangeOfRay | None = None,
    found: SweepCalibration | None = None,
) -> SweepCalibration:
    """
    Calibrate camera and mount from a sweep of a pan-tilt unit.

    Parameters
    ----------
    sweep : Sweep
        Sweep with camera and joints as given.
    range_m : callable, optional
        Horizontal range from the axis at azimuths and tangents (n,). With it the offset of the
        optical centre is calibrated; without it a usual range is assumed.
    found : SweepCalibration, optional
        A former calibration, with which the overlaps are tracked: patches that are scaled or
        sheared against each other are tracked with a bias.

    Returns
    -------
    SweepCalibration
        By the prior alone if frames share too little.

    Raises `LandmarkNavError`: a term contradicts an exact value.
    """
    given, mount = as_calibrated(sweep, prior), prior.mount
    seen = (found.sweep, found.mount) if found else (given, mount)
    overlaps = track_overlaps(*seen) if len(sweep.frames) > 2 else Overlaps.none()
    links, cameras = len(np.unique(overlaps.pair)), {frame.camera for frame in sweep.frames}
    if not links or len(overlaps) < _LEAST_PER_LINK * links or len(cameras) > 1:
        return SweepCalibration(given, prior, np.zeros(len(COMMON)), PanoramaQuality())
    problem = OverlapProblem(
        overlaps, given, mount, range_m or _usual_range, guessed=range_m is None
    )
    free = [_FOCAL, _TILT, _ROLL]
    if overlaps.closed:
        free.append(_SCALE)
    if given.frames[0].camera.model != 'equidistant':
        free.append(_DISTORTION)
    if range_m is not None:
        free += [_FORWARD, _LEFT, _PRINCIPAL]
    fit = problem.fit(sorted(free), _UNIT_SIGMA_RAD)
    common, covariance = posterior_terms(prior, fit)
    used = replace(fit, common=common) if _differs(fit) else problem.fit([], _UNIT_SIGMA_RAD)
    quality = _quality(problem, overlaps, used, _terms(used.common, covariance))
    made = as_corrected(prior, used.common)
    return SweepCalibration(as_calibrated(sweep, made), made, used.common, quality, fit)


def align_sweep(sweep: Sweep, mount: PanTiltMount) -> tuple[Sweep, PanoramaQuality]:
    """
    Correct pan, tilt and roll of each frame, and the common camera, of images at rough angles.

    Their prior is not used. The given focal length is the median over the frames; the one of
    `quality` is that of the lens without distortion that gives the same rotations.

    Raises `LandmarkNavError`: fewer than three frames, or too little texture in the overlaps.
    """
    if len(sweep.frames) < 3:
        raise LandmarkNavError(f'{len(sweep.frames)} frames are too few to align: take a sweep')
    fx, fy = np.median([(f.camera.fx, f.camera.fy) for f in sweep.frames], axis=0).tolist()
    camera = replace(sweep.frames[0].camera, fx=fx, fy=fy)
    frames = tuple(replace(frame, camera=camera) for frame in sweep.frames)
    given = aligned = replace(sweep, frames=frames)
    free = [_FOCAL] if camera.model == 'equidistant' else [_FOCAL, _DISTORTION]
    for _ in range(_ROUNDS):
        overlaps = track_overlaps(aligned, mount, every_frame=True)
        if len(overlaps) < _LEAST_PER_FRAME * len(sweep.frames):
            raise LandmarkNavError(
                f'{len(overlaps)} matches between neighbouring frames are too few to '
                'align them: they need to overlap and to show texture'
            )
        problem = OverlapProblem(overlaps, given, mount)
        fit = problem.fit(free, _ROUGH_SIGMA_RAD)
        aligned = corrected(given, fit)
    residual_px = problem.misfit_px(fit.common, fit.frames)
    quality = _quality(problem, overlaps, fit, _terms(fit.common, fit.covariance))
    return aligned, replace(quality, residual_px=residual_px)


def _differs(fit: Fit) -> bool:
    """Whether the overlaps contradict the values before (chi-square of all terms together)."""
    free = np.diag(fit.covariance) > 0.0
    terms = fit.common[free]
    misfit = float(terms @ solve_positive(fit.covariance[np.ix_(free, free)], terms))
    return misfit > float(chdtri(len(terms), _CHANCE))


def _terms(common: FloatArray, covariance: FloatArray) -> tuple[CalibrationTerm, ...]:
    """Free terms with their sigmas."""
    values, sigmas = common.tolist(), np.sqrt(np.diag(covariance)).tolist()
    terms = [CalibrationTerm(*term) for term in zip(COMMON, values, sigmas, strict=True)]
    if sigmas[_DISTORTION]:
        focal = _effective_focal(common, covariance)
        terms[_FOCAL] = CalibrationTerm('focal_length', *focal)
    return tuple(term for term in terms if term.sigma)


def _quality(
    problem: OverlapProblem, overlaps: Overlaps, fit: Fit, terms: tuple[CalibrationTerm, ...]
) -> PanoramaQuality:
    return PanoramaQuality(
        closure_rad=problem.closure_rad(fit),
        gaps_rad=overlaps.gaps_rad,
        residual_px=problem.misfit_px(fit.common),
        before_px=problem.misfit_px(np.zeros(len(COMMON))),
        calibration=terms,
    )


def moved_px(one: SweepCalibration, other: SweepCalibration) -> float:
    """Greatest difference of two calibrations of a sweep in its panorama, pixels."""
    camera = one.sweep.frames[0].camera
    half, near = np.tan(camera.half_fov_rad), 2.0
    # Greatest shift by a unit of each term.
    lens, angles, offset = (half, half**3), (np.pi, 1.0, half), (half / near, 1.0 / near)
    shift = camera.fx * np.array([*lens, *angles, *offset, half**2])
    return float(np.max(shift * np.abs(one.common - other.common)))


def _usual_range(azimuth: FloatArray, tangent: FloatArray) -> FloatArray:
    return np.full(np.broadcast_shapes(azimuth.shape, tangent.shape), _USUAL_RANGE_M)


def _effective_focal(common: FloatArray, covariance: FloatArray) -> tuple[float, float]:
    """Relative correction of the focal length of an equivalent lens without distortion; sigma."""
    # The combination of focal length and distortion that does not depend on the uncertainty of
    # the distortion: to first order the result of a fit without distortion.
    both = covariance[_FOCAL, _DISTORTION]
    lever = both / covariance[_DISTORTION, _DISTORTION]
    value = common[_FOCAL] - lever * common[_DISTORTION]
    variance = covariance[_FOCAL, _FOCAL] - lever * both
    return float(np.expm1(value)), float(np.sqrt(variance))
