"""The room of the demo, what its robot is given of it, and the ways that are driven."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.simulation.drive_path import plan_tour, plan_way
from landmark_nav.simulation.furnishing import generate_scene
from landmark_nav.simulation.places import choose_sweep_places
from landmark_nav.simulation.setup_documents import robot_document, room_document
from landmark_nav.simulation.world import DEFAULT_MOUNT
from landmark_nav.types import FloatArray


@dataclass(frozen=True, eq=False)
class DemoRoom:
    """
    A room and what happens in it.

    Parameters
    ----------
    seed : int
        Draws everything.
    room_file : Path or None
        What the nodes are given; None if they find walls and poses.
    robot_file : Path
        What the nodes are given.
    mount : PanTiltMount
        The same as `robot_file`.
    to_second_place, tour : ndarray, shape (n, 2)
        The way from the first to the second sweep, and that of the drive, in map; without a
        room file that is the base at the first sweep.
    size_m : tuple of float
        Extent of the room.

    """

    seed: int
    room_file: Path | None
    robot_file: Path
    mount: PanTiltMount
    to_second_place: FloatArray
    tour: FloatArray
    size_m: tuple[float, float]


def prepare_room(
    folder: Path, seed: int, tour_m: float = 14.0, *, measured: bool = True
) -> DemoRoom:
    """
    Draw a room, with a tour of `tour_m`; write ``robot.yaml`` into `folder`.

    If it is `measured`, ``room.yaml`` as well.

    Raises
    ------
    LandmarkNavError
        A room of this seed has no places for sweeps, or no space to drive.

    """
    scene = generate_scene(seed)
    places = choose_sweep_places(scene)
    if places is None:
        raise LandmarkNavError(f'the room of seed {seed} has no places for sweeps: take another')
    first, second = places.poses[:, :2]
    room_file, robot_file = folder / 'room.yaml', folder / 'robot.yaml'
    if measured:
        room_file.write_text(room_document(scene.room), encoding='utf-8')
    frame = np.zeros(3) if measured else places.poses[0]
    robot_file.write_text(robot_document(DEFAULT_MOUNT), encoding='utf-8')
    extent = np.ptp(scene.room.bounds, axis=0)
    return DemoRoom(
        seed,
        room_file if measured else None,
        robot_file,
        DEFAULT_MOUNT,
        se2.transform_points(se2.inverse(frame), plan_way(scene, first, second)),
        se2.transform_points(
            se2.inverse(frame),
            plan_tour(scene, second, tour_m, np.random.default_rng([seed, 40])),
        ),
        (float(extent[0]), float(extent[1])),
    )
