"""
Election: which reconstructed patches become landmarks, and why the others do not.

Livatino and Madsen elect patches whose acquisition camera is inside their observation area.
Further criteria are the size of the patch, its covariance, and the match in another panorama.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc, chdtri

from landmark_nav.geometry.patches import overlap, PatchView
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.adjustment.solution import Adjustment
from landmark_nav.learning.stereo.wall_patch import (
    PatchMeasurement,
    shown_at,
    wall_texture,
    WallPatch,
)
from landmark_nav.parameters import Config, parameter
from landmark_nav.types import FloatArray, ImageArray, Landmark, Panorama, Refusal

# Greatest chi-square of two measurements and a wall; the limit for more views has the same
# significance.
_MAX_CHI_SQUARE = 13.8
# Least cosine between the normals of patches that may cover each other.
_SAME_NORMAL = 0.7
# Detection threshold of a landmark, relative to the correlation between its own views.
_THRESHOLD_SHARE = 0.75


@dataclass(frozen=True)
class ElectionConfig(Config):
    """Criteria for landmarks."""

    # Greatest angle between the reference view and the normal.
    max_incidence_rad: float = 1.05
    # Least width and height in the reference view, pixels.
    min_size_px: int = 20
    max_off_wall_m: float = parameter(
        0.06, 'greatest distance of a patch from its wall, metres', minimum=0, maximum=1
    )
    max_sigma_m: float = parameter(
        0.03,
        'greatest standard deviation of its location relative to others, along any axis, metres; '
        'of a landmark off the walls, across its reference view',
        minimum=1e-4,
        maximum=1,
    )
    max_depth_sigma_m: float = parameter(
        0.02,
        'greatest standard deviation of its distance from the wall by measurements alone, metres',
        minimum=1e-4,
        maximum=1,
    )
    # Greatest standard deviation of the range of a landmark off the walls, relative to the range;
    # larger than max_sigma_m is allowed up to this.
    max_range_share: float = 0.0
    # Greatest share of a patch that another may cover.
    max_overlap: float = 0.4
    max_count: int = parameter(150, 'most landmarks of a map', minimum=3, maximum=5000)


def elect(
    patches: Sequence[WallPatch],
    measurements: Sequence[Sequence[PatchMeasurement]],
    adjustment: Adjustment,
    free: Adjustment,
    panoramas: Sequence[Panorama],
    room: Room,
    config: ElectionConfig,
) -> list[Landmark | Refusal]:
    """
    Elect landmarks among reconstructed patches; the result is in their order.

    Ids count from 1 in the order of saliency.

    Parameters
    ----------
    patches, measurements : sequence
        Reconstructed patches and their measurements.
    adjustment, free : Adjustment
        The patches as adjusted, and by measurements alone, without walls.
    panoramas : sequence of Panorama
        Panoramas with adjusted poses.
    """
    outcomes: list[Landmark | Refusal] = [Refusal('not reached')] * len(patches)
    covariance = adjustment.own_covariance + np.einsum(
        'nip,njp->nij', adjustment.shared_loading, adjustment.shared_loading
    )
    normals = np.array([patch.normal for patch in patches])
    depth_sigma = np.sqrt(np.einsum('ni,nij,nj->n', normals, free.own_covariance, normals))
    taken: list[Landmark] = []
    for k in np.argsort([-patch.candidate.saliency for patch in patches], kind='stable'):
        patch, panorama = patches[k], panoramas[patches[k].source]
        own = next(s for s in measurements[k] if s.panorama == patch.source)
        others = [s for s in measurements[k] if s is not own]
        position = adjustment.positions[k]
        refusal = _refuse(patch, k, adjustment, depth_sigma[k], panorama, len(others), config)
        if refusal is not None:
            outcomes[k] = refusal
            continue
        if any(_overlap(patch, position, other) > config.max_overlap for other in taken):
            outcomes[k] = Refusal('covered by a stronger landmark')
            continue
        if len(taken) >= config.max_count:
            outcomes[k] = Refusal('enough landmarks', f'{config.max_count} stronger ones')
            continue
        texture = _texture(patch, position, panorama, own)
        if texture is None:
            outcomes[k] = Refusal('runs out of its panorama')
            continue
        score = min(s.score for s in measurements[k])
        landmark = Landmark(
            id=len(taken) + 1,
            position=position,
            covariance=covariance[k],
            shared_loading=adjustment.shared_loading[k],
            normal=patch.normal,
            width_m=patch.shape[1] * patch.texel_m,
            height_m=patch.shape[0] * patch.texel_m,
            patch=texture,
            viewpoint=panorama.center_map,
            threshold=float(np.clip(_THRESHOLD_SHARE * score, 0.55, 0.85)),
            wall_id=room.walls[patch.wall].id if patch.on_wall else '',
            saliency=patch.candidate.saliency,
        )
        views = [_view(patch, landmark, panoramas[s.panorama], s) for s in others]
        landmark = replace(landmark, views=tuple(view for view in views if view is not None))
        outcomes[k] = landmark
        taken.append(landmark)
    return outcomes


def _refuse(
    patch: WallPatch,
    k: int,
    adjustment: Adjustment,
    depth_sigma: float,
    panorama: Panorama,
    others: int,
    config: ElectionConfig,
) -> Refusal | None:
    # Two views and a wall give two degrees of freedom; each further view adds two.
    likelihood = chdtrc(2, _MAX_CHI_SQUARE)
    most = float(chdtri(2 * others, likelihood))
    off_wall, misfit = adjustment.off_wall_m[k], adjustment.chi_square[k]
    # What all landmarks of the map share does not distinguish them.
    own = adjustment.own_covariance[k]
    ray = panorama.center_map[:2] - adjustment.positions[k, :2]
    if patch.on_wall:
        if abs(off_wall) > config.max_off_wall_m or misfit > most:
            return Refusal('not on a wall', f'{off_wall * 100:.0f} cm off, misfit {misfit:.0f}')
        # The wall would draw to it whatever stands there.
        if depth_sigma > config.max_depth_sigma_m:
            return Refusal('too little parallax', f'{depth_sigma * 100:.1f} cm sigma of its depth')
    else:
        if misfit > most:
            return Refusal('its views contradict each other', f'misfit {misfit:.0f}')
        reach = float(np.hypot(*ray))
        toward = np.append(ray / reach, 0.0)
        along = float(np.sqrt(toward @ own @ toward))
        if along > max(config.max_sigma_m, config.max_range_share * reach):
            return Refusal('too little parallax', f'{along * 100:.1f} cm sigma of its distance')
        across = np.eye(3) - np.outer(toward, toward)
        own = across @ own @ across
    sigma = float(np.sqrt(np.linalg.eigvalsh(own)[-1]))
    if sigma > config.max_sigma_m:
        return Refusal('place too uncertain', f'{sigma * 100:.1f} cm')
    incidence = float(np.arccos(np.clip(ray @ patch.normal[:2] / np.hypot(*ray), -1.0, 1.0)))
    if incidence > config.max_incidence_rad:
        return Refusal('too oblique', f'{np.degrees(incidence):.0f} deg')
    if min(patch.candidate.width_px, patch.candidate.height_px) < config.min_size_px:
        return Refusal('too small')
    return None


def _overlap(patch: WallPatch, position: FloatArray, other: Landmark) -> float:
    """Overlap of two patches in one plane, relative to the smaller one."""
    size = np.array([patch.shape[1], patch.shape[0]]) * patch.texel_m
    other_size = np.array([other.width_m, other.height_m])
    right, down = patch.axes
    away = other.position - position
    if abs(away @ patch.normal) > 0.5 * size.max() or other.normal @ patch.normal < _SAME_NORMAL:
        return 0.0
    apart = np.abs([away @ right, away @ down])
    # An edge goes on above and below: its parts share their error.
    if patch.candidate.edge and other.edge:
        apart[1] = 0.0
    return float(overlap(apart, size, other_size))


def _view(
    patch: WallPatch, landmark: Landmark, panorama: Panorama, measured: PatchMeasurement
) -> PatchView | None:
    """Image of a landmark in another panorama, at the resolution of that panorama."""
    reach = float(np.hypot(*(panorama.center_map - landmark.position)[:2]))
    columns = max(8, round(landmark.width_m * panorama.cylinder.fy / reach))
    texel = landmark.width_m / columns
    shape = (max(8, round(landmark.height_m / texel)), columns)
    sized = replace(patch, shape=shape, texel_m=texel)
    texture = _texture(sized, landmark.position, panorama, measured)
    return None if texture is None else PatchView(panorama.center_map, texture)


def _texture(
    patch: WallPatch, position: FloatArray, panorama: Panorama, measured: PatchMeasurement
) -> ImageArray | None:
    """Texture of a patch where a panorama shows it; None if that does not cover it."""
    shown = shown_at(position, patch.normal, panorama, measured)
    texture = wall_texture(replace(patch, position=shown), panorama)
    return None if texture is None else np.clip(np.rint(texture), 0, 255).astype(np.uint8)
