"""Landmarks, and markers of map, robot and field of view for RViz and Foxglove."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.camera import CameraModel, INTRINSICS, PanTiltMount
from landmark_nav.geometry.walls import Wall
from landmark_nav.messages.clouds import LANDMARKS, pack_cloud
from landmark_nav.messages.encode.poses import image
from landmark_nav.messages.factory import header, MessageFactory, upright, vector
from landmark_nav.types import (
    Detections,
    FloatArray,
    ImageArray,
    LandmarkMap,
    PoseEstimate,
    Triplet,
)

# visualization_msgs/Marker constants.
_ARROW, _CUBE, _SPHERE, _LINE_STRIP, _LINE_LIST, _TEXT = 0, 1, 2, 4, 5, 9
_DELETE_ALL = 3

_Rgba = tuple[float, float, float, float]
# Colours as in the figures: landmarks green, the fused pose blue.
_LANDMARK: _Rgba = (0.10, 0.62, 0.45, 0.9)
_UNCERTAINTY: _Rgba = (0.95, 0.60, 0.10, 0.4)
_WHITE: _Rgba = (1.0, 1.0, 1.0, 1.0)
_WALL: _Rgba = (0.55, 0.55, 0.60, 1.0)
_FUSED: _Rgba = (0.15, 0.50, 0.90, 1.0)
_LEVEL: _Rgba = (0.90, 0.35, 0.10, 1.0)
_TRIPLET: _Rgba = (0.95, 0.85, 0.20, 1.0)
_FOUND: _Rgba = (0.20, 0.85, 0.45, 0.9)
_VIEW: _Rgba = (0.60, 0.75, 0.95, 0.9)

_NORMAL_M = 0.18
_SWEEP_ARROW_M, _ROBOT_ARROW_M = (0.45, 0.05, 0.05), (0.40, 0.08, 0.08)
# Number of steps in the arc of the field of view, and its radius.
_VIEW_STEPS, _VIEW_M = 16, 1.5
_AROUND = np.linspace(0.0, 2.0 * np.pi, 49)


class _Drawing:
    """Markers of one stamp and frame; they replace those before."""

    def __init__(self, factory: MessageFactory, stamp_ns: int, frame_id: str) -> None:
        self._factory = factory
        self._header = header(factory, stamp_ns, frame_id)
        clear = factory('visualization_msgs/msg/Marker', header=self._header, action=_DELETE_ALL)
        self._markers = [clear]

    @property
    def message(self) -> Any:
        """The visualization_msgs/MarkerArray."""
        return self._factory('visualization_msgs/msg/MarkerArray', markers=self._markers)

    def add(
        self,
        namespace: str,
        kind: int,
        rgba: _Rgba,
        x_y_z_yaw: Sequence[float],
        scale_m: Sequence[float],
        number: int = 0,
        **fields: Any,
    ) -> None:
        """Add a marker; `fields` are further ones of visualization_msgs/Marker."""
        factory = self._factory
        red, green, blue, alpha = rgba
        marker = factory(
            'visualization_msgs/msg/Marker',
            header=self._header,
            ns=namespace,
            id=number,
            type=kind,
            pose=upright(factory, *x_y_z_yaw),
            scale=vector(factory, 'Vector3', *scale_m),
            color=factory('std_msgs/msg/ColorRGBA', r=red, g=green, b=blue, a=alpha),
            **fields,
        )
        self._markers.append(marker)

    def lines(
        self, namespace: str, kind: int, rgba: _Rgba, points: npt.ArrayLike, width_m: float = 0.02
    ) -> None:
        """Add lines through points (n, 2) or (n, 3)."""
        ends = [vector(self._factory, 'Point', *point) for point in np.asarray(points).tolist()]
        self.add(namespace, kind, rgba, (0.0, 0.0, 0.0, 0.0), (width_m, 0.0), points=ends)

    def label(
        self, namespace: str, text: str, x_y_z: Sequence[float], height_m: float, number: int
    ) -> None:
        """Add a text."""
        place, size = (*x_y_z, 0.0), (0.0, 0.0, height_m)
        self.add(namespace, _TEXT, _WHITE, place, size, number, text=text)


def landmark_markers(factory: MessageFactory, landmarks: LandmarkMap, stamp_ns: int) -> Any:
    """
    Build the visualization_msgs/MarkerArray of a map; it replaces the one before.

    Namespaces: ``walls``, ``landmarks`` (the patch on its wall), ``normals``, ``uncertainty``
    (three sigma), ``numbers`` and ``sweeps`` (pose of the base at each panorama).
    """
    drawing = _Drawing(factory, stamp_ns, landmarks.frame_id)
    if landmarks.walls:
        drawing.lines('walls', _LINE_LIST, _WALL, _wall_edges(landmarks.walls))
    if landmarks.landmarks:
        normals = _pairs(landmarks.positions, landmarks.positions + _NORMAL_M * landmarks.normals)
        drawing.lines('normals', _LINE_LIST, _LANDMARK, normals, width_m=0.01)
    for landmark in landmarks.landmarks:
        number, (x, y, z) = landmark.id, landmark.position
        yaw = np.arctan2(landmark.normal[1], landmark.normal[0])
        plate = (0.01, landmark.width_m, landmark.height_m)
        drawing.add('landmarks', _CUBE, _LANDMARK, (x, y, z, yaw), plate, number)
        variances, axes = np.linalg.eigh(landmark.covariance[:2, :2])
        major = np.arctan2(axes[1, 1], axes[0, 1])
        all_variances = np.maximum([*variances[::-1], landmark.covariance[2, 2]], 1e-8)
        diameters = 6.0 * np.sqrt(all_variances)  # of three sigma
        drawing.add(
            'uncertainty', _SPHERE, _UNCERTAINTY, (x, y, z, major), diameters.tolist(), number
        )
        above = z + 0.5 * landmark.height_m + 0.08
        drawing.label('numbers', str(number), (x, y, above), 0.12, number)
    for number, place in enumerate(landmarks.panorama_poses, 1):
        x, y, heading = place.pose
        drawing.add('sweeps', _ARROW, _FUSED, (x, y, 0.0, heading), _SWEEP_ARROW_M, number)
        drawing.label('sweeps', f'sweep {number}', (x, y, 0.2), 0.15, -number)
    return drawing.message


def pose_markers(
    factory: MessageFactory,
    estimate: PoseEstimate,
    level: PoseEstimate | None = None,
    frame_id: str = 'map',
) -> Any:
    """
    Build the MarkerArray of a pose: the robot, three sigma, and the protection level.

    One sigma of the covariance of `level` is the protection level, as in
    ``odometry_fusion/protection_level``.
    """
    drawing = _Drawing(factory, estimate.stamp_ns, frame_id)
    x, y, heading = estimate.pose
    drawing.add('robot', _ARROW, _FUSED, (x, y, 0.0, heading), _ROBOT_ARROW_M)
    ellipses = [('three_sigma', estimate, 3.0, _FUSED)]
    if level is not None:
        ellipses.append(('protection_level', level, 1.0, _LEVEL))
    for namespace, pose, sigmas, rgba in ellipses:
        variances, axes = np.linalg.eigh(pose.covariance[:2, :2])
        scaled = sigmas * np.sqrt(np.maximum(variances, 0.0)) * axes
        outline = pose.pose[:2] + np.stack([np.cos(_AROUND), np.sin(_AROUND)], 1) @ scaled.T
        drawing.lines(namespace, _LINE_STRIP, rgba, outline, width_m=0.01)
    return drawing.message


def view_markers(
    factory: MessageFactory,
    pose: PoseEstimate,
    landmarks: LandmarkMap,
    mount: PanTiltMount,
    camera: CameraModel,
    pan_rad: float,
    found: Detections,
    triplet: Triplet | None,
    frame_id: str = 'map',
) -> Any:
    """
    Build the MarkerArray of what the camera sees from a pose of the base.

    Namespaces: ``field_of_view``; ``triplet``, lines from the pan axis to the chosen landmarks;
    ``bearings``, measured bearings of the landmarks found. A bearing is drawn as long as its
    landmark is distant: if it ends beside the landmark, the pose or the map is wrong.
    """
    drawing = _Drawing(factory, pose.stamp_ns, frame_id)
    axis, height = mount.axis_pose_map(pose.pose), mount.axis_xyz[2]
    looks = float(pose.pose[2] + mount.azimuth_base_rad(pan_rad))
    rim = looks + np.linspace(-camera.half_fov_rad, camera.half_fov_rad, _VIEW_STEPS)
    arc = axis[:2] + _VIEW_M * np.stack([np.cos(rim), np.sin(rim)], 1)
    fan = np.concatenate([axis[None, :2], arc, axis[None, :2]])
    fan = np.pad(fan, ((0, 0), (0, 1)), constant_values=height)
    drawing.lines('field_of_view', _LINE_STRIP, _VIEW, fan)
    start = np.array([*axis[:2], height])
    if triplet is not None:
        chosen = triplet.ids[np.isin(triplet.ids, landmarks.ids)]
        ends = landmarks.positions[landmarks.indices(chosen)]
        drawing.lines('triplet', _LINE_LIST, _TRIPLET, _pairs(start, ends), width_m=0.03)
    # The map may have been replaced since the image was searched.
    found = found.chosen(np.isin(found.ids, landmarks.ids))
    if len(found):
        places = landmarks.positions[landmarks.indices(found.ids)]
        reach = np.hypot(*(places[:, :2] - axis[:2]).T)
        azimuth = pose.pose[2] + found.bearing_rad
        ends = axis[:2] + reach[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], 1)
        rays = _pairs(start, np.column_stack([ends, places[:, 2]]))
        drawing.lines('bearings', _LINE_LIST, _FOUND, rays, width_m=0.012)
    return drawing.message


def _wall_edges(walls: Iterable[Wall]) -> list[tuple[float, float, float]]:
    """End points of the edges of all walls, in pairs."""
    ends: list[tuple[float, float, float]] = []
    for wall in walls:
        low = [(*wall.start, 0.0), (*wall.end, 0.0)]
        high = [(*wall.start, wall.height), (*wall.end, wall.height)]
        ends.extend([*low, *high, low[0], high[0]])
    return ends


def _pairs(starts: FloatArray, ends: FloatArray) -> FloatArray:
    """End points of lines from `starts` (3,) or (n, 3) to `ends` (n, 3), in pairs, (2 n, 3)."""
    return np.stack([np.broadcast_to(starts, ends.shape), ends], 1).reshape(-1, 3)


_ATLAS_WIDTH = 1024


def landmark_map(
    factory: MessageFactory, landmarks: LandmarkMap, stamp_ns: int
) -> tuple[Any, Any, Any]:
    """
    Build ``landmarks``, ``landmarks/atlas`` and ``landmarks/markers``; the map may be empty.

    Receivers match the three by `stamp_ns`, the time of publication.
    """
    members = landmarks.landmarks
    views = [view.patch for k in members for view in k.views]
    corners, atlas = _pack_patches([*(k.patch for k in members), *views])
    points = _points(landmarks, corners)
    return (
        pack_cloud(factory, header(factory, stamp_ns, landmarks.frame_id), points, dense=False),
        image(factory, atlas, stamp_ns, landmarks.frame_id),
        landmark_markers(factory, landmarks, stamp_ns),
    )


def _points(landmarks: LandmarkMap, corners: npt.NDArray[np.int64]) -> npt.NDArray[np.void]:
    """Rows (n,) of the layout in `landmark_nav.messages.clouds`; `corners` (n + views, 2)."""
    members, walls = landmarks.landmarks, landmarks.walls
    wall_names = np.frombuffer('\n'.join(wall.id for wall in walls).encode(), dtype=np.uint8)
    factors = members[0].shared_loading.shape[1] if members else 0
    views = max((len(k.views) for k in members), default=0)
    learned = _learned(landmarks)
    each = -(-len(learned) // max(1, len(members)))
    layout = LANDMARKS.sized(
        shared_loading=3 * factors,
        walls=5 * len(walls),
        wall_names=len(wall_names),
        viewpoints=3 * views,
        views=4 * views,
        learned=each,
    )
    points = np.zeros(len(members), dtype=layout)
    points['id'] = landmarks.ids
    for names, values in (
        ('x y z', landmarks.positions),
        ('normal_x normal_y normal_z', landmarks.normals),
        ('viewpoint_x viewpoint_y viewpoint_z', landmarks.viewpoints),
        ('width height', landmarks.sizes_m),
        ('atlas_x atlas_y', corners[: len(members)]),
        ('atlas_height atlas_width', [k.patch.shape for k in members]),
        ('threshold saliency', [(k.threshold, k.saliency) for k in members]),
    ):
        for name, column in zip(names.split(), np.transpose(values), strict=bool(members)):
            points[name] = column
    points['covariance'] = landmarks.covariances.reshape(-1, 9)
    index = {wall.id: number for number, wall in enumerate(walls)}
    points['wall'] = [index.get(k.wall_id, -1) for k in members]
    if members:
        filled = np.full(each * len(members), np.nan)
        filled[: len(learned)] = learned
        points['learned'] = filled.reshape(-1, each)
    if factors:
        points['shared_loading'] = [k.shared_loading.reshape(-1) for k in members]
    if walls:
        points['walls'] = np.concatenate([[*w.start, *w.end, w.height] for w in walls])
        points['wall_names'] = wall_names
    if views:
        left_top = iter(corners[len(members) :])
        for point, landmark in zip(points, members, strict=True):
            for k, view in enumerate(landmark.views):
                point['viewpoints'][3 * k : 3 * k + 3] = view.viewpoint
                point['views'][4 * k : 4 * k + 4] = *next(left_top), *view.patch.shape[::-1]
    return points


def _learned(landmarks: LandmarkMap) -> FloatArray:
    """Values of the field `learned`."""
    prior, known = landmarks.prior, landmarks.calibration
    scale = np.array([landmarks.scale_sigma])
    if prior is None or known is None:
        return scale
    by_map = np.empty(0) if known.by_map is None else known.by_map
    lens = np.zeros(INTRINSICS) if known.intrinsics is None else known.intrinsics
    parts = scale, prior.values, prior.sigmas, known.values, known.covariance, lens, by_map
    return np.concatenate([part.ravel() for part in parts])


def _pack_patches(patches: list[ImageArray]) -> tuple[npt.NDArray[np.int64], ImageArray]:
    """Place patches on shelves, highest first: upper left corners (n, 2) as x, y and the atlas."""
    corners = np.zeros((len(patches), 2), dtype=np.int64)
    width = max([_ATLAS_WIDTH, *(p.shape[1] for p in patches)])
    x = y = shelf = 0
    for k in sorted(range(len(patches)), key=lambda k: -patches[k].shape[0]):
        rows, columns = patches[k].shape
        if x + columns > width:
            x, y, shelf = 0, y + shelf, 0
        corners[k] = x, y
        x, shelf = x + columns, max(shelf, rows)
    atlas = np.zeros((max(1, y + shelf), width), dtype=np.uint8)
    for (left, top), patch in zip(corners, patches, strict=True):
        atlas[top : top + patch.shape[0], left : left + patch.shape[1]] = patch
    return corners, atlas
