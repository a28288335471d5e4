"""
Comparison of two maps of one room, landmark by landmark, and check of one map.

Attention does not choose the same patch twice, so that the centres of overlapping landmarks
differ. Their textures are aligned, so that the locations of the same point of the texture are
compared.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.patches import patch_axes
from landmark_nav.geometry.walls import Room, Wall
from landmark_nav.matching.alignment import blur_to, match_template
from landmark_nav.types import FloatArray, Landmark, LandmarkMap, Refusal, RefusalCode

# Greatest distance of a patch from the plane of the other, and least cosine of their normals.
_SAME_PLANE_M = 0.1
_MIN_COS_NORMALS = np.cos(np.radians(10.0))
# Greatest distance of the centres of overlapping patches, relative to their mean size.
_MAX_SHIFT = 0.6
# Least width of the overlap of patches that are compared, texels.
_MIN_OVERLAP_PX = 10
# Greatest disagreement that is searched, relative to the smaller side of the patch.
_SEARCH = 0.15
# Greatest distance of two points without texture that are the same.
_SAME_POINT_M = 0.06
# Least correlation of the same texture.
_MIN_SCORE = 0.7
# Sigma that is added to covariances, as a location may be given as exact.
_LEAST_SIGMA_M = 1e-6


class Texture(Enum):
    """Result of the comparison of the images of two overlapping patches."""

    SAME = 'same'
    CHANGED = 'changed'
    UNKNOWN = 'unknown'


@dataclass(frozen=True, eq=False)
class Pair:
    """
    A location in both maps, as landmarks `a` and `b`.

    `disagreement_m` (2,) is the shift of the texture from the first map to the second, to the
    right and downwards; `covariance` (2, 2) is the expected one. Both hold if `texture` is SAME.
    """

    a: Landmark
    b: Landmark
    texture: Texture
    disagreement_m: FloatArray
    covariance: FloatArray

    @property
    def sigmas(self) -> float:
        """Mahalanobis distance of the disagreement (2 degrees of freedom)."""
        # The covariance may be zero.
        covariance = self.covariance + _LEAST_SIGMA_M**2 * np.eye(2)
        off = self.disagreement_m
        return float(np.sqrt(off @ np.linalg.solve(covariance, off)))


@dataclass(frozen=True, eq=False)
class Comparison:
    """Landmarks that two maps have in common, and those that only one of them has."""

    pairs: tuple[Pair, ...]
    only_a: tuple[Landmark, ...]
    only_b: tuple[Landmark, ...]

    def of(self, texture: Texture) -> tuple[Pair, ...]:
        """Pairs with this result of the comparison of their images."""
        return tuple(pair for pair in self.pairs if pair.texture is texture)


def compare_maps(a: LandmarkMap, b: LandmarkMap) -> Comparison:
    """Pair each landmark with the nearest overlapping one of the other map, and compare them."""
    found = _mutual_nearest(_apart(a, b))
    in_a, in_b = {i for i, _ in found}, {j for _, j in found}
    return Comparison(
        tuple(_pair(a.landmarks[i], b.landmarks[j]) for i, j in found),
        tuple(k for i, k in enumerate(a.landmarks) if i not in in_a),
        tuple(k for j, k in enumerate(b.landmarks) if j not in in_b),
    )


def wall_changes(a: LandmarkMap, b: LandmarkMap) -> dict[str, float]:
    """Greatest shift of the ends of each wall, m, by its id; inf if one map lacks the wall."""
    ends_a, ends_b = ({w.id: np.array([w.start, w.end]) for w in m.walls} for m in (a, b))
    none = np.full((2, 2), np.inf)
    return {
        name: float(np.abs(ends_b.get(name, none) - ends_a.get(name, -none)).max())
        for name in ends_a | ends_b
    }


def _apart(a: LandmarkMap, b: LandmarkMap) -> FloatArray:
    """Distances (n, m) of centres relative to the size of patches; inf if they do not overlap."""
    offset = b.positions[None] - a.positions[:, None]
    across = np.abs(np.sum(offset * a.normals[:, None], -1))
    size = 0.5 * (a.sizes_m.mean(1)[:, None] + b.sizes_m.mean(1)[None])
    distance = np.linalg.norm(offset, axis=-1) / np.maximum(size, _SAME_POINT_M / _MAX_SHIFT)
    apart = (across > _SAME_PLANE_M) | (a.normals @ b.normals.T < _MIN_COS_NORMALS)
    return np.where(apart | (distance > _MAX_SHIFT), np.inf, distance)


def _mutual_nearest(distance: FloatArray) -> list[tuple[int, int]]:
    if not distance.size:
        return []
    nearest_b, nearest_a = distance.argmin(1), distance.argmin(0)
    return [
        (i, int(j))
        for i, j in enumerate(nearest_b)
        if nearest_a[j] == i and np.isfinite(distance[i, j])
    ]


def _pair(a: Landmark, b: Landmark) -> Pair:
    axes = np.stack(patch_axes(a.normal))
    offset = axes @ (b.position - a.position)
    covariance = axes @ (a.covariance + b.covariance) @ axes.T
    alike = (a.width_m, a.height_m) == (b.width_m, b.height_m)
    blank = not (a.patch.size and b.patch.size)
    # Copies need no alignment; blank textures do not count.
    if blank or (alike and np.array_equal(a.patch, b.patch) and np.ptp(a.patch)):
        return Pair(a, b, Texture.SAME, offset, covariance)
    seen = _texture_offset(a, b, offset)
    if seen is None:
        return Pair(a, b, Texture.UNKNOWN, offset, covariance)
    if isinstance(seen, Refusal):
        # Only a low correlation shows that the texture has changed.
        changed = seen.code is RefusalCode.LOW_CORRELATION
        what = Texture.CHANGED if changed else Texture.UNKNOWN
        return Pair(a, b, what, offset, covariance)
    return Pair(a, b, Texture.SAME, seen[0], covariance + seen[1])


def _texture_offset(
    a: Landmark, b: Landmark, offset: FloatArray
) -> tuple[FloatArray, FloatArray] | Refusal | None:
    """Disagreement (2,) and its covariance, or a refusal; None if the overlap is too small."""
    texel = max(a.width_m / a.patch.shape[1], b.width_m / b.patch.shape[1])
    margin = int(np.ceil(_SEARCH * min(b.width_m, b.height_m) / texel)) + 1
    # Both images are on a grid of `texel` that is centred on b; that of a is shifted by `offset`.
    shape = (int(b.height_m / texel), int(b.width_m / texel))
    image_b = resampled(b, texel, shape, np.zeros(2))
    image_a = resampled(a, texel, shape, offset)
    rows, columns = (
        _shared(length, texel, size, shift, margin)
        for length, size, shift in zip(shape, (a.height_m, a.width_m), offset[::-1], strict=True)
    )
    if min(len(rows), len(columns)) < _MIN_OVERLAP_PX:
        return None
    top, left, bottom, right = rows[0], columns[0], rows[-1] + 1, columns[-1] + 1
    template = image_a[top:bottom, left:right]
    search = image_b[top - margin : bottom + margin, left - margin : right + margin]
    match = match_template(search, template, min_score=_MIN_SCORE)
    if isinstance(match, Refusal):
        return match
    expected = (np.array(search.shape[::-1]) - 1) / 2.0
    # If the texture is further right in the image of b, it is further right in its map too.
    return (match.xy - expected) * texel, match.covariance * texel**2


def _shared(
    length: int, texel_m: float, size_m: float, shift_m: float, margin: int
) -> npt.NDArray[np.intp]:
    """Rows (or columns) of the grid of b, without its margin, that the image of a covers."""
    place = np.arange(length)
    reach = np.abs((place - (length - 1) / 2.0) * texel_m + shift_m)
    return np.flatnonzero((reach <= 0.5 * size_m) & (place >= margin) & (place < length - margin))


def resampled(
    k: Landmark, texel_m: float, shape: tuple[int, int], offset: FloatArray
) -> npt.NDArray[np.float32]:
    """Patch resampled on a grid of `shape`, whose centre is shifted by `offset` (2,), m."""
    own = np.array([k.width_m, k.height_m]) / np.array(k.patch.shape[::-1])
    scale = texel_m / own
    center = (np.array(k.patch.shape[::-1]) - 1) / 2.0 + offset / own
    corner = center - scale * (np.array(shape[::-1]) - 1) / 2.0
    where = np.array([[scale[0], 0.0, corner[0]], [0.0, scale[1], corner[1]]])
    blurred, linear = blur_to(k.patch.astype(np.float32), scale), cv2.INTER_LINEAR
    how: dict[str, Any] = {'flags': linear | cv2.WARP_INVERSE_MAP}
    how['borderMode'] = cv2.BORDER_REPLICATE
    return np.asarray(cv2.warpAffine(blurred, where, shape[::-1], **how), dtype=np.float32)


# Greatest distance of a patch from the plane of its wall, to both sides, and beyond its ends.
_OFF_WALL_M = 0.1
# Greatest angle between the normals of a patch and its wall.
_MAX_TURN_RAD = np.radians(5.0)
# Greatest sigma of a landmark, and least sigma of the grey levels of a patch.
_MAX_SIGMA_M = 0.5
_MIN_CONTRAST = 2.0
# Greatest difference of the logarithms of width and height of a texel.
_MAX_SQUEEZE = 0.1
_LEAST_LANDMARKS = 3


def problems_of_map(landmarks: LandmarkMap) -> list[str]:
    """List implausible or unusable contents of a map, a line with the id of the landmark each."""
    problems = list(_problems_of_room(landmarks))
    walls = {wall.id: wall for wall in landmarks.walls}
    for k in landmarks.landmarks:
        found = list(_problems_of_landmark(k))
        if k.wall_id in walls:
            found += _problems_on_wall(k, walls[k.wall_id])
        elif walls and k.wall_id:
            found.append(f'its wall {k.wall_id!r} is not in the map')
        problems += [f'landmark {k.id}: {text}' for text in found]
    return problems


def _problems_of_room(landmarks: LandmarkMap) -> Iterator[str]:
    count = len(landmarks.landmarks)
    if count < _LEAST_LANDMARKS:
        yield f'{count} landmarks: a pose needs {_LEAST_LANDMARKS}'
    if not landmarks.walls:
        return  # a map of surveyed beacons has no walls
    try:
        room = Room(landmarks.walls)
    except LandmarkNavError as error:
        yield str(error)
        return
    for place in landmarks.panorama_poses:
        if not room.contains(place.pose[:2]):
            yield f'panorama at ({place.pose[0]:.2f}, {place.pose[1]:.2f}) m is not in the room'


def _problems_of_landmark(k: Landmark) -> Iterator[str]:
    eigenvalues = np.linalg.eigvalsh(k.covariance)
    if eigenvalues[-1] > _MAX_SIGMA_M**2:
        yield f'standard deviation of {np.sqrt(eigenvalues[-1]):.2f} m: of no use'
    if eigenvalues[0] <= 0.0 and k.wall_id:
        yield 'its covariance is singular: no estimate is free of errors'
    if not k.patch.size:
        return
    if not 0.0 < k.threshold < 1.0:
        yield f'threshold is {k.threshold:g}: a correlation lies between 0 and 1'
    if float(np.std(k.patch)) < _MIN_CONTRAST:
        yield f'its patch is blank (standard deviation of {np.std(k.patch):.1f} grey levels)'
    rows, columns = k.patch.shape
    squeeze = (k.width_m / columns) / (k.height_m / rows)
    if abs(np.log(squeeze)) > _MAX_SQUEEZE:
        size = f'{k.width_m:.2f} x {k.height_m:.2f} m'
        yield f'{size} do not fit a patch of {columns} x {rows} texels'
    viewpoints = np.array([k.viewpoint, *(view.viewpoint for view in k.views)])
    if np.any((viewpoints - k.position) @ k.normal <= 0.0):
        yield 'was learned from behind its wall'


def _problems_on_wall(k: Landmark, wall: Wall) -> Iterator[str]:
    turn = np.arccos(np.clip(k.normal @ wall.normal, -1.0, 1.0))
    if turn > _MAX_TURN_RAD:
        yield f'is turned by {np.degrees(turn):.1f} deg from wall {wall.id}'
    offset = k.position - np.array([*wall.start, 0.0])
    height = float(offset @ wall.normal)
    if abs(height) > _OFF_WALL_M:
        yield f'is {100 * height:.1f} cm off the plane of wall {wall.id}'
    right, _ = patch_axes(wall.normal)
    along = -float(offset @ right)  # `right` points from the end of the wall to its start
    if not -_OFF_WALL_M < along < wall.length + _OFF_WALL_M:
        yield f'lies {along:.2f} m along wall {wall.id}, which is {wall.length:.2f} m long'
    if not 0.0 <= k.position[2] <= wall.height:
        yield f'is {k.position[2]:.2f} m high on wall {wall.id} of {wall.height:.2f} m'
