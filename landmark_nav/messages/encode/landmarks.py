"""The landmark map: points and an atlas of patches."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from landmark_nav.messages.clouds import LANDMARKS, pack_cloud
from landmark_nav.messages.encode.images import image
from landmark_nav.messages.encode.markers import landmark_markers
from landmark_nav.messages.factory import header, MessageFactory
from landmark_nav.types import ImageArray, LandmarkMap

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
        pack_cloud(factory, header(factory, stamp_ns, landmarks.frame_id), points),
        image(factory, atlas, stamp_ns, landmarks.frame_id),
        landmark_markers(factory, landmarks, stamp_ns),
    )


def _points(landmarks: LandmarkMap, corners: npt.NDArray[np.int64]) -> npt.NDArray[np.void]:
    """Rows (n,) of the layout in `landmark_nav.messages.clouds`; `corners` (n + views, 2)."""
    members, walls = landmarks.landmarks, landmarks.walls
    names = np.frombuffer('\n'.join(wall.id for wall in walls).encode(), dtype=np.uint8)
    factors = members[0].shared_loading.shape[1] if members else 0
    views = max((len(k.views) for k in members), default=0)
    layout = LANDMARKS.sized(
        shared_loading=3 * factors,
        walls=5 * len(walls),
        wall_names=len(names),
        viewpoints=3 * views,
        views=4 * views,
    )
    points = np.zeros(len(members), dtype=layout)
    points['id'] = landmarks.ids
    for triple, values in (
        (('x', 'y', 'z'), landmarks.positions),
        (('normal_x', 'normal_y', 'normal_z'), landmarks.normals),
        (('viewpoint_x', 'viewpoint_y', 'viewpoint_z'), landmarks.viewpoints),
    ):
        for axis, name in enumerate(triple):
            points[name] = values[:, axis]
    points['width'], points['height'] = landmarks.sizes_m.T
    points['threshold'] = [k.threshold for k in members]
    points['saliency'] = [k.saliency for k in members]
    points['covariance'] = landmarks.covariances.reshape(-1, 9)
    points['atlas_x'], points['atlas_y'] = corners[: len(members)].T
    points['atlas_height'] = [k.patch.shape[0] for k in members]
    points['atlas_width'] = [k.patch.shape[1] for k in members]
    index = {wall.id: number for number, wall in enumerate(walls)}
    points['wall'] = [index.get(k.wall_id, -1) for k in members]
    if factors:
        points['shared_loading'] = [k.shared_loading.reshape(-1) for k in members]
    if walls:
        points['walls'] = np.concatenate([[*w.start, *w.end, w.height] for w in walls])
        points['wall_names'] = names
    if views:
        left_top = iter(corners[len(members) :])
        for point, landmark in zip(points, members, strict=True):
            for k, view in enumerate(landmark.views):
                point['viewpoints'][3 * k : 3 * k + 3] = view.viewpoint
                point['views'][4 * k : 4 * k + 4] = *next(left_top), *view.patch.shape[::-1]
    return points


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
