"""Odometry, poses in the plane, places that were found, detections, triplets, panoramas."""

from __future__ import annotations

from typing import Any

import numpy as np

from landmark_nav.calibration import Calibration
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.messages.clouds import unpack_cloud
from landmark_nav.messages.decode.headers import (
    covariances,
    finite,
    landmark_ids,
    seconds,
    stamp_ns,
    yaw_rad,
)
from landmark_nav.messages.decode.images import image_bgra
from landmark_nav.messages.layouts import (
    DETECTIONS,
    EXPECTATION,
    GLOBAL_POSE,
    GlobalPose,
    PLANAR,
    TRIPLET,
    UPRIGHT,
)
from landmark_nav.types import (
    Detections,
    Expectation,
    FloatArray,
    OdometrySample,
    Panorama,
    PoseEstimate,
    Triplet,
)

# Half around the earth, m: in UTM coordinates, too, a robot is nearer to their origin.
FARTHEST_M = 2.0e7
# Metres or radians per second.
_FASTEST = 1.0e3
# Beyond this, metres, radians or seconds, is no value or sigma of a calibration.
_MOST_OFF = 100.0


def odometry(msg: Any) -> OdometrySample:
    """
    Wheel odometry of a nav_msgs/Odometry.

    Raises `LandmarkNavError`: a value is not a number, or no place, heading or speed of a robot.
    """
    stamp, twist = stamp_ns(msg.header), msg.twist.twist
    speeds = [twist.linear.x, twist.angular.z]
    forward, turn = finite(speeds, 'odometry speed', stamp, _FASTEST).tolist()
    return OdometrySample(stamp, _planar(msg.pose.pose, 'odometry', stamp), forward, turn)


def pose_estimate(msg: Any) -> PoseEstimate:
    """
    Planar pose of a geometry_msgs/PoseWithCovarianceStamped or a nav_msgs/Odometry.

    Raises `LandmarkNavError`: a value is not a number, or no place or heading of a robot.
    """
    stamp = stamp_ns(msg.header)
    pose = _planar(msg.pose.pose, 'pose', stamp)
    return PoseEstimate(stamp, pose, pose_covariance(msg, PLANAR, 'pose', stamp))


def pose_covariance(msg: Any, axes: tuple[Any, ...], what: str, stamp: int) -> FloatArray:
    """
    Covariance of some axes, a layout, out of a message with a geometry_msgs/PoseWithCovariance.

    Of the others anything may be given: 0, 1e6 and the largest number all stand for "unknown".
    """
    what = f'{what} covariance'
    full = finite(msg.pose.covariance, what, stamp, np.inf, count=36)
    (covariance,) = covariances(full.reshape(6, 6)[axes], what, stamp, len(axes[0]))
    return np.asarray(covariance)


def global_pose(msg: Any) -> GlobalPose:
    """
    A place and what it was found from, out of ``global_localization/pose``.

    Raises `LandmarkNavError`: fields are missing or of another kind, no point, or values that are
    not numbers.
    """
    points, stamp = unpack_cloud(msg, GLOBAL_POSE), stamp_ns(msg.header)
    if not len(points):
        raise LandmarkNavError(
            f'global_localization/pose at {stamp * 1e-9:.3f} s names no landmark'
        )
    first = points[0]
    return GlobalPose(
        stamp,
        finite(first['pose'], 'global_localization/pose pose', stamp, FARTHEST_M),
        covariances(first['covariance'], 'global_localization/pose covariance', stamp, 3)[0],
        landmark_ids(points['id'], 'global_localization/pose'),
        float(finite(first['pan_rate'], 'global_localization/pose pan rate', stamp, _FASTEST)),
        *seconds([first['joint_delay']], 'global_localization/pose delay', stamp),
    )


def expectation(msg: Any, mount: PanTiltMount) -> tuple[Expectation, OdometrySample]:
    """
    Where the camera should be, and the speeds of the base, out of ``expectation``.

    Raises `LandmarkNavError`: fields are missing or of another kind, not one point, or values that
    are not numbers.
    """
    points, stamp = unpack_cloud(msg, EXPECTATION), stamp_ns(msg.header)
    if len(points) != 1:
        raise LandmarkNavError(f'expectation has {len(points)} points, not 1')
    first = points[0]
    pose = finite(first['pose'], 'expectation pose', stamp, FARTHEST_M)
    sigmas = finite(first['sigmas'], 'calibration sigma', stamp, _MOST_OFF, least=0.0)
    linear, angular = finite(first['speeds'], 'expectation speed', stamp, _FASTEST).tolist()
    expected = Expectation(
        stamp,
        pose,
        covariances(first['covariance'], 'expectation covariance', stamp, 3)[0],
        Calibration(
            finite(first['values'], 'calibration value', stamp, _MOST_OFF),
            np.diag(sigmas**2),
            mount,
        ),
        float(finite(first['tilt_sigma'], 'tilt sigma', stamp, _MOST_OFF, least=0.0)),
    )
    return expected, OdometrySample(stamp, pose, linear, angular)


def _planar(pose: Any, what: str, stamp: int) -> FloatArray:
    position = finite([pose.position.x, pose.position.y], f'{what} position', stamp, FARTHEST_M)
    return np.array([*position, yaw_rad(pose.orientation, f'{what} orientation', stamp)])


# Bearings may be unwrapped. No sensor is as exact as the root of this, rad.
_MOST_RAD, _LEAST_VARIANCE = 1e4, 1e-14
# Nothing is seen 89.9 degrees aside.
_FARTHEST = 1e3


def detections(msg: Any) -> Detections:
    """
    Landmarks found in one image, and those missed in it, out of ``detections``.

    Raises `LandmarkNavError`: fields are missing or of another kind, or values are not numbers
    within bounds.
    """
    points, stamp = unpack_cloud(msg, DETECTIONS), stamp_ns(msg.header)
    (delay,) = seconds(points['joint_delay'][:1].tolist() or [0.0], 'detections delay', stamp)
    # Other sensors may see a landmark twice at a time.
    landmark_ids(points['id'], 'detections', unique=False)
    missed = np.isnan(points['bearing']) & np.isnan(points['bearing_variance'])
    found = points[~missed]
    spread = covariances(found['point_covariance'], 'covariance of a point', stamp, 2)
    # Who measures bearings alone has no image.
    of_image = bool((np.diagonal(spread, axis1=1, axis2=2) > 0.0).all())
    places = finite(found['point'], 'detections point', stamp, _FARTHEST)
    near = finite(points['near'][0] if len(points) else np.zeros(3), 'near', stamp, FARTHEST_M)
    return Detections(
        stamp,
        found['id'],
        finite(found['bearing'], 'bearing', stamp, _MOST_RAD),
        finite(found['bearing_variance'], 'bearing variance', stamp, least=_LEAST_VARIANCE),
        finite(found['score'], 'detections score', stamp),
        finite(np.stack([found['u'], found['v']], -1), 'detections pixel', stamp),
        points['id'][missed],
        joint_delay_s=delay,
        points=places if of_image else places[:0],
        point_covariance=spread if of_image else spread[:0],
        near=near if near.any() else None,
    )


def triplet(msg: Any) -> Triplet:
    """
    The chosen three, out of ``triplet``.

    Raises `LandmarkNavError`: fields are missing or of another kind, not three points, or values
    that are not numbers.
    """
    points, stamp = unpack_cloud(msg, TRIPLET), stamp_ns(msg.header)
    if len(points) != 3:
        raise LandmarkNavError(f'triplet has {len(points)} points, not 3')
    return Triplet(
        stamp,
        landmark_ids(points['id'], 'triplet'),
        finite(points['bearing'], 'triplet bearing', stamp, _MOST_RAD),
        finite(points['bearing_sigma'], 'triplet sigma', stamp, least=0.0),
        covariances(points['covariance'][0], 'triplet covariance', stamp, 3)[0],
        float(finite(points['pan'][0], 'triplet pan', stamp, _MOST_RAD)),
    )


# Of a focal length or a principal point.
_MOST_PX = 1e6


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
    k = finite(info_msg.k, 'panorama geometry', stamp, _MOST_PX, count=9)
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
    return Panorama(
        stamp,
        np.ascontiguousarray(pixels[..., :3]),
        pixels[..., 3] > 0,
        cylinder,
        finite(position, 'panorama position', stamp, FARTHEST_M),
        yaw_rad(pose.orientation, 'panorama orientation', stamp),
        pose_covariance(pose_msg, UPRIGHT, 'panorama', stamp),
    )
