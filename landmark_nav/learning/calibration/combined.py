"""Update of the robot's calibration by a sweep and by papers."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.se2 import rotation_rpy
from landmark_nav.learning.calibration.overlap_fit import COMMON, Fit
from landmark_nav.learning.least_squares import covariance_of, solve_positive
from landmark_nav.quality import CalibrationTerm, SIGNIFICANT
from landmark_nav.types import FloatArray, Sweep

# The two parts of the camera's height; images show their sum.
HEIGHT = ('axis_z', 'center_z')
_AXIS_TILT = ('axis_roll', 'axis_pitch')
# Term of a sweep -> the quantity that it corrects.
_QUANTITIES = {
    'focal_length': 'focal_scale',
    'pan_scale': 'pan_scale',
    'tilt': 'camera_tilt',
    'roll': 'camera_roll',
    'forward': 'center_x',
    'left': 'center_y',
    'principal_point': 'principal_point',
    'distortion': 'distortion',
}
# Smaller information, relative to the largest, is rounding.
_ROUNDING = 1e-9


def as_calibrated(sweep: Sweep, calibration: Calibration) -> Sweep:
    """Return a sweep with camera and joints as calibrated."""
    pan_scale, tilt = 1.0 + calibration['pan_scale'][0], calibration['camera_tilt'][0]
    camera = cache(calibration.camera)
    frames = (
        replace(
            frame,
            camera=camera(frame.camera),
            pan_rad=frame.pan_rad * pan_scale,
            tilt_rad=frame.tilt_rad + tilt,
        )
        for frame in sweep.frames
    )
    return replace(sweep, frames=tuple(frames))


def as_corrected(before: Calibration, common: FloatArray) -> Calibration:
    """Return the calibration corrected by `common` (8,)."""
    names, values = _corrected_values(before, common)
    return before.with_values(**dict(zip(names, values.tolist(), strict=True)))


def posterior_terms(before: Calibration, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """
    Terms (8,) and their covariance (8, 8) by the prior `before`, which they correct, and a fit.

    Terms that the fit does not show are zero.

    Raises `LandmarkNavError`: a term contradicts an exact value.
    """
    after = with_overlaps(before, before, fit)
    index = [NAMES.index(_QUANTITIES[term]) for term in COMMON]
    terms, slope = (after.values - before.values)[index], 1.0 * (np.diag(fit.covariance) > 0.0)
    for k in (COMMON.index('focal_length'), COMMON.index('pan_scale')):
        slope[k] /= 1.0 + before.values[index[k]]
    terms *= slope
    terms[COMMON.index('focal_length')] = np.log1p(terms[COMMON.index('focal_length')])
    return terms, after.covariance[np.ix_(index, index)] * np.outer(slope, slope)


def _corrected_values(before: Calibration, common: FloatArray) -> tuple[list[str], FloatArray]:
    """Names and values (q,) of the quantities that terms of a sweep correct."""
    names = list(_QUANTITIES.values())
    values = np.array([before[name][0] for name in names])
    terms = common[[COMMON.index(term) for term in _QUANTITIES]]
    focal, pan_scale = names.index('focal_scale'), names.index('pan_scale')
    found = values + terms
    found[focal] = (1.0 + values[focal]) * np.exp(terms[focal]) - 1.0
    found[pan_scale] = (1.0 + values[pan_scale]) * (1.0 + terms[pan_scale]) - 1.0
    return names, found


def with_overlaps(known: Calibration, before: Calibration, fit: Fit | None) -> Calibration:
    """
    Update a calibration by the overlaps of a sweep, whose terms correct that of `before`.

    All terms are used together, as an offset of the optical centre resembles a longer focal
    length: without one of them, the other would be off by more than its sigma.

    Raises `LandmarkNavError`: a term contradicts an exact value.
    """
    if fit is None:
        return known
    terms = np.array([COMMON.index(term) for term in _QUANTITIES])
    covariance = fit.covariance[np.ix_(terms, terms)]
    shown = np.diag(covariance) > 0.0
    names, values = _corrected_values(before, fit.common)
    rows = np.array(names)[:, None] == np.array(NAMES)
    return known.observed(
        rows[shown].astype(np.float64), values[shown], covariance[np.ix_(shown, shown)]
    )


def with_papers(
    known: Calibration,
    used: Calibration,
    score: FloatArray,
    information: FloatArray,
    floor_rad: float,
) -> Calibration:
    """
    Update a calibration by height and tilt of the pan axis from papers.

    Raises `LandmarkNavError`: the papers contradict an exact value.

    Parameters
    ----------
    used : Calibration
        Calibration with which papers were measured.
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


# Smaller information, 1 / rad^2, is rounding: no paper was measured.
_LEAST_INFORMATION = 1e-3


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
