"""Update of the robot's calibration by a sweep and by papers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.se2 import rotation_rpy
from landmark_nav.learning.calibration.sweep_calibration import (
    SIGNIFICANT,
    USUAL_RANGE_M,
)
from landmark_nav.learning.least_squares import covariance_of, solve_positive
from landmark_nav.quality import CalibrationTerm
from landmark_nav.types import FloatArray, Sweep

# The two parts of the camera's height; images show their sum.
HEIGHT = ('axis_z', 'center_z')
# Term of a sweep -> the quantity that it corrects, and whether it is a factor.
_QUANTITIES = {
    'focal_length': ('focal_scale', True),
    'pan_scale': ('pan_scale', True),
    'tilt': ('camera_tilt', False),
    'roll': ('camera_roll', False),
    'forward': ('center_x', False),
    'left': ('center_y', False),
}
# Relative error of the ranges by which the offset of the optical centre is measured: furniture is
# nearer than the walls. The remaining error of an offset looks like one of the focal length.
_RANGE_SHARE = 0.1
# Smaller information, relative to the largest, is rounding.
_ROUNDING = 1e-9


def as_calibrated(sweep: Sweep, calibration: Calibration) -> Sweep:
    """Return a sweep with camera and joints as calibrated."""
    pan_scale, tilt = 1.0 + calibration['pan_scale'][0], calibration['camera_tilt'][0]
    cameras: dict[CameraModel, CameraModel] = {}
    for frame in sweep.frames:
        if frame.camera not in cameras:
            cameras[frame.camera] = calibration.camera(frame.camera)
    return replace(
        sweep,
        frames=tuple(
            replace(
                frame,
                camera=cameras[frame.camera],
                pan_rad=frame.pan_rad * pan_scale,
                tilt_rad=frame.tilt_rad + tilt,
            )
            for frame in sweep.frames
        ),
    )


def _found(
    before: Calibration, term: CalibrationTerm, offset_m: float = 0.0
) -> tuple[str, float, float]:
    """Quantity that a term corrects, its value and its sigma; see `with_terms`."""
    name, factor = _QUANTITIES[term.name]
    value = before[name][0]
    found = value + term.value * (1.0 + value if factor else 1.0)
    by_range = 0.0
    if name.startswith('center'):
        by_range = _RANGE_SHARE * max(abs(found), abs(term.value))
    elif term.name == 'focal_length':
        by_range = _RANGE_SHARE * offset_m / USUAL_RANGE_M
    return name, found, float(np.hypot(term.sigma, by_range))


def as_corrected(
    before: Calibration, terms: tuple[CalibrationTerm, ...], mount: PanTiltMount
) -> Calibration:
    """Calibration a panorama was made with: the one before, with the terms used and its axis."""
    values = dict(zip(('axis_roll', 'axis_pitch', 'axis_yaw'), mount.axis_rpy, strict=True))
    for term in terms:
        if term.used and term.name in _QUANTITIES:
            name, value, _ = _found(before, term)
            values[name] = value
    return before.with_values(**values)


def with_terms(
    known: Calibration, before: Calibration, terms: tuple[CalibrationTerm, ...]
) -> Calibration:
    """
    Update a calibration by the overlaps of a sweep.

    Raises `LandmarkNavError`: a term contradicts an exact value.

    Parameters
    ----------
    before : Calibration
        Calibration that the terms correct.
    terms : tuple of CalibrationTerm
        Terms of the sweep, used in the panorama or not.
    """
    offset_m = max(
        (abs(_found(before, t)[1]) for t in terms if t.name in ('forward', 'left')), default=0.0
    )
    for term in terms:
        if term.name in _QUANTITIES:
            known = known.measured(*_found(before, term, offset_m))
    return known


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
        Height and small rotations about x and y of the base, in information form.
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
    axis_tilt = [NAMES.index(name) for name in ('axis_roll', 'axis_pitch')]
    rows[1:, axis_tilt] = lean_axes(used)
    values = rows @ used.values + covariance @ score
    covariance[1:, 1:] += floor_rad**2 * np.eye(2)
    # Expressed in roll and pitch.
    turn = np.eye(3)
    turn[1:, 1:] = lean_axes(used).T
    return known.observed(turn @ rows, turn @ values, turn @ covariance @ turn.T)


def lean_axes(calibration: Calibration) -> FloatArray:
    """Matrix (2, 2) from roll and pitch of the pan axis to rotations about x and y of the base."""
    yaw = calibration['axis_yaw'][0]
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])


# Smaller information, 1 / rad^2, is rounding: no paper was measured.
_LEAST_INFORMATION = 1e-3


def levelled(
    mount: PanTiltMount, score: FloatArray, information: FloatArray
) -> tuple[PanTiltMount, tuple[CalibrationTerm, ...]]:
    """
    Correct the tilt of the pan axis if it is significant.

    Parameters
    ----------
    mount : PanTiltMount
        Assumed extrinsics.
    score, information : ndarray, shape (3,), (3, 3)
        Height and small rotations about x and y of the base, in information form: their estimate
        is ``information^-1 score``.

    Returns
    -------
    mount : PanTiltMount
    terms : tuple of CalibrationTerm
        ``axis_roll`` and ``axis_pitch``; empty if nothing was measured.
    """
    if np.linalg.eigvalsh(information[1:, 1:])[0] < _LEAST_INFORMATION:
        return mount, ()
    covariance = covariance_of(information)
    axis_tilt, covariance = (covariance @ score)[1:], covariance[1:, 1:]
    significant = float(axis_tilt @ solve_positive(covariance, axis_tilt)) > SIGNIFICANT**2
    terms = tuple(
        CalibrationTerm(name, float(value), float(sigma), significant)
        for name, value, sigma in zip(
            ('axis_roll', 'axis_pitch'), axis_tilt, np.sqrt(np.diag(covariance)), strict=True
        )
    )
    if not significant:
        return mount, terms
    return leant(mount, axis_tilt), terms


def leant(mount: PanTiltMount, tilt_roll_rad: FloatArray) -> PanTiltMount:
    """Rotate the pan axis by small angles (2,) about x and y of the base."""
    turned = Rotation.from_rotvec([*tilt_roll_rad, 0.0]).as_matrix() @ rotation_rpy(mount.axis_rpy)
    roll, pitch, yaw = Rotation.from_matrix(turned).as_euler('xyz').tolist()
    return replace(mount, axis_rpy=(roll, pitch, yaw))
