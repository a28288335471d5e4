"""
Types that stages exchange: immutable, SI units, radians, stamps in integer nanoseconds.

Names hold the frames: ``pose_map_base`` is the pose of ``base_link`` in ``map``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import auto, Enum
from functools import cached_property
import math

import cv2
import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from landmark_nav.arrays import Float32Array, FloatArray, ImageArray
from landmark_nav.calibration import Calibration
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import PanTrack
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.patches import is_upright_edge, patch_corners, PatchView
from landmark_nav.geometry.walls import Room, Wall
from landmark_nav.quality import PanoramaQuality


class RefusalCode(Enum):
    """Reasons of a refusal that callers handle differently."""

    OTHER = auto()
    UNRECOGNISED = auto()
    """The landmarks that should be in view from the hypotheses are not found."""
    LOW_CORRELATION = auto()
    """The correlation of a template is below the threshold."""
    WRONG_SIZE = auto()
    """The size of a patch contradicts its distance."""


@dataclass(frozen=True)
class Refusal:
    """
    Result of a stage that cannot give one: a short `reason`, and measured values in `detail`.

    Programs use the `code`; the wording is for people and may change.
    """

    reason: str
    detail: str = ''
    code: RefusalCode = RefusalCode.OTHER

    def __str__(self) -> str:
        """Reason and detail in one line."""
        return f'{self.reason}: {self.detail}' if self.detail else self.reason


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """Planar pose (3,) at a time: x [m], y [m], heading [rad], with its covariance (3, 3)."""

    stamp_ns: int
    pose: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class Expectation(PoseEstimate):
    """
    Expected pose of the base in an image of a time, and calibration, for the search for landmarks.

    The covariance is that of the pan axis with the azimuth of the camera: errors of heading and
    pan zero that cancel are not part of it. Of the calibration, only standard deviations are used,
    not the correlations. `tilt_sigma_rad` is that of the elevation of the view: of base, axis and
    camera together; `turn_rate_rad_s` is the rate of the base.
    """

    calibration: Calibration
    tilt_sigma_rad: float
    turn_rate_rad_s: float = 0.0

    def pan_sigma_rad(self, pan_rate_rad_s: float) -> float:
        """Standard deviation of the pan at this rate, without that of the pan zero."""
        delay = abs(pan_rate_rad_s) * self.calibration['joint_delay'][1]
        return math.hypot(delay, self.calibration.base.pan_sigma_rad)

    def stepped(
        self, sigma_m: float, sigma_rad: float, calibration: Mapping[str, float]
    ) -> Expectation:
        """
        Return the expectation after possible steps of base and calibration with these sigmas.

        Exact values of the calibration do not change.
        """
        known = self.calibration
        steps = {name: step for name, step in calibration.items() if known[name][1] > 0.0}
        turn = math.hypot(sigma_rad, steps.get('axis_yaw', 0.0))
        return replace(
            self,
            covariance=self.covariance + np.diag(np.square([sigma_m, sigma_m, turn])),
            calibration=known.widened(steps),
            tilt_sigma_rad=math.hypot(self.tilt_sigma_rad, steps.get('camera_tilt', 0.0)),
        )


@dataclass(frozen=True, eq=False)
class PlaceChain:
    """
    Poses (v, 3) of the base at v sweeps, in the frame of the first one.

    `covariance` (3 v, 3 v) is their joint covariance: an error of one motion is part of all later
    poses. `source` is the name of the sensor. `slip_m` is the sigma of a slip between two
    sweeps, in any direction, that is not part of the covariance: a slip is rare, but possible.
    """

    poses: FloatArray
    covariance: FloatArray
    source: str = 'odom'
    slip_m: float = 0.0


@dataclass(frozen=True, eq=False)
class OdometrySample:
    """Wheel odometry: pose (3,) of the base in ``odom`` and its speeds."""

    stamp_ns: int
    pose_odom_base: FloatArray
    linear_m_s: float = 0.0
    angular_rad_s: float = 0.0


@dataclass(frozen=True)
class JointSample:
    """
    Measured angles of the pan-tilt unit, radians, and the rate of the pan.

    `pan_sigma_rad` is the error of the pan by interpolation, `pan_track` the pan in an interval
    before and after.
    """

    stamp_ns: int
    pan_rad: float
    tilt_rad: float = 0.0
    pan_rate_rad_s: float = 0.0
    pan_sigma_rad: float = 0.0
    pan_track: PanTrack | None = field(default=None, compare=False)


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """
    One image with the joint angles at its stamp.

    `image` is BGR (height, width, 3) or grey (height, width), uint8. `roll_rad` is an additional
    rotation about the optical axis, from calibration. `row_turn_rad` is how far the camera turns
    to the left until rows one focal length further down are exposed, by a rolling shutter.
    """

    stamp_ns: int
    image: ImageArray
    camera: CameraModel
    pan_rad: float
    tilt_rad: float = 0.0
    roll_rad: float = 0.0
    pan_rate_rad_s: float = 0.0
    pan_sigma_rad: float = 0.0
    pan_track: PanTrack | None = None
    row_turn_rad: float = 0.0


@dataclass(frozen=True, eq=False)
class Sweep:
    """
    The frames of one turn of the camera at one pose of the base, sorted by time.

    `pose_map_base` is set if that pose was given (``sweep/pose``).
    """

    stamp_ns: int
    frames: tuple[CameraFrame, ...]
    pose_map_base: PoseEstimate | None = None


@dataclass(frozen=True, eq=False)
class Panorama:
    """
    A cylindrical image (height, width, 3) of the room, BGR, and its pose; `stamp_ns` is its start.

    `mask` has the pixels that at least one frame covers. Azimuth 0 of the cylinder is
    ``base_link`` +x. `center_map` (3,) is the viewpoint (pan axis at the height of the optical
    centre) in map, `heading_rad` the heading of the base there, `covariance` (4, 4) that of x, y,
    z, heading. `quality` and `calibration` are those after the sweep; messages hold no quality.
    `made_with` (17,) are the values of the calibration with which the image was synthesized;
    `by_calibration` (4, 17) are the derivatives of x, y, z, heading by the calibration, 0 if
    anchor papers located the camera itself.
    """

    stamp_ns: int
    image: ImageArray
    mask: npt.NDArray[np.bool_]
    cylinder: Cylinder
    center_map: FloatArray
    heading_rad: float
    covariance: FloatArray
    quality: PanoramaQuality | None = None
    calibration: Calibration | None = None
    made_with: FloatArray | None = None
    by_calibration: FloatArray | None = None

    @cached_property
    def grey(self) -> Float32Array:
        """Grey image (height, width)."""
        return np.asarray(cv2.cvtColor(self.image, cv2.COLOR_BGR2GRAY), dtype=np.float32)

    @property
    def axis(self) -> PoseEstimate:
        """Pose of the pan axis in map, with the orientation of the base."""
        pose = np.array([*self.center_map[:2], self.heading_rad])
        return PoseEstimate(self.stamp_ns, pose, self.covariance[np.ix_([0, 1, 3], [0, 1, 3])])


@dataclass(frozen=True)
class Candidate:
    """
    A patch around a pixel of a panorama, proposed by attention; the best `saliency` is 1.

    `edge`: it is an upright edge, whose row is uncertain.
    """

    column: float
    row: float
    width_px: int
    height_px: int
    saliency: float
    edge: bool = False


@dataclass(frozen=True, eq=False)
class Landmark:
    """
    An elected wall patch at `position` (3,) in map, with its total `covariance` (3, 3).

    `shared_loading` (3, m) are loadings of the shared map factors, mostly the pose errors of the
    panoramas: the covariance between landmarks k and l is ``L_k @ L_l.T``. Factors have unit
    variance; m is the same for the whole map. `normal` (3,) is a unit vector, horizontal, into the
    room. `patch` is grey texture in wall coordinates, uint8: columns run to the right as seen from
    inside the room, rows downwards, centre of the array at `position`, square texels. `viewpoint`
    (3,) is that of the reference view, which determines the observation area; `threshold` is the
    smallest normalized cross-correlation that counts as found. `wall_id` is empty if the patch has
    a plane of its own; `views` show the patch in other panoramas, none in old maps.
    """

    id: int
    position: FloatArray
    covariance: FloatArray
    shared_loading: FloatArray
    normal: FloatArray
    width_m: float
    height_m: float
    patch: ImageArray
    viewpoint: FloatArray
    threshold: float
    wall_id: str = ''
    saliency: float = 0.0
    views: tuple[PatchView, ...] = ()

    @cached_property
    def edge(self) -> bool:
        """Whether it is an upright edge: its row in an image is uncertain."""
        return is_upright_edge(self.patch)


@dataclass(frozen=True, eq=False)
class LandmarkMap:
    """
    Landmarks and provenance; arrays are stacked over `landmarks` in their order.

    `prior` is the calibration in ``robot.yaml`` at learning, `calibration` the estimate by
    learning. Maps of schema 1 and of other sources have neither.

    Raises `LandmarkNavError`: landmarks and calibration have different numbers of shared factors.
    """

    landmarks: tuple[Landmark, ...]
    frame_id: str = 'map'
    walls: tuple[Wall, ...] = ()
    panorama_poses: tuple[PoseEstimate, ...] = ()
    provenance: dict[str, str] = field(default_factory=dict)
    prior: Calibration | None = None
    calibration: Calibration | None = None

    def __post_init__(self) -> None:
        by_map = None if self.calibration is None else self.calibration.by_map
        numbers = {k.shared_loading.shape[1] for k in self.landmarks}
        numbers |= set() if by_map is None else {by_map.shape[1]}
        if self.landmarks and len(numbers) > 1:
            raise LandmarkNavError(
                f'landmarks and calibration of a map have {min(numbers)} to {max(numbers)} shared '
                'factors: learn the map again'
            )

    def calibration_from(self, given: Calibration) -> Calibration:
        """
        Calibration before a drive, with `given` from the current ``robot.yaml``.

        It is the estimate by learning, or `given` if ``robot.yaml`` has changed since learning. In
        the map's unit of length the distance of the pan axis is as uncertain as the scale.
        """
        known = given
        if self.prior is not None and self.calibration is not None and given.same_as(self.prior):
            known = replace(self.calibration, base=given.base)
        if not self.scale_sigma:
            return known
        return known.widened({k: self.scale_sigma * known[k][0] for k in ('axis_x', 'axis_y')})

    def same_as(self, other: LandmarkMap) -> bool:
        """Whether landmarks and their errors are equal."""
        names = ('ids', 'positions', 'covariances', 'shared_loadings')
        return all(np.array_equal(getattr(self, n), getattr(other, n)) for n in names)

    def shares_with(self, other: LandmarkMap) -> bool:
        """Whether a landmark of another map is at the same place in this one."""
        places = [set(map(tuple, one.positions.tolist())) for one in (self, other)]
        return not places[0].isdisjoint(places[1])

    @property
    def scale_sigma(self) -> float:
        """Relative sigma of the map's unit of length; 0 for that of a plan."""
        return float(self.provenance.get('scale_sigma', 0.0))

    @property
    def has_own_frame(self) -> bool:
        """Whether the map was learned without a plan and has a frame and scale of its own."""
        return 'frame' in self.provenance

    @cached_property
    def focal_px(self) -> float:
        """Focal length in pixels of the panoramas with the reference views; NaN without any."""
        away = [np.hypot(*(k.viewpoint - k.position)[:2]) / k.height_m for k in self.landmarks]
        rows = [k.patch.shape[0] for k in self.landmarks]
        return float(np.median(np.multiply(rows, away))) if rows else np.nan

    @cached_property
    def distinct(self) -> LandmarkMap:
        """The map without edges, which are also found where they are not."""
        return replace(self, landmarks=tuple(k for k in self.landmarks if not k.edge))

    @cached_property
    def objects(self) -> npt.NDArray[np.bool_]:
        """
        Which landmarks (n, m) are on each of m objects that may be moved.

        Those nearer to each other than the largest is wide may be on one thing, those of a wall on
        one cupboard.
        """
        count = len(self.landmarks)
        if not count:
            return np.empty((0, 0), dtype=np.bool_)
        first, second = (
            cKDTree(self.positions).query_pairs(self.sizes_m.max(), output_type='ndarray').T
        )
        links = coo_array((np.ones(len(first)), (first, second)), shape=(count, count))
        touching = connected_components(links, directed=False)[1]
        walls = [landmark.wall_id for landmark in self.landmarks]
        of_wall = [[each == wall for each in walls] for wall in dict.fromkeys(walls) if wall]
        things = touching[:, None] == np.arange(touching.max() + 1)
        return np.unique(np.hstack([things, np.reshape(of_wall, (-1, count)).T]), axis=1) > 0

    @cached_property
    def ids(self) -> npt.NDArray[np.int64]:
        """Landmark ids, (n,)."""
        return np.array([k.id for k in self.landmarks], dtype=np.int64)

    @cached_property
    def _places(self) -> dict[int, int]:
        """Indices in `landmarks` by id."""
        return {landmark.id: k for k, landmark in enumerate(self.landmarks)}

    def indices(self, ids: npt.NDArray[np.int64]) -> npt.NDArray[np.intp]:
        """Indices in `landmarks` of ids (n,), all of which must be in the map."""
        return np.array([self._places[k] for k in ids.tolist()], dtype=np.intp)

    def has(self, ids: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """Which of ids (n,) are in the map."""
        return np.array([k in self._places for k in ids.tolist()], dtype=np.bool_)

    @cached_property
    def edges(self) -> npt.NDArray[np.bool_]:
        """Which landmarks are edges, (n,)."""
        return np.array([k.edge for k in self.landmarks], dtype=np.bool_)

    @cached_property
    def positions(self) -> FloatArray:
        """Centres in map, (n, 3)."""
        return np.array([k.position for k in self.landmarks], dtype=np.float64).reshape(-1, 3)

    @cached_property
    def normals(self) -> FloatArray:
        """Normals, (n, 3)."""
        return np.array([k.normal for k in self.landmarks], dtype=np.float64).reshape(-1, 3)

    @cached_property
    def viewpoints(self) -> FloatArray:
        """Reference viewpoints, (n, 3)."""
        return np.array([k.viewpoint for k in self.landmarks], dtype=np.float64).reshape(-1, 3)

    @cached_property
    def sizes_m(self) -> FloatArray:
        """Width and height, (n, 2)."""
        return np.array([(k.width_m, k.height_m) for k in self.landmarks]).reshape(-1, 2)

    @cached_property
    def corners(self) -> FloatArray:
        """Corners of the patches on the wall in map, (n, 4, 3)."""
        return patch_corners(self.positions, self.normals, self.sizes_m)

    @cached_property
    def room(self) -> Room | None:
        """The room of its walls; None without walls. Raises as `Room`."""
        return Room(self.walls) if self.walls else None

    @cached_property
    def seen_through(self) -> npt.NDArray[np.bool_]:
        """Which walls are between landmarks and their reference viewpoints, (n, walls)."""
        assert self.room is not None, 'there are walls'
        return self.room.hiding(self.viewpoints[:, :2], self.positions[:, :2])

    @cached_property
    def covariances(self) -> FloatArray:
        """Total covariances, (n, 3, 3)."""
        return np.array([k.covariance for k in self.landmarks]).reshape(-1, 3, 3)

    @cached_property
    def shared_loadings(self) -> FloatArray:
        """Loadings of the shared map factors, (n, 3, m)."""
        loadings = [k.shared_loading for k in self.landmarks]
        return np.array(loadings, dtype=np.float64) if loadings else np.zeros((0, 3, 0))

    @cached_property
    def joint_covariance_xy(self) -> FloatArray:
        """Joint covariance of all (x, y), (2n, 2n), with the shared map factors."""
        n = len(self.landmarks)
        loading = self.shared_loadings[:, :2].reshape(2 * n, self.shared_loadings.shape[2])
        joint = (loading @ loading.T).reshape(n, 2, n, 2)
        joint[range(n), :, range(n)] = self.covariances[:, :2, :2]
        return np.asarray(joint.reshape(2 * n, 2 * n))

    def joint_covariance_of(self, indices: npt.NDArray[np.integer]) -> FloatArray:
        """Joint covariance (2m, 2m) of the (x, y) of the landmarks at indices (m,)."""
        rows = np.stack([2 * indices, 2 * indices + 1], -1).reshape(-1)
        return np.asarray(self.joint_covariance_xy[np.ix_(rows, rows)])


@dataclass(frozen=True, eq=False)
class Triplet:
    """
    The three landmarks to look at, chosen by the expected covariance of the fix.

    `bearing_rad` (3,) are the expected bearings at the pan axis, counter-clockwise from
    ``base_link`` +x, with standard deviations `sigma_rad` (3,); `covariance` (3, 3) is the
    predicted covariance of the fix; `pan_rad` is the pan at which all three are in view.
    """

    stamp_ns: int
    ids: npt.NDArray[np.int64]
    bearing_rad: FloatArray
    sigma_rad: FloatArray
    covariance: FloatArray
    pan_rad: float


@dataclass(frozen=True, eq=False)
class Detections:
    """
    Landmarks found in one image; arrays over the n found.

    Bearings are at the pan axis, counter-clockwise from ``base_link`` +x; their variances are
    without the errors of the map and of the pan, which all bearings of an image share. `score` is
    the normalized cross-correlation. `covariance_px2` (n, 2, 2) is that of `uv_px` (n, 2), empty
    for bearings of another source. `points` (n, 2) are normalised image coordinates by
    camera_info, x/z to the right, y/z down, with a covariance without that by an error of the
    focal length; empty where only bearings are known. `sizes` (n, 2) are width and height of the
    templates in these coordinates; empty if unknown. `by_lens` (n, 2, 3) are derivatives of the
    points of these pixels by focal scale, principal point and distortion. `below` (n,) are their
    rows below the principal point, in focal lengths. `intrinsics` (5,) are those of the camera,
    see `CameraModel`. These are None if unknown.

    `missed` (m,) are landmarks that should be in view, were searched and were not found. `pan_rad`
    is the pan of the `JointSample` at `joint_delay_s` (assumed) after the stamp, as azimuth in
    ``base_link``. `near` (3,) is the pose of the base found in this image by a search within the
    prior, if that was uncertain.
    """

    stamp_ns: int
    ids: npt.NDArray[np.int64]
    bearing_rad: FloatArray
    variance_rad2: FloatArray
    score: FloatArray
    uv_px: FloatArray
    missed: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    pan_sigma_rad: float = 0.0
    pan_rad: float = 0.0
    joint_delay_s: float = 0.0
    covariance_px2: FloatArray = field(default_factory=lambda: np.empty((0, 2, 2)))
    points: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    point_covariance: FloatArray = field(default_factory=lambda: np.empty((0, 2, 2)))
    sizes: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    by_lens: FloatArray | None = None
    below: FloatArray | None = None
    near: FloatArray | None = None
    intrinsics: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.ids)

    def chosen(self, which: npt.NDArray[np.bool_]) -> Detections:
        """Return the detections selected by the mask `which` (n,)."""
        if which.all():
            return self
        names = ['ids', 'bearing_rad', 'variance_rad2', 'score', 'uv_px']
        names += ['covariance_px2'] if len(self.covariance_px2) else []
        names += ['points', 'point_covariance'] if len(self.points) else []
        names += ['sizes'] if len(self.sizes) else []
        names += [name for name in ('by_lens', 'below') if getattr(self, name) is not None]
        return replace(self, **{name: getattr(self, name)[which] for name in names})
