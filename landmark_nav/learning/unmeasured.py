"""
Learning without a plan: relative poses from the panoramas, the scale from odometry, given poses or
sheets of a known size, and facades found in the panoramas.

The frame of the map is that of the base at the first sweep.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
import logging

import numpy as np
from scipy.linalg import block_diag

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.geometry.se2 import cross, rotation
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.facades.outline import FACADE_SIGMA_M, open_room, room_of
from landmark_nav.learning.facades.planes import (
    Facade,
    find_facades,
    FLOOR_M,
    placed_matches,
    SECTION_M,
    SeenPoints,
)
from landmark_nav.learning.pipeline import (
    check_number,
    learn_from_panoramas,
    LearningConfig,
    LearningResult,
)
from landmark_nav.learning.relative_pose.epipolar import (
    center,
    DIRECTION_SIGMA_RAD,
    evidence,
    RayPairs,
    STATE,
    TILT_SIGMA_RAD,
)
from landmark_nav.learning.relative_pose.features import find_features
from landmark_nav.learning.relative_pose.poses import relative_poses, RelativePoses
from landmark_nav.learning.sheets import find_sheets, SheetsConfig
from landmark_nav.learning.stages import StageLog
from landmark_nav.learning.stereo.wall_patch import PatchMeasurement, Ties
from landmark_nav.learning.sweep_pipeline import (
    panorama_from_sweep,
    unplaced_panorama,
)
from landmark_nav.parameters import Config
from landmark_nav.types import FloatArray, LandmarkMap, Panorama, PlaceChain, PoseEstimate, Sweep

_LOG = logging.getLogger(__name__)

# Sigmas of the relative poses in the search of landmarks: m, m, m, rad.
RELATIVE_SIGMA = np.array([0.005, 0.005, 0.003, 1e-3])
_LEAST_VARIANCE = 1e-10
# Sigma of the pan zero, which all sweeps share, beyond that of the robot file.
PAN_ZERO_SIGMA_RAD = 1e-3
# Covariance of a pose that is only used for the distances of the walls.
_KNOWN = np.diag([1e-4, 1e-4, 1e-6])
# Points this near to a wall of a plan are on it or are there by chance, m; odds that are required;
# scales that are tried, in sigmas, and their number.
_NEAR_WALL_M, _CONFIRMED, _SCALES, _TRIED = 0.5, np.log(1e3), 2.5, 11
# Least change of directions for which panoramas are made again: half a pixel; most rounds.
_SAME_RAD, _ROUNDS = 1e-3, 4
# Relative sigma of the scale in the adjustment, which keeps it: with a smaller scale relief would
# be smaller too.
_FIXED_SCALE = 1e-5
# Weight of the expected sigmas of panoramas: residuals do not show errors that all azimuths of a
# panorama share. Greatest relative sigma of a range: it may be large, as a bearing remains.
_CAMERA_WEIGHT, _MAX_RANGE_SHARE = 100.0, 0.05


@dataclass(frozen=True)
class UnmeasuredConfig(Config):
    """Parameters of the stages that replace a plan."""

    sheets: SheetsConfig = field(default_factory=SheetsConfig)


@dataclass(frozen=True, eq=False)
class Located:
    """
    Panoramas with poses, facades and the room of them, and the covariance of the poses.

    `places` (4 v, 4 v) is the joint covariance of the viewpoints by the sources of the scale, for
    a fixed scale: `poses.scale_sigma` is the sigma of the scale of the whole map. `ties` are the
    features that panoramas share, at `points`. `heading_sigma_rad` is that of the pan zero by
    ``robot.yaml``.
    """

    panoramas: tuple[Panorama, ...]
    facades: tuple[Facade, ...]
    room: Room
    places: FloatArray
    poses: RelativePoses
    ties: Ties
    points: SeenPoints
    heading_sigma_rad: float = PAN_ZERO_SIGMA_RAD

    @property
    def provenance(self) -> dict[str, str]:
        """Source of the map's frame and scale."""
        names = [share.name for share in self.poses.scales]
        own = {} if 'sweep/pose' in names else {'frame': 'base_link at the first sweep'}
        sigma = f'{self.poses.scale_sigma:.5f}'
        return {**own, 'scale': ', '.join(names), 'scale_sigma': sigma}


def locate(
    panoramas: Sequence[Panorama],
    known: Sequence[PlaceChain],
    lever: FloatArray,
    config: UnmeasuredConfig,
    log: StageLog | None = None,
    before: RelativePoses | None = None,
) -> Located:
    """
    Find the poses of panoramas and the facades around them.

    Raises `LandmarkNavError`: there is one panorama, the panoramas share too little or contradict
    the given poses, nothing gives the scale, or there are no walls.

    Parameters
    ----------
    panoramas : sequence of Panorama
        Panoramas; their poses are not used.
    known : sequence of PlaceChain
        Poses of the base by each source; the first source defines the frame.
    lever : ndarray, shape (3,)
        Viewpoint in the base frame, m.
    log : StageLog, optional
        Log of durations.
    before : RelativePoses, optional
        Poses found before the panoramas were levelled by them.
    """
    check_number(panoramas)
    log = log or StageLog()
    with log.measure('relative_poses'):
        features = [find_features(p) for p in panoramas]
        sheets = [find_sheets(p, config.sheets) for p in panoramas]
        axes = [_of_axis(chain, lever) for chain in known]
        poses = relative_poses(features, axes, lever, sheets, before)
    with log.measure('facades'):
        matched = [placed_matches(poses.states, p) for p in poses.pairs]
        eyes = center(poses.states)
        joined = SeenPoints.joined([points for points, _ in matched])
        facades = find_facades(joined)
        try:
            room = room_of(facades, joined, eyes)
        except LandmarkNavError as error:
            _LOG.warning('%s: only what stands for itself is learned', error)
            room = open_room(joined, eyes)
        off_axis = [_off_axis_m(panorama) for panorama in panoramas]
        measured = [
            m for points, pairs in matched for m in _measured(points, pairs, room, eyes, off_axis)
        ]
        shared_errors = poses.shared_errors.reshape(len(eyes), STATE, -1)[:, [0, 1, 3, 2]]
        ties = Ties(joined.positions, measured, shared_errors.reshape(4 * len(eyes), -1))
    located = [
        replace(
            p, center_map=eye, heading_rad=float(state[2]), covariance=np.diag(RELATIVE_SIGMA**2)
        )
        for p, eye, state in zip(panoramas, eyes, poses.states, strict=True)
    ]
    places = _viewpoints(poses)
    return Located(tuple(located), tuple(facades), room, places, poses, ties, joined)


def locate_sweeps(
    sweeps: Callable[[], Iterator[Sweep]],
    known: Callable[[Sequence[Sweep]], Sequence[PlaceChain]],
    given: Calibration,
    config: UnmeasuredConfig,
    log: StageLog,
) -> Located:
    """
    Make panoramas of sweeps, and find their poses and the facades around them.

    Calibration needs the distances of the walls, and so do panoramas of a camera off the pan axis:
    this is done twice, or until the distances do not change. Sweeps are large and are read again.

    Raises `LandmarkNavError`: as `locate`, and if a sweep makes no panorama or its heading remains
    too uncertain.

    Parameters
    ----------
    sweeps : callable
        Returns an iterator over the sweeps, the same each time.
    known : callable
        Given poses of sweeps, which are passed without most of their frames; empty if sheets of a
        known size alone give the scale.
    given : Calibration
        Prior of the calibration.
    """
    panoramas, stamped = [], []
    for sweep in sweeps():
        panoramas.append(unplaced_panorama(sweep, given, log))
        stamped.append(replace(sweep, frames=sweep.frames[:1] + sweep.frames[-1:]))
        del sweep  # large, and not needed while the next one is read
    check_number(panoramas)
    turn = float(np.hypot(PAN_ZERO_SIGMA_RAD, given.sigmas_from('axis_yaw')[0]))
    places = [_with_turn(chain, turn) for chain in known(stamped)]
    lever = np.array([*given.mount.axis_xyz[:2], panoramas[0].center_map[2]])
    located = locate(panoramas, places, lever, config, log)
    tilts = np.zeros((len(panoramas), 2))
    for _ in range(_ROUNDS):
        upright = np.abs(located.poses.states[:, 4:]).max() < _SAME_RAD
        tilts += 0.0 if upright else located.poses.states[:, 4:]
        bases = se2.compose(located.poses.states[:, :3], [*-lever[:2], 0.0])
        again = [
            panorama_from_sweep(
                replace(sweep, pose_map_base=PoseEstimate(sweep.stamp_ns, base, _KNOWN)),
                located.room,
                given,
                log,
                tilt_rad=tilt if tilt.any() else None,
            )
            for sweep, base, tilt in zip(sweeps(), bases, tilts, strict=True)
        ]
        if all(
            np.array_equal(new.image, old.image)
            for new, old in zip(again, located.panoramas, strict=True)
        ):
            again = [
                replace(p, calibration=new.calibration, made_with=new.made_with)
                for p, new in zip(located.panoramas, again, strict=True)
            ]
            located = replace(located, panoramas=tuple(again))
            break
        before, located = located, locate(again, places, lever, config, log, located.poses)
        moved_rad = _parallax_rad(before, located)
        if moved_rad < _SAME_RAD:
            break
    else:
        _LOG.warning(
            'the distances of walls remain uncertain, and as the camera is off the pan axis, '
            'directions too, by %.2f deg: sweep once more',
            np.degrees(moved_rad),
        )
    # Tilted panoramas leave headings less certain than those levelled by them.
    located.poses.check()
    return replace(located, heading_sigma_rad=turn)


def _parallax_rad(before: Located, after: Located) -> float:
    """Mean change of directions of panoramas if the distances of their walls change."""
    azimuth = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    changes = []
    for old, new in zip(before.panoramas, after.panoramas, strict=True):
        near = [
            1.0 / located.room.raycast(p.center_map[:2], azimuth + p.heading_rad)[0]
            for located, p in ((before, old), (after, new))
        ]
        changes.append(_off_axis_m(new) * np.mean(np.abs(near[1] - near[0])))
    return float(max(changes))


def with_plan(located: Located, plan: Room) -> Located:
    """
    Replace the walls found by those of a plan in the frame of the map.

    Raises `LandmarkNavError`: a sweep is outside the plan, or what the sweeps see is no evidence
    of its walls.
    """
    eyes, sigma = center(located.poses.states)[:, :2], located.poses.scale_sigma
    points = located.points.chosen(located.points.positions[:, 2] > FLOOR_M)
    seen = points.positions[:, :2] - eyes[0]
    likely = [
        _on_walls(eyes[0] + (1.0 + k * sigma) * seen, plan) - 0.5 * k**2
        for k in np.linspace(-_SCALES, _SCALES, _TRIED)
    ]
    if not plan.contains(eyes).all() or max(likely) < _CONFIRMED:
        raise LandmarkNavError(
            'the sweeps do not see the walls of the room file there: without papers its origin is '
            'base_link at the first sweep, as in --walls-out; correct it, or leave --room out'
        )
    return replace(located, room=plan)


def _on_walls(points_xy: FloatArray, plan: Room) -> float:
    """Evidence that points (n, 2) lie on walls; those of one section of a wall count as one."""
    distances = plan.wall_distances(points_xy)
    near = distances.min(axis=1) < _NEAR_WALL_M
    wall, points = distances[near].argmin(axis=1), points_xy[near]
    if not len(points):
        return 0.0
    normal = plan.normals[wall, :2]
    way = points - np.array([w.start for w in plan.walls])[wall]
    along = np.floor(cross(way, normal) / SECTION_M)
    key = np.stack([wall, along], 1)
    _, first, section = np.unique(key, axis=0, return_index=True, return_inverse=True)
    off = np.sum(way * normal, axis=1)
    middle = np.array([np.median(off[section.ravel() == k]) for k in range(len(first))])
    given = np.array([w.sigma_m or 0.0 for w in plan.walls])
    sigma = np.hypot(FACADE_SIGMA_M, given[wall[first]])
    return evidence(middle / sigma, _NEAR_WALL_M / sigma)


def learn_located(
    located: Located, config: LearningConfig, log: StageLog | None = None
) -> LearningResult:
    """Learn landmarks on the facades found; as `learn_from_panoramas`."""
    adjustment = replace(
        config.adjustment,
        camera_weight=_CAMERA_WEIGHT,
        tilt_sigma_rad=TILT_SIGMA_RAD,
        wave_sigma_rad=located.poses.wave_sigma_rad,
    )
    election = replace(config.election, max_range_share=_MAX_RANGE_SHARE)
    config = replace(config, adjustment=adjustment, election=election)
    result = learn_from_panoramas(
        located.panoramas, located.room, config, log, located.places, located.ties
    )
    # The pan zero turns the ways between sweeps against the base; camera and map share its error.
    # The principal point turns each panorama against the base.
    first, panoramas = result.panoramas[0], []
    for p in result.panoramas:
        moved = np.zeros(4)
        way = (p.center_map - first.center_map)[:2]
        moved[:2] = located.heading_sigma_rad * rotation(np.pi / 2) @ way
        covariance = p.covariance + np.outer(moved, moved)
        if p is not first and p.calibration and first.calibration:
            turns = [known['principal_point'][1] for known in (p.calibration, first.calibration)]
            covariance[3, 3] += float(np.sum(np.square(turns)))
        panoramas.append(replace(p, covariance=covariance))
    result = replace(result, panoramas=tuple(panoramas))
    return replace(result, map=_turned(result.map, PAN_ZERO_SIGMA_RAD))


def _measured(
    points: SeenPoints,
    pairs: RayPairs,
    room: Room,
    eyes: FloatArray,
    off_axis_m: Sequence[float],
) -> Iterator[list[PatchMeasurement]]:
    """Measurements of each match in its two panoramas."""
    sides = []
    for view, rays in ((pairs.one, pairs.rays), (pairs.other, pairs.other_rays)):
        x, y, tangent = (rays / np.hypot(rays[:, 0], rays[:, 1])[:, None]).T
        # A camera off its axis shows what is nearer than the walls displaced, and matches were
        # selected without that.
        way = (points.positions - eyes[view])[:, :2]
        wall, _ = room.raycast(eyes[view, :2], np.arctan2(way[:, 1], way[:, 0]))
        displaced = off_axis_m[view] * (1.0 / np.hypot(way[:, 0], way[:, 1]) - 1.0 / wall)
        sides.append((view, np.arctan2(y, x), tangent, np.hypot(DIRECTION_SIGMA_RAD, displaced)))
    for k in range(len(pairs.rays)):
        yield [
            PatchMeasurement(
                view, float(azimuth[k]), float(tangent[k]), float(sigma[k]), float(sigma[k]), 1.0
            )
            for view, azimuth, tangent, sigma in sides
        ]


def _off_axis_m(panorama: Panorama) -> float:
    """Distance of the optical centre from the pan axis with which a panorama was made."""
    if panorama.made_with is None:
        return 0.0
    return float(np.hypot(*panorama.made_with[[NAMES.index('center_x'), NAMES.index('center_y')]]))


def _of_axis(chain: PlaceChain, lever: FloatArray) -> PlaceChain:
    """Poses of the pan axis, with the heading of the base, by those of the base."""
    axis = np.array([*lever[:2], 0.0])
    by_base = block_diag(*[se2.compose_jacobians(pose, axis)[0] for pose in chain.poses])
    return replace(
        chain,
        poses=se2.compose(chain.poses, axis),
        covariance=by_base @ chain.covariance @ by_base.T,
    )


def _with_turn(chain: PlaceChain, sigma_rad: float) -> PlaceChain:
    """Add the error of the pan zero, which turns the way between panoramas, to given poses."""
    turned = np.zeros_like(chain.poses)
    turned[:, :2] = sigma_rad * (chain.poses - chain.poses[0])[:, :2] @ rotation(np.pi / 2).T
    flat = turned.ravel()
    return replace(chain, covariance=chain.covariance + np.outer(flat, flat))


def _viewpoints(poses: RelativePoses) -> FloatArray:
    """Joint covariance (4 v, 4 v) of x, y, z, heading of viewpoints, for a fixed scale."""
    count = len(poses.states)
    joint = np.zeros((4 * count, 4 * count))
    plane = np.flatnonzero(np.arange(4 * count) % 4 != 2)
    joint[np.ix_(plane, plane)] = poses.covariance
    heights = 4 * np.arange(1, count) + 2
    joint[heights, heights] += RELATIVE_SIGMA[2] ** 2
    joint += _LEAST_VARIANCE * np.eye(4 * count)
    # Derivative of the scale by the viewpoints.
    way = np.zeros((count, 4))
    way[:, :2] = (poses.states - poses.states[0])[:, :2]
    growth = way.ravel() / np.sum(way**2)
    along = joint @ growth
    return np.asarray(joint - np.outer(along, along) / (growth @ along + _FIXED_SCALE**2))


def _turned(landmarks: LandmarkMap, sigma_rad: float) -> LandmarkMap:
    """
    Add a factor that all landmarks share: the error of the pan zero.

    It rotates the whole map about the first viewpoint; the panoramas do not show it.
    """
    origin = landmarks.panorama_poses[0].pose
    turned = []
    for k in landmarks.landmarks:
        factor = np.zeros((3, 1))
        factor[:2, 0] = sigma_rad * rotation(np.pi / 2) @ (k.position - [*origin[:2], 0.0])[:2]
        loading = np.hstack([k.shared_loading, factor])
        turned.append(
            replace(k, covariance=k.covariance + factor @ factor.T, shared_loading=loading)
        )
    poses = []
    for pose in landmarks.panorama_poses:
        moved = np.append(rotation(np.pi / 2) @ (pose.pose - origin)[:2], 1.0) * sigma_rad
        poses.append(replace(pose, covariance=pose.covariance + np.outer(moved, moved)))
    known = landmarks.calibration
    if known is not None and known.by_map is not None:
        known = replace(known, by_map=np.pad(known.by_map, ((0, 0), (0, 1))))
    return replace(
        landmarks, landmarks=tuple(turned), panorama_poses=tuple(poses), calibration=known
    )
