"""
Alignment of images with approximate angles: pan, tilt and roll of each image, and the common focal
length and radial distortion, from the overlaps of neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.learning.calibration.overlap_fit import (
    COMMON,
    corrected,
    OverlapProblem,
    track_overlaps,
)
from landmark_nav.learning.calibration.sweep_calibration import fit_significant
from landmark_nav.quality import PanoramaQuality
from landmark_nav.types import Sweep

_ROUNDS = 2
_LEAST_PER_FRAME = 6


# Sigmas of the given angles: of pan, and of tilt and roll.
_PAN_SIGMA_RAD, _TILT_SIGMA_RAD = 0.03, 0.01


@dataclass(frozen=True, eq=False)
class SweepAlignment:
    """
    A sweep with corrected angles and one common camera.

    `focal_px` is the focal length of the lens without distortion that gives the same rotations,
    with the sigma `focal_sigma_px`; `focal_scale` is its ratio to the given one, the median over
    the frames. `quality` has the corrections of focal length and distortion.
    """

    sweep: Sweep
    focal_px: float
    focal_sigma_px: float
    focal_scale: float
    quality: PanoramaQuality


def align_sweep(sweep: Sweep, mount: PanTiltMount) -> SweepAlignment:
    """
    Correct pan, tilt and roll of each frame and the common camera.

    Raises `LandmarkNavError`: fewer than three frames, or too little texture in the overlaps.
    """
    if len(sweep.frames) < 3:
        raise LandmarkNavError(f'{len(sweep.frames)} frames are too few to align: take a sweep')
    given = sweep = _with_one_camera(sweep)
    camera = given.frames[0].camera
    sigma = [_PAN_SIGMA_RAD, _TILT_SIGMA_RAD, _TILT_SIGMA_RAD]
    free = [COMMON.index('focal_length')]
    if camera.model != 'equidistant':
        free.append(COMMON.index('distortion'))
    for _ in range(_ROUNDS):
        overlaps = track_overlaps(sweep, mount, every_frame=True)
        if len(overlaps) < _LEAST_PER_FRAME * len(sweep.frames):
            raise LandmarkNavError(
                f'{len(overlaps)} matches between neighbouring frames are too few to '
                'align them: they need to overlap and to show texture'
            )
        problem = OverlapProblem(overlaps, given, mount)
        fit, terms = fit_significant(problem, free, sigma, camera)
        sweep, _ = corrected(given, mount, fit.common, fit.frames)
    focal = next(term for term in terms if term.name == 'focal_length')
    scale = 1.0 + focal.value if focal.used else 1.0
    return SweepAlignment(
        sweep,
        camera.fx * scale,
        camera.fx * focal.sigma,
        scale,
        PanoramaQuality(
            closure_rad=problem.closure_rad(fit.common, fit.frames, fit.weight),
            gaps_rad=overlaps.gaps_rad,
            residual_px=problem.misfit_px(fit.common, fit.frames),
            before_px=problem.misfit_px(np.zeros(len(COMMON))),
            calibration=terms,
        ),
    )


def _with_one_camera(sweep: Sweep) -> Sweep:
    """All frames with the median of their focal lengths, as one camera took them."""
    cameras = [frame.camera for frame in sweep.frames]
    one = replace(
        cameras[0],
        fx=float(np.median([camera.fx for camera in cameras])),
        fy=float(np.median([camera.fy for camera in cameras])),
    )
    return replace(sweep, frames=tuple(replace(frame, camera=one) for frame in sweep.frames))
