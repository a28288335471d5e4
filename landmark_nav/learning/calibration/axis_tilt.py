"""Tilt of the pan axis, as the reference papers show it: overlaps of frames do not show it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.rotation import rotation_rpy
from landmark_nav.learning.calibration.sweep_calibration import CalibrationConfig, SIGNIFICANT
from landmark_nav.learning.least_squares import covariance_of
from landmark_nav.quality import CalibrationTerm
from landmark_nav.types import FloatArray

__all__ = ['levelled']

# Less information than that, 1 / rad^2, is none: rounding, where no paper was measured.
_LEAST_INFORMATION = 1e-3


def levelled(
    mount: PanTiltMount, score: FloatArray, information: FloatArray, config: CalibrationConfig
) -> tuple[PanTiltMount, tuple[CalibrationTerm, ...]]:
    """
    Turn the pan axis as far as it is significantly tilted.

    Parameters
    ----------
    mount : PanTiltMount
        As it was taken to stand.
    score, information : ndarray, shape (2,), (2, 2)
        What measurements say of small turns about x and y of the base, [rad], in information form:
        the tilt is ``information^-1 score``.
    config : CalibrationConfig
        Whether to use what is found.

    Returns
    -------
    mount : PanTiltMount
    terms : tuple of CalibrationTerm
        ``axis_roll`` and ``axis_pitch``; none where nothing was measured.

    """
    if np.linalg.eigvalsh(information)[0] < _LEAST_INFORMATION:
        return mount, ()
    covariance = covariance_of(information)
    axis_tilt = covariance @ score
    significant = float(axis_tilt @ score) > SIGNIFICANT**2 and config.enabled
    terms = tuple(
        CalibrationTerm(name, float(value), float(sigma), significant)
        for name, value, sigma in zip(
            ('axis_roll', 'axis_pitch'), axis_tilt, np.sqrt(np.diag(covariance)), strict=True
        )
    )
    if not significant:
        return mount, terms
    turned = Rotation.from_rotvec([*axis_tilt, 0.0]).as_matrix() @ rotation_rpy(mount.axis_rpy)
    roll, pitch, yaw = Rotation.from_matrix(turned).as_euler('xyz').tolist()
    return replace(mount, axis_rpy=(roll, pitch, yaw)), terms
