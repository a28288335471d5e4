"""Rooms out of a seed: outline, reference papers, and everything in them."""

from __future__ import annotations

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.walls import Paper, Room, Wall
from landmark_nav.simulation.furnishing import furnish
from landmark_nav.simulation.places import choose_sweep_places
from landmark_nav.simulation.scene import Scene
from landmark_nav.types import FloatArray

__all__ = ['generate_room', 'generate_scene']


_ATTEMPTS = 25

# A room must show this many things to both places that the camera turns at.
_WANTED_ITEMS = 8

_PAPER_SIZE_M = (0.21, 0.297)


def generate_scene(seed: int, room: Room | None = None) -> Scene:
    """
    Furnish a room.

    Parameters
    ----------
    seed : int
        The same seed gives the same scene; no two seeds give the same.
    room : Room, optional
        Walls and papers; by default they are drawn too.

    Returns
    -------
    Scene
        With the specialised target and places from where it and all papers are seen well.

    Raises
    ------
    LandmarkNavError
        The given room is too small or too winding for that.

    """
    best: Scene | None = None
    most = -1
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([seed, attempt])
        scene = furnish(room if room is not None else generate_room(rng), rng, seed)
        places = choose_sweep_places(scene)
        if places is None:
            continue
        if places.shared_items >= _WANTED_ITEMS:
            return scene
        if places.shared_items > most:
            best, most = scene, places.shared_items
    if best is None:
        raise LandmarkNavError(
            'the room has no two places 1.5 to 2.5 m apart that see all papers and the target: '
            'make it larger or hang the papers where they are seen from its middle'
        )
    return best


def generate_room(rng: np.random.Generator) -> Room:
    """Outline, a third of them L-shaped, and three papers wide apart on one wall."""
    length = float(rng.integers(50, 91)) / 10.0
    width = float(rng.integers(40, 61)) / 10.0
    height = float(rng.integers(25, 30)) / 10.0
    outline = np.array([[0.0, 0.0], [length, 0.0], [length, width], [0.0, width]])
    if length > 6.0 and rng.random() < 1.0 / 3.0:
        notch = np.round(np.array([length, width]) * rng.uniform(0.25, 0.4, 2), 1)
        inner = np.array([length, width]) - notch
        outline = np.array(
            [[0, 0], [length, 0], [length, inner[1]], inner, [inner[0], width], [0, width]]
        )
    for axis, size in ((0, length), (1, width)):
        if rng.random() < 0.5:
            outline[:, axis] = size - outline[:, axis]
            outline = outline[::-1]
    walls = _walls(np.round(outline, 3), height)
    return Room(walls, _papers(walls, rng))


def _walls(outline: FloatArray, height: float) -> tuple[Wall, ...]:
    """Walls along a counter-clockwise outline, called after the side of the room."""
    names = {(0, 1): 'south', (-1, 0): 'east', (0, -1): 'north', (1, 0): 'west'}
    used: dict[str, int] = {}
    walls = []
    for start, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        side = np.sign(np.round(end - start, 6)).astype(int)
        name = names[(-int(side[1]), int(side[0]))]
        used[name] = used.get(name, 0) + 1
        label = name if used[name] == 1 else f'{name}_{used[name]}'
        ends = [(float(p[0]), float(p[1])) for p in (start, end)]
        walls.append(Wall(label, ends[0], ends[1], height))
    return tuple(walls)


def _papers(walls: tuple[Wall, ...], rng: np.random.Generator) -> tuple[Paper, ...]:
    """Three colours on the longest wall, in any order, 1 m apart or more."""
    wall = max(walls, key=lambda candidate: candidate.length)
    room_for = wall.length - 1.2
    gaps = rng.uniform(1.05, 1.5, 2)
    gaps *= min(1.0, room_for / gaps.sum())
    first = 0.6 + rng.uniform(0.0, room_for - gaps.sum()) if room_for > gaps.sum() else 0.6
    along = first + np.array([0.0, gaps[0], gaps.sum()])
    height = float(np.round(rng.uniform(1.5, 1.7), 2))
    start, end = np.array(wall.start), np.array(wall.end)
    papers = []
    for color, distance in zip(rng.permutation(['red', 'green', 'blue']), along, strict=True):
        x, y = np.round(start + (end - start) * distance / wall.length, 3)
        papers.append(Paper(str(color), (float(x), float(y), height), *_PAPER_SIZE_M))
    return tuple(papers)
