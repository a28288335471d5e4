"""Merge of two maps of one room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from landmark_nav.calibration import Calibration
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.walls import Room
from landmark_nav.types import FloatArray, Landmark, LandmarkMap
from landmark_nav.upkeep.comparison import (
    compare_maps,
    Comparison,
    Pair,
    Texture,
    wall_changes,
)
from landmark_nav.upkeep.frames import brought_together

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
    _check_sweeps(older, newer)
    newer, alignment = brought_together(older, newer)
    if alignment is None:
        _check_same_room(older, newer)
    else:
        on_walls = (_on_wall_of(older, k) for k in newer.landmarks)
        newer = replace(newer, landmarks=tuple(k for k in on_walls if k is not None))
    comparison = compare_maps(older, newer)
    _check_agreement(comparison)
    outdated = {pair.a.id for pair in comparison.pairs if not _older_stays(pair)}
    kept_out = {
        pair.b.id
        for pair in comparison.pairs
        if pair.texture is not Texture.UNKNOWN and _older_stays(pair)
    }
    first_free = int(max(older.ids, default=-1)) + 1
    factors_older, factors_newer = _factors(older), _factors(newer)
    added = [k for k in newer.landmarks if k.id not in kept_out]
    provenance = {key: text for key, text in newer.provenance.items() if key not in _OF_FRAME}
    return LandmarkMap(
        (
            *(_padded(k, 0, factors_newer) for k in older.landmarks if k.id not in outdated),
            *(
                replace(_padded(k, factors_older, 0), id=first_free + i)
                for i, k in enumerate(added)
            ),
        ),
        older.frame_id,
        older.walls,
        (*older.panorama_poses, *newer.panorama_poses),
        {**provenance, **older.provenance, 'merged': '2 maps'},
        newer.prior,
        _shifted(newer.calibration, factors_older),
    )


def _older_stays(pair: Pair) -> bool:
    if pair.texture is Texture.CHANGED:
        return False
    if pair.texture is Texture.UNKNOWN:
        return True
    return bool(np.trace(pair.a.covariance) <= np.trace(pair.b.covariance))


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
            f'both maps were learned from the sweep of {min(common) * 1e-9:.3f} s, so their '
            'errors are not independent: learn one map of all sweeps instead'
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


def _shifted(known: Calibration | None, factors: int) -> Calibration | None:
    """Calibration of the newer map; its factors follow the `factors` of the older one."""
    if known is None or known.by_map is None:
        return known
    return replace(known, by_map=np.pad(known.by_map, ((0, 0), (factors, 0))))


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


def _factors(landmarks: LandmarkMap) -> int:
    return landmarks.landmarks[0].shared_loading.shape[1] if landmarks.landmarks else 0


def _padded(k: Landmark, before: int, after: int) -> Landmark:
    """Landmark with columns of zeros for the factors of the other map."""
    loading: FloatArray = np.pad(k.shared_loading, ((0, 0), (before, after)))
    return replace(k, shared_loading=loading)
