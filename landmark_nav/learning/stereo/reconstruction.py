"""Search of all candidates of each panorama in the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from landmark_nav.arrays import FloatArray
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.stereo.own_plane import depths_of, is_off_wall, match_freely
from landmark_nav.learning.stereo.wall_patch import (
    own_measurement,
    PatchMeasurement,
    StereoConfig,
    Ties,
    WallPatch,
)
from landmark_nav.learning.stereo.wall_stereo import hypothesize, match_in
from landmark_nav.types import Candidate, Landmark, Panorama, Refusal


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
) -> Reconstruction:
    """
    Search each candidate in the other panoramas: on the wall behind it, else on its own plane.

    `ties` are features that panoramas share: they give the range of patches around them.
    """
    found = Reconstruction([], [], [], [[] for _ in panoramas])
    for i, panorama in enumerate(panoramas):
        features = None if ties is None else depths_of(ties.seen_by(i), panorama)
        for n, candidate in enumerate(candidates[i]):
            behind = hypothesize(candidate, i, panorama, room, config)
            again = _on_wall(behind, panoramas, room, config)
            # A candidate across a corner of measured walls has no plane of its own.
            flat = ties is not None or isinstance(behind, WallPatch)
            if flat and (isinstance(again, Refusal) or is_off_wall(*again, panoramas, config)):
                own = match_freely(candidate, i, panoramas, config, features)
                again = again if isinstance(own, Refusal) else own
            if isinstance(again, Refusal):
                found.outcomes[i].append(again)
                continue
            patch, measurements = again
            if not patch.on_wall:
                azimuth = float(panorama.cylinder.azimuth_rad(candidate.column))
                _, wall = room.raycast(panorama.center_map[:2], azimuth + panorama.heading_rad)
                patch = replace(patch, wall=int(wall))
            found.outcomes[i].append(Refusal('not elected'))
            found.patches.append(patch)
            found.measurements.append(measurements)
            found.origin.append((i, n))
    return found


def _on_wall(
    patch: WallPatch | Refusal, panoramas: Sequence[Panorama], room: Room, config: StereoConfig
) -> tuple[WallPatch, list[PatchMeasurement]] | Refusal:
    """Match a candidate on the wall behind it."""
    if isinstance(patch, Refusal):
        return patch
    others = [j for j in range(len(panoramas)) if j != patch.source]
    matches = [match_in(patch, j, panoramas, room, config) for j in others]
    seen = [match for match in matches if isinstance(match, PatchMeasurement)]
    if not seen:
        return next(match for match in matches if isinstance(match, Refusal))
    return patch, [own_measurement(patch, panoramas[patch.source]), *seen]
