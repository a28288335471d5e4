"""All candidates of all panoramas, looked for in the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from landmark_nav.arrays import Float32Array
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.stereo.config import StereoConfig
from landmark_nav.learning.stereo.free_stereo import explain, FreeMatch
from landmark_nav.learning.stereo.wall_patch import own_measurement, PatchMeasurement, WallPatch
from landmark_nav.learning.stereo.wall_stereo import hypothesize, match_in
from landmark_nav.types import Candidate, Landmark, Panorama, Refusal

__all__ = ['Found', 'find_again']


@dataclass(frozen=True, eq=False)
class Found:
    """
    Patches that were found again from another place, and where the panoramas show each.

    `origin` holds the panorama and the candidate of each; `outcomes` what became of every
    candidate so far; `off_walls` what was found where it was not looked for, off its wall.
    """

    patches: list[WallPatch]
    measurements: list[list[PatchMeasurement]]
    origin: list[tuple[int, int]]
    outcomes: list[list[Landmark | Refusal]]
    off_walls: list[FreeMatch]

    @property
    def walls(self) -> list[int]:
        """The wall that each patch was looked for on."""
        return [patch.wall for patch in self.patches]

    @property
    def anywhere(self) -> Found:
        """The same with what was found off its wall among the patches."""
        return replace(
            self,
            patches=[*self.patches, *(match.patch for match in self.off_walls)],
            measurements=[*self.measurements, *(match.measurements for match in self.off_walls)],
        )


def find_again(
    panoramas: Sequence[Panorama],
    candidates: Sequence[Sequence[Candidate]],
    greys: Sequence[Float32Array],
    room: Room,
    config: StereoConfig,
) -> Found:
    """Look for each candidate in the other panoramas."""
    found = Found([], [], [], [[] for _ in panoramas], [])
    for i, panorama in enumerate(panoramas):
        for n, candidate in enumerate(candidates[i]):
            patch = hypothesize(candidate, i, panorama, room, config)
            if isinstance(patch, Refusal):
                found.outcomes[i].append(patch)
                continue
            others = [j for j in range(len(panoramas)) if j != i]
            matches = [match_in(patch, j, panoramas, greys, room, config) for j in others]
            seen = [match for match in matches if isinstance(match, PatchMeasurement)]
            if not seen:
                refused = next(match for match in matches if isinstance(match, Refusal))
                off_wall = explain(patch, panoramas, greys, config)
                if off_wall is not None:
                    found.off_walls.append(off_wall)
                found.outcomes[i].append(refused if off_wall is None else off_wall.refusal)
                continue
            found.outcomes[i].append(Refusal('not elected'))
            found.patches.append(patch)
            found.measurements.append([own_measurement(patch, panorama), *seen])
            found.origin.append((i, n))
    return found
