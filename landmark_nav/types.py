"""
What crosses the stages: frozen values, SI units, radians, integer nanoseconds.

Frames are in the names: ``pose_map_base`` is the pose of ``base_link`` in ``map``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import auto, Enum
from functools import cached_property
import math

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import FloatArray, ImageArray
from landmark_nav.calibration import Calibration
from landmark_nav.geometry.angles import PanTrack
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.patches import patch_corners, PatchView
from landmark_nav.geometry.walls import Wall
from landmark_nav.quality import PanoramaQuality

__all__ = [
    'CameraFrame',
    'Candidate',
    'Detections',
    'Expectation',
    'FloatArray',
    'ImageArray',
    'JointSample',
    'Landmark',
    'LandmarkMap',
    'OdometrySample',
    'Panorama',
    'PlaceChain',
    'PoseEstimate',
    'Refusal',
    'RefusalCode',
    'Sweep',
    'Triplet',
]


class RefusalCode(Enum):
    """Reasons that other stages act on."""

    OTHER = auto()
    UNRECOGNISED = auto()
    """No pose shows the landmarks that should be seen from it."""
    LOW_CORRELATION = auto()
    """A texture looks different."""
    CLOCK_SET_BACK = auto()


@dataclass(frozen=True)
class Refusal:
    """
    Something to be expected did not work out: a short `reason` and what was measured.

    Programs look at the `code`; the wording is for people and may change.
    """

    reason: str
    detail: str = ''
    code: RefusalCode = RefusalCode.OTHER

    def __str__(self) -> str:
        """Both in one line."""
        return f'{self.reason}: {self.detail}' if self.detail else self.reason


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A planar pose (3,), x [m], y [m], heading [rad], at a time, with its covariance (3, 3)."""

    stamp_ns: int
    pose: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class Expectation(PoseEstimate):
    """
    Pose of the base at a time, and the calibration: what a search for landmarks needs.

    The covariance is that of the pan axis in the direction of the camera: errors of heading and
    pan zero that cancel are left out.

    Parameters
    ----------
    calibration : Calibration
        Its standard deviations count, not its correlations.
    tilt_sigma_rad : float
        How well it is known how high the camera looks: of base, axis and camera together.
    """

    calibration: Calibration
    tilt_sigma_rad: float

    def pan_sigma_rad(self, pan_rate_rad_s: float) -> float:
        """How well the pan is known at this rate, beside the pan zero."""
        delay = abs(pan_rate_rad_s) * self.calibration['joint_delay'][1]
        return math.hypot(delay, self.calibration.base.pan_sigma_rad)

    def stepped(
        self, sigma_m: float, sigma_rad: float, calibration: Mapping[str, float]
    ) -> Expectation:
        """
        Return what is expected if base or calibration have changed by so much.

        What is exact stays.
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
    Poses of the base (v, 3) where sweeps were taken, in the frame of the first one.

    `covariance` (3 v, 3 v) is joint: errors of one way go on in all later poses. `source` names
    what measured them.
    """

    poses: FloatArray
    covariance: FloatArray
    source: str = 'odom'


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
    Measured angles of the pan-tilt unit, radians, and how fast it pans.

    `pan_sigma_rad` is what interpolation adds to the error of the pan, `pan_track` the pan a while
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
    One image with the joint angles it was taken at.

    `image` is BGR (height, width, 3) or grey (height, width), uint8. `roll_rad` turns the camera
    about its optical axis: 0 on a pan-tilt unit, unless calibration finds otherwise.
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


@dataclass(frozen=True, eq=False)
class Sweep:
    """
    The frames of one turn of the camera at one place, sorted by time.

    `pose_map_base` is set if the place is known from elsewhere (``sweep/pose``).
    """

    stamp_ns: int
    frames: tuple[CameraFrame, ...]
    pose_map_base: PoseEstimate | None = None


@dataclass(frozen=True, eq=False)
class Panorama:
    """
    A cylindrical view of the room and where it was taken.

    Parameters
    ----------
    stamp_ns : int
        Start of its sweep.
    image : ndarray, shape (height, width, 3)
        BGR, uint8.
    mask : ndarray of bool, shape (height, width)
        Which pixels some frame covered.
    cylinder : Cylinder
        Geometry; azimuth 0 is ``base_link`` +x.
    center_map : ndarray, shape (3,)
        The viewpoint (pan axis at the height of the optical centre) in map, metres.
    heading_rad : float
        Heading of the base in map.
    covariance : ndarray, shape (4, 4)
        Of x, y, z, heading.
    quality : PanoramaQuality, optional
        Where it was made here: it does not travel.
    calibration : Calibration, optional
        As far as it is known after the sweep. It does not travel either.
    made_with : ndarray, shape (15,), optional
        Values of the calibration that the image was made with.
    by_calibration : ndarray, shape (4, 15), optional
        Derivative of x, y, z, heading by the calibration; papers locate the camera itself: 0.
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

    @property
    def axis(self) -> PoseEstimate:
        """Pose of the pan axis in map, with the orientation of the base."""
        pose = np.array([*self.center_map[:2], self.heading_rad])
        return PoseEstimate(self.stamp_ns, pose, self.covariance[np.ix_([0, 1, 3], [0, 1, 3])])


@dataclass(frozen=True)
class Candidate:
    """A patch about a pixel of a panorama, as attention proposes it; `saliency` 1 is the best."""

    column: float
    row: float
    width_px: int
    height_px: int
    saliency: float


@dataclass(frozen=True, eq=False)
class Landmark:
    """
    An elected wall patch.

    Parameters
    ----------
    id : int
        Unique in its map.
    position : ndarray, shape (3,)
        Centre in map, metres.
    covariance : ndarray, shape (3, 3)
        Total covariance of `position`.
    shared_loading : ndarray, shape (3, m)
        What all landmarks of a map have in common, mostly the pose errors of the panoramas: the
        covariance between landmarks k and l is ``L_k @ L_l.T``. Columns are unit-variance
        factors; `m` is the same for the whole map.
    normal : ndarray, shape (3,)
        Unit, horizontal, into the room.
    width_m, height_m : float
        Size of the patch on the wall.
    patch : ndarray, shape (rows, columns)
        Grey texture in wall coordinates, uint8: columns run to the right as seen from inside the
        room, rows downwards, centre of the array at `position`, square texels.
    viewpoint : ndarray, shape (3,)
        Where it was learned from, in map: sets the observation area.
    threshold : float
        Least normalized cross-correlation that counts as found.
    wall_id, saliency
        Of the wall that carries it (empty for one on a plane of its own), of its candidate.
    views : tuple of PatchView
        What other panoramas show of it; old maps do not hold it.
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


@dataclass(frozen=True, eq=False)
class LandmarkMap:
    """
    What was learned, and where; the arrays are stacked over `landmarks` in their order.

    `prior` is the calibration that ``robot.yaml`` gave at learning, `calibration` what was learned
    of it; maps of schema 1 and of others' data have none.
    """

    landmarks: tuple[Landmark, ...]
    frame_id: str = 'map'
    walls: tuple[Wall, ...] = ()
    panorama_poses: tuple[PoseEstimate, ...] = ()
    provenance: dict[str, str] = field(default_factory=dict)
    prior: Calibration | None = None
    calibration: Calibration | None = None

    def calibration_from(self, given: Calibration) -> Calibration:
        """
        What is known before a drive with ``robot.yaml`` as `given`.

        That is what learning made of it; another ``robot.yaml`` than at learning counts itself.
        """
        if self.prior is None or self.calibration is None or not given.same_as(self.prior):
            return given
        return replace(self.calibration, base=given.base)

    @property
    def has_own_frame(self) -> bool:
        """Whether its frame and scale are its own, as it was learned without a plan."""
        return 'frame' in self.provenance

    @cached_property
    def ids(self) -> npt.NDArray[np.int64]:
        """Landmark ids, (n,)."""
        return np.array([k.id for k in self.landmarks], dtype=np.int64)

    def indices(self, ids: npt.NDArray[np.int64]) -> npt.NDArray[np.intp]:
        """Places in `landmarks` of ids (n,) that the map holds."""
        order = np.argsort(self.ids)
        return np.asarray(order[np.searchsorted(self.ids, ids, sorter=order)], dtype=np.intp)

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
        """Where each was learned from, (n, 3)."""
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
    def covariances(self) -> FloatArray:
        """Total covariances, (n, 3, 3)."""
        return np.array([k.covariance for k in self.landmarks]).reshape(-1, 3, 3)

    @cached_property
    def shared_loadings(self) -> FloatArray:
        """What they have in common, (n, 3, m)."""
        loadings = [k.shared_loading for k in self.landmarks]
        return np.array(loadings, dtype=np.float64) if loadings else np.zeros((0, 3, 0))

    @cached_property
    def joint_covariance_xy(self) -> FloatArray:
        """Joint covariance of all (x, y), (2n, 2n), with the part that landmarks share."""
        n = len(self.landmarks)
        loading = self.shared_loadings[:, :2].reshape(2 * n, self.shared_loadings.shape[2])
        joint = (loading @ loading.T).reshape(n, 2, n, 2)
        joint[range(n), :, range(n)] = self.covariances[:, :2, :2]
        return np.asarray(joint.reshape(2 * n, 2 * n))

    def joint_covariance_of(self, places: npt.NDArray[np.integer]) -> FloatArray:
        """Joint covariance (2m, 2m) of the (x, y) of some landmarks (m,), by their places."""
        rows = np.stack([2 * places, 2 * places + 1], -1).reshape(-1)
        return np.asarray(self.joint_covariance_xy[np.ix_(rows, rows)])


@dataclass(frozen=True, eq=False)
class Triplet:
    """
    Three landmarks to look at, chosen by their expected covariance.

    `bearing_rad` (3,) are expected at the pan axis, counter-clockwise from ``base_link`` +x, with
    standard deviations `sigma_rad` (3,); `covariance` (3, 3) is the predicted one of the fix;
    `pan_rad` is where the camera should look.
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
    Landmarks found in one image, arrays over the n found.

    `bearing_rad` (n,) is seen from the pan axis, counter-clockwise from ``base_link`` +x;
    `variance_rad2` (n,) is its own measurement variance, without the map's share and without
    what all bearings of an image share (the pan angle's error); `score` (n,) is the normalized
    cross-correlation; `uv_px` (n, 2) the place in the image and `covariance_px2` (n, 2, 2) its
    covariance, empty where bearings came from elsewhere. `missed` (m,) are the ids of those
    that should be in view, were looked for and not found. `points` (n, 2) are the places in the
    normalised image, x/z to the right and y/z down, as camera_info has it, `point_covariance`
    (n, 2, 2) theirs; both are empty where only bearings are known. `near` (3,) is the pose that
    the image itself shows, where hardly any was known before. The pan and its sigma
    are of the `JointSample` `joint_delay_s` after the stamp, as azimuths in ``base_link``.
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
    near: FloatArray | None = None

    def __len__(self) -> int:
        """Return how many were found."""
        return len(self.ids)

    def chosen(self, which: npt.NDArray[np.bool_]) -> Detections:
        """Some of them: `which` (n,) says whether to keep each."""
        names = ['ids', 'bearing_rad', 'variance_rad2', 'score', 'uv_px']
        names += ['covariance_px2'] if len(self.covariance_px2) else []
        names += ['points', 'point_covariance'] if len(self.points) else []
        return replace(self, **{name: getattr(self, name)[which] for name in names})
