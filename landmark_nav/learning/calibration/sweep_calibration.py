"""
Self-calibration of camera and mount from the overlaps of a sweep's frames, and from papers.

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
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.se2 import rotation_rpy
from landmark_nav.learning.calibration.overlap_fit import (
    as_calibrated,
    COMMON,
    CORRECTED,
    corrected,
    Fit,
    OverlapProblem,
    Overlaps,
    RangeOfRay,
    track_overlaps,
)
from landmark_nav.learning.least_squares import covariance_of, solve_positive
from landmark_nav.quality import CalibrationTerm, PanoramaQuality, SIGNIFICANT
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
# The two parts of the camera's height; images show their sum.
HEIGHT = ('axis_z', 'center_z')
_AXIS_TILT = ('axis_roll', 'axis_pitch')
# Smaller information is rounding: relative to the largest; of a tilt, 1 / rad^2.
_ROUNDING, _LEAST_INFORMATION = 1e-9, 1e-3


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
    Calibrate camera and mount from a sweep; by the prior alone if frames share too little.

    Raises `LandmarkNavError`: with ranges, a term contradicts an exact value.

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
    """
    given = as_calibrated(sweep, prior)
    seen = (found.sweep, found.mount) if found else (given, prior.mount)
    overlaps = track_overlaps(*seen) if len(sweep.frames) > 2 else Overlaps.none()
    links, cameras = len(np.unique(overlaps.pair)), {frame.camera for frame in sweep.frames}
    if not links or len(overlaps) < _LEAST_PER_LINK * links or len(cameras) > 1:
        return SweepCalibration(given, prior, np.zeros(len(COMMON)), PanoramaQuality())
    reach_m = range_m or usual_range
    problem = OverlapProblem(overlaps, sweep, prior, reach_m, guessed=range_m is None)
    free = [_FOCAL, _TILT, _ROLL]
    if overlaps.closed:
        free.append(_SCALE)
    if sweep.frames[0].camera.model != 'equidistant':
        free.append(_DISTORTION)
    if range_m is not None:
        free += [_FORWARD, _LEFT, _PRINCIPAL]
    fit = problem.fit(sorted(free), _UNIT_SIGMA_RAD)
    # Exact values are judged once ranges are known: before, the parallax of a wrong offset of the
    # optical centre looks like another focal length.
    judged = prior.sigmas[CORRECTED] > 0.0 if range_m is None else np.ones(len(COMMON), np.bool_)
    fit = replace(fit, covariance=fit.covariance * np.outer(judged, judged))
    after, shown = with_overlaps(prior, prior, fit), np.diag(fit.covariance) > 0.0
    common = np.where(shown, (after.values - prior.values)[CORRECTED], 0.0)
    covariance = after.covariance[np.ix_(CORRECTED, CORRECTED)] * np.outer(shown, shown)
    # Whether the overlaps contradict the values before: chi-square of all terms together.
    misfit = 0.0
    if shown.any():
        known = fit.covariance[np.ix_(shown, shown)]
        misfit = float(fit.common[shown] @ solve_positive(known, fit.common[shown]))
    differs = misfit > chdtri(max(int(shown.sum()), 1), _CHANCE)
    used = replace(fit, common=common) if differs else problem.fit([], _UNIT_SIGMA_RAD)
    quality = _quality(problem, overlaps, used, _terms(used.common, covariance))
    made = corrected(prior, used.common)
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
    prior = Calibration.of_mount(mount)
    free = [_FOCAL] if camera.model == 'equidistant' else [_FOCAL, _DISTORTION]
    for _ in range(_ROUNDS):
        overlaps = track_overlaps(aligned, mount, every_frame=True)
        if len(overlaps) < _LEAST_PER_FRAME * len(sweep.frames):
            raise LandmarkNavError(
                f'{len(overlaps)} matches between neighbouring frames are too few to '
                'align them: they need to overlap and to show texture'
            )
        problem = OverlapProblem(overlaps, given, prior)
        fit = problem.fit(free, _ROUGH_SIGMA_RAD)
        aligned = as_calibrated(given, corrected(prior, fit.common), fit.frames)
    residual_px = problem.misfit_px(fit.common, fit.frames)
    quality = _quality(problem, overlaps, fit, _terms(fit.common, fit.covariance))
    return aligned, replace(quality, residual_px=residual_px)


def _terms(common: FloatArray, covariance: FloatArray) -> tuple[CalibrationTerm, ...]:
    """Free terms with their sigmas."""
    values, sigmas = common.tolist(), np.sqrt(np.diag(covariance)).tolist()
    terms = [CalibrationTerm(*term) for term in zip(COMMON, values, sigmas, strict=True)]
    if sigmas[_DISTORTION]:
        # Of an equivalent lens without distortion: the combination of focal length and distortion
        # that does not depend on the uncertainty of the distortion.
        both = covariance[_FOCAL, _DISTORTION]
        lever = both / covariance[_DISTORTION, _DISTORTION]
        value = float(common[_FOCAL] - lever * common[_DISTORTION])
        sigma = float(np.sqrt(covariance[_FOCAL, _FOCAL] - lever * both))
        terms[_FOCAL] = CalibrationTerm('focal_length', value, sigma)
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


def usual_range(azimuth: FloatArray, tangent: FloatArray | None = None) -> FloatArray:
    """Range of what a camera sees in a room, in any direction."""
    return np.full(azimuth.shape, _USUAL_RANGE_M)


def with_overlaps(known: Calibration, before: Calibration, fit: Fit | None) -> Calibration:
    """
    Update a calibration by the overlaps of a sweep, whose terms correct that of `before`.

    All terms are used together, as an offset of the optical centre resembles a longer focal
    length: without one of them, the other would be off by more than its sigma.

    Raises `LandmarkNavError`: a term contradicts an exact value.
    """
    if fit is None:
        return known
    shown = np.diag(fit.covariance) > 0.0
    rows = np.eye(len(NAMES))[CORRECTED][shown]
    values = rows @ before.values + fit.common[shown]
    return known.observed(rows, values, fit.covariance[np.ix_(shown, shown)])


def with_papers(
    known: Calibration,
    used: Calibration,
    score: FloatArray,
    information: FloatArray,
    floor_rad: float,
) -> Calibration:
    """
    Update a calibration by height and tilt of the pan axis from papers, measured with `used`.

    Raises `LandmarkNavError`: the papers contradict an exact value.

    Parameters
    ----------
    score, information : ndarray, shape (3,), (3, 3)
        Height and small rotations about x and y of the base, in information form: their estimate
        is ``information^-1 score``.
    floor_rad : float
        Sigma of the tilt of the base by the floor.
    """
    size, axes = np.linalg.eigh(information)
    if size[-1] <= 0.0:
        return known
    # Directions that papers do not show get almost no information, and no value.
    shows = size > _ROUNDING * size[-1]
    size = np.where(shows, size, _ROUNDING * size[-1])
    covariance = (axes / size) @ axes.T
    score = axes @ (shows * (axes.T @ score))
    rows = np.zeros((3, len(NAMES)))
    rows[0, [NAMES.index(name) for name in HEIGHT]] = 1.0
    rows[1:, [NAMES.index(name) for name in _AXIS_TILT]] = tilt_axes(used)
    values = rows @ used.values + covariance @ score
    covariance[1:, 1:] += floor_rad**2 * np.eye(2)
    # Expressed in roll and pitch.
    turn = np.eye(3)
    turn[1:, 1:] = tilt_axes(used).T
    return known.observed(turn @ rows, turn @ values, turn @ covariance @ turn.T)


def tilt_axes(calibration: Calibration) -> FloatArray:
    """Matrix (2, 2) from roll and pitch of the pan axis to rotations about x and y of the base."""
    yaw = calibration['axis_yaw'][0]
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])


def levelled(
    before: Calibration, score: FloatArray, information: FloatArray
) -> tuple[Calibration, tuple[CalibrationTerm, ...]]:
    """
    Correct the tilt of the pan axis by papers if it is significant; not its covariance.

    Papers measure it to some milliradians. The adjustment estimates smaller tilts: panoramas that
    were tilted by that noise gave drives that were a third less exact. `score` and `information`
    are as in `with_papers`. Also returned are the terms of ``axis_roll`` and ``axis_pitch``, none
    if nothing was measured.
    """
    if np.linalg.eigvalsh(information[1:, 1:])[0] < _LEAST_INFORMATION:
        return before, ()
    covariance = covariance_of(information)
    axis_tilt, covariance = (covariance @ score)[1:], covariance[1:, 1:]
    values = zip(
        _AXIS_TILT, axis_tilt.tolist(), np.sqrt(np.diag(covariance)).tolist(), strict=True
    )
    terms = tuple(CalibrationTerm(*term) for term in values)
    if float(axis_tilt @ solve_positive(covariance, axis_tilt)) <= SIGNIFICANT**2:
        return before, terms
    roll, pitch, _ = tilted(before.mount, axis_tilt).axis_rpy
    return before.with_values(axis_roll=roll, axis_pitch=pitch), terms


def tilted(mount: PanTiltMount, tilt_roll_rad: FloatArray) -> PanTiltMount:
    """Rotate the pan axis by small angles (2,) about x and y of the base."""
    turned = Rotation.from_rotvec([*tilt_roll_rad, 0.0]).as_matrix() @ rotation_rpy(mount.axis_rpy)
    roll, pitch, yaw = Rotation.from_matrix(turned).as_euler('xyz').tolist()
    return replace(mount, axis_rpy=(roll, pitch, yaw))
