"""
Stereo between panoramas: candidates on walls are matched in other panoramas.

The ray of a candidate meets a wall, and other panoramas should show the same patch of wall. Both
views are resampled on the wall, which removes the effects of slant and distance: only the shift
along the epipolar curve remains (McMillan and Bishop, SIGGRAPH 1995); on the wall the curve is a
short straight line.

`displaced_quarter` tests that all of a patch is flat. A rear corner of furniture lies on the wall,
and a patch around it has a high correlation, which its outline dominates; but each view shows
another side of the furniture. So the quarters of a patch are compared one by one.

`log_nearer` gives depth by scale: if two panoramas and a patch lie on one line, there is no
parallax; but on the way to a patch its image grows the faster the nearer it is. Resampled on the
assumed plane, views of a parallel plane in front of it differ by one factor in both directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array
from landmark_nav.geometry.patches import patch_axes
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.stereo.wall_patch import (
    covered_rows,
    PatchMeasurement,
    StereoConfig,
    texels_per_pixel,
    wall_texture,
    WallPatch,
)
from landmark_nav.matching.alignment import blur_to, Match, match_template
from landmark_nav.types import Candidate, FloatArray, Panorama, Refusal

# Sigma of the Gaussian blur against noise, pixels.
_BLUR_PX = 0.8
# Least mean square of a quarter's gradients, relative to that of the patch: a blank quarter shows
# no displacement.
_BLANK = 0.02


def displaced_quarter(first: Float32Array, second: Float32Array) -> float:
    """
    Greatest displacement of a quarter of a patch between two views (h, w), pixels.

    The views are aligned and equally sharp. It is their deviation, after correction of gain and
    offset, over their gradients. The part common to all quarters is noise and is removed, as is
    the brightness of each quarter.
    """
    one, two = (cv2.GaussianBlur(view - view.mean(), (0, 0), _BLUR_PX) for view in (first, second))
    one *= np.sum(one * two) / np.sum(one * one)
    slopes = [np.gradient(view) for view in (one, two)]
    power = _quarters(0.5 * np.sum(np.square(slopes), axis=(0, 1))).mean(1)
    unlike = _quarters(two - one).var(1)
    power += _BLANK * power.mean()
    return float(np.sqrt(np.max((unlike - unlike.min()) / power)))


def _quarters(image: Float32Array) -> FloatArray:
    """Pixels of the four quarters (4, n), without the middle row and column of odd sizes."""
    rows, columns = image.shape[0] // 2, image.shape[1] // 2
    halves = image[:rows], image[-rows:]
    parts = [part for half in halves for part in (half[:, :columns], half[:, -columns:])]
    return np.array([part.ravel() for part in parts])


# Number of sigmas of the poses that are searched, and the largest margin on the wall.
_SIGMAS = 3.0
_LARGEST_MARGIN_M = 0.5
# Sigma of a patch that is not flat, relative to the displacement of its quarters.
_RELIEF_SHARE = 0.5
# Greatest deviation of the match in the reverse direction, and its least score, relative to that
# of the first one.
_MAX_RETURN_PX, _RETURN_SCORE = 1.0, 0.9
_UNCOVERED = Refusal('not covered by both panoramas')


def hypothesize(
    candidate: Candidate, source: int, panorama: Panorama, room: Room, config: StereoConfig
) -> WallPatch | Refusal:
    """Patch of wall behind a candidate of panorama number `source`."""
    cylinder = panorama.cylinder
    azimuth = float(cylinder.azimuth_rad(candidate.column)) + panorama.heading_rad
    tangent = float(cylinder.tangent(candidate.row))
    distances, walls = room.raycast(panorama.center_map[:2], azimuth)
    distance, wall = float(distances), int(walls)
    if wall < 0:
        return Refusal('no wall behind it')
    height = float(panorama.center_map[2]) + distance * tangent
    normal = room.normals[wall]
    direction = np.array([np.cos(azimuth), np.sin(azimuth)])
    cosine = float(-direction @ normal[:2])
    if cosine < np.cos(config.max_incidence_rad):
        return Refusal('too oblique', f'{np.degrees(np.arccos(cosine)):.0f} deg')
    texel = distance / cylinder.fy
    shape = (candidate.height_px, max(8, round(candidate.width_px / cosine)))
    half = 0.5 * shape[0] * texel
    if not half < height < room.walls[wall].height - half:
        return Refusal('floor or ceiling', f'height {height:.2f} m')
    position = np.append(panorama.center_map[:2] + distance * direction, height)
    right, _ = patch_axes(normal)
    ends = position[:2] + np.array([[-0.5], [0.5]]) * shape[1] * texel * right[:2]
    start, side = room.walls[wall].start, np.subtract(room.walls[wall].end, room.walls[wall].start)
    share = (ends - start) @ side / (side @ side)
    # A corner itself is an edge on both walls.
    if not candidate.edge and (share.min() < 0.0 or share.max() > 1.0):
        return Refusal('across the corner of two walls')
    return WallPatch(candidate, source, wall, position, normal, shape, texel)


def match_in(
    patch: WallPatch, other: int, panoramas: Sequence[Panorama], room: Room, config: StereoConfig
) -> PatchMeasurement | Refusal:
    """
    Find a patch of one panorama in another, number `other`.

    Without parallax and at the same range, a patch on the wall looks like one in front of it.
    """
    here, there = panoramas[patch.source], panoramas[other]
    if sigma := room.walls[patch.wall].sigma_m:
        config = replace(
            config,
            before_wall_m=config.before_wall_m + _SIGMAS * sigma,
            behind_wall_m=config.behind_wall_m + _SIGMAS * sigma,
        )
    if not room.visible(there.center_map[:2], patch.position[:2]):
        return Refusal('hidden from the other place')
    to_here = here.center_map - patch.position
    to_there = there.center_map - patch.position
    if to_there @ patch.normal < np.cos(config.max_incidence_rad) * np.hypot(*to_there[:2]):
        return Refusal('too oblique from the other place')
    # Straight ahead of both, a patch above or below the camera has vertical parallax, and a larger
    # image in the nearer view.
    turn = float(np.linalg.norm(np.cross(to_here, to_there)))
    parallax = float(np.arctan2(turn, to_here @ to_there))
    reach, reach_there = float(np.linalg.norm(to_here)), float(np.linalg.norm(to_there))
    approach = max(reach, reach_there) / min(reach, reach_there)
    if parallax < config.min_parallax_rad and approach < config.min_approach:
        return Refusal('too little parallax', f'{np.degrees(parallax):.1f} deg')
    return compare(patch, other, panoramas, config)


def compare(
    patch: WallPatch, other: int, panoramas: Sequence[Panorama], config: StereoConfig
) -> PatchMeasurement | Refusal:
    """
    Match the two views, resampled on the patch's plane, in both directions.

    The search extends in front of the plane and behind it as `config` says.
    """
    here, there = panoramas[patch.source], panoramas[other]
    area = _search_area(patch, here, there, config)
    template = wall_texture(patch, here)
    if template is None:
        return _UNCOVERED
    # The sharper view is blurred to the resolution of the other, which improves the correlation.
    own, seen = (texels_per_pixel(patch, p) for p in (here, there))
    template = blur_to(template, seen, own)
    ahead = _located(area, template, there, (own, seen), config)
    if isinstance(ahead, Refusal):
        return ahead
    match, point = ahead
    found = wall_texture(replace(patch, position=point), there)
    if found is None:
        return _UNCOVERED
    found = blur_to(found, own, seen)
    loose = replace(config, min_score=_RETURN_SCORE * config.min_score)
    back = _located(replace(patch, shape=area.shape), found, here, (seen, own), loose)
    if isinstance(back, Refusal):
        return Refusal('reverse match differs', str(back))
    # In pixels of the coarser view.
    coarser = max(own.max(), seen.max())
    away = back[1] - patch.position
    if patch.candidate.edge:
        away[2] = 0.0
    off = float(np.linalg.norm(away)) / patch.texel_m / coarser
    if off > _MAX_RETURN_PX:
        return Refusal('reverse match differs', f'by {off:.1f} px')
    displaced = displaced_quarter(template, found) / coarser
    if displaced > config.max_displaced_px:
        return Refusal('not flat', f'a quarter is out of place by {displaced:.1f} px')
    ray = point - there.center_map
    reach = float(np.hypot(ray[0], ray[1]))
    cosine = -float(ray[:2] @ patch.normal[:2]) / reach
    sigma = np.sqrt(np.diag(match.covariance)) * patch.texel_m / reach
    if not patch.on_wall:
        # A patch that is not flat may be matched by any part of it.
        relief = _RELIEF_SHARE * displaced * coarser * patch.texel_m / reach
        sigma = np.hypot(sigma, relief)
    edge = patch.candidate.edge
    nearer = (0.0, np.inf) if edge else log_nearer(patch, point, (here, there))
    return PatchMeasurement(
        other,
        float(np.arctan2(ray[1], ray[0])) - there.heading_rad,
        float(ray[2]) / reach,
        float(sigma[0]) * cosine,
        float(sigma[1]),
        match.score,
        *nearer,
    )


def _located(
    area: WallPatch,
    template: Float32Array,
    panorama: Panorama,
    blur: tuple[FloatArray, FloatArray],
    config: StereoConfig,
) -> tuple[Match, FloatArray] | Refusal:
    """Match of a template in an area of the patch's plane, and its point (3,)."""
    rows = covered_rows(area, panorama)
    count = rows.stop - rows.start
    if count < template.shape[0] + 4:
        return _UNCOVERED
    below = (rows.start + 0.5 * (count - area.shape[0])) * area.texel_m
    center = area.position + below * area.axes[1]
    area = replace(area, position=center, shape=(count, area.shape[1]))
    search = wall_texture(area, panorama)
    if search is None:
        return _UNCOVERED
    match = match_template(
        blur_to(search, *blur),
        template,
        min_score=config.min_score,
        max_second_ratio=config.max_second_ratio,
        edge=area.candidate.edge,
    )
    if isinstance(match, Refusal):
        return match
    off = (match.xy - (np.array(area.shape[::-1]) - 1) / 2.0) * area.texel_m
    return match, center + off @ area.axes


def _search_area(
    patch: WallPatch, here: Panorama, there: Panorama, config: StereoConfig
) -> WallPatch:
    """Area of the patch's plane where `there` may show it."""
    # Depth along the source's ray moves the match along a line on the wall.
    to_here = here.center_map - patch.position
    reach, reach_there = patch.reach_m(here), patch.reach_m(there)
    # At most half way to either camera: near a camera the line on the wall becomes infinite.
    before = min(config.before_wall_m, 0.5 * reach, 0.5 * reach_there)
    shifts = [
        _on_wall(patch, patch.position + depth / reach * to_here, there.center_map)
        for depth in (-config.behind_wall_m, 0.0, before)
    ]
    uncertain = _SIGMAS * np.hypot(_sigma_on_wall(patch, here), _sigma_on_wall(patch, there))
    margin = np.clip(uncertain, config.margin_m, _LARGEST_MARGIN_M) / patch.texel_m + 3.0
    low = np.floor(np.min(shifts, 0) / patch.texel_m - margin).astype(int)
    high = np.ceil(np.max(shifts, 0) / patch.texel_m + margin).astype(int)
    columns, rows = (high - low).tolist()
    return replace(
        patch,
        position=patch.position + (low + high) / 2.0 * patch.texel_m @ patch.axes,
        shape=(patch.shape[0] + rows, patch.shape[1] + columns),
    )


def _sigma_on_wall(patch: WallPatch, panorama: Panorama) -> FloatArray:
    """Sigma (2,) of the patch on the wall, right and down, by the panorama's pose, m."""
    ray = patch.position - panorama.center_map
    # Shift by x, y, z and heading, projected back onto the wall along the ray.
    moved = np.vstack([np.eye(3), [-ray[1], ray[0], 0.0]])
    moved -= np.outer(moved @ patch.normal / (ray @ patch.normal), ray)
    by_place = patch.axes @ moved.T
    return np.asarray(np.sqrt(np.diag(by_place @ panorama.covariance @ by_place.T)))


def _on_wall(patch: WallPatch, point: FloatArray, center: FloatArray) -> FloatArray:
    """Projection of a point onto the wall from `center`, right and down, m."""
    ray = point - center
    scale = ((patch.position - center) @ patch.normal) / float(ray @ patch.normal)
    return np.asarray(patch.axes @ (center + scale * ray - patch.position))


# Blur of a pixel itself, relative to its size.
_BLUR_SHARE = 0.5
_ITERATIONS = 6
_CONVERGED = 1e-4
# With larger values it is not the same patch, or the pattern is not usable.
_MOST = 0.25
_LARGEST_SIGMA = 0.02
_LEAST_PIVOT = 1e-5
# Border of a view that the blur affects, pixels.
MARGIN = 4
_INNER = (slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))


def log_nearer(
    patch: WallPatch, point: FloatArray, panoramas: tuple[Panorama, Panorama]
) -> tuple[float, float]:
    """
    Log ratio of the distances of two panoramas from the true plane of a patch, and its sigma.

    `point` (3,) is its match in the second one, on the plane of the patch. The sigma is infinite
    if the ratio is not observable.
    """
    shape = (patch.shape[0] + 2 * MARGIN, patch.shape[1] + 2 * MARGIN)
    views = [
        wall_texture(replace(patch, position=place, shape=shape), panorama)
        for panorama, place in zip(panoramas, (patch.position, point), strict=True)
    ]
    if views[0] is None or views[1] is None:
        return 0.0, np.inf
    own, seen = (texels_per_pixel(patch, panorama) for panorama in panoramas)
    own_view, seen_view = blur_to(views[0], seen, own), blur_to(views[1], own, seen)
    coarser = float(max(own.max(), seen.max()))
    if own.max() > seen.max():
        larger, sigma = log_magnification(own_view, seen_view, coarser) or (0.0, np.inf)
    else:
        smaller, sigma = log_magnification(seen_view, own_view, coarser) or (0.0, np.inf)
        larger = -smaller
    reach, reach_there = (patch.reach_m(panorama) for panorama in panoramas)
    return larger + float(np.log(reach / reach_there)), sigma


def log_magnification(
    template: Float32Array, found: Float32Array, pixel: float
) -> tuple[float, float] | None:
    """
    Log of the magnification of `found` relative to `template`, and its sigma.

    Shift, gain, offset and blur are estimated too: a slightly more blurred view would look larger,
    as its outlines are wider. Gradients are those of the template alone: with a view's own
    gradients its noise would look like blur. The result is None if the pattern does not show it.

    Both views (h, w) are aligned and about equally sharp; the template should be the coarser one.
    The outermost `MARGIN` pixels are used for filtering only. `pixel` are the texels per pixel of
    the coarser view, the correlation length of its noise.
    """
    height, width = template.shape
    right, down = (
        np.arange(n, dtype=np.float32) - np.float32(0.5 * (n - 1)) for n in (width, height)
    )
    reference = np.asarray(cv2.GaussianBlur(template, (0, 0), _BLUR_PX), np.float32)
    blurred = cv2.GaussianBlur(found, (0, 0), _BLUR_PX) - reference.mean()
    reference -= reference.mean()
    rows = _rows(reference, right, down)
    normal = np.asarray(rows @ rows.T, np.float64)
    size = np.sqrt(np.diag(normal))
    if size.min() <= 0.0:
        return None
    scaled = normal / np.outer(size, size)
    if np.linalg.eigvalsh(scaled)[0] < _LEAST_PIVOT:
        return None
    inverse = np.linalg.inv(scaled) / np.outer(size, size)
    grown, center = 0.0, 0.5 * np.array([width - 1, height - 1])
    for _ in range(_ITERATIONS):
        larger = float(np.exp(grown))
        # cv2.remap is too coarse: it has 32 steps per pixel.
        seen = (
            _cubic(height, center[1] + larger * down)
            @ blurred
            @ _cubic(width, center[0] + larger * right).T
        )
        values = seen[_INNER].ravel()
        solution = inverse @ (rows @ values)
        gain = float(solution[3])
        if gain <= 0.0:
            return None
        step = solution[:3] / gain
        grown, center = grown - float(step[0]), center - step[1:]
        if not abs(grown) < _MOST:
            return None
        if abs(step[0]) < _CONVERGED:
            break
    left = values - solution @ rows
    variance = float(left @ left) / max(values.size - len(rows), 1)
    influence = np.zeros((height, width))
    influence[_INNER] = (inverse[0] @ rows).reshape(seen[_INNER].shape)
    # White noise of the image is filtered by the blur, and so are the residuals.
    passed = float(np.hypot(_BLUR_PX, _BLUR_SHARE * pixel))
    carried = cv2.GaussianBlur(influence, (0, 0), passed, borderType=cv2.BORDER_CONSTANT)
    sigma = float(np.sqrt(4.0 * np.pi * variance * np.sum(carried**2))) * passed / gain
    return (grown, sigma) if sigma < _LARGEST_SIGMA else None


def _rows(view: Float32Array, right: Float32Array, down: Float32Array) -> Float32Array:
    """Derivatives (7, n) of a view (h, w) by size, shift (2), gain, offset and blur (2)."""
    by_y, by_x = np.gradient(view)
    grown = right * by_x + down[:, None] * by_y
    bend_x, bend_y = np.gradient(by_x, axis=1), np.gradient(by_y, axis=0)
    rows = np.stack([grown, by_x, by_y, view, np.ones_like(view), bend_x, bend_y])
    inner = rows[:, MARGIN:-MARGIN, MARGIN:-MARGIN]
    return np.asarray(inner.reshape(len(rows), -1), np.float32)


def _cubic(count: int, places: Float32Array) -> Float32Array:
    """Weights (n, count) of `count` samples at places (n,) between them (Keys, 1981)."""
    away = np.abs(places[:, None] - np.arange(count))
    near = (1.5 * away - 2.5) * away**2 + 1.0
    far = ((2.5 - 0.5 * away) * away - 4.0) * away + 2.0
    return np.asarray(np.where(away < 1.0, near, np.where(away < 2.0, far, 0.0)), np.float32)
