"""Evaluation of a recording of the nodes like an offline run, and its checks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation import run_report
from landmark_nav.evaluation.metrics import PoseTrack
from landmark_nav.evaluation.replay import Replay
from landmark_nav.geometry import se2
from landmark_nav.localization.estimator.integrity import ProtectionLevel
from landmark_nav.localization.localizer import LocalizationUpdate
from landmark_nav.localization.observer import Observation
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag
from landmark_nav.types import Detections, LandmarkMap, PoseEstimate, Refusal

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
    # Topics for RViz, Foxglove and PlotJuggler.
    'landmarks/markers',
    'odometry_fusion/protection_level',
    'odometry_fusion/path',
    'odometry_fusion/odometry_path',
    'odometry_fusion/markers',
    'triangulation_localizer/markers',
    'triangulation_localizer/debug_image/compressed',
)

# Topics for `landmark-nav learn` without a plan.
SWEEP_TOPICS = (
    *('sweep/image/compressed', 'sweep/camera_info', 'sweep/trajectory'),
    *('odom', 'ground_truth/odom'),
)

T = TypeVar('T')

_NOT_RECORDED = Refusal('not recorded')
# Status by the levels OK, WARN and ERROR of DiagnosticStatus, which rosbags reads as numbers.
_STATUS = ('tracking', 'coasting', 'lost')


def recorded_run(bag: Bag) -> Replay:
    """
    Read the recording of the nodes as a run with one update for each image.

    The fused pose of an image is interpolated from those published for stamps near its stamp,
    before the fusion could use the image.

    Raises `LandmarkNavError`: topics are missing, or there is no fused pose.
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
    """Last status of the fusion and its reason at each image; tracking before the first."""
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


# Bounds of a passed demo.
_MIN_LANDMARKS = 20
_MIN_WALLS = 3
_MAX_RMSE_M = 0.03
_MAX_RMSE_DEG = 0.4
_MIN_AVAILABILITY = 0.95
# Greatest error of the scale of a map that is learned without a plan, sigmas.
_MOST_SIGMAS = 3.0


@dataclass(frozen=True)
class Check:
    """Result of a check, with a text of the measured value and its bound."""

    passed: bool
    text: str


def figures(
    run: Replay, landmarks: LandmarkMap
) -> tuple[dict[str, Any], Replay, run_report.RunErrors]:
    """
    Return figures with the keys of ``landmark-nav evaluate --json``, the run and its errors.

    For a map with its own frame, errors are computed after alignment, and the returned run is in
    the scale of the map.
    """
    walls = len({landmark.wall_id for landmark in landmarks.landmarks} - {''})
    of_run: dict[str, Any] = {'spells': run_report.spells(run), 'walls': walls}
    run, errors, in_frame = run_report.against_truth(run, landmarks)
    if in_frame:
        of_run['scale_sigma'] = float(landmarks.provenance['scale_sigma'])
    else:
        of_run['integrity'] = run_report.integrity_report(run, errors)
    return run_report.pose_report(run, errors, landmarks) | of_run | in_frame, run, errors


def judge(measured: dict[str, Any]) -> list[Check]:
    """Compare the figures with the bounds of a passed demo."""
    fused = measured.get('fused_after_scale', measured['fused'])
    odometry = measured['odometry']
    meters, degrees = fused['position_rmse_m'], fused['heading_rmse_deg']
    alone = odometry['position_rmse_m']
    if meters is None or alone is None:
        return [Check(False, 'no fused pose that could be compared with the truth')]
    landmarks, walls = measured['landmarks'], measured['walls']
    available = measured['availability']
    checks = [
        (
            landmarks >= _MIN_LANDMARKS and walls >= _MIN_WALLS,
            f'{landmarks} landmarks on {walls} walls (at least {_MIN_LANDMARKS} on {_MIN_WALLS})',
        ),
        (
            meters <= _MAX_RMSE_M and degrees <= _MAX_RMSE_DEG,
            f'fused RMSE {100 * meters:.2f} cm and {degrees:.2f} deg '
            f'(at most {100 * _MAX_RMSE_M:g} cm and {_MAX_RMSE_DEG:g} deg)',
        ),
        (
            available >= _MIN_AVAILABILITY,
            f'availability {available:.3f} (at least {_MIN_AVAILABILITY:g})',
        ),
        (meters < alone, f'better than odometry alone, which is off by {100 * alone:.1f} cm'),
    ]
    if 'scale' in measured:
        off, most = abs(measured['scale'] - 1.0), _MOST_SIGMAS * measured['scale_sigma']
        checks.append(
            (off <= most, f'scale off by {100 * off:.2f} % (at most {100 * most:.2f} %)')
        )
    return [Check(*check) for check in checks]
