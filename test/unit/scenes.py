"""
Small scenes with known truth: flat boards with continuous textures, met by rays.

Written apart from `landmark_nav.simulation`, so that the one checks the other.
"""

from dataclasses import dataclass
from functools import lru_cache

from builders import bare_landmark, panorama_of, walls_of
import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.geometry import se2
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.se2 import rotation_rpy
from landmark_nav.geometry.walls import Room
from landmark_nav.types import CameraFrame, Candidate, FloatArray, Sweep

Color = tuple[float, float, float]

GREY: Color = (150.0, 150.0, 150.0)
COLORS: dict[str, Color] = {
    'red': (40.0, 40.0, 200.0),
    'green': (50.0, 170.0, 50.0),
    'blue': (190.0, 70.0, 40.0),
    'yellow': (40.0, 200.0, 210.0),
    '#d07010': (16.0, 112.0, 208.0),
    'hsv(280, 60, 60)': (153.0, 61.0, 122.0),
}

# Rays of a pixel at an edge: no two share a column or a row, so that coverage has 48 levels.
_SUBPIXELS = 48


@dataclass(frozen=True, eq=False)
class Board:
    """A vertical rectangle seen from the side of `normal`; its texture fills it."""

    center: FloatArray
    normal: FloatArray
    width_m: float
    height_m: float
    texture: npt.NDArray[np.float32]

    @property
    def right(self):
        """To the right for someone who looks at it."""
        return np.array([-self.normal[1], self.normal[0], 0.0])


@dataclass(frozen=True, eq=False)
class Scene:
    """Boards in front of a uniform background (floor and ceiling)."""

    boards: tuple[Board, ...]
    background: Color = (90.0, 90.0, 90.0)

    def look(self, origin, directions):
        """BGR of what rays (rows, columns, 3) from an origin meet, and the board's number."""
        nearest = np.full(directions.shape[:2], np.inf)
        number = np.full(directions.shape[:2], -1, np.int16)
        seen = np.empty(directions.shape, np.float32)
        seen[:] = self.background
        for k, board in enumerate(self.boards):
            with np.errstate(divide='ignore', invalid='ignore'):
                facing = directions @ board.normal
                offset = board.center - origin
                reach = (offset @ board.normal) / facing
                across = reach * (directions @ board.right) - offset @ board.right
                up = reach * directions[..., 2] - offset[..., 2]
                hit = (reach > 1e-6) & (reach < nearest) & (facing < 0.0)
                hit &= np.abs(across) <= board.width_m / 2.0
                hit &= np.abs(up) <= board.height_m / 2.0
            if not hit.any():
                continue
            # Only the rows and columns that the board reaches are looked up.
            rows, columns = np.flatnonzero(hit.any(axis=1)), np.flatnonzero(hit.any(axis=0))
            box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
            hit = hit[box]
            size = board.texture.shape
            at_column = (across[box] / board.width_m + 0.5) * size[1] - 0.5
            at_row = (0.5 - up[box] / board.height_m) * size[0] - 0.5
            texture = cv2.remap(
                board.texture,
                np.where(hit, at_column, 0.0).astype(np.float32),
                np.where(hit, at_row, 0.0).astype(np.float32),
                cv2.INTER_CUBIC,
                borderMode=cv2.BORDER_REPLICATE,
            )
            seen[box][hit] = texture[hit]
            nearest[box][hit] = reach[box][hit]
            number[box][hit] = k
        return seen, number


def draw(scene, origin, rays, rays_of):
    """
    BGR (rows, columns, 3) of an image whose pixels look along `rays`.

    Pixels at the edge of a board are averaged over many rays, `rays_of` parts of pixels (..., 2).
    """
    image, board = scene.look(origin, rays)
    ring = np.ones((3, 3), np.uint8)
    edge = cv2.dilate(board, ring) != cv2.erode(board, ring)
    part = (np.arange(_SUBPIXELS) + 0.5) / _SUBPIXELS
    offsets = np.stack([part, np.mod(0.618034 * np.arange(_SUBPIXELS), 1.0)], -1) - 0.5
    where = np.argwhere(edge)
    for start in range(0, len(where), 20000):
        chunk = where[start : start + 20000]
        pixels = chunk[:, None, ::-1] + offsets
        image[chunk[:, 0], chunk[:, 1]] = scene.look(origin, rays_of(pixels))[0].mean(axis=1)
    return image


def with_noise(image, rng, sigma=3.0):
    """Round to uint8 with noise of `sigma` grey levels; none without `rng`."""
    noise = 0.0 if rng is None else rng.normal(0.0, sigma, image.shape)
    return np.asarray(np.clip(np.rint(image + noise), 0, 255), dtype=np.uint8)


def smooth_texture(rng, width_m, height_m, feature_m=0.035):
    """Grey texture of blots of about `feature_m`, smooth enough to be sampled anywhere."""
    texel = feature_m / 4.0
    size = (round(height_m / texel), round(width_m / texel))
    grey = sum(
        weight * _standard(cv2.GaussianBlur(rng.normal(size=size), (0, 0), scale))
        for weight, scale in ((20.0, 4.0), (20.0, 10.0))
    )
    return cv2.merge([np.clip(128.0 + np.asarray(grey), 5, 250).astype(np.float32)] * 3)


def _standard(image):
    return np.asarray((image - image.mean()) / image.std())


def flat_texture(color):
    """Texture of one colour."""
    return np.full((4, 4, 3), color, np.float32)


def rectangle_room(width=6.0, depth=5.0, papers=(), height=2.5):
    """Walls s, e, n, w of a room from (0, 0) to (width, depth)."""
    corners = [(0.0, 0.0), (width, 0.0), (width, depth), (0.0, depth)]
    return Room(walls_of(corners, 'senw', height), tuple(papers))


def wall_board(wall, texture):
    """The whole wall as a board."""
    middle = (np.array(wall.start) + np.array(wall.end)) / 2.0
    center = np.array([*middle, wall.height / 2.0])
    return Board(center, wall.normal, wall.length, wall.height, texture)


def paper_board(paper, room):
    """A coloured paper, as flat on its wall as can be distinguished."""
    normal = room.normals[int(room.nearest_wall(np.array(paper.center[:2])))]
    center = np.array(paper.center) + 1e-5 * normal
    texture = flat_texture(COLORS[paper.color])
    return Board(center, normal, paper.width, paper.height, texture)


def textured_room(room, seed, feature_m=0.035):
    """Random texture on every wall, and the papers."""
    rng = np.random.default_rng(seed)
    walls = [
        wall_board(wall, smooth_texture(rng, wall.length, wall.height, feature_m))
        for wall in room.walls
    ]
    return Scene((*walls, *(paper_board(paper, room) for paper in room.papers)))


def draw_cylinder(scene, cylinder, center_map, heading_rad):
    """What a perfect panorama shows, BGR (rows, columns, 3)."""
    center = tuple(float(value) for value in center_map)
    return _seen_around(scene, cylinder, center, float(heading_rad))


@lru_cache(maxsize=8)
def _seen_around(scene, cylinder, center, heading_rad):
    turn = rotation_rpy((0.0, 0.0, heading_rad))

    def rays_of(pixels):
        return np.asarray(cylinder.rays(pixels) @ turn.T)

    grid = np.stack(np.meshgrid(np.arange(cylinder.width), np.arange(cylinder.height)), -1)
    return draw(scene, np.array(center), rays_of(grid), rays_of)


def draw_panorama(scene, center_map, heading_rad, *, covariance=None, rng=None):
    """Panorama with its true pose."""
    cylinder = Cylinder.with_resolution(250.0, -0.4, 0.4)
    image = with_noise(draw_cylinder(scene, cylinder, center_map, heading_rad), rng, 2.0)
    known = np.diag([0.01, 0.01, 0.01, 0.003]) ** 2 if covariance is None else covariance
    center = np.asarray(center_map, dtype=np.float64)
    given = {'center_map': center, 'heading_rad': heading_rad, 'covariance': known}
    return panorama_of(image, cylinder, **given)


def draw_frame(
    scene,
    camera,
    mount,
    pose_map_base,
    pan_rad=0.0,
    tilt_rad=0.0,
    *,
    stamp_ns=0,
    rng=None,
    sigma=3.0,
):
    """Image of the scene through a lens, with noise if there is `rng`."""
    pose = tuple(float(value) for value in pose_map_base)
    seen = _seen(scene, camera, mount, pose, float(pan_rad), float(tilt_rad))
    return CameraFrame(stamp_ns, with_noise(seen, rng, sigma), camera, pan_rad, tilt_rad)


# Many tests look at one scene from the same few places.
@lru_cache(maxsize=64)
def _seen(scene, camera, mount, pose, pan_rad, tilt_rad):
    """BGR of an image without noise."""
    rotation, center = mount.camera_pose_map(np.array(pose), pan_rad, tilt_rad)

    def rays_of(pixels):
        column, row = np.moveaxis(pixels.astype(np.float32), -1, 0)
        rays = cv2.remap(camera.ray_grid, column, row, cv2.INTER_LINEAR)
        return _turned(rays, rotation)

    return draw(scene, center, _turned(camera.ray_grid, rotation), rays_of)


def _turned(rays, rotation):
    return np.concatenate([rays, np.ones_like(rays[..., :1])], -1).astype(np.float64) @ rotation.T


def draw_sweep(scene, camera, mount, pose_map_base, pans_rad, *, rng=None):
    """Frames at pans (n,), a tenth of a second apart."""
    frames = tuple(
        draw_frame(
            scene, camera, mount, pose_map_base, float(pan), stamp_ns=k * 10**8, rng=rng, sigma=2.0
        )
        for k, pan in enumerate(pans_rad)
    )
    return Sweep(0, frames)


def true_landmark(
    scene, number, board, across_m, up_m, viewpoint, *, size_m=0.32, texel_m=0.008, sigma_m=0.002
):
    """
    Landmark cut out of a board, `across_m` and `up_m` from its centre, as if perfectly learned.

    Its own error is of `sigma_m`; nothing is shared.
    """
    count = round(size_m / texel_m)
    step = (np.arange(count) - (count - 1) / 2.0) * texel_m
    position = board.center + across_m * board.right + np.array([0.0, 0.0, up_m])
    columns, rows = np.meshgrid(step, step)
    points = position + columns[..., None] * board.right - rows[..., None] * [0.0, 0.0, 1.0]
    offset = 0.05 * board.normal
    grey = scene.look(points + offset, np.broadcast_to(-board.normal, points.shape))[0][..., 0]
    size = count * texel_m
    return bare_landmark(
        number, position, np.eye(3) * sigma_m**2, shared_loading=np.zeros((3, 1)),
        normal=board.normal, width_m=size, height_m=size, patch=with_noise(grey, None),
        viewpoint=viewpoint,
    )  # fmt: skip


def candidate_at(panorama, point, size=32):
    """Candidate at the pixel nearest to where a panorama shows a point."""
    turned = (point - panorama.center_map)[:2] @ se2.rotation(panorama.heading_rad)
    column, row = panorama.cylinder.project([*turned, point[2] - panorama.center_map[2]])
    return Candidate(float(np.rint(column)), float(np.rint(row)), size, size, 1.0)


__all__ = ['turn_sweep']


def texture(directions):
    """Grey of directions (..., 3): a smooth pattern that differs everywhere."""
    rng = np.random.default_rng(5)
    waves = rng.normal(size=(60, 3))
    waves *= rng.uniform(10.0, 70.0, (60, 1)) / np.linalg.norm(waves, axis=1, keepdims=True)
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    values = np.sin(unit @ waves.T + rng.uniform(0.0, 6.28, 60)).sum(-1)
    return np.asarray(128.0 + 14.0 * values)


def turn_sweep(camera, mount, pans, tilt_rad=0.0, roll_rad=0.0):
    """Frames as they look at true angles."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.unproject(np.stack([u, v], -1))
    frames = []
    for k, pan in enumerate(pans):
        rotation, _ = mount.camera_pose_base(pan, tilt_rad, roll_rad)
        grey = np.clip(np.rint(texture(rays @ rotation.T)), 0, 255).astype(np.uint8)
        image = np.dstack([grey] * 3)
        frames.append(CameraFrame(k, image, camera, float(pan), tilt_rad, roll_rad))
    return Sweep(0, tuple(frames))
