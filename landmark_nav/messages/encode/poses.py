"""Images, panoramas, poses, odometry, transforms, detections, triplets, joints."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from landmark_nav.geometry.camera import CameraModel, INTRINSICS, PanTiltMount
from landmark_nav.geometry.se2 import rot_y, rot_z, rotation_rpy
from landmark_nav.image_codec import encode_image
from landmark_nav.messages import clouds
from landmark_nav.messages.clouds import pack_cloud
from landmark_nav.messages.factory import (
    header,
    MessageFactory,
    PLANAR,
    pose_with_covariance,
    time_message,
    UNKNOWN_VARIANCE,
    UPRIGHT,
    upright,
    vector,
)
from landmark_nav.types import (
    Detections,
    Expectation,
    FloatArray,
    ImageArray,
    JointSample,
    OdometrySample,
    Panorama,
    PoseEstimate,
    Triplet,
)


def image(factory: MessageFactory, pixels: ImageArray, stamp_ns: int, frame_id: str) -> Any:
    """Build a sensor_msgs/Image of grey (h, w), BGR (h, w, 3) or BGRA (h, w, 4)."""
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    height, width = pixels.shape[:2]
    return factory(
        'sensor_msgs/msg/Image',
        header=header(factory, stamp_ns, frame_id),
        height=height,
        width=width,
        encoding={1: 'mono8', 3: 'bgr8', 4: 'bgra8'}[channels],
        is_bigendian=0,
        step=width * channels,
        data=np.ascontiguousarray(pixels).reshape(-1),
    )


def compressed_image(
    factory: MessageFactory,
    pixels: ImageArray,
    stamp_ns: int,
    frame_id: str,
    jpeg_quality: int = 90,
) -> Any:
    """Build a sensor_msgs/CompressedImage (JPEG) of grey (h, w) or BGR (h, w, 3)."""
    return factory(
        'sensor_msgs/msg/CompressedImage',
        header=header(factory, stamp_ns, frame_id),
        format='jpeg',
        data=encode_image(pixels, '.jpg', [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]),
    )


def camera_info(factory: MessageFactory, camera: CameraModel, stamp_ns: int, frame_id: str) -> Any:
    """Build a sensor_msgs/CameraInfo."""
    return factory(
        'sensor_msgs/msg/CameraInfo',
        header=header(factory, stamp_ns, frame_id),
        width=camera.width,
        height=camera.height,
        distortion_model=camera.model,
        d=camera.coefficients,
        k=camera.matrix.reshape(-1),
        r=np.eye(3).reshape(-1),
        p=np.hstack([camera.matrix, np.zeros((3, 1))]).reshape(-1),
    )


def panorama(
    factory: MessageFactory, view: Panorama, frame_id: str = 'map'
) -> tuple[Any, Any, Any]:
    """
    Build ``panorama/image`` (alpha is the mask), ``panorama/camera_info`` and ``panorama/pose``.

    The pose is that of the optical centre with the orientation of the base. `d` of camera_info
    holds values, covariance and intrinsics of the calibration, `made_with` and `by_calibration`.
    """
    alpha = np.where(view.mask, np.uint8(255), np.uint8(0))
    stamp = header(factory, view.stamp_ns, frame_id)
    cylinder, known, calibrated = view.cylinder, view.calibration, np.zeros(0)
    if known is not None and view.made_with is not None and view.by_calibration is not None:
        lens = np.zeros(INTRINSICS) if known.intrinsics is None else known.intrinsics
        parts = known.values, known.covariance, lens, view.made_with, view.by_calibration
        calibrated = np.concatenate([part.ravel() for part in parts])
    info = factory(
        'sensor_msgs/msg/CameraInfo',
        header=stamp,
        width=cylinder.width,
        height=cylinder.height,
        distortion_model='cylindrical',
        d=calibrated,
        k=np.array([cylinder.fx, 0.0, cylinder.cx, 0.0, cylinder.fy, cylinder.cy, 0.0, 0.0, 1.0]),
    )
    x, y, z = view.center_map
    place = factory(
        'geometry_msgs/msg/PoseWithCovarianceStamped',
        header=stamp,
        pose=pose_with_covariance(factory, (x, y, z, view.heading_rad), view.covariance, UPRIGHT),
    )
    pixels = np.dstack([view.image, alpha])
    return image(factory, pixels, view.stamp_ns, frame_id), info, place


_UNKNOWN: FloatArray = UNKNOWN_VARIANCE * np.eye(6)


def odometry(
    factory: MessageFactory,
    sample: OdometrySample,
    covariance: FloatArray = _UNKNOWN[:3, :3],
    *,
    frame_id: str = 'odom',
    child_frame_id: str = 'base_link',
) -> Any:
    """
    Build a nav_msgs/Odometry; `frame_id` need not be ``odom``.

    The covariance (3, 3) of x, y, heading is unknown by default.
    """
    twist = factory(
        'geometry_msgs/msg/Twist',
        linear=vector(factory, 'Vector3', sample.linear_m_s, 0.0),
        angular=vector(factory, 'Vector3', 0.0, 0.0, sample.angular_rad_s),
    )
    return factory(
        'nav_msgs/msg/Odometry',
        header=header(factory, sample.stamp_ns, frame_id),
        child_frame_id=child_frame_id,
        pose=pose_with_covariance(factory, _upright(sample.pose_odom_base), covariance, PLANAR),
        twist=factory(
            'geometry_msgs/msg/TwistWithCovariance',
            twist=twist,
            covariance=_UNKNOWN.reshape(-1),
        ),
    )


def pose(factory: MessageFactory, estimate: PoseEstimate, frame_id: str = 'map') -> Any:
    """Build a geometry_msgs/PoseWithCovarianceStamped."""
    return factory(
        'geometry_msgs/msg/PoseWithCovarianceStamped',
        header=header(factory, estimate.stamp_ns, frame_id),
        pose=pose_with_covariance(factory, _upright(estimate.pose), estimate.covariance, PLANAR),
    )


def _upright(pose: FloatArray) -> tuple[float, float, float, float]:
    """Return x, y, z, yaw of a planar pose."""
    x, y, yaw = pose.tolist()
    return x, y, 0.0, yaw


def global_pose(factory: MessageFactory, place: clouds.GlobalPose, frame_id: str = 'map') -> Any:
    """Build the PointCloud2 of ``global_localization/pose``, stamped with the image."""
    points = clouds.GLOBAL_POSE.rows(place, len(place.ids))
    return pack_cloud(factory, header(factory, place.stamp_ns, frame_id), points)


def expectation(
    factory: MessageFactory,
    expected: Expectation,
    speeds: OdometrySample,
    frame_id: str = 'map',
) -> Any:
    """Build the PointCloud2 of ``expectation``, one point, with the speeds at its time."""
    points, known = clouds.EXPECTATION.rows(expected, 1), expected.calibration
    points['speeds'] = speeds.linear_m_s, speeds.angular_rad_s
    points['values'], points['sigmas'] = known.values, known.sigmas
    points['intrinsics'] = 0.0 if known.intrinsics is None else known.intrinsics
    return pack_cloud(factory, header(factory, expected.stamp_ns, frame_id), points)


def pose_stamped(
    factory: MessageFactory, stamp_ns: int, pose_map: FloatArray, frame_id: str = 'map'
) -> Any:
    """Build a geometry_msgs/PoseStamped of a planar pose (3,)."""
    return factory(
        'geometry_msgs/msg/PoseStamped',
        header=header(factory, stamp_ns, frame_id),
        pose=upright(factory, *_upright(pose_map)),
    )


def detections(factory: MessageFactory, found: Detections, frame_id: str = 'base_link') -> Any:
    """
    Build the PointCloud2 of ``detections``, stamped with the image.

    Missed landmarks follow as invalid points: NaN, with a score of 0.
    """
    points = clouds.DETECTIONS.rows(found, len(found), len(found.missed))
    points['u'][: len(found)], points['v'][: len(found)] = found.uv_px.T
    points['id'][len(found) :] = found.missed
    for name in ('bearing', 'bearing_variance', 'u', 'v'):
        points[name][len(found) :] = np.nan
    dense = not len(found.missed)
    return pack_cloud(factory, header(factory, found.stamp_ns, frame_id), points, dense)


def triplet(factory: MessageFactory, chosen: Triplet, frame_id: str = 'base_link') -> Any:
    """Build the PointCloud2 of ``triplet``."""
    points = clouds.TRIPLET.rows(chosen, 3)
    return pack_cloud(factory, header(factory, chosen.stamp_ns, frame_id), points)


class Transform(NamedTuple):
    """Pose of the frame `child` in `parent`: rotation (3, 3), translation (3,) in metres."""

    parent: str
    child: str
    rotation: FloatArray
    translation: FloatArray


def planar_transform(parent: str, child: str, pose: FloatArray) -> Transform:
    """Transform of a planar pose (3,) of `child` in `parent`."""
    return Transform(parent, child, rot_z(pose[2]), np.array([*pose[:2], 0.0]))


def joint_transforms(mount: PanTiltMount, joints: JointSample) -> Iterator[Transform]:
    """Yield the transforms that turn with the joints: base to pan link, pan link to tilt link."""
    pan_link, tilt_link = _links(mount)
    panned = rotation_rpy(mount.axis_rpy) @ rot_z(joints.pan_rad)
    yield Transform(mount.base_frame, pan_link, panned, np.array(mount.axis_xyz))
    yield Transform(pan_link, tilt_link, rot_y(-joints.tilt_rad), np.zeros(3))


def camera_transform(
    mount: PanTiltMount, optical_frame: str, camera_tilt_rad: float = 0.0
) -> Transform:
    """Static transform of the camera, tilted against its joint, on the tilt link."""
    rotation, center = mount.camera_pose_base(0.0, camera_tilt_rad)
    to_axis = rotation_rpy(mount.axis_rpy).T
    _, tilt_link = _links(mount)
    return Transform(
        tilt_link, optical_frame, to_axis @ rotation, to_axis @ (center - mount.axis_xyz)
    )


def transforms(factory: MessageFactory, stamp_ns: int, of: Iterable[Transform]) -> Any:
    """Build a tf2_msgs/TFMessage for ``/tf`` and ``/tf_static``."""
    return factory(
        'tf2_msgs/msg/TFMessage', transforms=[_stamped(factory, stamp_ns, one) for one in of]
    )


def _stamped(factory: MessageFactory, stamp_ns: int, one: Transform) -> Any:
    x, y, z, w = Rotation.from_matrix(one.rotation).as_quat().tolist()
    return factory(
        'geometry_msgs/msg/TransformStamped',
        header=header(factory, stamp_ns, one.parent),
        child_frame_id=one.child,
        transform=factory(
            'geometry_msgs/msg/Transform',
            translation=vector(factory, 'Vector3', *one.translation),
            rotation=factory('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w),
        ),
    )


def _links(mount: PanTiltMount) -> tuple[str, str]:
    """Names of the frames that turn with the joints, as usual in URDF."""
    pan, tilt = (name.removesuffix('_joint') for name in (mount.pan_joint, mount.tilt_joint))
    return f'{pan}_link', f'{tilt}_link'


def joint_state(factory: MessageFactory, sample: JointSample, mount: PanTiltMount) -> Any:
    """Build a sensor_msgs/JointState."""
    return factory(
        'sensor_msgs/msg/JointState',
        header=header(factory, sample.stamp_ns, ''),
        name=[mount.pan_joint, mount.tilt_joint],
        position=np.array([sample.pan_rad, sample.tilt_rad]),
    )


def sweep_trajectory(
    factory: MessageFactory, samples: Sequence[JointSample], mount: PanTiltMount
) -> Any:
    """Build the trajectory_msgs/JointTrajectory that ends a sweep: one point for each frame."""
    start_ns = samples[0].stamp_ns
    return factory(
        'trajectory_msgs/msg/JointTrajectory',
        header=header(factory, start_ns, ''),
        joint_names=[mount.pan_joint, mount.tilt_joint],
        points=[
            factory(
                'trajectory_msgs/msg/JointTrajectoryPoint',
                positions=np.array([sample.pan_rad, sample.tilt_rad]),
                time_from_start=time_message(factory, sample.stamp_ns - start_ns, 'Duration'),
            )
            for sample in samples
        ],
    )
