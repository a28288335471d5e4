"""
Panoramas without a plan: poses from what they share and from odometry, walls from what they show.

The frame of the map is that of the base at the first sweep.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
import logging

import cv2
import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.se2 import rotation
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.facades import (
    FacadesConfig,
    find_facades,
    room_of,
    seen_points,
)
from landmark_nav.learning.relative_pose import (
    find_features,
    relative_poses,
    RelativePoseConfig,
    RelativePoses,
)
from landmark_nav.learning.relative_pose.epipolar import center
from landmark_nav.learning.stages import StageLog
from landmark_nav.parameters import Config
from landmark_nav.types import FloatArray, LandmarkMap, Panorama, PlaceChain

__all__ = ['Located', 'UnmeasuredConfig', 'locate']

_LOG = logging.getLogger(__name__)

# How far off the poses may be, to each other, where landmarks are looked for: m, m, m, rad.
_SEARCH_SIGMA = np.array([0.005, 0.005, 0.003, 1e-3])
_LEAST_VARIANCE = 1e-10
# The scale is taken as it is, up to this: relief would shrink with it, and speak for less.
_FIXED_SCALE = 1e-5


@dataclass(frozen=True)
class UnmeasuredConfig(Config):
    """Parameters of the stages that replace a plan."""

    relative_pose: RelativePoseConfig = field(default_factory=RelativePoseConfig)
    facades: FacadesConfig = field(default_factory=FacadesConfig)


@dataclass(frozen=True, eq=False)
class Located:
    """
    Panoramas with poses, the room found around them, and what their poses share.

    `places` (4 v, 4 v) is the joint covariance of the viewpoints by odometry, were the scale
    known: nothing that the panoramas show depends on it, see `with_scale`.
    """

    panoramas: tuple[Panorama, ...]
    room: Room
    places: FloatArray
    poses: RelativePoses

    @property
    def scale_sigma(self) -> float:
        """Relative standard deviation of the scale, by odometry."""
        count = len(self.poses.states)
        chain = self.poses.places.covariance.reshape(count, 3, count, 3)
        plan = chain[1:, :2, 1:, :2].reshape(2 * count - 2, 2 * count - 2)
        way = self.poses.states[1:, :2].ravel()
        return float(1.0 / np.sqrt(way @ np.linalg.solve(plan, way)))

    def with_scale(self, landmarks: LandmarkMap) -> LandmarkMap:
        """Add the error of the scale to a map: one more factor that all landmarks share."""
        origin, sigma = self.panoramas[0].center_map, self.scale_sigma
        scaled = []
        for landmark in landmarks.landmarks:
            factor = sigma * (landmark.position - origin)[:, None]
            scaled.append(
                replace(
                    landmark,
                    covariance=landmark.covariance + factor @ factor.T,
                    shared_loading=np.hstack([landmark.shared_loading, factor]),
                )
            )
        return replace(landmarks, landmarks=tuple(scaled))


def locate(
    panoramas: Sequence[Panorama],
    places: PlaceChain,
    lever: FloatArray,
    config: UnmeasuredConfig,
    log: StageLog | None = None,
) -> Located:
    """
    Find where panoramas were taken, and the walls around.

    Parameters
    ----------
    panoramas : sequence of Panorama
        Their poses do not matter.
    places : PlaceChain
        Poses of the base by odometry: they give the scale.
    lever : ndarray, shape (3,)
        Viewpoint in the base frame, metres.
    config : UnmeasuredConfig
        Parameters of the stages.
    log : StageLog, optional
        Where times go.

    Raises
    ------
    LandmarkNavError
        One panorama, or panoramas that share too little or contradict odometry; no walls.

    """
    if len(panoramas) < 2:
        raise LandmarkNavError(
            f'learning needs two panoramas from different places, not {len(panoramas)}: '
            'take another sweep 1 to 3 m away'
        )
    log = log or StageLog()
    with log.measure('relative_poses'):
        features = [
            find_features(
                np.asarray(cv2.cvtColor(p.image, cv2.COLOR_BGR2GRAY)),
                p.mask,
                p.cylinder,
                config.relative_pose.features,
            )
            for p in panoramas
        ]
        poses = relative_poses(features, places, lever, config.relative_pose)
    with log.measure('facades'):
        sigma = config.relative_pose.direction_sigma_rad
        points = seen_points(poses.states, poses.pairs, lever, sigma)
        eyes = np.array([center(state, lever) for state in poses.states])
        facades = find_facades(points, config.facades)
        room = room_of(facades, eyes, config.facades, 'map')
    located = [
        replace(
            p,
            center_map=eye,
            heading_rad=float(state[2]),
            covariance=np.diag(_SEARCH_SIGMA**2),
        )
        for p, eye, state in zip(panoramas, eyes, poses.states, strict=True)
    ]
    rise = config.relative_pose.rise_sigma_m
    return Located(tuple(located), room, _viewpoints(poses, lever, rise), poses)


def _viewpoints(poses: RelativePoses, lever: FloatArray, rise_sigma_m: float) -> FloatArray:
    """Joint covariance (4 v, 4 v) of x, y, z, heading of viewpoints by odometry."""
    count = len(poses.states)
    jacobian = np.zeros((count, 4, count, 3))
    for k, state in enumerate(poses.states):
        jacobian[k, :2, k, :2] = np.eye(2)
        jacobian[k, :2, k, 2] = rotation(state[2] + np.pi / 2) @ lever[:2]
        jacobian[k, 3, k, 2] = 1.0
    flat = jacobian.reshape(4 * count, 3 * count)
    joint = flat @ poses.places.covariance @ flat.T
    heights = 4 * np.arange(1, count) + 2
    joint[heights, heights] += rise_sigma_m**2
    joint += _LEAST_VARIANCE * np.eye(4 * count)
    # By how much of itself the way from the first sweep grows if the viewpoints move.
    way = np.zeros((count, 4))
    way[:, :2] = poses.states[:, :2] - poses.states[0, :2]
    growth = way.ravel() / np.sum(way**2)
    along = joint @ growth
    return np.asarray(
        joint - np.outer(along, along) / (growth @ along + _FIXED_SCALE**2)
    )
