"""
From a sweep to a panorama with its place, stage by stage.

sweep -> calibration out of its overlaps -> cylinder -> place from the reference area;
with the walls' distance then known -> calibration again, the optical centre's offset too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
import logging
from math import pi

import cv2
import numpy as np

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_one_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.calibration import (
    calibrate_sweep,
    CalibrationConfig,
    check_turn,
    moved_px,
    SweepCalibration,
)
from landmark_nav.learning.calibration.combined import (
    as_calibrated,
    as_corrected,
    HEIGHT,
    leant,
    levelled,
    with_papers,
    with_terms,
)
from landmark_nav.learning.least_squares import checked_covariance
from landmark_nav.learning.panorama import CylinderImage, PanoramaConfig, synthesize_cylinder
from landmark_nav.learning.panorama.photometry import even_out, measure_photometry, Photometry
from landmark_nav.learning.reference_area import (
    check_agreement,
    locate_sweep,
    MountError,
    optical_height,
    PaperRecord,
    papers_fit,
    ReferenceAreaConfig,
    SweepPlace,
    WRONG_PRIOR,
    WrongMountError,
)
from landmark_nav.learning.stages import StageLog
from landmark_nav.parameters import Config
from landmark_nav.quality import PanoramaQuality
from landmark_nav.types import CameraFrame, FloatArray, ImageArray, Panorama, PoseEstimate, Sweep

# Nobody writes less.
_HARDLY_RAD = 1e-3


def why_seen_otherwise(
    sweep: Sweep, room: Room, mount: PanTiltMount, config: ReferenceAreaConfig
) -> str | None:
    """What to change if that makes the papers fit; None if nothing does."""
    for why, seen, mounted in _otherwise(sweep, mount):
        view = synthesize_cylinder(seen, mounted, PanoramaConfig(blend='feather'))
        if papers_fit(seen, view, room, mounted, config):
            return f'{why}, as the papers show'
    return None


def _otherwise(sweep: Sweep, mount: PanTiltMount) -> Iterator[tuple[str, Sweep, PanTiltMount]]:
    """What is wrong and what to do, and the sweep and the mount without it."""
    roll, pitch, yaw = mount.axis_rpy
    upside_down = 'is mounted the other way up: set'
    yield (
        f'the camera {upside_down} camera_roll: {_turned(mount.camera_roll_rad)}',
        sweep,
        replace(mount, camera_roll_rad=mount.camera_roll_rad + pi),
    )
    yield (
        f'the pan unit {upside_down} pan_axis rpy: [{_turned(roll)}, {pitch:.4f}, {yaw:.4f}]',
        sweep,
        replace(mount, axis_rpy=(roll + pi, pitch, yaw)),
    )
    if sweep.frames[0].image.ndim == 3:
        exchanged = _changed(sweep, lambda image: image[..., ::-1])
        yield 'red and blue are exchanged: name the encoding (rgb8, bgr8) right', exchanged, mount
    for what, flip in (('top to bottom', np.flipud), ('left to right', np.fliplr)):
        flipped = _changed(sweep, flip)
        yield f'images are flipped {what}: publish them as they are', flipped, mount


def _changed(sweep: Sweep, change: Callable[[ImageArray], ImageArray]) -> Sweep:
    def frame(one: CameraFrame) -> CameraFrame:
        return replace(one, image=np.ascontiguousarray(change(one.image)))

    return replace(sweep, frames=tuple(map(frame, sweep.frames)))


def _turned(angle_rad: float) -> str:
    """Angle and half a turn, as one writes it."""
    angle_rad = wrap_one_rad(angle_rad + pi)
    return '0' if abs(angle_rad) < _HARDLY_RAD else f'{angle_rad:.4f}'


_LOG = logging.getLogger(__name__)

# Walls farther away than this are as good as infinitely far.
_FAR_M = 50.0
# Standard deviations of a given pose that no map can be learned with: metres, metres, radians.
_MOST_SIGMA = np.array([1.0, 1.0, 0.3])
# A focal length that is off by such a share is worth a word.
_WORTH_REPORTING = 0.02
# No pose is better known.
_LEAST_VARIANCE = 1e-10
# Height and lean that are off by more of the usual standard deviations are measured once more,
# with those of the robot's file.
_WIDER_SIGMAS = 2.0
# Calibrations that differ by less make one panorama.
_SAME_PX = 0.2


@dataclass(frozen=True)
class PanoramaStages(Config):
    """Parameters of the stages from sweep to panorama."""

    panorama: PanoramaConfig = field(default_factory=PanoramaConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    reference_area: ReferenceAreaConfig = field(default_factory=ReferenceAreaConfig)


def panorama_from_sweep(
    sweep: Sweep,
    room: Room,
    given: Calibration | PanTiltMount,
    config: PanoramaStages,
    log: StageLog | None = None,
    papers: PaperRecord | None = None,
) -> Panorama:
    """
    Make the panorama of a sweep and find where it was taken.

    Height and lean of the camera that papers show otherwise than given are used, as far as
    a person with a tape and a spirit level may be off by them.

    Raises `LandmarkNavError`: no frames, a pan that does not turn as reported, a camera that is
    mounted quite otherwise than given, or otherwise than given as exact, or papers that do not
    give one place.

    Parameters
    ----------
    sweep : Sweep
        Frames of one turn, or of a part of one; its place too, if it is known from elsewhere.
    given : Calibration or PanTiltMount
        What is known of the robot: the prior. A mount has default standard deviations.
    log : StageLog, optional
        Where times go.
    papers : PaperRecord, optional
        Papers in other sweeps of the room, which help to name what is wrong; this one is added.
    """
    if not sweep.frames:
        raise LandmarkNavError('the sweep has no frames: take it again')
    log = log or StageLog()
    papers = PaperRecord(room, config.reference_area) if papers is None else papers
    floor_rad = config.reference_area.horizon_sigma_rad
    prior = given if isinstance(given, Calibration) else Calibration.of_mount(given)
    try:
        return _made(sweep, room, prior, prior, config, floor_rad, log, papers)
    except WrongMountError as error:
        if not error.found.reasonable:
            raise
        allowed = _not_exact(error, prior, config.reference_area)
        papers.clear()
        other, wider = mended(prior, allowed), _wider(config, prior)
    return _made(sweep, room, other, prior, wider, floor_rad, log, papers)


def _not_exact(
    error: WrongMountError, prior: Calibration, area: ReferenceAreaConfig
) -> MountError:
    """Return what may be mended of a mount: nothing that was given as exact."""
    rise, axis_tilt = _mount_sigmas(prior)
    found = error.found
    high = abs(found.rise_m) > WRONG_PRIOR * area.height_sigma_m
    leans = np.hypot(*found.tilt_roll_rad) > WRONG_PRIOR * area.horizon_sigma_rad
    if (high and not rise) or (leans and not axis_tilt):
        raise LandmarkNavError(f'{error}; robot.yaml gives it as exact (sigma 0)') from error
    return MountError(found.rise_m if rise else 0.0, found.tilt_roll_rad * (axis_tilt > 0.0))


def _within_prior(found: MountError, prior: Calibration) -> bool:
    """Whether a mount is off by no more than is expected: no fault of papers is looked for."""
    rise, axis_tilt = WRONG_PRIOR * np.array(_mount_sigmas(prior))
    return bool(abs(found.rise_m) <= rise and np.hypot(*found.tilt_roll_rad) <= axis_tilt)


def _mount_sigmas(prior: Calibration) -> tuple[float, float]:
    """Standard deviations of height and lean of the camera."""
    height = [NAMES.index(name) for name in HEIGHT]
    rise = float(np.sqrt(prior.covariance[np.ix_(height, height)].sum()))
    return rise, float(prior.sigma_of('axis_roll', 2).max())


def mended(given: Calibration, found: MountError) -> Calibration:
    """Return the calibration with height and lean of the pan axis as they were found."""
    roll, pitch, _ = leant(given.mount, found.tilt_roll_rad).axis_rpy
    height = given['axis_z'][0] + found.rise_m
    return given.with_values(axis_z=height, axis_roll=roll, axis_pitch=pitch)


def _wider(config: PanoramaStages, prior: Calibration) -> PanoramaStages:
    """Parameters with height and lean of the camera as uncertain as the robot's file says."""
    area = config.reference_area
    rise, axis_tilt = _mount_sigmas(prior)
    wider = replace(
        area,
        height_sigma_m=float(np.hypot(area.height_sigma_m, rise)),
        horizon_sigma_rad=float(np.hypot(area.horizon_sigma_rad, axis_tilt)),
    )
    return replace(config, reference_area=wider)


def _made(
    taken: Sweep,
    room: Room,
    used: Calibration,
    prior: Calibration,
    config: PanoramaStages,
    floor_rad: float,
    log: StageLog,
    papers: PaperRecord,
) -> Panorama:
    """Panorama of a sweep with the calibration `used`; `prior` is what is known of it."""
    sweep, mount = as_calibrated(taken, used), used.mount
    with log.measure('calibration'):
        try:
            check_turn(sweep, mount)
        except LandmarkNavError as error:
            why = why_seen_otherwise(sweep, room, mount, config.reference_area)
            raise LandmarkNavError(why or str(error)) from error
        found = calibrate_sweep(sweep, mount, config.calibration)
    with log.measure('panorama'):
        photometry = Photometry.none(len(sweep.frames))
        if config.panorama.even_out:
            photometry = measure_photometry(found.sweep, found.mount)
        view = _view(found, photometry, config)
    with log.measure('reference_area'):
        papers.add(view, optical_height(found.sweep, found.mount))
        try:
            place = _place(view, found, room, config, prior, used is not prior)
        except LandmarkNavError as error:
            if isinstance(error, WrongMountError) and _within_prior(error.found, prior):
                raise
            why = why_seen_otherwise(sweep, room, mount, config.reference_area)
            faults = papers.faults()
            cause = why or faults.cause or str(error)
            wrong = faults.mount
            if wrong is None and isinstance(error, WrongMountError) and not faults.faults:
                wrong = error.found
            if why or wrong is None:
                raise LandmarkNavError(cause) from error
            raise WrongMountError(cause, wrong) from error
    mount, axis_tilt = levelled(
        mount, place.axis_tilt_score, place.axis_tilt_information, config.calibration
    )
    with log.measure('calibration'):
        refined = calibrate_sweep(
            sweep, mount, config.calibration, _range_of_ray(place, found, room), found.overlaps
        )
    mount_changed = refined.mount.axis_rpy != found.mount.axis_rpy
    off_axis = any(refined.mount.optical_center_offset[:2])
    if mount_changed or off_axis or moved_px(found, refined) > _SAME_PX:
        found = refined
        with log.measure('reference_area'):
            place = _place(view, found, room, config, prior, used is not prior)
        with log.measure('panorama'):
            view = _view(found, photometry, config, _range_of_azimuth(place, found, room))
    found = refined
    for warning in filter(None, [place.warning, _wrong_focal(found.quality)]):
        _LOG.warning('%s', warning)
    by_calibration = _by_calibration(place, found)
    terms = found.quality.calibration
    made = as_corrected(used, terms, found.mount)
    known = prior
    if config.calibration.enabled:
        known = with_papers(
            with_terms(prior, used, terms), made, place.mount_score, place.mount_information,
            floor_rad,
        )  # fmt: skip
    return Panorama(
        sweep.stamp_ns,
        view.image,
        view.mask,
        view.cylinder,
        _axis(place, found.mount),
        float(place.pose_map_base[2]),
        _axis_covariance(place, found.mount)
        + by_calibration @ known.covariance @ by_calibration.T,
        replace(found.quality, calibration=(*found.quality.calibration, *axis_tilt)).of(
            tenengrad(view), photometry.vignetting, photometry.gain_spread
        ),
        known,
        made.values,
        by_calibration,
    )


def unplaced_panorama(
    sweep: Sweep, mount: PanTiltMount, config: PanoramaStages, log: StageLog
) -> Panorama:
    """
    Make the panorama of a sweep of which no place is known: its pose is that in the base frame.

    Raises `LandmarkNavError`: no frames, or a pan that does not turn as reported.
    """
    if not sweep.frames:
        raise LandmarkNavError('the sweep has no frames: take it again')
    with log.measure('calibration'):
        check_turn(sweep, mount)
        found = calibrate_sweep(sweep, mount, config.calibration)
    with log.measure('panorama'):
        photometry = Photometry.none(len(sweep.frames))
        if config.panorama.even_out:
            photometry = measure_photometry(found.sweep, found.mount)
        view = _view(found, photometry, config)
    place = SweepPlace(np.zeros(3), optical_height(found.sweep, found.mount), np.eye(4))
    return Panorama(
        sweep.stamp_ns,
        view.image,
        view.mask,
        view.cylinder,
        _axis(place, found.mount),
        0.0,
        place.covariance,
        found.quality.of(tenengrad(view), photometry.vignetting, photometry.gain_spread),
    )


def _wrong_focal(quality: PanoramaQuality) -> str:
    """Warning about a focal length that the turn shows to be far off what was given."""
    for term in quality.calibration:
        if term.name == 'focal_length' and term.used and abs(term.value) > _WORTH_REPORTING:
            return (
                f'the focal length in camera_info is {100.0 * abs(term.value):.1f} % too '
                f'{"small" if term.value > 0.0 else "large"}, as the turn shows it: the sweep is '
                'mended, but navigation goes by camera_info: calibrate the camera'
            )
    return ''


def record_papers(sweep: Sweep, given: Calibration, papers: PaperRecord) -> None:
    """Add what a sweep shows of the papers to a record, without finding its pose."""
    sweep, mount = as_calibrated(sweep, given), given.mount
    view = synthesize_cylinder(sweep, mount, PanoramaConfig(blend='feather'))
    papers.add(view, optical_height(sweep, mount))


def tenengrad(view: CylinderImage) -> float:
    """Mean squared gradient (Sobel, per pixel) of what is covered: the sharper, the greater."""
    grey = cv2.cvtColor(view.image, cv2.COLOR_BGR2GRAY)
    across, down = cv2.spatialGradient(grey)
    square = np.square(across, dtype=np.float32) + np.square(down, dtype=np.float32)
    inner = cv2.erode(view.mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    # A Sobel kernel sums up eight times the slope.
    return float(square[inner].mean() / 64.0) if inner.any() else 0.0


def _view(
    found: SweepCalibration,
    photometry: Photometry,
    config: PanoramaStages,
    range_m: Callable[[FloatArray], FloatArray] | None = None,
) -> CylinderImage:
    return synthesize_cylinder(
        even_out(found.sweep, photometry), found.mount, config.panorama, range_m
    )


def _range_of_azimuth(
    place: SweepPlace, found: SweepCalibration, room: Room
) -> Callable[[FloatArray], FloatArray]:
    """Distance of the walls at azimuths in the base frame."""
    axis, heading = _axis(place, found.mount), place.pose_map_base[2]
    return lambda azimuth: np.minimum(room.raycast(axis[:2], azimuth + heading)[0], _FAR_M)


def _range_of_ray(
    place: SweepPlace, found: SweepCalibration, room: Room
) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Distance of walls, floor and ceiling at azimuths and tangents in the base frame."""
    axis, heading = _axis(place, found.mount), place.pose_map_base[2]
    heights = np.array([wall.height for wall in room.walls])

    def range_m(azimuth: FloatArray, tangent: FloatArray) -> FloatArray:
        walls, hit = room.raycast(axis[:2], azimuth + heading)
        above = heights[hit] - axis[2]
        with np.errstate(divide='ignore'):
            level = np.where(tangent > 0.0, above, -axis[2]) / tangent
        return np.asarray(np.clip(np.minimum(walls, level), 0.2, _FAR_M))

    return range_m


def _by_calibration(place: SweepPlace, found: SweepCalibration) -> FloatArray:
    """Derivative (4, 15) of the viewpoint; papers locate the camera itself."""
    jacobian = np.zeros((4, len(NAMES)))
    if found.sweep.pose_map_base is not None:
        jacobian[:2, :2] = se2.rotation(place.pose_map_base[2])
        jacobian[3, NAMES.index('axis_yaw')] = 1.0
        jacobian[2, [NAMES.index(name) for name in HEIGHT]] = 1.0
    return jacobian


def _place(
    view: CylinderImage,
    found: SweepCalibration,
    room: Room,
    config: PanoramaStages,
    prior: Calibration,
    wide: bool,
) -> SweepPlace:
    known = found.sweep.pose_map_base
    if known is None:
        most = WRONG_PRIOR if wide else _WIDER_SIGMAS
        return locate_sweep(found.sweep, view, room, found.mount, config.reference_area, most)
    covariance = np.zeros((4, 4))
    plane = np.ix_([0, 1, 3], [0, 1, 3])
    covariance[plane] = _given_covariance(known)
    place = SweepPlace(known.pose, optical_height(found.sweep, found.mount), covariance)
    mounted = _by_calibration(place, found)
    uncertain = covariance + mounted @ prior.covariance @ mounted.T
    check_agreement(
        known.pose,
        uncertain[plane],
        found.sweep,
        view,
        room,
        found.mount,
        config.reference_area,
    )
    covariance[2, 2] = config.reference_area.height_sigma_m**2
    return place


def _given_covariance(known: PoseEstimate) -> FloatArray:
    """Covariance (3, 3) of the pose of a sweep that is given; an error if it is none."""
    if not np.isfinite(known.pose).all():
        raise LandmarkNavError('sweep/pose is not a number: mend its publisher')
    covariance = checked_covariance(known.covariance, _MOST_SIGMA, 'sweep/pose')
    return np.asarray(covariance + _LEAST_VARIANCE * np.eye(3))


def _axis(place: SweepPlace, mount: PanTiltMount) -> FloatArray:
    """The panorama's viewpoint: the pan axis at the height of the optical centre."""
    axis = mount.axis_pose_map(place.pose_map_base)
    return np.array([axis[0], axis[1], place.height_m])


def _axis_covariance(place: SweepPlace, mount: PanTiltMount) -> FloatArray:
    jacobian = np.eye(4)
    lever = se2.rotation(place.pose_map_base[2]) @ np.asarray(mount.axis_xyz[:2])
    jacobian[0, 3], jacobian[1, 3] = -lever[1], lever[0]
    return np.asarray(jacobian @ place.covariance @ jacobian.T)
