"""A recording of the nodes as a run that can be measured and drawn like an offline one."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.replay import Replay
from landmark_nav.evaluation.tracks import PoseTrack
from landmark_nav.geometry import se2
from landmark_nav.localization.estimator.integrity import ProtectionLevel
from landmark_nav.localization.localizer import LocalizationUpdate
from landmark_nav.localization.observer import Observation
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag
from landmark_nav.types import Detections, PoseEstimate, Refusal

RECORDED_TOPICS = (
    'camera/image_raw/compressed',
    'camera/camera_info',
    'joint_states',
    'odom',
    'ground_truth/odom',
    'detections',
    'triangulation/pose',
    'odometry/fused',
    '/diagnostics',
    'triplet',
    # For people: what RViz, Foxglove and PlotJuggler show.
    'landmarks/markers',
    'odometry_fusion/protection_level',
    'odometry_fusion/path',
    'odometry_fusion/odometry_path',
    'odometry_fusion/markers',
    'triangulation_localizer/markers',
    'triangulation_localizer/debug_image/compressed',
)

# What `landmark-nav learn` takes without a plan.
SWEEP_TOPICS = (
    *('sweep/image/compressed', 'sweep/camera_info', 'sweep/trajectory'),
    *('odom', 'ground_truth/odom'),
)

T = TypeVar('T')

_NOT_RECORDED = Refusal('not recorded')
# By the levels OK, WARN and ERROR of DiagnosticStatus, which rosbags reads as numbers.
_STATUS = ('tracking', 'coasting', 'lost')


def recorded_run(bag: Bag) -> Replay:
    """
    Read what the nodes published, one update an image.

    The fused pose at an image is the one that was published around its stamp: before anything
    of that image could have gone into it.

    Raises `LandmarkNavError`: topics are missing, or nothing was fused.
    """
    images = _read(bag, 'camera/image_raw/compressed', lambda m: decode.stamp_ns(m.header))
    fused = {e.stamp_ns: e for e in _read(bag, 'odometry/fused', decode.pose_estimate)}
    odometry = {e.stamp_ns: e.pose_odom_base for e in _read(bag, 'odom', decode.odometry)}
    truth = _read(bag, 'ground_truth/odom', decode.pose_estimate)
    fixes = {e.stamp_ns: e for e in _read(bag, 'triangulation/pose', decode.pose_estimate)}
    found = {e.stamp_ns: e for e in _read(bag, 'detections', decode.detections)}
    levels = {
        e.stamp_ns: ProtectionLevel.unscaled(e)
        for e in _read(bag, 'odometry_fusion/protection_level', decode.pose_estimate)
    }
    started = [stamp for stamp in sorted(fused) if stamp in odometry]
    if not started:
        raise LandmarkNavError(f"{bag.path}: odometry/fused never came: see the nodes' logs")
    start = fused[started[0]]
    fused_track = PoseTrack.of((stamp, estimate.pose) for stamp, estimate in fused.items())
    stamps = [s for s in images if started[0] <= s <= fused_track.stamps_ns[-1]]
    if not stamps:
        raise LandmarkNavError(f'{bag.path}: no image was recorded while driving')
    states = _states_at(bag, np.array(stamps, dtype=np.int64))
    updates = []
    for stamp, pose, (status, reason) in zip(stamps, fused_track.at(stamps), states, strict=True):
        nearest = min(fused, key=lambda other: abs(other - stamp))
        seen = found.get(stamp, _nothing(stamp))
        updates.append(
            LocalizationUpdate(
                stamp,
                Observation(seen, {}, partial(_or_refusal, fixes.get(stamp))),
                len(seen),
                PoseEstimate(stamp, pose, fused[nearest].covariance),
                status,
                '' if status == 'tracking' else reason,
                level=levels.get(nearest),
            )
        )
    track = PoseTrack.of(odometry.items())
    way = se2.relative(odometry[started[0]], track.poses)
    return Replay(
        start=start,
        searched=(),
        updates=tuple(updates),
        update_seconds=np.zeros(len(updates)),
        odometry=PoseTrack(track.stamps_ns, se2.compose(start.pose, way)),
        truth=PoseTrack.of((estimate.stamp_ns, estimate.pose) for estimate in truth),
        seconds=bag.duration_s,
    )


def _read(bag: Bag, name: str, decoder: Callable[[Any], T]) -> list[T]:
    topic = bag.find(name)
    return [decoder(entry.message) for entry in bag.messages([topic])] if topic else []


def _states_at(bag: Bag, stamps_ns: Any) -> list[tuple[str, str]]:
    """Last report of the fusion at each image, status and reason; not lost before the first."""
    states = [(0, 'tracking', '')]
    for entry in bag.messages(['/diagnostics']):
        for status in entry.message.status:
            if status.name.startswith('odometry_fusion:'):
                stamp = decode.stamp_ns(entry.message.header)
                states.append((stamp, _STATUS[min(int(status.level), 2)], status.message))
    last = np.searchsorted([stamp for stamp, *_ in states], stamps_ns, side='right') - 1
    return [states[k][1:] for k in last]


def _or_refusal(fix: PoseEstimate | None) -> PoseEstimate | Refusal:
    return fix or _NOT_RECORDED


def _nothing(stamp_ns: int) -> Detections:
    none = np.empty(0)
    return Detections(stamp_ns, none.astype(np.int64), none, none, none, none.reshape(0, 2))
