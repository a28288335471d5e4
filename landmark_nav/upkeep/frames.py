"""
Alignment of two maps with different frames by their common landmarks, and merge of two maps.

A single matching texture gives a complete transformation, as heights and normals are known. Each
match is tried, and the transformation with most support is fitted to all its inliers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from landmark_nav.arrays import BoolArray, Float32Array, IndexArray
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.patches import patch_axes
from landmark_nav.geometry.se2 import compose, rot_z, rotation
from landmark_nav.geometry.walls import Room, Wall
from landmark_nav.matching.alignment import match_template
from landmark_nav.types import FloatArray, Landmark, LandmarkMap, PoseEstimate, Refusal
from landmark_nav.upkeep.comparison import (
    compare_maps,
    Comparison,
    Pair,
    resampled,
    Texture,
    wall_changes,
)

# Share of a patch that is the template, the least correlation, and the least size of a template.
_TEMPLATE, _MIN_SCORE = 0.6, 0.7
_MIN_TEMPLATE_PX = 8
# Greatest number of matches that are tried as transformations; it bounds time and memory.
_MOST_MATCHES = 1500
# Sigma of the difference in height of two frames, apart from the scale: floor and camera.
_HEIGHT_SIGMA_M = 0.03
# Sigmas of a normal and of the location of a match.
_NORMAL_SIGMA_RAD, _MATCH_SIGMA_M = 0.02, 0.005
_GATE_SIGMAS = 3.0
# Relative sigma of a scale that was measured by a person.
_MEASURED_SCALE_SIGMA = 2e-3
# Least support, also as a share of the landmarks: of 120 landmarks of two rooms at most 4 agreed
# by chance, of one room 84 to 100 (seeds 901, 902). Greatest support of another transformation,
# relative to the best one.
_LEAST_SUPPORT, _LEAST_SHARE, _MOST_RIVAL = 4, 0.1, 0.5
# Rounds of the fit; factor on the gate in the first round, halved in each; and information that
# regularises unknowns without data.
_ROUNDS, _FIRST_SPREAD, _LEAST_INFORMATION = 10, 8.0, 1e-9


@dataclass(frozen=True, eq=False)
class FrameAlignment:
    """
    Transformation from the frame of map b to that of map a.

    `pose` (3,) is that of the frame of b in that of a, and `rise_m` its height, which differs from
    0 as the height of the camera is given, not scaled; `scale` is the length of a metre of b in
    metres of a. `covariance` is that of x, y, height, heading and the logarithm of the scale;
    `support` the number of inlier landmarks.
    """

    pose: FloatArray
    rise_m: float
    scale: float
    covariance: FloatArray
    support: int


@dataclass(frozen=True, eq=False)
class _Matches:
    """Similar textures: locations (m, 3) in each map, heading of b in a, indices of landmarks."""

    in_a: FloatArray
    in_b: FloatArray
    turn_rad: FloatArray
    a: IndexArray
    b: IndexArray

    def chosen(self, which: BoolArray) -> _Matches:
        return _Matches(*(getattr(self, name)[which] for name in self.__dataclass_fields__))

    @property
    def landmarks(self) -> int:
        """Number of landmarks in the matches, of the map with fewer."""
        return min(len(np.unique(self.a)), len(np.unique(self.b)))


def in_one_frame(a: LandmarkMap, b: LandmarkMap) -> tuple[LandmarkMap, FrameAlignment | None]:
    """Map b in the frame of a, and the alignment: None if both were measured in one frame."""
    if not (a.has_own_frame or b.has_own_frame):
        return b, None
    alignment = align_frames(a, b)
    return replace(in_frame_of(alignment, b), frame_id=a.frame_id), alignment


def align_frames(a: LandmarkMap, b: LandmarkMap) -> FrameAlignment:
    """
    Estimate pose and scale of the frame of map b in that of map a.

    Raises `LandmarkNavError`: the maps have too few landmarks in common, or more than one
    transformation fits.
    """
    sigma_a, sigma_b = (m.scale_sigma or _MEASURED_SCALE_SIGMA for m in (a, b))
    scale_sigma = float(np.hypot(sigma_a, sigma_b))
    matches = _matches(a, b, scale_sigma)
    best, explained = _best(a, b, matches, scale_sigma)
    needed = max(_LEAST_SUPPORT, _LEAST_SHARE * min(len(a.landmarks), len(b.landmarks)))
    if best is None or best.support < needed:
        raise LandmarkNavError(
            f'{best.support if best else 0} landmarks agree on where the frames of the maps are '
            f'to each other, {needed:.0f} are needed: are they of one room? Learn one map of all '
            'sweeps'
        )
    # Inliers of the best transformation do not support another.
    rival, _ = _best(a, b, matches.chosen(~explained), scale_sigma)
    if rival is not None and rival.support > max(_LEAST_SUPPORT, _MOST_RIVAL * best.support):
        raise LandmarkNavError(
            f'{best.support} landmarks agree on where the frames of the maps are to each other, '
            f'and {rival.support} on another place: textures repeat; learn one map of all sweeps'
        )
    return best


def in_frame_of(alignment: FrameAlignment, b: LandmarkMap) -> LandmarkMap:
    """
    Return map b in the frame and the scale of a.

    The error of the alignment adds five factors that all its landmarks share.
    """
    scale, pose = alignment.scale, alignment.pose
    turn = rot_z(pose[2])
    origin = np.array([*pose[:2], alignment.rise_m])
    root = np.linalg.cholesky(alignment.covariance)

    def placed(points: FloatArray) -> FloatArray:
        return np.asarray(origin + scale * turn @ points)

    def moved(k: Landmark) -> Landmark:
        position = placed(k.position)
        factors = _by_frame(position - origin) @ root
        by_own = scale * turn
        return replace(
            k,
            position=position,
            covariance=by_own @ k.covariance @ by_own.T + factors @ factors.T,
            shared_loading=np.hstack([by_own @ k.shared_loading, factors]),
            normal=turn @ k.normal,
            width_m=scale * k.width_m,
            height_m=scale * k.height_m,
            viewpoint=placed(k.viewpoint),
            views=tuple(replace(v, viewpoint=placed(v.viewpoint)) for v in k.views),
        )

    def posed(place: PoseEstimate) -> PoseEstimate:
        way = place.pose * [scale, scale, 1.0]
        by_own = np.diag([scale, scale, 1.0])
        by_own[:2, :2] = scale * rotation(pose[2])
        covariance = by_own @ place.covariance @ by_own.T
        return replace(place, pose=compose(pose, way), covariance=covariance)

    def walled(wall: Wall) -> Wall:
        start, end = (placed(np.array([*p, 0.0]))[:2].tolist() for p in (wall.start, wall.end))
        height = scale * wall.height + alignment.rise_m
        return replace(wall, start=tuple(start), end=tuple(end), height=height)

    known = b.calibration
    if known is not None and known.by_map is not None:
        known = replace(known, by_map=np.pad(known.by_map, ((0, 0), (0, 5))))
    return replace(
        b,
        landmarks=tuple(moved(k) for k in b.landmarks),
        walls=tuple(walled(wall) for wall in b.walls),
        panorama_poses=tuple(posed(place) for place in b.panorama_poses),
        calibration=known,
    )


def _by_frame(ways: FloatArray) -> FloatArray:
    """Derivatives (..., 3, 5) of points by the alignment; `ways` (..., 3) are from its origin."""
    jacobian = np.zeros((*ways.shape, 5))
    jacobian[..., :3] = np.eye(3)
    jacobian[..., 0, 3], jacobian[..., 1, 3] = -ways[..., 1], ways[..., 0]
    jacobian[..., 4] = ways
    return jacobian


def _matches(a: LandmarkMap, b: LandmarkMap, scale_sigma: float) -> _Matches:
    """Similar textures at the same height, the best first."""
    texels = [k.width_m / k.patch.shape[1] for m in (a, b) for k in m.landmarks if k.patch.size]
    texel = float(np.median(texels)) if texels else 1.0

    def image(k: Landmark) -> Float32Array:
        shape = max(int(k.height_m / texel), 1), max(int(k.width_m / texel), 1)
        return resampled(k, texel, shape, np.zeros(2))

    images_a, images_b = (
        [(k, image(k), index) for index, k in enumerate(m.landmarks) if k.patch.size]
        for m in (a, b)
    )
    rows = []
    for one, image_a, i in images_a:
        for other, image_b, j in images_b:
            apart = abs(one.position[2] - other.position[2])
            if apart > 0.5 * max(one.height_m, other.height_m) + _GATE_SIGMAS * _HEIGHT_SIGMA_M:
                continue
            found = _offset(image_a, image_b)
            if found is None:
                continue
            score, offset_a, offset_b = found
            point_a = _point(one, texel * offset_a)
            point_b = _point(other, texel * offset_b)
            height_sigma = np.hypot(_HEIGHT_SIGMA_M, scale_sigma * point_a[2])
            if abs(point_a[2] - point_b[2]) > _GATE_SIGMAS * height_sigma:
                continue
            turn = np.arctan2(*one.normal[1::-1]) - np.arctan2(*other.normal[1::-1])
            rows.append((score, *point_a, *point_b, turn, i, j))
    table = np.array(sorted(rows, reverse=True)[:_MOST_MATCHES]).reshape(-1, 10)
    index = table[:, 8:].astype(np.intp)
    return _Matches(table[:, 1:4], table[:, 4:7], wrap_rad(table[:, 7]), index[:, 0], index[:, 1])


def _offset(a: Float32Array, b: Float32Array) -> tuple[float, FloatArray, FloatArray] | None:
    """Score, and offsets (2,) of the same point from the middles of both images, px; or None."""
    swapped = a.size > b.size
    small, large = (b, a) if swapped else (a, b)
    top, left = (round(0.5 * (1.0 - _TEMPLATE) * length) for length in small.shape)
    template = small[top : small.shape[0] - top, left : small.shape[1] - left].copy()
    least = np.array(template.shape)
    if least.min() < _MIN_TEMPLATE_PX or (least + 4 > large.shape).any():
        return None
    match = match_template(large, template, min_score=_MIN_SCORE)
    if isinstance(match, Refusal):
        return None
    middle, offset = np.zeros(2), match.xy - (np.array(large.shape[::-1]) - 1) / 2.0
    return (match.score, offset, middle) if swapped else (match.score, middle, offset)


def _point(k: Landmark, offset_m: FloatArray) -> FloatArray:
    right, down = patch_axes(k.normal)
    return np.asarray(k.position + offset_m[0] * right + offset_m[1] * down)


def _agreement(matches: _Matches, scale_sigma: float) -> BoolArray:
    """Whether the transformation of each match (rows) fits the others (columns), (m, m)."""
    way_a, way_b = (xyz[None, :, :2] - xyz[:, None, :2] for xyz in (matches.in_a, matches.in_b))
    off = np.einsum('kij,klj->kli', rotation(matches.turn_rad), way_b) - way_a
    sigma = np.hypot(scale_sigma, _NORMAL_SIGMA_RAD) * np.linalg.norm(way_b, axis=-1)
    turn = wrap_rad(matches.turn_rad[None] - matches.turn_rad[:, None])
    return np.asarray(
        (np.linalg.norm(off, axis=-1) < _GATE_SIGMAS * np.hypot(sigma, 2.0 * _MATCH_SIGMA_M))
        & (np.abs(turn) < _GATE_SIGMAS * 2.0 * _NORMAL_SIGMA_RAD)
    )


def _distinct(agree: BoolArray, matches: _Matches) -> IndexArray:
    """Number of landmarks in each row of `agree`, of the map with fewer."""
    counts = []
    for index in (matches.a, matches.b):
        order = np.argsort(index, kind='stable')
        begins = np.flatnonzero(np.diff(index[order], prepend=-1))
        counts.append(np.logical_or.reduceat(agree[:, order], begins, axis=1).sum(1))
    return np.asarray(np.minimum(*counts))


def _best(
    a: LandmarkMap, b: LandmarkMap, matches: _Matches, scale_sigma: float
) -> tuple[FrameAlignment | None, BoolArray]:
    """Transformation with most inliers, fitted to them, and the mask (m,) of the inliers."""
    if not len(matches.a):
        return None, np.zeros(0, dtype=np.bool_)
    agree = _agreement(matches, scale_sigma)
    first = int(np.argmax(_distinct(agree, matches)))
    # Pose and scale by Gauss-Newton from these inliers, which are updated in each round.
    chosen, turn_rad = matches.chosen(agree[first]), matches.turn_rad[first]
    state = np.array([*(chosen.in_a - chosen.in_b @ rot_z(turn_rad).T).mean(0), turn_rad, 0.0])
    # Both frames are on the floor, except for the effect of the scale at a given camera height.
    height_sigma = np.hypot(_HEIGHT_SIGMA_M, scale_sigma * np.abs(matches.in_a[:, 2]).max())
    prior = np.diag([0.0, 0.0, height_sigma**-2, 0.0, scale_sigma**-2])
    spread = _FIRST_SPREAD
    for _ in range(_ROUNDS):
        scaled = np.exp(state[4]) * rot_z(state[3])
        ways = matches.in_b @ scaled.T
        off = matches.in_a - ways - state[:3]
        noise = a.covariances[matches.a] + scaled @ b.covariances[matches.b] @ scaled.T
        information = np.linalg.inv(noise + _MATCH_SIGMA_M**2 * np.eye(3))
        which = np.einsum('mi,mij,mj->m', off, information, off) < (_GATE_SIGMAS * spread) ** 2
        spread = max(1.0, 0.5 * spread)
        jacobian = _by_frame(ways[which])
        weighed = np.einsum('mki,mkl->mil', jacobian, information[which])
        normal = np.einsum('mil,mlj->ij', weighed, jacobian) + prior
        covariance = np.linalg.inv(normal + _LEAST_INFORMATION * np.eye(5))
        # Only height and logarithm of the scale have a prior, with mean 0.
        state = state + covariance @ (np.einsum('mil,ml->i', weighed, off[which]) - prior @ state)
    support = matches.chosen(which).landmarks
    pose, rise_m = np.array([*state[:2], wrap_rad(state[3])]), float(state[2])
    found = FrameAlignment(pose, rise_m, float(np.exp(state[4])), covariance, support)
    return found, agree[first]


# Greatest shift of a wall between two maps in one frame.
_SAME_WALL_M = 1e-3
# Greatest distance of a patch of an aligned map from a wall, and least cosine of their normals.
_ON_WALL_M, _SAME_NORMAL = 0.1, np.cos(np.radians(5.0))
# Keys of the provenance that describe the frame of a map.
_OF_FRAME = ('frame', 'scale', 'scale_sigma')
# Greatest disagreement of the locations of one texture, sigmas.
_MAX_SIGMAS = 5.0
# Least number of changed textures that is more than a few replaced posters.
_FEW = 4


def merge_maps(older: LandmarkMap, newer: LandmarkMap) -> LandmarkMap:
    """
    Merge two maps; at common locations the better landmark is kept.

    If the texture is the same, this is the one with the smaller covariance; if it has changed, the
    newer one; if the overlap is too small to decide, both. Landmarks of the older map keep their
    ids; added ones get greater ids. The errors of the two maps are independent, so that their
    landmarks share no factors. A map with its own frame is aligned first; its landmarks are then
    assigned to the walls of the older map.

    Raises `LandmarkNavError`: frames or walls differ, both maps were learned from one panorama, or
    the maps cannot be aligned or contradict each other.
    """
    newer, alignment = in_one_frame(older, newer)
    if alignment is None:
        _check_same_room(older, newer)
    else:
        on_walls = (_on_wall_of(older, k) for k in newer.landmarks)
        newer = replace(newer, landmarks=tuple(k for k in on_walls if k is not None))
    _check_sweeps(older, newer)
    comparison = compare_maps(older, newer)
    _check_agreement(comparison)
    known_pairs = [pair for pair in comparison.pairs if pair.texture is not Texture.UNKNOWN]
    outdated = {pair.a.id for pair in known_pairs if not _older_stays(pair)}
    kept_out = {pair.b.id for pair in known_pairs if _older_stays(pair)}
    first_free = int(max(older.ids, default=-1)) + 1
    factors_older, factors_newer = (m.shared_loadings.shape[2] for m in (older, newer))
    added = [k for k in newer.landmarks if k.id not in kept_out]
    provenance = {key: text for key, text in newer.provenance.items() if key not in _OF_FRAME}
    known = newer.calibration
    if known is not None and known.by_map is not None:
        known = replace(known, by_map=np.pad(known.by_map, ((0, 0), (factors_older, 0))))
    kept = [_padded(k, 0, factors_newer) for k in older.landmarks if k.id not in outdated]
    for number, k in enumerate(added, first_free):
        kept.append(replace(_padded(k, factors_older, 0), id=number))
    return replace(
        older,
        landmarks=tuple(kept),
        panorama_poses=(*older.panorama_poses, *newer.panorama_poses),
        provenance={**provenance, **older.provenance, 'merged': '2 maps'},
        prior=newer.prior,
        calibration=known,
    )


def _older_stays(pair: Pair) -> bool:
    better = np.trace(pair.a.covariance) <= np.trace(pair.b.covariance)
    return bool(pair.texture is Texture.SAME and better)


def _check_same_room(a: LandmarkMap, b: LandmarkMap) -> None:
    if a.frame_id != b.frame_id:
        raise LandmarkNavError(f'the maps have frames {a.frame_id} and {b.frame_id}: not one room')
    for name, moved in wall_changes(a, b).items():
        if moved == np.inf:
            raise LandmarkNavError(f'wall {name} is in one of the maps alone: not one room')
        if moved > _SAME_WALL_M:
            raise LandmarkNavError(
                f'wall {name} lies {moved:.3f} m apart in the maps: they are of two rooms, or '
                'the room.yaml was changed between them'
            )


def _check_sweeps(a: LandmarkMap, b: LandmarkMap) -> None:
    common = {p.stamp_ns for p in a.panorama_poses} & {p.stamp_ns for p in b.panorama_poses}
    if common:
        raise LandmarkNavError(
            f'both maps have a sweep of {min(common) * 1e-9:.3f} s: if it is the same, their '
            'errors are not independent: learn one map of all sweeps; else record all by one clock'
        )


def _on_wall_of(landmarks: LandmarkMap, k: Landmark) -> Landmark | None:
    """Landmark, assigned to the nearest wall of another map; None if there is no such wall."""
    if not landmarks.walls or not k.wall_id:
        return k
    room = Room(landmarks.walls)
    off = room.wall_distances(k.position[:2])
    off[room.normals @ k.normal < _SAME_NORMAL] = np.inf
    nearest = int(np.argmin(off))
    if off[nearest] > _ON_WALL_M:
        return None
    return replace(k, wall_id=landmarks.walls[nearest].id)


def _check_agreement(comparison: Comparison) -> None:
    """Check that most common textures are unchanged, at locations consistent with covariances."""
    pairs, changed = comparison.of(Texture.SAME), comparison.of(Texture.CHANGED)
    if len(changed) >= max(len(pairs), _FEW):
        raise LandmarkNavError(
            f'{len(changed)} of the {len(pairs) + len(changed)} places that both maps know look '
            'different: one map lies far off, or the room was changed: learn it anew'
        )
    wrong = [pair for pair in pairs if pair.sigmas > _MAX_SIGMAS]
    if len(wrong) > 0.5 * len(pairs):
        worst = max(float(np.hypot(*pair.disagreement_m)) for pair in wrong)
        raise LandmarkNavError(
            f'the maps contradict each other: {len(wrong)} of the {len(pairs)} textures that both '
            f'know lie over {_MAX_SIGMAS:g} sigma apart (up to {100 * worst:.1f} cm): '
            'learn again the one that is wrong (`landmark-nav map diff` lists them)'
        )


def _padded(k: Landmark, before: int, after: int) -> Landmark:
    """Landmark with columns of zeros for the factors of the other map."""
    loading: FloatArray = np.pad(k.shared_loading, ((0, 0), (before, after)))
    return replace(k, shared_loading=loading)
