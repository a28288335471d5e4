"""Random rooms, and random things on their walls and floor."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.walls import Marker, Paper, Room, Wall
from landmark_nav.simulation.scene import Box, choose_sweep_places, Lamp, Scene, WallItem
from landmark_nav.types import FloatArray

Generator = np.random.Generator

_TARGET_SIZE_M = 0.5
# Smallest distance of things on a wall from each other, and from corners.
_GAP_M = 0.1
_CORNER_M = 0.12
# Size of tags with their white border and without it, and heights that are tried for them.
_TAG_M, _MARKER_M, _TAG_HEIGHTS_M = 0.2, 0.16, (1.5, 1.1, 1.9)
TAG_DICTIONARY = 'DICT_APRILTAG_36h11'
_POSTERS = ('photo', 'poster')
# Relative power of a dimmed lamp on another day.
_DIMMED = 0.35

# Probability of each kind, and ranges of its width and height, metres.
_KINDS: dict[str, tuple[float, tuple[float, float], tuple[float, float]]] = {
    'photo': (0.45, (0.45, 0.85), (0.4, 0.7)),
    'poster': (0.32, (0.5, 0.75), (0.7, 1.05)),
    'shelf': (0.13, (0.7, 1.0), (0.8, 1.2)),
    'blinds': (0.1, (1.1, 1.7), (0.9, 1.2)),
}

# Range of the distance of a face from the wall, metres: photos have frames, blinds hang before a
# window. All other things lie on the wall.
_BEFORE_M = {'photo': (0.01, 0.03), 'blinds': (0.02, 0.05)}


@dataclass
class _Strip:
    """A wall, and the parts of its length that are occupied."""

    wall: Wall
    taken: list[tuple[float, float]]

    def find(self, width: float, margin: float, rng: Generator) -> float | None:
        """Occupy a free part of length `width`; return its centre, or None if there is none."""
        low, high = margin + width / 2, self.wall.length - margin - width / 2
        if low > high:
            return None
        for along in rng.uniform(low, high, 80):
            a, b = along - width / 2 - _GAP_M, along + width / 2 + _GAP_M
            if all(b <= start or a >= end for start, end in self.taken):
                self.taken.append((along - width / 2, along + width / 2))
                return float(along)
        return None


def furnish(room: Room, rng: Generator, seed: int) -> Scene:
    """Place random things on the walls and furniture on the floor; neither overlap."""
    strips = [_Strip(wall, []) for wall in room.walls]
    for paper in room.papers:
        strip = strips[int(room.nearest_wall(paper.center[:2]))]
        along = float(np.linalg.norm(np.array(paper.center[:2]) - strip.wall.start))
        strip.taken.append((along - paper.width / 2, along + paper.width / 2))
    bare = [k for k, strip in enumerate(strips) if not strip.taken]
    items: list[WallItem] = []
    # The target hangs on a wall without papers if possible, preferably on a long one.
    choice = bare or list(range(len(strips)))
    lengths = np.array([strips[k].wall.length for k in choice])
    longest = int(rng.choice(choice, p=lengths**2 / np.sum(lengths**2)))
    _hang(items, strips, 'target', longest, rng)
    if bare:
        _hang(items, strips, 'door', int(rng.choice(bare)), rng)
    boxes: list[Box] = []
    if rng.random() < 0.5:
        _place_at_wall(boxes, strips, room, rng, tall=True)
    for index, strip in enumerate(strips):
        for _ in range(max(2, round(strip.wall.length / 1.15)) + 1):
            kinds, chances = list(_KINDS), np.array([v[0] for v in _KINDS.values()])
            if sum(item.kind == 'blinds' for item in items) >= 2:
                chances[kinds.index('blinds')] = 0.0
            kind = str(rng.choice(kinds, p=chances / chances.sum()))
            _hang(items, strips, kind, index, rng)
    for _ in range(int(rng.integers(2, 5))):
        _place_at_wall(boxes, strips, room, rng, tall=False)
    if rng.random() < 0.6:
        _place_free(boxes, room, rng)
    lamps = _lamps(room, items, rng)
    return Scene(seed, room, tuple(items), tuple(boxes), lamps)


def move_one_box(scene: Scene, rng: Generator) -> tuple[Box, ...]:
    """Furniture of `scene` with one piece moved; unchanged if there is no space for it."""
    if not scene.boxes:
        return scene.boxes
    index = int(rng.integers(len(scene.boxes)))
    rest = [box for k, box in enumerate(scene.boxes) if k != index]
    moved = scene.boxes[index]
    for _ in range(200):
        shift = rng.uniform(-0.8, 0.8, 2)
        center = np.array(moved.center_xy) + shift
        yaw_rad = moved.yaw_rad + float(rng.uniform(-0.3, 0.3))
        box = replace(moved, center_xy=tuple(center.tolist()), yaw_rad=yaw_rad)
        if np.linalg.norm(shift) > 0.3 and _fits(box, rest, scene.room, 0.0):
            return (*rest, box)
    return scene.boxes


def another_day(scene: Scene, rng: Generator) -> Scene:
    """Scene with one lamp dimmed and one piece of furniture moved."""
    lamps = list(scene.lamps)
    if lamps:
        k = int(rng.integers(len(lamps)))
        lamps[k] = replace(lamps[k], power=_DIMMED * lamps[k].power)
    return replace(scene, lamps=tuple(lamps), boxes=move_one_box(scene, rng))


def exchange_posters(scene: Scene, share: float, rng: Generator) -> tuple[WallItem, ...]:
    """Items of `scene` with a share of the posters and photos replaced by others of their size."""
    items = list(scene.items)
    posters = [k for k, item in enumerate(items) if item.kind in _POSTERS]
    for k in rng.permutation(posters)[: round(share * len(posters))]:
        items[k] = replace(items[k], seed=int(rng.integers(2**31)))
    return tuple(items)


def hang_tags(scene: Scene, spacing_m: float) -> tuple[WallItem, ...]:
    """Items of a room, with AprilTags at free parts of the walls, `spacing_m` apart."""
    items = list(scene.items)
    for index, wall in enumerate(scene.room.walls):
        hung = [
            (item.along_m, item.center_z_m, item.width_m, item.height_m)
            for item in scene.items
            if item.wall == index
        ]
        for paper in scene.room.papers:
            away = np.append(np.subtract(paper.center[:2], wall.start), 0.0)
            if abs(away @ wall.normal) < _GAP_M:
                along_m = float(away[:2] @ wall.along)
                hung.append((along_m, paper.center[2], paper.width, paper.height))
        for along in np.arange(0.5 * spacing_m, wall.length, spacing_m):
            for z in _TAG_HEIGHTS_M:
                if all(
                    abs(along - x) > 0.5 * (_TAG_M + width) or abs(z - y) > 0.5 * (_TAG_M + height)
                    for x, y, width, height in hung
                ):
                    number = len(items) - len(scene.items)
                    items.append(WallItem('tag', index, float(along), z, _TAG_M, _TAG_M, number))
                    break
    return tuple(items)


def markers_of(scene: Scene) -> tuple[Marker, ...]:
    """Tags of a room, with their exact places."""
    return tuple(
        Marker(item.seed, tuple(item.center(scene.room).tolist()), _MARKER_M)
        for item in scene.items
        if item.kind == 'tag'
    )


def _hang(
    items: list[WallItem], strips: list[_Strip], kind: str, index: int, rng: Generator
) -> None:
    """Add one thing on wall `index` if there is space for it."""
    strip = strips[index]
    margin = _CORNER_M
    if kind == 'target':
        width = height = _TARGET_SIZE_M
        margin = min(0.6, 0.2 * strip.wall.length)
    elif kind == 'door':
        width, height = 0.86, 2.0
    else:
        _, widths, heights = _KINDS[kind]
        width, height = float(rng.uniform(*widths)), float(rng.uniform(*heights))
    along = strip.find(width, margin, rng)
    if along is None:
        return
    top = strip.wall.height - 0.15 - height / 2
    center = 1.0 if kind == 'door' else min(float(rng.uniform(1.4, 1.65)), top)
    seed = int(rng.integers(2**31))
    before = float(np.random.default_rng([seed, 6]).uniform(*_BEFORE_M.get(kind, (0.0, 0.0))))
    items.append(WallItem(kind, index, along, center, width, height, seed, before))


def _place_at_wall(
    boxes: list[Box], strips: list[_Strip], room: Room, rng: Generator, *, tall: bool
) -> None:
    """Add furniture with its back to a wall; a tall piece occupies the wall behind it."""
    for _ in range(30):
        strip = strips[int(rng.integers(len(strips)))]
        size = (float(rng.uniform(0.6, 1.5)), float(rng.uniform(0.3, 0.6)))
        height = float(rng.uniform(1.6, 1.95) if tall else rng.uniform(0.45, 0.95))
        wall = strip.wall
        if wall.length < size[0] + 0.5:
            continue
        along = float(rng.uniform(size[0] / 2 + 0.02, wall.length - size[0] / 2 - 0.02))
        side = np.subtract(wall.end, wall.start) / wall.length
        center = wall.start + side * along + wall.normal[:2] * (size[1] / 2 + 0.01)
        yaw_rad = float(np.arctan2(side[1], side[0]))
        material = str(rng.choice(['wood', 'books', 'wood', 'paint']))
        seed = int(rng.integers(2**31))
        box = Box(tuple(center.tolist()), yaw_rad, (*size, height), material, seed)
        part = (along - size[0] / 2, along + size[0] / 2)
        free = all(part[1] <= a or part[0] >= b for a, b in strip.taken)
        if (free or not tall) and _fits(box, boxes, room, 0.0):
            if tall:
                strip.taken.append(part)
            boxes.append(box)
            return


def _place_free(boxes: list[Box], room: Room, rng: Generator) -> None:
    """Add a low piece of furniture in the room, with space to pass."""
    for center in rng.uniform(*room.bounds, (40, 2)):
        size = (float(rng.uniform(0.35, 0.6)), float(rng.uniform(0.35, 0.6)))
        yaw_rad, height = float(rng.uniform(-np.pi, np.pi)), float(rng.uniform(0.4, 0.75))
        material, seed = str(rng.choice(['books', 'paint', 'wood'])), int(rng.integers(2**31))
        box = Box(tuple(center.tolist()), yaw_rad, (*size, height), material, seed)
        if _fits(box, boxes, room, 0.75):
            boxes.append(box)
            return


def _fits(box: Box, others: list[Box], room: Room, clearance_m: float) -> bool:
    """Whether `box` is inside the room and does not overlap other furniture."""
    step = np.linspace(0.0, 1.0, 9)[:, None]
    corners = box.footprint
    outline = np.concatenate(
        [a + (b - a) * step for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    )
    if not bool(np.all(room.contains(outline))):
        return False
    if clearance_m > 0.0 and Scene(0, room).distance_to_obstacles(outline).min() < clearance_m:
        return False
    if not others:
        return True
    rest = Scene(0, room, boxes=tuple(others))
    centers = np.array([other.center_xy for other in others])
    apart = float(np.linalg.norm(centers - box.center_xy, axis=1).min())
    edges = np.concatenate([other.footprint for other in others])
    distance = np.linalg.norm(outline[:, None] - edges, axis=-1).min()
    inside = rest.distance_to_obstacles(outline) == 0.0
    return apart > 0.5 and distance > max(clearance_m, 0.1) and not bool(np.any(inside))


def _lamps(room: Room, items: list[WallItem], rng: Generator) -> tuple[Lamp, ...]:
    """Random panels under the ceiling, and daylight at each window."""
    corners = np.array([wall.start for wall in room.walls])
    low, high = room.bounds
    height = max(wall.height for wall in room.walls)
    long = int(np.argmax(high - low))
    lamps = []
    count = int(rng.integers(2, 4))
    for k in range(count):
        center = 0.5 * (low + high)
        center[long] = low[long] + (high - low)[long] * (k + 0.5) / count
        if not room.contains(center):
            center = 0.5 * (center + corners[room.contains(corners * 0.9 + center * 0.1)].mean(0))
        size = (0.6, 0.6) if rng.random() < 0.5 else (0.3, 1.2)
        tint = 1.0 + rng.uniform(-0.05, 0.05) * np.array([1.0, 0.0, -1.0])
        power = float(rng.uniform(0.8, 1.2))
        lamps.append(Lamp((*center.tolist(), height), size, power, tuple(tint.tolist())))
    for item in items:
        if item.kind == 'blinds':
            at = item.center(room) + 0.15 * room.walls[item.wall].normal
            power = float(rng.uniform(0.15, 0.4))
            lamps.append(Lamp(tuple(at.tolist()), (0.0, 0.0), power, (1.1, 1.0, 0.92)))
    return tuple(lamps)


_ATTEMPTS = 25
# Wanted number of things that are in view from both sweep positions.
_WANTED_ITEMS = 8
_PAPER_SIZE_M = (0.21, 0.297)


def generate_scene(seed: int, room: Room | None = None) -> Scene:
    """
    Generate a random furnished room, in which walls and papers may be given.

    It has the specialised target, and two positions from which it and all papers are well visible.
    Raises `LandmarkNavError`: the given room has no such positions.
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
    """Random room (one of three long ones is L-shaped) with three papers on one wall."""
    length = float(rng.integers(50, 91)) / 10.0
    width = float(rng.integers(40, 61)) / 10.0
    height = float(rng.integers(25, 30)) / 10.0
    outline = np.array([[0.0, 0.0], [length, 0.0], [length, width], [0.0, width]])
    if length > 6.0 and rng.random() < 1.0 / 3.0:
        notch = np.round(np.array([length, width]) * rng.uniform(0.25, 0.4, 2), 1)
        inner = np.array([length, width]) - notch
        foot, head = [[0, 0], [length, 0], [length, inner[1]]], [[inner[0], width], [0, width]]
        outline = np.array([*foot, inner, *head])
    for axis, size in ((0, length), (1, width)):
        if rng.random() < 0.5:
            outline[:, axis] = size - outline[:, axis]
            outline = outline[::-1]
    walls = _walls(np.round(outline, 3), height)
    return Room(walls, _papers(walls, rng))


def _walls(outline: FloatArray, height: float) -> tuple[Wall, ...]:
    """Walls along a counter-clockwise outline, named by the side of the room."""
    names = {(0, 1): 'south', (-1, 0): 'east', (0, -1): 'north', (1, 0): 'west'}
    used: dict[str, int] = {}
    walls = []
    for start, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        side = np.sign(np.round(end - start, 6)).astype(int)
        name = names[(-int(side[1]), int(side[0]))]
        used[name] = used.get(name, 0) + 1
        label = name if used[name] == 1 else f'{name}_{used[name]}'
        walls.append(Wall(label, tuple(start.tolist()), tuple(end.tolist()), height))
    return tuple(walls)


def _papers(walls: tuple[Wall, ...], rng: np.random.Generator) -> tuple[Paper, ...]:
    """Papers of three colours on the longest wall, in random order, 1 m apart if possible."""
    wall = max(walls, key=lambda candidate: candidate.length)
    room_for = wall.length - 1.2
    gaps = rng.uniform(1.05, 1.5, 2)
    gaps *= min(1.0, room_for / gaps.sum())
    first = 0.6 + rng.uniform(0.0, room_for - gaps.sum()) if room_for > gaps.sum() else 0.6
    along = first + np.array([0.0, gaps[0], gaps.sum()])
    height = float(np.round(rng.uniform(1.5, 1.7), 2))
    start, end = np.array(wall.start), np.array(wall.end)
    places = np.round(start + (end - start) * along[:, None] / wall.length, 3).tolist()
    return tuple(
        Paper(str(color), (x, y, height), *_PAPER_SIZE_M)
        for color, (x, y) in zip(rng.permutation(['red', 'green', 'blue']), places, strict=True)
    )
