"""
Two maps of one room, landmark by landmark.

Attention doesn't choose the same patch twice: two landmarks that overlap have centres of their
own. Their textures say how far apart these truly are, so that what is compared is where the maps
put the same point of the same poster.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.patches import patch_axes
from landmark_nav.matching import blur_to, match_template
from landmark_nav.types import FloatArray, Landmark, LandmarkMap, Refusal, RefusalCode

_SAME_PLANE_M = 0.1
_MIN_COS_NORMALS = np.cos(np.radians(10.0))
# Two patches share a place if their centres are nearer than this share of their mean size ...
_MAX_SHIFT = 0.6
# ... and can be compared if what they share is at least as wide as this, texels.
_MIN_OVERLAP_PX = 10
# How far the maps may disagree and still be aligned by texture: share of the patch.
_SEARCH = 0.15
# Points without a texture are the same within this.
_SAME_POINT_M = 0.06
_MIN_SCORE = 0.7
_LEAST_SIGMA_M = 1e-6


class Texture(Enum):
    """What the images of two overlapping patches say."""

    SAME = 'same'
    CHANGED = 'changed'
    UNKNOWN = 'unknown'


@dataclass(frozen=True, eq=False)
class Pair:
    """
    A place that both maps know, as landmarks `a` and `b`.

    `disagreement_m` (2,) is how far `b`'s map puts the same texture to the right and downwards,
    `covariance` (2, 2) what was to be expected of it; both hold where `texture` is the same.
    """

    a: Landmark
    b: Landmark
    texture: Texture
    disagreement_m: FloatArray
    covariance: FloatArray

    @property
    def sigmas(self) -> float:
        """Mahalanobis distance of the disagreement (2 degrees of freedom)."""
        # A place may be given as exact.
        covariance = self.covariance + _LEAST_SIGMA_M**2 * np.eye(2)
        return float(
            np.sqrt(self.disagreement_m @ np.linalg.solve(covariance, self.disagreement_m))
        )


@dataclass(frozen=True, eq=False)
class Comparison:
    """What two maps have in common, and what only one of them holds."""

    pairs: tuple[Pair, ...]
    only_a: tuple[Landmark, ...]
    only_b: tuple[Landmark, ...]

    def of(self, texture: Texture) -> tuple[Pair, ...]:
        """Pairs whose images say `texture`."""
        return tuple(pair for pair in self.pairs if pair.texture is texture)


def compare_maps(a: LandmarkMap, b: LandmarkMap) -> Comparison:
    """Pair each landmark with the other map's nearest at the same place, and look at both."""
    found = _mutual_nearest(_apart(a, b))
    in_a, in_b = {i for i, _ in found}, {j for _, j in found}
    return Comparison(
        tuple(_pair(a.landmarks[i], b.landmarks[j]) for i, j in found),
        tuple(k for i, k in enumerate(a.landmarks) if i not in in_a),
        tuple(k for j, k in enumerate(b.landmarks) if j not in in_b),
    )


def wall_changes(a: LandmarkMap, b: LandmarkMap) -> dict[str, float]:
    """How far an end of each wall moved, m, by the wall's id; inf where one map lacks the wall."""
    ends_a, ends_b = ({w.id: np.array([w.start, w.end]) for w in m.walls} for m in (a, b))
    return {
        name: float(np.abs(ends_b[name] - ends_a[name]).max())
        if name in ends_a and name in ends_b
        else np.inf
        for name in ends_a | ends_b
    }


def _apart(a: LandmarkMap, b: LandmarkMap) -> FloatArray:
    """Distances (n, m) of centres in units of the patches' size; inf off each other's plane."""
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
    if _is_copy(a, b) or not (a.patch.size and b.patch.size):  # nothing to align
        return Pair(a, b, Texture.SAME, offset, covariance)
    seen = _texture_offset(a, b, offset)
    if seen is None:
        return Pair(a, b, Texture.UNKNOWN, offset, covariance)
    if isinstance(seen, Refusal):
        # Only a low correlation says that there is something else now.
        changed = seen.code is RefusalCode.LOW_CORRELATION
        what = Texture.CHANGED if changed else Texture.UNKNOWN
        return Pair(a, b, what, offset, covariance)
    return Pair(a, b, Texture.SAME, seen[0], covariance + seen[1])


def _is_copy(a: Landmark, b: Landmark) -> bool:
    """Whether the textures are the same to the last bit; blank ones show nothing."""
    alike = (a.width_m, a.height_m) == (b.width_m, b.height_m)
    return alike and bool(np.array_equal(a.patch, b.patch) and a.patch.size and np.ptp(a.patch))


def _texture_offset(
    a: Landmark, b: Landmark, offset: FloatArray
) -> tuple[FloatArray, FloatArray] | Refusal | None:
    """Disagreement (2,) and its covariance; None where too little is shared to decide."""
    texel = max(a.width_m / a.patch.shape[1], b.width_m / b.patch.shape[1])
    margin = int(np.ceil(_SEARCH * min(b.width_m, b.height_m) / texel)) + 1
    # Both on one grid of `texel`, which is centred on b; a's image is moved by the offset.
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
    # Where b's image shows the texture further right, its map puts it further right.
    return (match.xy - expected) * texel, match.covariance * texel**2


def _shared(
    length: int, texel_m: float, size_m: float, shift_m: float, margin: int
) -> npt.NDArray[np.intp]:
    """Rows (or columns) of b's grid, but for its margin, where a's image reaches."""
    place = np.arange(length)
    reach = np.abs((place - (length - 1) / 2.0) * texel_m + shift_m)
    return np.flatnonzero((reach <= 0.5 * size_m) & (place >= margin) & (place < length - margin))


def resampled(
    k: Landmark, texel_m: float, shape: tuple[int, int], offset: FloatArray
) -> npt.NDArray[np.float32]:
    """Patch on a grid of `shape` whose centre lies `offset` (2,) from the patch's."""
    own = np.array([k.width_m, k.height_m]) / np.array(k.patch.shape[::-1])
    scale = texel_m / own
    center = (np.array(k.patch.shape[::-1]) - 1) / 2.0 + offset / own
    corner = center - scale * (np.array(shape[::-1]) - 1) / 2.0
    where = np.array([[scale[0], 0.0, corner[0]], [0.0, scale[1], corner[1]]])
    blurred = blur_to(k.patch.astype(np.float32), scale)
    return np.asarray(
        cv2.warpAffine(
            blurred,
            where,
            shape[::-1],
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        ),
        dtype=np.float32,
    )
