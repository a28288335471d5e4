"""Sweeps that look towards papers in a plain room, and how far off they are placed."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from scenes import draw_frame, flat_texture, paper_board, Scene, wall_board

from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.walls import Paper, Room
from landmark_nav.learning.panorama.synthesis import synthesize_cylinder
from landmark_nav.learning.reference_area.location import PaperSearch, SweepPlace
from landmark_nav.learning.reference_area.model import ReferenceAreaConfig
from landmark_nav.types import FloatArray, Sweep

MOUNT = PanTiltMount(axis_xyz=(0.12, 0.01, 1.1))
CAMERA = CameraModel(420, 240, 380.0, 380.0, 209.0, 120.5, distortion=(-0.15, 0.04))
CONFIG = ReferenceAreaConfig()
TURN = np.radians(np.arange(0.0, 360.0, 20.0))

# Three on one wall, and three on two walls; never at equal distances.
EAST = (
    Paper('red', (6.0, 1.4, 1.2), 0.21, 0.297),
    Paper('green', (6.0, 2.3, 1.35), 0.21, 0.297),
    Paper('blue', (6.0, 3.6, 1.1), 0.21, 0.297),
)
CORNER = (
    Paper('red', (5.1, 5.0, 1.2), 0.297, 0.21),
    Paper('yellow', (6.0, 2.6, 1.3), 0.21, 0.297),
    Paper('blue', (6.0, 4.0, 1.1), 0.21, 0.297),
)


@lru_cache(maxsize=8)
def scene_of(room: Room, papers: tuple[Paper, ...] | None = None) -> Scene:
    walls = [
        wall_board(wall, flat_texture((g, g, g)))
        for wall, g in zip(room.walls, (170.0, 150.0, 160.0, 140.0), strict=True)
    ]
    shown = room.papers if papers is None else papers
    return Scene((*walls, *(paper_board(paper, room) for paper in shown)))


def sweep_at(
    scene: Scene,
    pose: FloatArray,
    rng: np.random.Generator | None = None,
    *,
    mount: PanTiltMount = MOUNT,
    rise_m: float = 0.0,
    tilt_rad: float = 0.0,
    towards: tuple[Paper, ...] = EAST,
    pan_sigma_rad: float = 0.0,
) -> Sweep:
    """Frames that look towards some papers, as JPEG with halved colours."""
    axis = mount.axis_pose_map(pose)
    azimuth = se2.bearings(axis, np.array([p.center[:2] for p in towards]))
    raised = replace(mount, axis_xyz=(*mount.axis_xyz[:2], mount.axis_xyz[2] + rise_m))
    frames = []
    for pan in TURN:
        ahead = mount.camera_pose_base(pan)[0][:2, 2]
        off = wrap_rad(np.arctan2(ahead[1], ahead[0]) - azimuth)
        if np.abs(off).min() > np.radians(27.0):
            continue
        slip = 0.0 if rng is None else float(rng.normal(0.0, pan_sigma_rad))
        frame = draw_frame(
            scene, CAMERA, raised, pose, pan + slip, tilt_rad, stamp_ns=len(frames), rng=rng
        )
        # A lens leaves no edge sharper than that.
        soft = cv2.GaussianBlur(frame.image, (0, 0), 0.6)
        jpeg = cv2.imencode('.jpg', soft, [cv2.IMWRITE_JPEG_QUALITY, 92])[1]
        image = np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), dtype=np.uint8)
        frames.append(replace(frame, image=image, pan_rad=float(pan)))
    return Sweep(0, tuple(frames))


def locate(
    sweep: Sweep, room: Room, mount: PanTiltMount = MOUNT, config: ReferenceAreaConfig = CONFIG
) -> SweepPlace:
    view = synthesize_cylinder(sweep, mount)
    return PaperSearch(sweep, view, room, mount, config).located()


def error_of(place: SweepPlace, pose: FloatArray) -> FloatArray:
    """x, y, heading found minus true."""
    error = place.pose_map_base - pose
    error[2] = wrap_rad(error[2])
    return error


def deviations(place: SweepPlace, pose: tuple[float, float, float] | FloatArray) -> FloatArray:
    """Errors of x, y, heading in their own standard deviations, absolute."""
    sigma = np.sqrt(np.diag(place.covariance))[[0, 1, 3]]
    return np.abs(error_of(place, np.asarray(pose))) / sigma
