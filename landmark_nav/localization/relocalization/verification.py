"""Verification of a pose hypothesis by the landmarks that should be visible from there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.detection.correlation import detect_blurred
from landmark_nav.localization.detection.expectation import DetectionConfig, View
from landmark_nav.localization.detection.rows import RowResiduals
from landmark_nav.localization.image_stages import ImageStagesConfig
from landmark_nav.localization.triangulation.model import axis_from_base, base_from_axis, Fix
from landmark_nav.localization.triangulation.robust import triangulate
from landmark_nav.localization.triplet.visibility import visible_landmarks
from landmark_nav.types import CameraFrame, FloatArray, LandmarkMap, PoseEstimate, Refusal

# With fewer matches a wrong height cannot be distinguished from a wrong tilt.
_LEAST_HEIGHTS = 3
# Larger rolls than this are not caused by an uneven floor, rad.
_TILTED_RAD = 0.005
# Sigma of an unknown tilt and roll, rad.
_ANY_RAD = 0.1
# A roll is certain if it exceeds a number of sigmas, has a least number of matches and a least
# share of all, and stays certain without those within any circle of this radius: a poster may have
# been moved.
_SURE, _LEAST_SURE, _CAMERA_TILT_MOST, _NEAR_M = 3.0, 4, 0.6, 0.5


class CameraTilt(NamedTuple):
    """
    Correction of the camera's tilt (upwards) and roll (to its right), rad.

    `matches` is the number of matches that support it, without wrong heights; `roll_sigma_rad` is
    the sigma of the roll; `sure` is whether the roll is certain, also without any one object on a
    wall.
    """

    tilt_rad: float = 0.0
    roll_rad: float = 0.0
    roll_sigma_rad: float = np.inf
    matches: int = 0
    sure: bool = False

    @property
    def is_roll(self) -> bool:
        """Whether there is certainly a roll, and more than an uneven floor causes."""
        return self.sure and abs(self.roll_rad) > _TILTED_RAD


def estimate_camera_tilt(heights: RowResiduals) -> CameraTilt:
    """Estimate unknown tilt and roll of a camera from the rows of matches."""
    fits = ~heights.wrong(_ANY_RAD)
    count = int(fits.sum())
    if count < _LEAST_HEIGHTS:
        return CameraTilt()
    off_px, by_tilt_roll, covariance, points = heights.chosen(fits)
    inverse = np.linalg.inv(covariance)
    weighted = inverse @ by_tilt_roll
    information, projected = by_tilt_roll.T @ weighted + np.eye(2) / _ANY_RAD**2, off_px @ weighted
    (tilt, roll), sigma = _solved(information, projected)
    sure = count >= max(_LEAST_SURE, _CAMERA_TILT_MOST * len(fits)) and abs(roll) > _SURE * sigma
    if sure:
        near = np.linalg.norm(points[:, None] - points, axis=-1) < _NEAR_M
        for out in np.unique(near, axis=0):
            # Least squares without some rows are a low-rank change of those with all.
            less = np.linalg.solve(inverse[np.ix_(out, out)], weighted[out]).T
            (_, without), sigma_without = _solved(
                information - less @ weighted[out], projected - less @ (inverse @ off_px)[out]
            )
            sure &= bool(without * np.sign(roll) > _SURE * sigma_without)
    return CameraTilt(float(tilt), float(roll), float(sigma), count, sure)


def _solved(information: FloatArray, projected: FloatArray) -> tuple[FloatArray, float]:
    """Least-squares tilt and roll (2,), and the sigma of the roll."""
    spread = np.linalg.inv(information)
    return spread @ projected, float(np.sqrt(spread[1, 1]))


# Number of images in which a landmark is searched: those that show it nearest to their middle.
_VIEWS = 2
# Sigmas (m, m, rad) of a hypothesis, and of the first fix found from it.
_SIGMAS = ((0.08, 0.08, 0.025), (0.02, 0.02, 0.008))
# Share of the expected landmarks that must agree on a tilt; largest vertical sigma of its search.
_MOST, _TALLEST_PX = 0.4, 50.0
# Iterations, as virtual landmarks depend on the heading.
_HEADING_PASSES = 3


@dataclass(frozen=True, eq=False)
class CarriedFrames:
    """
    Images with the poses of the base by odometry.

    `poses_last_base` (n, 3) are in the base frame at `stamp_ns`; `variances` (n, 3) are those
    along, across and of the heading.
    """

    stamp_ns: int
    frames: Sequence[CameraFrame]
    poses_last_base: FloatArray
    variances: FloatArray

    def levelled(self, camera_tilt: CameraTilt) -> CarriedFrames:
        """Return the images with corrected tilt and roll of the camera."""
        tilt, roll, *_ = camera_tilt
        return replace(
            self,
            frames=[
                replace(frame, tilt_rad=frame.tilt_rad + tilt, roll_rad=frame.roll_rad + roll)
                for frame in self.frames
            ],
        )


@dataclass(frozen=True, eq=False)
class Verification:
    """
    A verified hypothesis.

    `ids` (n,) are the landmarks found, `bearing_rad` (n,) their bearings at the estimated pose,
    `sigma_without_m` (n,) the position sigma of the pan axis (root of the trace) without each of
    them. `expected` is the number of landmarks that should have been found.
    """

    estimate: PoseEstimate
    ids: npt.NDArray[np.int64]
    bearing_rad: FloatArray
    sigma_without_m: FloatArray
    expected: int

    @property
    def share(self) -> float:
        """Share of the expected landmarks that were found."""
        return len(self.ids) / self.expected


class _Bearings(NamedTuple):
    """Bearings of landmarks (columns of the map), each from one of the frames."""

    landmark: npt.NDArray[np.intp]
    frame: npt.NDArray[np.intp]
    bearing: FloatArray
    variance: FloatArray


@dataclass(frozen=True, eq=False)
class PlaceVerifier:
    """
    Verifies poses by the landmarks of a map.

    `tilt_sigma_rad` is the sigma of tilt and roll of the camera; a small roll is found with 0 too.
    """

    landmark_map: LandmarkMap
    mount: PanTiltMount
    stages: ImageStagesConfig
    tilt_sigma_rad: float = 0.0

    def verify(self, pose_map_base: FloatArray, carried: CarriedFrames) -> Verification | Refusal:
        """
        Search all landmarks that should be visible from a pose, and triangulate from those found.

        The hypothesis, (3,), is the pose of the base at the common time, within about 10 cm and
        2 degrees. A tilt and roll common to all images are estimated from the rows of the matches.
        """
        estimate = PoseEstimate(carried.stamp_ns, pose_map_base, np.zeros((3, 3)))
        detection = self.stages.detection
        if self.tilt_sigma_rad:
            prior = replace(estimate, covariance=np.diag(np.square(_SIGMAS[0])))
            height_px = min(self.tilt_sigma_rad * carried.frames[0].camera.fy, _TALLEST_PX)
            tall = replace(detection, vertical_sigma_px=height_px)
            _, expected, heights = self._look(prior, carried, tall)
            camera_tilt = estimate_camera_tilt(heights)
            if (matches := camera_tilt.matches) < _MOST * expected:
                return Refusal('no tilt', f'{matches} of {expected} landmarks agree on one')
            if not camera_tilt.is_roll:
                camera_tilt = camera_tilt._replace(roll_rad=0.0)
            carried = carried.levelled(camera_tilt)
        for sigmas in _SIGMAS:
            prior = replace(estimate, covariance=np.diag(np.square(sigmas)))
            found, expected, heights = self._look(prior, carried, detection)
            if (camera_tilt := estimate_camera_tilt(heights)).is_roll:
                carried = carried.levelled(camera_tilt)
                found, expected, _ = self._look(prior, carried, detection)
            fix = self._solve(found, prior, carried)
            if isinstance(fix, Refusal):
                return fix
            estimate = base_from_axis(fix.at(carried.stamp_ns), self.mount)
        assert isinstance(fix, Fix)
        seen = found.landmark[fix.used]
        landmark = np.unique(seen)
        bearing = se2.bearings(fix.pose, self.landmark_map.positions[landmark, :2])
        without = np.array([fix.covariance_without(seen == one) for one in landmark])
        sigma = np.sqrt(without[:, 0, 0] + without[:, 1, 1])
        return Verification(estimate, self.landmark_map.ids[landmark], bearing, sigma, expected)

    def _look(
        self, prior: PoseEstimate, carried: CarriedFrames, detection: DetectionConfig
    ) -> tuple[_Bearings, int, RowResiduals]:
        """Return the bearings found, the number of expected landmarks, and the rows of matches."""
        landmark_map, mount = self.landmark_map, self.mount
        poses = se2.compose(prior.pose, carried.poses_last_base)
        views, expected = [], []
        for k, (frame, pose, drift) in enumerate(
            zip(carried.frames, poses, carried.variances, strict=True)
        ):
            here = PoseEstimate(frame.stamp_ns, pose, prior.covariance + np.diag(drift))
            views.append(View(frame, here, mount))
            pan, tilt = frame.pan_rad, frame.tilt_rad
            index = visible_landmarks(
                here, landmark_map, frame.camera, mount, pan, tilt, self.stages.triplet
            )
            axis = axis_from_base(here, mount).pose
            turn, _ = mount.camera_pose_base(pan, tilt)
            offset = landmark_map.positions[index, :2] - axis[:2]
            middle = axis[2] + np.arctan2(turn[1, 2], turn[0, 2])
            aside = np.abs(wrap_rad(np.arctan2(offset[:, 1], offset[:, 0]) - middle))
            expected.append((index, np.full(len(index), k), aside))
        landmark, of_frame, aside = map(np.concatenate, zip(*expected, strict=True))
        order = np.lexsort((aside, landmark))
        landmark, of_frame = landmark[order], of_frame[order]
        best = np.arange(len(order)) - np.searchsorted(landmark, landmark) < _VIEWS
        parts, heights, blur = [], [], np.zeros(2)
        for k, view in enumerate(views):
            index = landmark[best & (of_frame == k)]
            result, blur = detect_blurred(view, landmark_map, detection, index, blur)
            heights.append(result.heights)
            seen = result.detections
            where = landmark_map.indices(seen.ids)
            parts.append((where, np.full(len(seen), k), seen.bearing_rad, seen.variance_rad2))
        found = _Bearings(*map(np.concatenate, zip(*parts, strict=True)))
        return found, len(np.unique(landmark)), RowResiduals.joined(heights)

    def _solve(
        self, found: _Bearings, prior: PoseEstimate, carried: CarriedFrames
    ) -> Fix | Refusal:
        """Triangulate the pan axis at the last image from bearings taken at different places."""
        # A bearing from an earlier pose is one to a virtual landmark, shifted by the motion of the
        # axis since then (Font-Llagunes and Batlle, Consistent triangulation, RAS 57(9), 2009).
        axis = np.array([*self.mount.axis_xyz[:2], 0.0])
        moved = se2.relative(axis, se2.compose(carried.poses_last_base, axis))[found.frame]
        position = self.landmark_map.positions[found.landmark, :2]
        start = axis_from_base(prior, self.mount)
        covariance = self.landmark_map.joint_covariance_of(found.landmark)
        covariance += _drift(position - start.pose[:2], carried.variances[found.frame])
        heading = float(start.pose[2])
        for _ in range(_HEADING_PASSES):
            fix = triangulate(
                position - moved[:, :2] @ se2.rotation(heading).T,
                wrap_rad(found.bearing + moved[:, 2]),
                found.variance + self.mount.pan_sigma_rad**2,
                covariance,
                start=start,
                config=self.stages.triangulation,
            )
            if isinstance(fix, Refusal) or not moved.any():
                return fix
            heading = float(fix.pose[2])
        return fix


def _drift(sight: FloatArray, variances: FloatArray) -> FloatArray:
    """Covariance (2n, 2n) of virtual landmarks at `sight` (n, 2) by the errors of odometry."""
    # They accumulate from the last image backwards, so two bearings share those of the later one.
    # An error of the turn moves a landmark across the line of sight.
    across = np.stack([-sight[:, 1], sight[:, 0]], -1).reshape(-1)
    turn = np.minimum.outer(variances[:, 2], variances[:, 2])
    way = variances[:, :2].max(axis=1)
    by_turn = np.repeat(np.repeat(turn, 2, axis=0), 2, axis=1) * np.outer(across, across)
    return np.asarray(by_turn + np.kron(np.minimum.outer(way, way), np.eye(2)))
