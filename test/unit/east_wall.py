"""A camera before a wall of texture with four landmarks, and how far off they are found."""

import numpy as np
from scenes import rectangle_room, textured_room, true_landmark

from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.localization.detection.correlation import detect_landmarks
from landmark_nav.localization.detection.expectation import DetectionConfig, View
from landmark_nav.types import LandmarkMap, PoseEstimate

LENS = CameraModel(
    480, 360, 400.0, 400.0, 240.0, 180.0, distortion=(-0.15, 0.05, 0.001, -0.001, 0.0)
)
MOUNT = PanTiltMount(axis_xyz=(0.12, 0.02, 1.15), optical_center_offset=(0.03, 0.0, 0.0))
CONFIG = DetectionConfig()
ROOM = rectangle_room(6.0, 5.0)
SCENE = textured_room(ROOM, seed=6, feature_m=0.04)
EAST = SCENE.boards[1]
HERE = np.array([2.9, 2.3, 0.1])
PRIOR = np.diag([0.02, 0.02, 0.008]) ** 2


def map_of(places, viewpoint=None, size_m=0.32):
    """Landmarks of the east wall, metres across and up from its centre."""
    viewpoint = np.array([3.0, 2.3, 1.15]) if viewpoint is None else viewpoint
    return LandmarkMap(
        tuple(
            true_landmark(SCENE, k + 1, EAST, *place, viewpoint, size_m=size_m)
            for k, place in enumerate(places)
        ),
        walls=ROOM.walls,
    )


PLACES = [(-0.8, 0.1), (-0.2, -0.3), (0.3, 0.2), (0.9, -0.1)]
LANDMARKS = map_of(PLACES)


def detect(frame, prior, landmark_map=LANDMARKS, config=CONFIG):
    everything = np.arange(len(landmark_map.landmarks))
    estimate = PoseEstimate(frame.stamp_ns, prior, PRIOR)
    return detect_landmarks(View(frame, estimate, MOUNT), landmark_map, config, everything)


def bearing_at(pose, landmark):
    """Bearing at the pan axis."""
    axis = MOUNT.axis_pose_map(pose)
    return float(se2.bearings(axis, landmark.position[:2]))


def errors_of(result, pose, landmark_map=LANDMARKS):
    found = result.detections
    index = landmark_map.indices(found.ids)
    truth = [bearing_at(pose, landmark_map.landmarks[k]) for k in index]
    return wrap_rad(found.bearing_rad - truth)
