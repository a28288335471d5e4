"""
The stages from a sweep to a panorama with its pose.

sweep -> calibration from overlaps -> cylinder -> rough pose from the reference area -> calibration
again with the distances of the walls, which make the optical centre offset observable -> pose;
the last two once more if papers then show that the pan axis is tilted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
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
from landmark_nav.learning.calibration.overlap_fit import as_calibrated
from landmark_nav.learning.calibration.sweep_calibration import (
    calibrate_sweep,
    FAR_M,
    HEIGHT,
    levelled,
    moved_px,
    SweepCalibration,
    tilted,
    usual_range,
    with_overlaps,
    with_papers,
)
from landmark_nav.learning.calibration.turn import check_turn
from landmark_nav.learning.least_squares import checked_covariance
from landmark_nav.learning.panorama.photometry import even_out, measure_photometry, Photometry
from landmark_nav.learning.panorama.synthesis import CylinderImage, synthesize_cylinder
from landmark_nav.learning.reference_area.faults import PaperRecord
from landmark_nav.learning.reference_area.location import (
    MountError,
    optical_height,
    PaperSearch,
    SweepPlace,
    WRONG_PRIOR,
    WrongMountError,
)
from landmark_nav.learning.reference_area.model import MEASURED, ReferenceAreaConfig
from landmark_nav.learning.stages import StageLog
from landmark_nav.quality import CalibrationTerm
from landmark_nav.types import CameraFrame, FloatArray, ImageArray, Panorama, Sweep

# Angles below this are written as 0.
_HARDLY_RAD = 1e-3


_LOG = logging.getLogger(__name__)

# Greatest sigmas of a given pose: x, y (m) and heading (rad).
_MOST_SIGMA = np.array([1.0, 1.0, 0.3])
# Least relative error of the focal length that is reported.
_WORTH_REPORTING = 0.02
# Least error of the distortion that is reported: shift at the border of the image, pixels.
_BENT_PX = 1.0
# Least variance of a pose (m2, rad2).
_LEAST_VARIANCE = 1e-10
# Greatest error of height and tilt of the camera, in sigmas of the configuration; beyond it the
# panorama is made again with the sigmas of the robot file.
_WIDER_SIGMAS = 2.0
# Greatest shift of pixels between two calibrations for which the panorama is not made again.
_SAME_PX = 0.2


def why_seen_otherwise(
    sweep: Sweep, room: Room, mount: PanTiltMount, config: ReferenceAreaConfig
) -> str | None:
    """Advice for an error of the setup without which the papers fit; None if there is none."""
    for why, seen, mounted in _otherwise(sweep, mount):
        view = synthesize_cylinder(seen, mounted, feathered=True)
        if PaperSearch(seen, view, room, mounted, config).fits_somewhere():
            return f'{why}, as the papers show'
    return None


def _otherwise(sweep: Sweep, mount: PanTiltMount) -> Iterator[tuple[str, Sweep, PanTiltMount]]:
    """Yield possible errors of the setup: advice, and sweep and mount without the error."""
    camera_roll, (roll, pitch, yaw) = mount.camera_roll_rad, mount.axis_rpy
    upside_down = 'is mounted the other way up: set'
    why = f'the camera {upside_down} camera_roll: {_turned(camera_roll)}'
    yield why, sweep, replace(mount, camera_roll_rad=camera_roll + pi)
    why = f'the pan unit {upside_down} pan_axis rpy: [{_turned(roll)}, {pitch:.4f}, {yaw:.4f}]'
    yield why, sweep, replace(mount, axis_rpy=(roll + pi, pitch, yaw))
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
    """Text of an angle plus half a turn, within +-pi."""
    angle_rad = wrap_one_rad(angle_rad + pi)
    return '0' if abs(angle_rad) < _HARDLY_RAD else f'{angle_rad:.4f}'


def panorama_from_sweep(
    sweep: Sweep,
    room: Room,
    given: Calibration | PanTiltMount,
    log: StageLog | None = None,
    papers: PaperRecord | None = None,
    tilt_rad: FloatArray | None = None,
) -> Panorama:
    """
    Make the panorama of a sweep and find its pose.

    If the papers contradict the given height or tilt of the camera, the measured values are used,
    as long as the error is plausible for a measurement with tape and spirit level.

    Raises `LandmarkNavError`: the sweep has no frames; the pan does not turn as reported; the
    mount has a large error, or one in a value that is given as exact; the papers do not give a
    unique pose.

    Parameters
    ----------
    sweep : Sweep
        Frames of a full turn or a part of it; also the pose, if it is given.
    given : Calibration or PanTiltMount
        Prior of the calibration. A mount has default sigmas.
    papers : PaperRecord, optional
        Papers in other sweeps of the room, for the diagnosis of faults; this sweep is added.
    tilt_rad : ndarray, shape (2,), optional
        Known tilt of the base at this sweep about x and y, which is no error of the mount.
    """
    if not sweep.frames:
        raise LandmarkNavError('the sweep has no frames: take it again')
    prior = given if isinstance(given, Calibration) else Calibration.of_mount(given)
    papers = PaperRecord(room) if papers is None else papers
    maker = _Maker(sweep, room, prior, log or StageLog(), papers)
    try:
        used = prior if tilt_rad is None else corrected(prior, MountError(0.0, tilt_rad))
        return maker.made(used, MEASURED, _WIDER_SIGMAS)
    except WrongMountError as error:
        if not error.found.reasonable:
            raise
        allowed = maker.not_exact(error)
    papers.clear()
    # The uncertainty of height and tilt is that of the robot file.
    rise, tilt = maker.sigmas
    wider = replace(
        MEASURED,
        height_sigma_m=float(np.hypot(MEASURED.height_sigma_m, rise)),
        horizon_sigma_rad=float(np.hypot(MEASURED.horizon_sigma_rad, tilt)),
    )
    return maker.made(corrected(prior, allowed), wider, WRONG_PRIOR)


def next_prior(given: Calibration, known: Calibration, after: Panorama) -> Calibration:
    """
    Prior of the calibration after a panorama, which was made with `known`.

    Its lens is that of this camera: use `Calibration.for_camera` with the next sweep.

    The values by the panorama are used if they contradict the given ones. Sweeps share the errors
    of tracking and ranges, so that what several show is as uncertain as one of them.
    """
    found = after.calibration
    if found is None or not found.surprises(given):
        return known
    return replace(given, values=found.values, intrinsics=found.intrinsics)


def corrected(given: Calibration, found: MountError) -> Calibration:
    """Return the calibration with height and tilt of the pan axis as measured."""
    roll, pitch, _ = tilted(given.mount, found.tilt_roll_rad).axis_rpy
    height = given['axis_z'][0] + found.rise_m
    return given.with_values(axis_z=height, axis_roll=roll, axis_pitch=pitch)


@dataclass(frozen=True, eq=False)
class _Maker:
    """Makes the panorama of one sweep; arguments as for `panorama_from_sweep`."""

    sweep: Sweep
    room: Room
    prior: Calibration
    log: StageLog
    papers: PaperRecord

    @property
    def sigmas(self) -> tuple[float, float]:
        """Sigmas of height and tilt of the camera by the robot file, m and rad."""
        height = [NAMES.index(name) for name in HEIGHT]
        rise = float(np.sqrt(self.prior.covariance[np.ix_(height, height)].sum()))
        return rise, float(self.prior.sigmas_from('axis_roll').max())

    def not_exact(self, error: WrongMountError) -> MountError:
        """Return the error of a mount that may be corrected; refuse errors of exact values."""
        found, (rise, tilt) = error.found, self.sigmas
        given = MEASURED.height_sigma_m, MEASURED.horizon_sigma_rad
        high, off_level = found.beyond(*given, WRONG_PRIOR)
        if (high and not rise) or (off_level and not tilt):
            raise LandmarkNavError(f'{error}; robot.yaml gives it as exact (sigma 0)') from error
        return MountError(found.rise_m if rise else 0.0, found.tilt_roll_rad * (tilt > 0.0))

    def made(self, used: Calibration, area: ReferenceAreaConfig, most_sigmas: float) -> Panorama:
        """Panorama by a calibration; errors of height and tilt have a limit, in sigmas."""
        log, room = self.log, self.room
        sweep, mount = as_calibrated(self.sweep, used), used.mount
        try:
            check_turn(sweep, mount)
        except LandmarkNavError as error:
            why = why_seen_otherwise(sweep, room, mount, area)
            raise LandmarkNavError(why or str(error)) from error
        found, photometry, view = _first_view(self.sweep, used, log)

        def placed(
            found: SweepCalibration, area: ReferenceAreaConfig, near: SweepPlace | None = None
        ) -> SweepPlace:
            with log.measure('reference_area'):
                try:
                    return self._place(view, found, area, most_sigmas, near)
                except LandmarkNavError as error:
                    self.papers.add(view, optical_height(found.sweep, found.mount))
                    raise self._explained(error, sweep, mount, area) from error

        # Ranges are unknown in the first view, and with them the parallax of a known offset too.
        off_axis_m = np.hypot(self.prior.sigmas_from('center_x'), mount.optical_center_offset[:2])
        place = placed(found, replace(area, center_sigma_m=float(off_axis_m.max())))

        level = used
        axis_tilt: tuple[CalibrationTerm, ...] = ()
        # Once more if the calibrated camera shows that its axis is tilted.
        for _ in range(2):
            with log.measure('calibration'):
                range_m = _range_of_ray(place, found, room)
                refined = calibrate_sweep(self.sweep, level, range_m, found)
            mount_changed = refined.mount.axis_rpy != found.mount.axis_rpy
            off_axis = any(refined.mount.optical_center_offset[:2])
            if mount_changed or off_axis or moved_px(found, refined) > _SAME_PX:
                with log.measure('panorama'):
                    even = even_out(refined.sweep, photometry)
                    reach_m = _seen_range(place, refined, room)
                    view = synthesize_cylinder(even, refined.mount, reach_m)
            found = refined
            # The posterior, or the prior where the frames show nothing.
            sigmas = {term.name: term.sigma for term in found.quality.calibration}
            forward, left = self.prior.sigmas_from('center_x').tolist()
            center_m = max(sigmas.get('forward', forward), sigmas.get('left', left))
            place = placed(found, replace(area, center_sigma_m=center_m), near=place)
            if level is not used:
                break
            information = place.mount_information + np.diag([area.height_sigma_m**-2, 0.0, 0.0])
            level, axis_tilt = levelled(used, place.mount_score, information)
            if level is used:
                break
        self.papers.add(view, optical_height(found.sweep, found.mount))
        for warning in filter(None, [place.warning, _wrong_lens(found)]):
            _LOG.warning('%s', warning)
        by_calibration, made = _by_calibration(place, found), found.calibration
        shown = place.mount_score, place.mount_information
        known = with_overlaps(self.prior, used, found.fit)
        known = with_papers(known, made, *shown, MEASURED.horizon_sigma_rad)
        panorama = _panorama(sweep, view, found, place, photometry, axis_tilt)
        return replace(
            panorama,
            covariance=panorama.covariance + by_calibration @ known.covariance @ by_calibration.T,
            calibration=replace(known, intrinsics=self.sweep.frames[0].camera.intrinsics),
            made_with=made.values,
            by_calibration=by_calibration,
        )

    def _place(
        self,
        view: CylinderImage,
        found: SweepCalibration,
        area: ReferenceAreaConfig,
        most_sigmas: float,
        near: SweepPlace | None,
    ) -> SweepPlace:
        """
        Pose of a sweep by papers, or the given one if they agree.

        Without a place `near` by the first view, it is a rough one.
        """
        sweep, mount, known = found.sweep, found.mount, found.sweep.pose_map_base
        papers = PaperSearch(sweep, view, self.room, mount, area)
        if known is None:
            return papers.located(most_sigmas, near is None, near)
        plane = np.ix_([0, 1, 3], [0, 1, 3])
        if not np.isfinite(known.pose).all():
            raise LandmarkNavError('sweep/pose is not a number: fix its publisher')
        covariance = np.zeros((4, 4))
        covariance[plane] = checked_covariance(known.covariance, _MOST_SIGMA, 'sweep/pose')
        covariance[plane] += _LEAST_VARIANCE * np.eye(3)
        place = SweepPlace(known.pose, optical_height(sweep, mount), covariance)
        mounted = _by_calibration(place, found)
        uncertain = covariance + mounted @ self.prior.covariance @ mounted.T
        if near is not None:
            papers.check_agreement(known.pose, uncertain[plane])
        covariance[2, 2] = area.height_sigma_m**2
        return place

    def _explained(
        self, error: LandmarkNavError, sweep: Sweep, mount: PanTiltMount, area: ReferenceAreaConfig
    ) -> LandmarkNavError:
        """Return the error with its cause, and with the error of the mount if that is it."""
        # An error that the prior allows is corrected without a search for faults of papers.
        if isinstance(error, WrongMountError) and not any(
            error.found.beyond(*self.sigmas, WRONG_PRIOR)
        ):
            return error
        if why := why_seen_otherwise(sweep, self.room, mount, area):
            return LandmarkNavError(why)
        faults = self.papers.faults()
        wrong = faults.mount
        if isinstance(error, WrongMountError) and not faults.faults:
            wrong = error.found
        cause = faults.cause or str(error)
        return WrongMountError(cause, wrong) if wrong else LandmarkNavError(cause)


def unplaced_panorama(sweep: Sweep, given: Calibration, log: StageLog) -> Panorama:
    """
    Make the panorama of a sweep with unknown pose: it gets the pose of the axis in the base frame.

    Exact values stay, as ranges are unknown. Raises `LandmarkNavError`: the sweep has no frames,
    or the pan does not turn as reported.
    """
    if not sweep.frames:
        raise LandmarkNavError('the sweep has no frames: take it again')
    check_turn(as_calibrated(sweep, given), given.mount)
    found, photometry, view = _first_view(sweep, given, log)
    place = SweepPlace(np.zeros(3), optical_height(found.sweep, found.mount), np.eye(4))
    panorama = _panorama(sweep, view, found, place, photometry)
    return replace(panorama, covariance=place.covariance)


def _first_view(
    sweep: Sweep, used: Calibration, log: StageLog
) -> tuple[SweepCalibration, Photometry, CylinderImage]:
    """Calibrate a sweep without its pose, measure its photometry, and join its frames."""
    with log.measure('calibration'):
        found = calibrate_sweep(sweep, used)
    with log.measure('panorama'):
        photometry = measure_photometry(found.sweep, found.mount)
        range_m = usual_range if any(found.mount.optical_center_offset[:2]) else None
        even = even_out(found.sweep, photometry)
        return found, photometry, synthesize_cylinder(even, found.mount, range_m)


def _panorama(
    sweep: Sweep,
    view: CylinderImage,
    found: SweepCalibration,
    place: SweepPlace,
    photometry: Photometry,
    axis_tilt: tuple[CalibrationTerm, ...] = (),
) -> Panorama:
    """Panorama whose viewpoint is the pan axis at the height of the optical centre."""
    quality = replace(found.quality, calibration=(*found.quality.calibration, *axis_tilt))
    heading, jacobian = place.pose_map_base[2], np.eye(4)
    lever = se2.rotation(heading) @ np.asarray(found.mount.axis_xyz[:2])
    jacobian[0, 3], jacobian[1, 3] = -lever[1], lever[0]
    return Panorama(
        sweep.stamp_ns,
        view.image,
        view.mask,
        view.cylinder,
        _axis(place, found.mount),
        float(heading),
        jacobian @ place.covariance @ jacobian.T,
        quality.of(tenengrad(view), photometry.vignetting, photometry.gain_spread),
    )


def _wrong_lens(found: SweepCalibration) -> str:
    """Warning if the sweep shows a large error of the lens in camera_info; else empty."""
    camera = found.sweep.frames[0].camera
    border_px = camera.fx * np.tan(camera.half_fov_rad) ** 3
    words = []
    for term in found.quality.calibration:
        value = abs(term.value)
        if term.name == 'focal_length' and term.significant and value > _WORTH_REPORTING:
            size = 'small' if term.value > 0.0 else 'large'
            words.append(f'the focal length is {100.0 * value:.1f} % too {size}')
        elif term.name == 'distortion' and term.significant and value * border_px > _BENT_PX:
            words.append(f'k1 is off by {-term.value:+.3f}')
    if not words:
        return ''
    return (
        f'camera_info: {", ".join(words)}, as the sweep shows; it is corrected: '
        'calibrate the camera'
    )


def record_papers(sweep: Sweep, given: Calibration, papers: PaperRecord) -> None:
    """Add the papers in a sweep to a record, without a search for its pose."""
    sweep, mount = as_calibrated(sweep, given), given.mount
    view = synthesize_cylinder(sweep, mount, feathered=True)
    papers.add(view, optical_height(sweep, mount))


def tenengrad(view: CylinderImage) -> float:
    """Mean squared gradient (Sobel, per pixel) of the covered pixels, a measure of sharpness."""
    grey = cv2.cvtColor(view.image, cv2.COLOR_BGR2GRAY)
    across, down = cv2.spatialGradient(grey)
    square = np.square(across, dtype=np.float32) + np.square(down, dtype=np.float32)
    inner = cv2.erode(view.mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    # A Sobel kernel yields eight times the gradient.
    return float(square[inner].mean() / 64.0) if inner.any() else 0.0


def _seen_range(
    place: SweepPlace, found: SweepCalibration, room: Room
) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Return a function for the distance of walls, and of what is not on them, in a panorama."""
    axis, heading = _axis(place, found.mount), place.pose_map_base[2]

    def range_m(azimuth: FloatArray, tangent: FloatArray) -> FloatArray:
        walls = np.minimum(room.raycast(axis[:2], azimuth + heading)[0], FAR_M)
        seen = walls if found.fit is None else found.fit.range_m(walls, azimuth, tangent)
        return np.asarray(np.minimum(seen, FAR_M))

    return range_m


def _range_of_ray(
    place: SweepPlace, found: SweepCalibration, room: Room
) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Return a function for the distance of walls, floor and ceiling at azimuths and tangents."""
    axis, heading = _axis(place, found.mount), place.pose_map_base[2]
    heights = np.array([wall.height for wall in room.walls])

    def range_m(azimuth: FloatArray, tangent: FloatArray) -> FloatArray:
        walls, hit = room.raycast(axis[:2], azimuth + heading)
        above = heights[hit] - axis[2]
        with np.errstate(divide='ignore'):
            level = np.where(tangent > 0.0, above, -axis[2]) / tangent
        return np.asarray(np.clip(np.minimum(walls, level), 0.2, FAR_M))

    return range_m


def _by_calibration(place: SweepPlace, found: SweepCalibration) -> FloatArray:
    """Derivative (4, 17) of the viewpoint by the calibration; 0 if papers locate the camera."""
    jacobian = np.zeros((4, len(NAMES)))
    if found.sweep.pose_map_base is not None:
        jacobian[:2, :2] = se2.rotation(place.pose_map_base[2])
        jacobian[3, NAMES.index('axis_yaw')] = 1.0
        jacobian[2, [NAMES.index(name) for name in HEIGHT]] = 1.0
    return jacobian


def _axis(place: SweepPlace, mount: PanTiltMount) -> FloatArray:
    """Viewpoint of the panorama: the pan axis at the height of the optical centre."""
    axis = mount.axis_pose_map(place.pose_map_base)
    return np.array([axis[0], axis[1], place.height_m])
