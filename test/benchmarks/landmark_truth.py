"""What a simulated room truly shows where a landmark is said to be; for `landmarks.py`."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
from patch_texels import patch_points

from landmark_nav.geometry.patches import patch_axes
from landmark_nav.matching import blur_to, Match, match_template
from landmark_nav.simulation.scene import Scene
from landmark_nav.simulation.solids import wall_solids
from landmark_nav.simulation.surfaces import Surface
from landmark_nav.types import FloatArray, Landmark

# How far along its wall a landmark's texture is looked for.
_SEARCH_M = 0.06
# What truly hangs there scores above 0.99.
_MIN_SCORE = 0.9
# Of two places that look the same, as slats of blinds do, the landmark is that which is so near.
_NEAR_M, _SAME_SCORE = 0.025, 0.02


class TrueWalls:
    """
    Walls of a scene as they are, to find the textures of landmarks on them.

    A landmark is right where its texture is: its patch is found again in the wall's own image,
    as fine as 2 mm, whatever panorama it was cut from. So errors of the panorama count as well
    as errors of its place, along the wall and up. Of a patch that shows things at several
    distances from the wall, that of its edges counts, as it does in stereo.
    """

    def __init__(self, scene: Scene) -> None:
        """Draw the walls; takes a second."""
        self.scene = scene
        self._walls = {}
        for wall, solid in zip(scene.room.walls, wall_solids(scene), strict=True):
            base, *hung = solid.surfaces
            grey = _grey(base.albedo)
            before = np.zeros_like(grey)
            for surface in hung:
                share, camera_image = _laid_on(base, grey.shape, surface)
                grey = (1.0 - share) * grey + share * camera_image
                depth = float((surface.corner - base.corner) @ base.normal)
                before = np.where(share > 0.5, depth, before)
            # An outline belongs to what is in front.
            nearest = cv2.dilate(before, np.ones((11, 11), np.uint8))
            self._walls[wall.id] = (wall, base, grey.astype(np.float32), nearest)

    def place(self, landmark: Landmark) -> FloatArray | None:
        """
        Where its texture truly is, (3,).

        None if its wall does not show it within 6 cm: it stands before the wall, or is no texture
        of one place.
        """
        wall, base, grey, before = self._walls[landmark.wall_id or self._nearest(landmark)]
        texel = landmark.width_m / landmark.patch.shape[1]
        margin = round(_SEARCH_M / texel) + 2
        shape = (landmark.patch.shape[0] + 2 * margin, landmark.patch.shape[1] + 2 * margin)
        offset = patch_points(landmark.position, landmark.normal, shape, texel) - base.corner
        step = base.width_m / grey.shape[1], base.height_m / grey.shape[0]
        columns = (offset @ base.across / step[0] - 0.5).astype(np.float32)
        rows = (offset @ base.down / step[1] - 0.5).astype(np.float32)
        # As sharp as the panorama that it was cut from.
        ray = landmark.viewpoint - landmark.position
        slant = float(np.hypot(*ray[:2]) / abs(ray @ landmark.normal))
        wide = blur_to(grey, 1.5 * texel * np.array([slant, 1.0]) / step)
        search = cv2.remap(wide, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        found = _best_match(search, landmark.patch)
        if found is None:
            return None
        off = max(0, margin - round(_NEAR_M / texel) - 2)
        near = _best_match(search[off : shape[0] - off, off : shape[1] - off], landmark.patch)
        center = found.xy
        if near is not None and near.score > found.score - _SAME_SCORE:
            center = near.xy + off
        right, down = patch_axes(landmark.normal)
        across, below = (center - (np.array(shape[::-1]) - 1) / 2.0) * texel
        if landmark.edge:  # its texture does not say how high it is
            below = 0.0
        point = landmark.position + across * right + below * down
        size = landmark.patch.shape[::-1]
        there = cv2.remap(
            before, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
        )
        depths, edges = (
            cv2.getRectSubPix(image, size, center.tolist()).astype(np.float64)
            for image in (there, _edges(search))
        )
        before_wall = (point[:2] - wall.start) @ wall.normal[:2]
        return np.asarray(point + (np.average(depths, weights=edges) - before_wall) * wall.normal)

    def _nearest(self, landmark: Landmark) -> str:
        """Wall that lies next to what hangs on none, of those that face as it does."""
        facing = {
            name: abs((landmark.position[:2] - wall.start) @ wall.normal[:2])
            for name, (wall, *_) in self._walls.items()
            if landmark.normal @ wall.normal > 0.5
        }
        return min(facing, key=lambda name: facing[name])

    def hidden(self, eye: FloatArray, points: FloatArray) -> npt.NDArray[np.bool_]:
        """Whether furniture or walls stand between an eye (3,) and points (..., 3)."""
        way = points - eye
        hidden = ~self.scene.room.visible(
            np.broadcast_to(eye[:2], points[..., :2].shape), points[..., :2]
        )
        for box in self.scene.boxes:
            turn = np.array([np.cos(box.yaw_rad), np.sin(box.yaw_rad)])
            axes = np.array([[*turn, 0.0], [-turn[1], turn[0], 0.0], [0.0, 0.0, 1.0]])
            half = np.array(box.size_m) / 2.0
            start = axes @ (eye - [*box.center_xy, half[2]])
            slope = way @ axes.T
            with np.errstate(divide='ignore', invalid='ignore'):
                ends = (np.stack([-half, half]) - start) / slope[..., None, :]
            enter, leave = ends.min(-2).max(-1), ends.max(-2).min(-1)
            hidden |= (enter < leave) & (enter < 1.0 - 1e-6) & (leave > 0.0)
        return np.asarray(hidden)


def _best_match(search: cv2.typing.MatLike, patch: npt.NDArray[np.uint8]) -> Match | None:
    found = match_template(
        np.ascontiguousarray(search, np.float32),
        patch.astype(np.float32),
        min_score=_MIN_SCORE,
        max_second_ratio=1.0,
    )
    return found if isinstance(found, Match) else None


def _grey(camera_image: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    return cv2.cvtColor(camera_image[..., :3], cv2.COLOR_BGR2GRAY).astype(np.float32)


def _edges(image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Squared gradient."""
    return cv2.Sobel(image, cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(image, cv2.CV_32F, 0, 1) ** 2


def _laid_on(
    base: Surface, shape: tuple[int, ...], surface: Surface
) -> tuple[FloatArray, npt.NDArray[np.float32]]:
    """Share of each of a wall's texels that `surface` covers, and what it shows there."""
    rows, columns = shape
    corner = surface.corner - base.corner
    left, top = float(corner @ base.across), float(corner @ base.down)
    across = _covered(left, left + surface.width_m, base.width_m, columns)
    down = _covered(top, top + surface.height_m, base.height_m, rows)
    camera_image = _grey(surface.albedo)
    finer_x = base.width_m / columns * camera_image.shape[1] / surface.width_m
    finer_y = base.height_m / rows * camera_image.shape[0] / surface.height_m
    first_x = -left / surface.width_m * camera_image.shape[1] + 0.5 * finer_x - 0.5
    first_y = -top / surface.height_m * camera_image.shape[0] + 0.5 * finer_y - 0.5
    shown = cv2.warpAffine(
        camera_image,
        np.array([[finer_x, 0.0, first_x], [0.0, finer_y, first_y]]),
        (columns, rows),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.outer(down, across), shown


def _covered(low: float, high: float, length: float, count: int) -> FloatArray:
    """Share of each of `count` texels along a `length` that lies between two places on it."""
    edges = np.linspace(0.0, length, count + 1)
    common = np.minimum(edges[1:], high) - np.maximum(edges[:-1], low)
    return np.clip(common * count / length, 0.0, 1.0)
