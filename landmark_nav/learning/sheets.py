"""
Sheets of a known size at unknown places in a panorama: their size gives the range.

They are coloured papers, and ArUco and AprilTag markers (Garrido-Jurado et al., Pattern
Recognition 47(6), 2014): squares of a known size, whose corners give the pose (Collins and
Bartoli, IJCV 109, 2014: IPPE).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from landmark_nav.arrays import BoolArray, ImageArray
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.walls import marker_count, paper_bgr
from landmark_nav.learning.panorama.synthesis import CylinderImage
from landmark_nav.learning.reference_area.blobs import color_blobs
from landmark_nav.learning.reference_area.edges import outline_blobs
from landmark_nav.parameters import Config, parameter
from landmark_nav.types import FloatArray, Panorama


@dataclass(frozen=True)
class SheetsConfig(Config):
    """Known sizes of sheets; 0 if there are none of a kind."""

    paper_width_m: float = parameter(
        0.0, 'width of coloured papers that hang upright anywhere', minimum=0, maximum=5
    )
    paper_height_m: float = parameter(0.0, 'their height', minimum=0, maximum=5)
    paper_colors: str = parameter('red green blue', 'their colours')
    marker_size_m: float = parameter(
        0.0, 'side of the black square of markers', minimum=0, maximum=5
    )
    marker_dictionary: str = parameter(
        'DICT_4X4_50', 'dictionary of the markers, as OpenCV names it'
    )
    # Relative sigma of these sizes.
    size_sigma: float = 0.002

    def __post_init__(self) -> None:
        """Check that sizes come in pairs, colours have a hue and the dictionary is known."""
        super().__post_init__()
        if (self.paper_width_m > 0.0) != (self.paper_height_m > 0.0):
            raise LandmarkNavError(
                f'papers of {self.paper_width_m:g} m x {self.paper_height_m:g} m: give both sides'
            )
        marker_count(self.marker_dictionary)
        for color in self.paper_colors.split():
            paper_bgr(color)

    @property
    def has_papers(self) -> bool:
        """Whether papers of a known size are searched."""
        return self.paper_width_m > 0.0

    @property
    def has_markers(self) -> bool:
        """Whether markers of a known size are searched."""
        return self.marker_size_m > 0.0


@dataclass(frozen=True, eq=False)
class SheetView:
    """
    A candidate for a sheet.

    `kind` is ``papers`` or ``markers``, `name` a colour or a number; `position` (3,) is that of
    the centre from the viewpoint, along the axes of the base, m; `covariance` (3, 3) is that of
    its own errors. `shared` (3, q) are the loadings of q errors common to all sheets of a kind.
    `foreshortening` is the width seen over that of a sheet seen from ahead, with its sigma.
    """

    kind: str
    name: str
    position: FloatArray
    covariance: FloatArray
    shared: FloatArray
    foreshortening: float = 1.0
    foreshortening_sigma: float = np.inf


def find_sheets(panorama: Panorama, config: SheetsConfig) -> list[SheetView]:
    """Find candidates for sheets of a known size in a panorama; its pose is not used."""
    papers = find_papers(panorama, config) if config.has_papers else []
    markers = find_markers(panorama, config) if config.has_markers else []
    return papers + markers


# Ratio of width and height of a candidate, relative to that of the sheet: a slanted sheet is
# narrower. Bounds are widened by the first factor for blobs, which are less exact than outlines.
_ROUGHLY, _NARROWEST, _WIDEST = 1.3, 0.2, 1.05
# Range in which papers are measured, m.
_NEAREST_M, _FARTHEST_M = 0.3, 12.0


def find_papers(panorama: Panorama, config: SheetsConfig) -> list[SheetView]:
    """Find candidates for papers: blobs of their colour and shape with four clear edges."""
    view = CylinderImage(panorama.image, panorama.mask, panorama.cylinder)
    colors = config.paper_colors.split()
    found = []
    for color, blobs in color_blobs(view, colors).items():
        likely = _may_be(blobs.edges, config, _ROUGHLY)
        outlines = outline_blobs(view, color, blobs.only(likely))
        parts = outlines.edges, outlines.sigma, outlines.by_response
        for edges, sigma, by_response in zip(*parts, strict=True):
            if _may_be(edges, config):
                position, by_edge = _located(edges, config.paper_height_m)
                own = by_edge * sigma
                # Outwards is right (smaller azimuth), left, down and up.
                response = by_edge @ (by_response * [-1.0, 1.0, -1.0, 1.0])
                shared = np.stack([config.size_sigma * position, response], 1)
                slant = _foreshortened(edges, sigma, by_response, config)
                found.append(SheetView('papers', color, position, own @ own.T, shared, *slant))
    return found


def _foreshortened(
    edges: FloatArray, sigma: FloatArray, by_response: FloatArray, config: SheetsConfig
) -> tuple[float, float]:
    """Foreshortening of an upright sheet by its edges (4,), and its sigma."""
    right, left, bottom, top = edges
    sides = np.array([left - right, top - bottom])
    seen = sides[0] / sides[1] * config.paper_height_m / config.paper_width_m
    own = np.hypot(sigma[[0, 2]], sigma[[1, 3]]) / sides
    outwards = by_response.reshape(2, 2).sum(1) / sides
    relative = [*own, outwards[0] - outwards[1], np.sqrt(2.0) * config.size_sigma]
    return float(seen), float(seen * np.linalg.norm(relative))


def _may_be(edges: FloatArray, config: SheetsConfig, margin: float = 1.0) -> BoolArray:
    """Whether shape and range of edges (..., 4) are those of a paper, within a factor."""
    right, left, bottom, top = np.moveaxis(edges, -1, 0)
    height = np.maximum(top - bottom, 1e-9)
    share = (left - right) / height * config.paper_height_m / config.paper_width_m
    reach = config.paper_height_m / height
    return np.asarray(
        (share > _NARROWEST / margin)
        & (share < _WIDEST * margin)
        & (reach > _NEAREST_M / margin)
        & (reach < _FARTHEST_M * margin)
    )


def _located(edges: FloatArray, height_m: float) -> tuple[FloatArray, FloatArray]:
    """Centre (3,) of an upright sheet and its derivative (3, 4) by its edges."""
    right, left, bottom, top = edges
    middle = 0.5 * (right + left)
    reach = height_m / (top - bottom)
    ray = np.array([np.cos(middle), np.sin(middle), 0.5 * (bottom + top)])
    by_azimuth = 0.5 * reach * np.array([-ray[1], ray[0], 0.0])
    nearer = reach / (top - bottom) * ray
    up = np.array([0.0, 0.0, 0.5 * reach])
    return reach * ray, np.stack([by_azimuth, by_azimuth, up + nearer, up - nearer], 1)


# Magnification of panoramas in which markers are searched.
_FINER = 2
# Sigma of the corners of markers, and of a shift of all their edges inwards or outwards, as the
# camera's response to light makes bright parts wider; pixels.
CORNER_SIGMA_PX, RESPONSE_SIGMA_PX = 0.15, 0.4
# Corners in the order of OpenCV, to the left and up.
CORNERS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


def find_markers(panorama: Panorama, config: SheetsConfig) -> list[SheetView]:
    """Find markers of one dictionary; `LandmarkNavError` if OpenCV has no detector."""
    cylinder, size, found = panorama.cylinder, config.marker_size_m, []
    sigma, response = (px / cylinder.fx for px in (CORNER_SIGMA_PX, RESPONSE_SIGMA_PX))
    for number, rays in marker_corners(panorama.image, cylinder, config.marker_dictionary):
        located = locate_square(rays, size, sigma)
        wider = locate_square(rays + response * _outwards(rays), size, sigma)
        if located is not None and wider is not None:
            position, covariance = located
            shared = np.stack([config.size_sigma * position, wider[0] - position], 1)
            found.append(SheetView('markers', str(number), position, covariance, shared))
    return found


def _outwards(rays: FloatArray) -> FloatArray:
    """Change of the rays (4, 3) of the corners of an upright square that is wider and higher."""
    x, y, _ = rays.T
    reach = np.hypot(x, y)
    left = np.stack([-y, x, np.zeros(4)], 1)
    return np.asarray(CORNERS[:, :1] * left + CORNERS[:, 1:] * reach[:, None] * [0.0, 0.0, 1.0])


def marker_corners(
    image: ImageArray, cylinder: Cylinder, dictionary: str
) -> list[tuple[int, FloatArray]]:
    """
    Find number and rays (4, 3) of the corners of each marker of a dictionary in a panorama.

    Raises `LandmarkNavError`: OpenCV has no detector.
    """
    if not hasattr(cv2, 'aruco') or not hasattr(cv2.aruco, 'ArucoDetector'):
        raise LandmarkNavError(
            f'OpenCV {cv2.__version__} has no ArUco detector: install opencv-python-headless 4.7 '
            'or newer, or leave out markers'
        )
    width = cylinder.width
    # A marker across the seam is whole in the padded part; others there appear twice.
    columns = np.arange(width + width // 8) % width
    grey = np.ascontiguousarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)[:, columns])
    # Cells of markers across a room are two or three pixels wide.
    grey = cv2.resize(grey, None, fx=_FINER, fy=_FINER, interpolation=cv2.INTER_CUBIC)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    detector = cv2.aruco.ArucoDetector(markers, parameters)
    corners, numbers, _ = detector.detectMarkers(grey)
    found = []
    for corner, number in zip(corners, [] if numbers is None else numbers.ravel(), strict=True):
        # Here the centre of the first pixel is at 0.5, as in the library of AprilTags.
        pixels = corner.reshape(4, 2).astype(np.float64) / _FINER - 0.5
        if pixels[:, 0].min() < width:
            found.append((int(number), cylinder.rays(pixels)))
    return found


def locate_square(
    rays: FloatArray, size_m: float, sigma_rad: float
) -> tuple[FloatArray, FloatArray] | None:
    """
    Centre (3,) of a square and its covariance (3, 3), from the rays (4, 3) of its corners.

    Corners are in the order of OpenCV; None if no square in front of the viewpoint fits.
    """
    # A camera that looks at the middle: z forward, x right, y down.
    unit = rays / np.linalg.norm(rays, axis=1)[:, None]
    ahead = unit.mean(0) / np.linalg.norm(unit.mean(0))
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(ahead, right), ahead])
    seen = unit @ axes.T
    flat = seen[:, :2] / seen[:, 2:]
    square = 0.5 * size_m * np.column_stack([-CORNERS[:, 0], CORNERS[:, 1], np.zeros(4)])
    count, turns, middles, _ = cv2.solvePnPGeneric(
        square, flat[:, None], np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    if not count:
        return None
    turn, middle = cv2.solvePnPRefineLM(
        square, flat[:, None], np.eye(3), np.zeros(4), turns[0], middles[0]
    )
    # Derivatives by rotation and translation come first.
    _, by_all = cv2.projectPoints(square, turn, middle, np.eye(3), np.zeros(4))
    jacobian, center = by_all[:, :6], np.asarray(middle, dtype=np.float64).ravel()
    if center[2] <= 0.0 or np.linalg.matrix_rank(jacobian) < 6:
        return None
    covariance = sigma_rad**2 * np.linalg.inv(jacobian.T @ jacobian)
    return center @ axes, np.asarray(axes.T @ covariance[3:, 3:] @ axes)
