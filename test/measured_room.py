"""What a person who measured a simulated room tells the robot; for the checks of rooms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.adjustment import AdjustmentConfig
from landmark_nav.learning.reference_area import ReferenceAreaConfig
from landmark_nav.simulation.setup_documents import robot_document, room_document
from landmark_nav.storage.setup_files import load_robot, load_room


def tell_measured(folder: Path, told: Path, seed: int) -> None:
    """Write into `told` what a person would have measured of the room simulated in `folder`."""
    room, mount = measured(
        load_room(folder / 'room.yaml'),
        load_robot(folder / 'robot.yaml'),
        np.random.default_rng([seed, 60]),
    )
    told.mkdir(exist_ok=True)
    (told / 'room.yaml').write_text(room_document(room))
    (told / 'robot.yaml').write_text(robot_document(mount))


def measured(
    room: Room, mount: PanTiltMount, rng: np.random.Generator
) -> tuple[Room, PanTiltMount]:
    """What a person would have measured of a room whose walls meet at right angles."""
    expected, papers = AdjustmentConfig(), ReferenceAreaConfig()
    off = rng.normal(0.0, expected.wall_sigma_m, len(room.walls))
    moved = off[:, None] * room.normals[:, :2]
    starts = np.array([wall.start for wall in room.walls]) + moved + np.roll(moved, 1, axis=0)
    corners = [(float(x), float(y)) for x, y in starts]
    walls = tuple(
        replace(wall, start=start, end=end)
        for wall, start, end in zip(room.walls, corners, corners[1:] + corners[:1], strict=True)
    )
    sheets = []
    for paper in room.papers:
        wall = room.walls[int(room.nearest_wall(np.array(paper.center[:2])))]
        along, up = rng.normal(0.0, papers.paper_sigma_m, 2)
        x, y = paper.center[:2] + along * np.subtract(wall.end, wall.start) / wall.length
        sheets.append(replace(paper, center=(float(x), float(y), paper.center[2] + float(up))))
    x, y, z = mount.axis_xyz
    height = z + float(rng.normal(0.0, papers.height_sigma_m))
    told = replace(room, walls=walls, papers=tuple(sheets))
    return told, replace(mount, axis_xyz=(x, y, height))
