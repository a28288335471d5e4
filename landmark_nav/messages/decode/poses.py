"""Odometry, planar poses, results of global localization, detections, triplets, panoramas."""

from __future__ import annotations

from typing import Any

import numpy as np

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.errors import inside, LandmarkNavError
from landmark_nav.geometry.camera import INTRINSICS, PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.messages import clouds
from landmark_nav.messages.decode.headers import (
    covariances,
    finite,
    nonzero,
    Points,
    stamp_ns,
    yaw_rad,
)
from landmark_nav.messages.decode.images import image_bgra
from landmark_nav.messages.factory import PLANAR, UPRIGHT
from landmark_nav.types import (
    Detections,
    Expectation,
    FloatArray,
    OdometrySample,
    Panorama,
    PoseEstimate,
    Triplet,
)

# Largest coordinate, m, and speed, m/s or rad/s, as in `clouds`.
_FARTHEST_M, _MAX_SPEED = 2.0e7, 1.0e3
# Largest focal length or principal point, and largest number of a calibration.
_MAX_PX, _MAX_CALIBRATION = 1e6, 1e3


def odometry(msg: Any) -> OdometrySample:
    """Wheel odometry of a nav_msgs/Odometry."""
    stamp, twist = stamp_ns(msg.header), msg.twist.twist
    speeds = [twist.linear.x, twist.angular.z]
    forward, turn = finite(speeds, 'odometry speed', stamp, _MAX_SPEED).tolist()
    return OdometrySample(stamp, _planar(msg.pose.pose, 'odometry', stamp), forward, turn)


def pose_estimate(msg: Any) -> PoseEstimate:
    """Planar pose of a geometry_msgs/PoseWithCovarianceStamped or a nav_msgs/Odometry."""
    stamp = stamp_ns(msg.header)
    pose = _planar(msg.pose.pose, 'pose', stamp)
    return PoseEstimate(stamp, pose, _covariance(msg, PLANAR, 'pose covariance', stamp))


def _covariance(msg: Any, axes: tuple[Any, ...], what: str, stamp: int) -> FloatArray:
    """Covariance of some axes; others may hold 0, 1e6 or the largest number for "unknown"."""
    full = finite(msg.pose.covariance, what, stamp, np.inf, count=36).reshape(6, 6)
    return np.asarray(covariances(full[axes], what, stamp, len(axes[0]))[0])


def _planar(pose: Any, what: str, stamp: int) -> FloatArray:
    position = finite([pose.position.x, pose.position.y], f'{what} position', stamp, _FARTHEST_M)
    return np.array([*position, yaw_rad(pose.orientation, f'{what} orientation', stamp)])


def global_pose(msg: Any) -> clouds.GlobalPose:
    """Result of global localization, out of ``global_localization/pose``."""
    points = Points(msg, clouds.GLOBAL_POSE)
    if not len(points):
        raise LandmarkNavError(f'{points.layout.topic} names no landmark')
    return clouds.GlobalPose(points.stamp, ids=points.ids(), **points.common())


def expectation(msg: Any, mount: PanTiltMount) -> tuple[Expectation, OdometrySample]:
    """Expected pose and calibration, and the speeds of the base, out of ``expectation``."""
    points = Points(msg, clouds.EXPECTATION)
    if len(points) != 1:
        raise LandmarkNavError(f'expectation has {len(points)} points, not 1')
    values, sigmas, intrinsics = (points(k)[0] for k in ('values', 'sigmas', 'intrinsics'))
    known = Calibration(values, np.diag(sigmas**2), mount, intrinsics=nonzero(intrinsics))
    pose, tilt_sigma = points('pose')[0], float(points('tilt_sigma')[0])
    linear, turn_rate = points('speeds')[0].tolist()
    covariance = points('covariance')[0]
    expected = Expectation(points.stamp, pose, covariance, known, tilt_sigma, turn_rate)
    return expected, OdometrySample(points.stamp, pose, linear, turn_rate)


def detections(msg: Any) -> Detections:
    """Landmarks found in one image, and those missed in it, out of ``detections``."""
    points = Points(msg, clouds.DETECTIONS)
    # Other sensors may detect a landmark twice at a time.
    ids = points.ids(unique=False)
    missed = np.isnan(points.raw['bearing']) & np.isnan(points.raw['bearing_variance'])
    found = ~missed
    covariance = points('point_covariance', rows=found)
    # A sensor that measures bearings only publishes no points.
    has_points = bool((np.diagonal(covariance, axis1=1, axis2=2) > 0.0).all())
    of_points = slice(None if has_points else 0)
    by_lens = points('by_lens', rows=found)[of_points].reshape(-1, 2, 3)
    common = points.common()
    return Detections(
        points.stamp,
        ids[found],
        points('bearing', rows=found),
        points('bearing_variance', rows=found),
        points('score', rows=found),
        points('u', 'v', rows=found),
        ids[missed],
        joint_delay_s=common['joint_delay_s'],
        points=points('point', rows=found)[of_points],
        point_covariance=covariance[of_points],
        sizes=points('size', rows=found)[of_points],
        by_lens=nonzero(by_lens),
        below=points('below', rows=found) if has_points else None,
        near=nonzero(common['near']),
        intrinsics=nonzero(common['intrinsics']),
    )


def triplet(msg: Any) -> Triplet:
    """The chosen landmarks, out of ``triplet``."""
    points = Points(msg, clouds.TRIPLET)
    if len(points) != 3:
        raise LandmarkNavError(f'triplet has {len(points)} points, not 3')
    bearings, sigmas = points('bearing'), points('bearing_sigma')
    return Triplet(points.stamp, points.ids(), bearings, sigmas, **points.common())


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
    pose = pose_msg.pose.pose
    position = (pose.position.x, pose.position.y, pose.position.z)
    calibration, made_with, by_calibration = _calibration(info_msg.d, stamp)
    return Panorama(
        stamp,
        np.ascontiguousarray(pixels[..., :3]),
        pixels[..., 3] > 0,
        cylinder,
        finite(position, 'panorama position', stamp, _FARTHEST_M),
        yaw_rad(pose.orientation, 'panorama orientation', stamp),
        _covariance(pose_msg, UPRIGHT, 'panorama covariance', stamp),
        calibration=calibration,
        made_with=made_with,
        by_calibration=by_calibration,
    )


def _calibration(
    numbers: Any, stamp: int
) -> tuple[Calibration | None, FloatArray | None, FloatArray | None]:
    """Calibration after a sweep, values that made its panorama, derivatives of its pose."""
    flat, n = finite(numbers, 'panorama calibration', stamp, _MAX_CALIBRATION), len(NAMES)
    if not len(flat):
        return None, None, None
    count = n * (n + 6) + INTRINSICS
    if len(flat) != count:
        raise LandmarkNavError(
            f'panorama has a calibration of {len(flat)} numbers, not {count}: use one release of '
            'landmark_nav'
        )
    parts = np.split(flat, np.cumsum([n, n * n, INTRINSICS, n]))
    values, matrix, intrinsics, made_with, derivatives = parts
    covariance = covariances(matrix, 'covariance of the panorama calibration', stamp, n)[0]
    with inside('panorama'):
        known = Calibration(values, covariance, intrinsics=nonzero(intrinsics))
    return known, made_with, derivatives.reshape(4, n)
