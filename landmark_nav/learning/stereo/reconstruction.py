"""
Search of all candidates of each panorama in the others: on walls, else on planes of their own.

A patch that is not on a wall has an own depth and orientation. It is moved along its ray, upright
and facing both panoramas, and searched between consecutive depths: together these are the epipolar
curve. If matched features around it give its depth, only that is searched. Then the patch is
rotated for the best correlation of its views.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from landmark_nav.geometry.patches import overlap
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.stereo.wall_patch import (
    own_measurement,
    PatchMeasurement,
    StereoConfig,
    texels_per_pixel,
    Ties,
    WallPatch,
)
from landmark_nav.learning.stereo.wall_stereo import compare, hypothesize, match_in
from landmark_nav.types import Candidate, FloatArray, Landmark, Panorama, Refusal, RefusalCode

# Azimuths in the base frame, tangents and horizontal distances (n,) of points in a panorama.
Depths = tuple[FloatArray, FloatArray, FloatArray]
# Ratio of consecutive depths; half a step is searched on either side of each.
_STEP = 0.72
_NEAREST_M, _FARTHEST_M, _WIDEST_M = 0.5, 12.0, 2.0
# Least score without features that give the depth: the search is so wide that chance finds peaks.
_MIN_SCORE = 0.88
# Greatest score of another depth, relative to the best.
_MAX_RIVAL = 0.95
# Features within this distance of a patch, relative to its size, give its depth, which is searched
# within this relative range.
_AROUND, _DEPTH_SHARE = 0.75, 0.1
# Number of features that do not agree by chance, each in a cell of its own of this size.
_AGREED, _ONE_PX = 3, 6.0
# Rotations that are tried, rad; then these steps from the best one.
_TURNS, _FINER = (0.0, 0.5, -0.5, 1.0, -1.0), (0.25, 0.12, 0.06)
# Least score before the rotation is refined, relative to the final one; penalty of the score per
# radian of rotation.
_TURNING_SHARE = 0.8
_TURN_PRICE = 0.02
_LEAST_COSINE = 0.35
# Error of directions that is allowed before a patch counts as off its wall.
_SLACK_RAD = 5e-3
# Range of the search once the depth is known, m.
_NEAR_M, _MARGIN_M = 0.1, 0.01
# Relative sigma of a size by surfaces that are not flat, and greatest disagreement of sizes and
# depth, in sigmas.
_SIZE_SIGMA, _SIZE_SIGMAS = 0.02, 3.0
# Number of panoramas that show a patch beyond doubt, its own among them: one match may be false.
_CONFIRMED = 3
# Number of other panoramas in which a reserve is searched: measurements of more add little to the
# relief of what hangs there.
_MOST_VIEWS = 3
_COVERED = Refusal('covered by a stronger candidate')


def match_freely(
    candidate: Candidate,
    source: int,
    panoramas: Sequence[Panorama],
    config: StereoConfig,
    others: Sequence[int],
    depths: Depths | None = None,
) -> tuple[WallPatch, list[PatchMeasurement]] | Refusal:
    """
    Find a candidate of panorama number `source` in `others`, at any depth.

    `depths` are those of matched features. The result is the patch on its own plane and its
    measurements, that of its own panorama first.
    """
    known = _known_depth(candidate, panoramas[source], depths)
    if depths is not None and known is None and not candidate.edge:
        return Refusal('no feature around it is found again')
    strict = max(config.min_score, _MIN_SCORE)
    searches = [_Search(candidate, source, other, panoramas, config) for other in others]
    best: tuple[float, WallPatch] | None = None
    refused = Refusal('found at no depth')
    for search in searches:
        at = known or search.depth(strict)
        if isinstance(at, Refusal):
            refused = at
            continue
        turned = search.turned(at, _TURNING_SHARE * config.min_score)
        if turned is not None and (best is None or turned[0] > best[0]):
            best = turned
    if best is None:
        return refused
    patch = best[1]
    seen = []
    for search in searches:
        found = search.near(patch, config.min_score)
        if isinstance(found, Refusal):
            refused = found
        else:
            seen.append(found)
    # A single other view may match by chance, and an edge looks like others; two views or several
    # features do not.
    if seen and len(seen) < 2 and not (known and known.agreed):
        least = np.inf if candidate.edge else strict
        seen = [found for found in seen if found.score >= least]
        refused = Refusal('low correlation', f'less than {strict:.2f}')
    return (patch, [own_measurement(patch, panoramas[source]), *seen]) if seen else refused


def depths_of(positions: FloatArray, panorama: Panorama) -> Depths:
    """Azimuths in the base frame, tangents and horizontal distances of points (n, 3) in map."""
    away = positions - panorama.center_map
    distance = np.hypot(away[:, 0], away[:, 1])
    azimuth = np.arctan2(away[:, 1], away[:, 0]) - panorama.heading_rad
    return azimuth, away[:, 2] / distance, distance


def is_off_wall(
    patch: WallPatch,
    measurements: Sequence[PatchMeasurement],
    panoramas: Sequence[Panorama],
    config: StereoConfig,
) -> bool:
    """Whether all other panoramas show a patch of a wall far off it."""
    here = panoramas[patch.source]
    reach = float(np.hypot(*(patch.position - here.center_map)[:2]))
    off = []
    for seen in measurements[1:]:
        there = panoramas[seen.panorama]
        distance = _distance(patch, seen, here, there, config)
        if distance is None:
            return False
        baseline = float(np.hypot(*(there.center_map - here.center_map)[:2]))
        slack = _SLACK_RAD * distance * reach / baseline
        off.append(abs(1.0 - distance / reach) * patch.reach_m(here) - slack)
    return min(off) > config.max_off_wall_m


class _Depth(NamedTuple):
    """Distance of a patch, half width of its search, and whether several features agree."""

    distance_m: float
    near_m: float
    agreed: bool = False


def _known_depth(candidate: Candidate, panorama: Panorama, depths: Depths | None) -> _Depth | None:
    """Distance by the features around a candidate; None if there are none."""
    if depths is None:
        return None
    cylinder, (azimuth, tangent, distance) = panorama.cylinder, depths
    column = cylinder.column_of(azimuth)
    half = 0.5 * cylinder.width
    across = (column - candidate.column + half) % cylinder.width - half
    down = cylinder.row_of(tangent) - candidate.row
    near = np.abs(across) < _AROUND * candidate.width_px
    near &= np.abs(down) < _AROUND * candidate.height_px
    if not near.any():
        return None
    middle = float(np.median(distance[near]))
    spread = float(np.median(np.abs(distance[near] - middle)))
    if spread > _DEPTH_SHARE * middle:
        nearest = np.argmin(np.where(near, across**2 + down**2, np.inf))
        middle, spread = float(distance[nearest]), 0.0
    near &= np.abs(distance - middle) < _DEPTH_SHARE * middle
    # Several features at one corner may belong to one false match.
    cells = np.stack([across, down], 1)[near] // _ONE_PX
    agreed = len(np.unique(cells, axis=0)) >= _AGREED
    return _Depth(middle, _DEPTH_SHARE * middle + spread, agreed)


class _Search:
    """Search of a candidate of panorama `source` in panorama `other`, off the walls."""

    def __init__(
        self,
        candidate: Candidate,
        source: int,
        other: int,
        panoramas: Sequence[Panorama],
        config: StereoConfig,
    ) -> None:
        self._candidate, self._source, self._other = candidate, source, other
        self._panoramas, self._config = panoramas, config
        self._here, self._there = panoramas[source], panoramas[other]

    def depth(self, least: float) -> _Depth | Refusal:
        """Distance of the candidate, from a search along its epipolar curve; by a least score."""
        found: list[tuple[float, float]] = []
        for patch in self._moved():
            step = 0.5 * (1.0 / _STEP - 1.0) * patch.reach_m(self._here)
            if patch.reach_m(self._there) < 2.0 * step:
                continue
            wide = replace(
                self._config,
                min_score=least,
                before_wall_m=min(step, _WIDEST_M),
                behind_wall_m=min(1.3 * step, _WIDEST_M),
                # Its rotation is not known yet.
                max_displaced_px=100.0,
            )
            seen = compare(patch, self._other, self._panoramas, wide)
            if isinstance(seen, PatchMeasurement):
                distance = _distance(patch, seen, self._here, self._there, self._config)
                if distance is not None:
                    found.append((seen.score, distance))
        if not found:
            return Refusal('found at no depth')
        score, distance = max(found)
        apart = -np.log(1.0 - 2 * _DEPTH_SHARE)
        rivals = [s for s, d in found if abs(np.log(d / distance)) > apart]
        if rivals and max(rivals) > _MAX_RIVAL * score:
            return Refusal('found at two depths')
        return _Depth(distance, _NEAR_M)

    def _moved(self) -> Iterator[WallPatch]:
        """Yield the patch at all depths, facing both cameras and rotated to either side."""
        distance = _FARTHEST_M
        while distance > _NEAREST_M:
            for turn in _TURNS:
                patch = self._patch(distance, turn)
                if patch is not None:
                    yield patch
            distance *= _STEP

    def _patch(self, distance: float, turn: float) -> WallPatch | None:
        """Patch at a distance, rotated from facing both; None if oblique or below the floor."""
        candidate, here, there = self._candidate, self._here, self._there
        azimuth = float(here.cylinder.azimuth_rad(candidate.column)) + here.heading_rad
        ray = np.array([np.cos(azimuth), np.sin(azimuth), here.cylinder.tangent(candidate.row)])
        position = here.center_map + distance * ray
        between = 0.5 * (here.center_map + there.center_map)[:2] - position[:2]
        toward = float(np.arctan2(between[1], between[0])) + turn
        normal = np.array([np.cos(toward), np.sin(toward), 0.0])
        cosine = float(-ray[:2] @ normal[:2])
        across = there.center_map - position
        texel = distance / here.cylinder.fy
        if min(cosine, float(across @ normal) / float(np.hypot(*across[:2]))) < _LEAST_COSINE:
            return None
        # As in a mirror or outside a window.
        if position[2] < 0.5 * candidate.height_px * texel:
            return None
        shape = (candidate.height_px, max(8, round(candidate.width_px / cosine)))
        return WallPatch(
            candidate, self._source, -1, position, normal, shape, texel, on_wall=False
        )

    def turned(self, at: _Depth, least: float) -> tuple[float, WallPatch] | None:
        """Score, at `least` this, and patch with distance and rotation of the best correlation."""
        distance, near_m, _ = at
        best: tuple[float, float, float, WallPatch] | None = None
        wrong_size, sized = False, True
        turns: tuple[float, ...] = _TURNS
        for finer in (*_FINER, None):
            for turn in turns:
                patch = self._patch(distance, turn)
                found = patch and self.near(patch, least, near_m)
                if patch is None or not isinstance(found, PatchMeasurement):
                    code = found.code if isinstance(found, Refusal) else None
                    wrong_size |= code is RefusalCode.WRONG_SIZE
                    continue
                exact = _distance(patch, found, self._here, self._there, self._config)
                worth = found.score - _TURN_PRICE * abs(turn)
                if exact is not None and (best is None or worth > best[0]):
                    share, center = exact / distance, self._here.center_map
                    position = center + share * (patch.position - center)
                    patch = replace(patch, position=position, texel_m=share * patch.texel_m)
                    best = worth, turn, exact, patch
                    sized = bool(np.isfinite(found.sigma_log_nearer))
            if best is None or finer is None:
                break
            _, turn, distance, _ = best
            near_m = _NEAR_M
            turns = (turn - finer, turn + finer)
        # What repeats may match in another size; a rotation at which none is measured hides it.
        return None if wrong_size and not sized else best and (best[0], best[3])

    def near(
        self, patch: WallPatch, least: float, near_m: float = _NEAR_M
    ) -> PatchMeasurement | Refusal:
        """Find a patch in the other panorama by a least score, with its plane nearly known."""
        to_there = self._there.center_map - patch.position
        if to_there @ patch.normal < _LEAST_COSINE * np.hypot(*to_there[:2]):
            return Refusal('too oblique from the other place')
        close = replace(
            self._config,
            min_score=least,
            before_wall_m=near_m,
            behind_wall_m=near_m,
            margin_m=_MARGIN_M,
            max_displaced_px=max(self._config.max_displaced_px, self._config.max_relief_px),
        )
        found = compare(patch, self._other, self._panoramas, close)
        if isinstance(found, Refusal):
            return found
        ratio = patch.reach_m(self._here) / patch.reach_m(self._there)
        missed = abs(found.log_nearer - float(np.log(ratio)))
        if missed > _SIZE_SIGMAS * np.hypot(_SIZE_SIGMA, found.sigma_log_nearer):
            detail = f'by {100.0 * missed:.0f} %'
            return Refusal('size contradicts depth', detail, RefusalCode.WRONG_SIZE)
        return found


def _distance(
    patch: WallPatch, seen: PatchMeasurement, here: Panorama, there: Panorama, config: StereoConfig
) -> float | None:
    """Horizontal distance by both azimuths; None if there is too little parallax."""
    # The sine rule in plan (McMillan and Bishop, 1995).
    ray, base = (p[:2] - here.center_map[:2] for p in (patch.position, there.center_map))
    azimuth, toward = (float(np.arctan2(v[1], v[0])) for v in (ray, base))
    heading = seen.azimuth_rad + there.heading_rad
    parallax = float(np.sin(heading - azimuth))
    if abs(parallax) < np.sin(0.5 * config.min_parallax_rad):
        return None
    distance = float(np.hypot(*base) * np.sin(heading - toward) / parallax)
    return distance if _NEAREST_M / 2.0 < distance < 2.0 * _FARTHEST_M else None


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """
    Patches that were found in another panorama, and their measurements.

    `origin` has the panorama and the candidate of each; `outcomes` the result for every candidate
    so far.
    """

    patches: list[WallPatch]
    measurements: list[list[PatchMeasurement]]
    origin: list[tuple[int, int]]
    outcomes: list[list[Landmark | Refusal]]

    @property
    def walls(self) -> list[int]:
        """Wall of each patch, -1 for those on a plane of their own."""
        return [patch.wall if patch.on_wall else -1 for patch in self.patches]

    @property
    def normals(self) -> FloatArray:
        """Normals (n, 3) of the patches."""
        return np.array([patch.normal for patch in self.patches])


def reconstruct(
    panoramas: Sequence[Panorama],
    candidates: Sequence[Sequence[Candidate]],
    room: Room,
    config: StereoConfig,
    ties: Ties | None = None,
    max_overlap: float = 1.0,
) -> Reconstruction:
    """
    Search each candidate in the other panoramas: on the wall behind it, else on its own plane.

    `ties` are features that panoramas share: they give the range of patches around them. Of a
    candidate, a stronger one that several panoramas show may cover a share of more than
    `max_overlap` in its panorama. It is a reserve, and shows how far things are from the wall: it
    is searched in the panoramas that show its depth best, and not at all if `ties` give the poses.
    """
    features = [
        None if ties is None else depths_of(ties.seen_by(i), p) for i, p in enumerate(panoramas)
    ]
    outcomes: list[list[Landmark | Refusal]] = [[_COVERED] * len(group) for group in candidates]
    found: dict[tuple[int, int], tuple[WallPatch, list[PatchMeasurement]]] = {}
    shown: list[list[_Shown]] = [[] for _ in panoramas]
    every = [(i, n) for i, group in enumerate(candidates) for n in range(len(group))]
    for i, n in sorted(every, key=lambda at: -candidates[at[0]][at[1]].saliency):
        panorama, candidate = panoramas[i], candidates[i][n]
        others = [j for j in range(len(panoramas)) if j != i]
        overlaps = _overlaps(candidate, shown[i], panorama)
        is_covered = overlaps.max(initial=0.0) > max_overlap
        if is_covered:
            if ties is not None:
                continue
            others = shown[i][int(overlaps.argmax())].best_views(i, panoramas)
        behind = hypothesize(candidate, i, panorama, room, config)
        again = _on_wall(behind, others, panoramas, room, config)
        # A candidate across a corner of measured walls has no plane of its own.
        flat = ties is not None or isinstance(behind, WallPatch)
        if flat and (isinstance(again, Refusal) or is_off_wall(*again, panoramas, config)):
            own = match_freely(candidate, i, panoramas, config, others, features[i])
            again = again if isinstance(own, Refusal) else own
        if isinstance(again, Refusal):
            outcomes[i][n] = again
            continue
        patch, measurements = again
        if not patch.on_wall:
            azimuth = float(panorama.cylinder.azimuth_rad(candidate.column))
            _, wall = room.raycast(panorama.center_map[:2], azimuth + panorama.heading_rad)
            patch = replace(patch, wall=int(wall))
        outcomes[i][n] = Refusal('not elected')
        found[i, n] = patch, measurements
        if len(measurements) >= _CONFIRMED and not is_covered:
            views = [seen.panorama for seen in measurements]
            for k, seen in zip(views, measurements, strict=True):
                rectangle = _rectangle(patch, seen, panoramas[k])
                shown[k].append(_Shown(rectangle, patch.position, views))
    origin = sorted(found)
    patches, measured = [found[at][0] for at in origin], [found[at][1] for at in origin]
    return Reconstruction(patches, measured, origin, outcomes)


class _Shown(NamedTuple):
    """Rectangle of a patch in a panorama, its position (3,) and all panoramas that show it."""

    rectangle: Candidate
    position: FloatArray
    views: list[int]

    def best_views(self, source: int, panoramas: Sequence[Panorama]) -> list[int]:
        """Other panoramas that show it, those with most information about its depth."""
        away = {k: self.position - panoramas[k].center_map for k in self.views}
        # Parallax per metre of depth.
        slopes = {
            k: float(np.linalg.norm(np.cross(away[source], ray)) / (ray @ ray))
            for k, ray in away.items()
            if k != source
        }
        return sorted(sorted(slopes, key=lambda k: -slopes[k])[:_MOST_VIEWS])


def _rectangle(patch: WallPatch, seen: PatchMeasurement, panorama: Panorama) -> Candidate:
    """Rectangle of a patch in a panorama."""
    width, height = (patch.shape[::-1] / texels_per_pixel(patch, panorama)).tolist()
    return replace(
        patch.candidate,
        column=float(panorama.cylinder.column_of(seen.azimuth_rad)),
        row=float(panorama.cylinder.row_of(seen.tangent)),
        width_px=round(width),
        height_px=round(height),
    )


def _overlaps(one: Candidate, others: Sequence[_Shown], panorama: Panorama) -> FloatArray:
    """Overlaps (n,) of rectangles of a panorama, relative to the smaller one."""
    rectangles = [(c.column, c.row, c.width_px, c.height_px, c.edge) for c, _, _ in others]
    at, sizes, edges = np.split(np.array(rectangles, np.float64).reshape(-1, 5), [2, 4], axis=1)
    apart = np.abs(at - (one.column, one.row))
    apart[:, 0] = np.minimum(apart[:, 0], panorama.cylinder.width - apart[:, 0])
    apart[:, 1] *= 1.0 - edges[:, 0] * one.edge
    return overlap(apart, np.array([one.width_px, one.height_px], np.float64), sizes)


def _on_wall(
    patch: WallPatch | Refusal,
    others: Sequence[int],
    panoramas: Sequence[Panorama],
    room: Room,
    config: StereoConfig,
) -> tuple[WallPatch, list[PatchMeasurement]] | Refusal:
    """Match a candidate on the wall behind it."""
    if isinstance(patch, Refusal):
        return patch
    matches = [match_in(patch, j, panoramas, room, config) for j in others]
    seen = [match for match in matches if isinstance(match, PatchMeasurement)]
    if not seen:
        return next(match for match in matches if isinstance(match, Refusal))
    return patch, [own_measurement(patch, panoramas[patch.source]), *seen]
