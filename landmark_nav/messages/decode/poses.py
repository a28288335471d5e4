"""Odometry, planar poses, results of global localization, detections, triplets, panoramas."""

from __future__ import annotations

from typing import Any

import numpy as np

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import INTRINSICS, PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.messages import clouds
from landmark_nav.messages.clouds import unpack_cloud
from landmark_nav.messages.decode.headers import (
    covariances,
    delays_s,
    finite,
    landmark_ids,
    stamp_ns,
    yaw_rad,
)
from landmark_nav.messages.decode.images import image_bgra
from landmark_nav.types import (
    Detections,
    Expectation,
    FloatArray,
    OdometrySample,
    Panorama,
    PoseEstimate,
    Triplet,
)

# Largest coordinate: half the circumference of the earth, more than any UTM coordinate.
FARTHEST_M = 2.0e7
# Largest speed, metres or radians per second.
_MAX_SPEED = 1.0e3
# Largest value or sigma of a calibration, metres, radians or seconds.
_MAX_CALIBRATION = 100.0


def odometry(msg: Any) -> OdometrySample:
    """
    Wheel odometry of a nav_msgs/Odometry.

    Raises `LandmarkNavError`: a position, heading or speed is not a number or out of bounds.
    """
    stamp, twist = stamp_ns(msg.header), msg.twist.twist
    speeds = [twist.linear.x, twist.angular.z]
    forward, turn = finite(speeds, 'odometry speed', stamp, _MAX_SPEED).tolist()
    return OdometrySample(stamp, _planar(msg.pose.pose, 'odometry', stamp), forward, turn)


def pose_estimate(msg: Any) -> PoseEstimate:
    """
    Planar pose of a geometry_msgs/PoseWithCovarianceStamped or a nav_msgs/Odometry.

    Raises `LandmarkNavError`: a value is not a number or out of bounds.
    """
    stamp = stamp_ns(msg.header)
    pose = _planar(msg.pose.pose, 'pose', stamp)
    return PoseEstimate(stamp, pose, pose_covariance(msg, clouds.PLANAR, 'pose', stamp))


def pose_covariance(msg: Any, axes: tuple[Any, ...], what: str, stamp: int) -> FloatArray:
    """
    Covariance of some axes in a message with a geometry_msgs/PoseWithCovariance.

    `axes` is `PLANAR` or `UPRIGHT`. The other axes may hold anything: 0, 1e6 and the largest
    number all are in use for "unknown".
    """
    what = f'{what} covariance'
    full = finite(msg.pose.covariance, what, stamp, np.inf, count=36)
    (covariance,) = covariances(full.reshape(6, 6)[axes], what, stamp, len(axes[0]))
    return np.asarray(covariance)


def global_pose(msg: Any) -> clouds.GlobalPose:
    """
    Result of global localization, out of ``global_localization/pose``.

    Raises `LandmarkNavError`: fields are missing or of another type, there is no point, or values
    are not numbers.
    """
    points, stamp = unpack_cloud(msg, clouds.GLOBAL_POSE), stamp_ns(msg.header)
    where = 'global_localization/pose'
    if not len(points):
        raise LandmarkNavError(f'{where} at {stamp * 1e-9:.3f} s names no landmark')
    first = points[0]
    return clouds.GlobalPose(
        stamp,
        finite(first['pose'], f'{where} pose', stamp, FARTHEST_M),
        covariances(first['covariance'], f'{where} covariance', stamp, 3)[0],
        landmark_ids(points['id'], where),
        float(finite(first['pan_rate'], f'{where} pan rate', stamp, _MAX_SPEED)),
        *delays_s([first['joint_delay']], f'{where} delay', stamp),
    )


def expectation(msg: Any, mount: PanTiltMount) -> tuple[Expectation, OdometrySample]:
    """
    Expected pose and calibration, and the speeds of the base, out of ``expectation``.

    Raises `LandmarkNavError`: fields are missing or of another type, the number of points is not
    1, or values are not numbers.
    """
    points, stamp = unpack_cloud(msg, clouds.EXPECTATION), stamp_ns(msg.header)
    if len(points) != 1:
        raise LandmarkNavError(f'expectation has {len(points)} points, not 1')
    first = points[0]
    pose = finite(first['pose'], 'expectation pose', stamp, FARTHEST_M)
    sigmas = finite(first['sigmas'], 'calibration sigma', stamp, _MAX_CALIBRATION, least=0.0)
    intrinsics = finite(first['intrinsics'], 'intrinsics', stamp, _MAX_COORDINATE)
    linear, angular = finite(first['speeds'], 'expectation speed', stamp, _MAX_SPEED).tolist()
    expected = Expectation(
        stamp,
        pose,
        covariances(first['covariance'], 'expectation covariance', stamp, 3)[0],
        Calibration(
            finite(first['values'], 'calibration value', stamp, _MAX_CALIBRATION),
            np.diag(sigmas**2),
            mount,
            intrinsics=intrinsics if intrinsics.any() else None,
        ),
        float(finite(first['tilt_sigma'], 'tilt sigma', stamp, _MAX_CALIBRATION, least=0.0)),
    )
    return expected, OdometrySample(stamp, pose, linear, angular)


def _planar(pose: Any, what: str, stamp: int) -> FloatArray:
    position = finite([pose.position.x, pose.position.y], f'{what} position', stamp, FARTHEST_M)
    return np.array([*position, yaw_rad(pose.orientation, f'{what} orientation', stamp)])


# Largest bearing, which may be unwrapped, rad; smallest variance of a bearing, rad^2.
_MAX_BEARING_RAD, _MIN_VARIANCE_RAD2 = 1e4, 1e-14
# Largest normalised image coordinate: a ray 89.9 degrees from the optical axis.
_MAX_COORDINATE = 1e3


def detections(msg: Any) -> Detections:
    """
    Landmarks found in one image, and those missed in it, out of ``detections``.

    Raises `LandmarkNavError`: fields are missing or of another type, or values are not numbers
    within bounds.
    """
    points, stamp = unpack_cloud(msg, clouds.DETECTIONS), stamp_ns(msg.header)
    (delay,) = delays_s(points['joint_delay'][:1].tolist() or [0.0], 'detections delay', stamp)
    # Other sensors may detect a landmark twice at a time.
    landmark_ids(points['id'], 'detections', unique=False)
    missed = np.isnan(points['bearing']) & np.isnan(points['bearing_variance'])
    found = points[~missed]
    point_covariance = covariances(found['point_covariance'], 'covariance of a point', stamp, 2)
    # A sensor that measures bearings only publishes no points.
    has_points = bool((np.diagonal(point_covariance, axis1=1, axis2=2) > 0.0).all())
    image_points = finite(found['point'], 'detections point', stamp, _MAX_COORDINATE)
    sizes = finite(found['size'], 'detections size', stamp, _MAX_COORDINATE, least=0.0)
    by_lens = finite(found['by_lens'], 'detections by_lens', stamp, _MAX_COORDINATE)
    common = points[:1] if len(points) else np.zeros(1, clouds.DETECTIONS.fields)
    near = finite(common['near'][0], 'near', stamp, FARTHEST_M)
    intrinsics = finite(common['intrinsics'][0], 'intrinsics', stamp, _MAX_COORDINATE)
    return Detections(
        stamp,
        found['id'],
        finite(found['bearing'], 'bearing', stamp, _MAX_BEARING_RAD),
        finite(found['bearing_variance'], 'bearing variance', stamp, least=_MIN_VARIANCE_RAD2),
        finite(found['score'], 'detections score', stamp),
        finite(np.stack([found['u'], found['v']], -1), 'detections pixel', stamp),
        points['id'][missed],
        joint_delay_s=delay,
        points=image_points if has_points else image_points[:0],
        point_covariance=point_covariance if has_points else point_covariance[:0],
        sizes=sizes if has_points else sizes[:0],
        by_lens=by_lens.reshape(-1, 2, 3) if has_points and by_lens.any() else None,
        near=near if near.any() else None,
        intrinsics=intrinsics if intrinsics.any() else None,
    )


def triplet(msg: Any) -> Triplet:
    """
    The chosen landmarks, out of ``triplet``.

    Raises `LandmarkNavError`: fields are missing or of another type, the number of points is not
    3, or values are not numbers.
    """
    points, stamp = unpack_cloud(msg, clouds.TRIPLET), stamp_ns(msg.header)
    if len(points) != 3:
        raise LandmarkNavError(f'triplet has {len(points)} points, not 3')
    return Triplet(
        stamp,
        landmark_ids(points['id'], 'triplet'),
        finite(points['bearing'], 'triplet bearing', stamp, _MAX_BEARING_RAD),
        finite(points['bearing_sigma'], 'triplet sigma', stamp, least=0.0),
        covariances(points['covariance'][0], 'triplet covariance', stamp, 3)[0],
        float(finite(points['pan'][0], 'triplet pan', stamp, _MAX_BEARING_RAD)),
    )


# Largest focal length or principal point.
_MAX_PX = 1e6


def panorama(image_msg: Any, info_msg: Any, pose_msg: Any) -> Panorama:
    """
    Panorama out of ``panorama/image``, ``panorama/camera_info`` and ``panorama/pose``.

    Raises `LandmarkNavError`: the three do not belong together, or the geometry is not
    cylindrical.
    """
    stamp = stamp_ns(image_msg.header)
    others = (stamp_ns(info_msg.header), stamp_ns(pose_msg.header))
    if others != (stamp, stamp):
        raise LandmarkNavError(
            f'panorama image of {stamp * 1e-9:.3f} s comes with geometry of '
            f'{others[0] * 1e-9:.3f} s and a pose of {others[1] * 1e-9:.3f} s'
        )
    if info_msg.distortion_model != 'cylindrical':
        raise LandmarkNavError(
            f'panorama has the camera model {info_msg.distortion_model!r:.60}, not cylindrical'
        )
    k = finite(info_msg.k, 'panorama geometry', stamp, _MAX_PX, count=9)
    cylinder = Cylinder(int(info_msg.width), int(info_msg.height), k[4], k[2], k[5])
    if cylinder.fy <= 0.0 or abs(k[0] - cylinder.fx) > 1e-6 * cylinder.fx:
        raise LandmarkNavError(
            f'panorama of {cylinder.width} columns has {k[0]:g} px/rad: it must span one turn '
            f'({cylinder.fx:g} px/rad)'
        )
    pixels = image_bgra(image_msg)
    if pixels.shape[:2] != (cylinder.height, cylinder.width):
        raise LandmarkNavError(
            f'panorama image is {pixels.shape[1]} x {pixels.shape[0]}, its geometry '
            f'{cylinder.width} x {cylinder.height}'
        )
    n = len(NAMES)
    calibrated = finite(info_msg.d, 'panorama calibration', stamp, _MAX_COORDINATE)
    count = n * (n + 6) + INTRINSICS
    if len(calibrated) not in (0, count):
        raise LandmarkNavError(
            f'panorama has a calibration of {len(calibrated)} numbers, not {count}: use one '
            'release of landmark_nav'
        )
    calibration = made_with = by_calibration = None
    if len(calibrated):
        parts = np.split(calibrated, np.cumsum([n, n * n, INTRINSICS, n]))
        values, matrix, intrinsics, made_with, derivatives = parts
        covariance = covariances(matrix, 'covariance of the panorama calibration', stamp, n)[0]
        lens = intrinsics if intrinsics.any() else None
        calibration = Calibration(values, covariance, intrinsics=lens)
        by_calibration = derivatives.reshape(4, n)
    pose = pose_msg.pose.pose
    position = (pose.position.x, pose.position.y, pose.position.z)
    return Panorama(
        stamp,
        np.ascontiguousarray(pixels[..., :3]),
        pixels[..., 3] > 0,
        cylinder,
        finite(position, 'panorama position', stamp, FARTHEST_M),
        yaw_rad(pose.orientation, 'panorama orientation', stamp),
        pose_covariance(pose_msg, clouds.UPRIGHT, 'panorama', stamp),
        calibration=calibration,
        made_with=made_with,
        by_calibration=by_calibration,
    )
