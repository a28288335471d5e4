"""Steps of the demo, and its recording as a run."""

from __future__ import annotations

from collections.abc import Callable, Collection
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
import sys
import time
from typing import Any, TYPE_CHECKING, TypeVar

import numpy as np
from tqdm import tqdm

from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation import run_report
from landmark_nav.evaluation.metrics import PoseTrack
from landmark_nav.evaluation.replay import Replay
from landmark_nav.geometry import se2
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.estimator.integrity import ProtectionLevel, Status
from landmark_nav.localization.localizer import LocalizationUpdate
from landmark_nav.localization.observer import Observation
from landmark_nav.localization.triangulation.model import base_from_axis
from landmark_nav.messages import decode
from landmark_nav.simulation.drive_path import PathFollower, plan_tour, plan_way
from landmark_nav.simulation.furnishing import generate_scene
from landmark_nav.simulation.scene import sweep_places
from landmark_nav.simulation.setup_documents import robot_document, room_document
from landmark_nav.simulation.world import DEFAULT_MOUNT
from landmark_nav.storage.bags import Bag
from landmark_nav.types import Detections, FloatArray, LandmarkMap, PoseEstimate, Refusal

if TYPE_CHECKING:  # the import needs ROS
    from landmark_nav.ros.robot_client import RobotClient

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
_NONE = np.empty(0)
# Status by the levels OK, WARN and ERROR of DiagnosticStatus, which rosbags reads as numbers.
_STATUS = tuple(status.value for status in Status)


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
        nothing = Detections(stamp, _NONE.astype(int), _NONE, _NONE, _NONE, _NONE.reshape(0, 2))
        seen = found.get(stamp, nothing)
        fix: PoseEstimate | Refusal = fixes.get(stamp) or _NOT_RECORDED
        updates.append(
            LocalizationUpdate(
                stamp,
                Observation(seen, {}, partial(_same, fix)),
                len(seen),
                PoseEstimate(stamp, pose, fused[nearest].covariance),
                status,
                '' if status == Status.OK.value else reason,
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


def _same(fix: PoseEstimate | Refusal) -> PoseEstimate | Refusal:
    return fix


def _states_at(bag: Bag, stamps_ns: Any) -> list[tuple[str, str]]:
    """Last status of the fusion and its reason at each image; tracking before the first."""
    states = [(0, Status.OK.value, '')]
    for entry in bag.messages(['/diagnostics']):
        for status in entry.message.status:
            if status.name.startswith('odometry_fusion:'):
                stamp = decode.stamp_ns(entry.message.header)
                states.append((stamp, _STATUS[min(int(status.level), 2)], status.message))
    last = np.searchsorted([stamp for stamp, *_ in states], stamps_ns, side='right') - 1
    return [states[k][1:] for k in last]


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


def figures(run: Replay, landmarks: LandmarkMap) -> tuple[dict[str, Any], Replay]:
    """
    Return figures with the keys of ``landmark-nav evaluate --json``, and the run.

    For a map with its own frame, errors are computed after alignment, and the returned run is in
    the scale of the map.
    """
    walls = len({landmark.wall_id for landmark in landmarks.landmarks} - {''})
    run, in_frame = run_report.against_truth(run, landmarks)
    measured = run_report.pose_report(run, landmarks) | in_frame | {'walls': walls}
    return measured | {'scale_sigma': landmarks.scale_sigma}, run


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
        scaled = f'scale off by {100 * off:.2f} % (at most {100 * most:.2f} %)'
        checks.append((off <= most, scaled))
    return [Check(*check) for check in checks]


# Length of the drive.
_TOUR_M = 14.0


@dataclass(frozen=True, eq=False)
class DemoRoom:
    """
    A room with the paths (n, 2) of the robot in map: to the second sweep, and of the drive.

    Without a room file the nodes estimate walls and poses, and map is the frame of the base at the
    first sweep.
    """

    seed: int
    room_file: Path | None
    robot_file: Path
    mount: PanTiltMount
    to_second_place: FloatArray
    tour: FloatArray
    size_m: tuple[float, float]


def prepare_room(folder: Path, seed: int, *, measured: bool = True) -> DemoRoom:
    """
    Generate a room with a tour, and write ``robot.yaml`` into `folder`.

    If the room is `measured`, ``room.yaml`` is written too.

    Raises `LandmarkNavError`: the room has no space to drive.
    """
    scene = generate_scene(seed)
    places = sweep_places(scene)
    first, second = places.poses[:, :2]
    tour = plan_tour(scene, second, _TOUR_M, np.random.default_rng([seed, 40]))
    room_file, robot_file = folder / 'room.yaml', folder / 'robot.yaml'
    if measured:
        room_file.write_text(room_document(scene.room), encoding='utf-8')
    to_frame = se2.inverse(np.zeros(3) if measured else places.poses[0])
    robot_file.write_text(robot_document(DEFAULT_MOUNT), encoding='utf-8')
    return DemoRoom(
        seed,
        room_file if measured else None,
        robot_file,
        DEFAULT_MOUNT,
        se2.transform_points(to_frame, plan_way(scene, first, second)),
        se2.transform_points(to_frame, tour),
        tuple(np.ptp(scene.room.bounds, axis=0).tolist()),
    )


# Least time between two updates of the progress line.
_REFRESH_S = 0.2


class Narrator:
    """
    Prints steps with their time, their results, and a line with the progress.

    The progress is shown on terminals only.
    """

    def __init__(self) -> None:
        self._begin = time.monotonic()
        look: dict[str, Any] = {
            'bar_format': '{desc}',
            'mininterval': _REFRESH_S,
            'miniters': 1,
            'leave': False,
        }
        self._bar: Any = tqdm(file=sys.stdout, disable=None, **look)

    @property
    def seconds(self) -> float:
        """Time since the start."""
        return time.monotonic() - self._begin

    def title(self, text: str) -> None:
        """Print the title of a new step."""
        bold = f'\033[1m{text}\033[0m' if sys.stdout.isatty() else text
        self._print(f'\n[{self.seconds:5.1f} s] {bold}')

    def print_line(self, text: str) -> None:
        """Print a result."""
        self._print(f'          {text}')

    def status(self, text: str) -> None:
        """Show the progress, in place of the previous one."""
        self._bar.set_description_str(f'          ... {text}', refresh=False)
        self._bar.update()

    def _print(self, text: str) -> None:
        """Print a text, which ends the progress before it."""
        self._bar.set_description_str('', refresh=False)
        tqdm.write(text, file=sys.stdout)
        sys.stdout.flush()


# Speed of the robot, and least period of its control.
_SPEED_M_S = 0.3
_CONTROL_NS = 50_000_000


def run_scenario(
    robot: RobotClient, room: DemoRoom, nodes: Collection[str], folder: Path, narrator: Narrator
) -> None:
    """
    Run the demo: two sweeps, learning, and a recorded drive.

    The results are ``map`` and ``recording`` in `folder`.

    Raises `LandmarkNavError`: a step fails; the message says which.
    """
    narrator.title(f'Starting {len(nodes)} nodes, each a process')
    robot.wait(lambda: all(robot.status_of(k).reason for k in nodes), 60.0, 'a report of each')
    robot.wait(lambda: robot.odometry is not None, 20.0, 'odom of the simulated robot')
    length, width = room.size_m
    narrator.print_line(f'a robot that knows nothing, in a room of {length:.1f} m x {width:.1f} m')

    sweeps = robot.recording(folder / 'sweeps', SWEEP_TOPICS)
    with nullcontext() if room.room_file else sweeps:
        first = _sweep(robot, room, narrator, 'first')
        narrator.title('Driving to the second place, by odometry alone')
        anchor = se2.compose(first.pose, se2.inverse(_odometry(robot)))
        _follow(
            robot, room.to_second_place, lambda: se2.compose(anchor, _odometry(robot)), narrator
        )
        second = _sweep(robot, room, narrator, 'second')

    narrator.title('Learning landmarks from the two panoramas: service learn_landmarks')
    narrator.print_line('texture that stands out, found from both places, hard to mistake')
    narrator.print_line(robot.call('learn_landmarks', 120.0))
    narrator.print_line(robot.call('save_map', 20.0))

    way_m = float(np.linalg.norm(np.diff(room.tour, axis=0), axis=1).sum())
    narrator.title(f'Driving {way_m:.0f} m, steered by the fused pose')
    narrator.print_line('the camera keeps turning to the three landmarks of the best expected fix')
    with robot.recording(folder / 'recording', RECORDED_TOPICS, room.mount):
        if room.room_file:  # otherwise learning has published the pose
            robot.start_at(second)
        robot.wait(lambda: robot.fused is not None, 10.0, 'odometry/fused')
        robot.wait(lambda: robot.fixes > 0, 20.0, 'a first triangulated pose')
        _follow(robot, room.tour, lambda: _fused(robot), narrator)
    narrator.print_line(
        'recording/ is an MCAP file: Foxglove and Lichtblick show it with the layout foxglove.json'
    )


def _sweep(robot: RobotClient, room: DemoRoom, narrator: Narrator, which: str) -> PoseEstimate:
    """Take a sweep and wait for its panorama; return the pose of the base, zero without papers."""
    narrator.title(f'Taking the {which} sweep: service capture_sweep')
    narrator.print_line('the camera turns step by step and keeps a frame, all the way round')
    before = len(robot.panoramas)
    status_of = robot.call(
        'capture_sweep', 240.0, lambda: narrator.status(robot.status_of('sweep_capture').reason)
    )
    narrator.print_line(status_of)

    def made() -> bool:
        status = robot.status_of('panorama_synthesizer')
        if status.lost:
            raise LandmarkNavError(f'panorama_synthesizer: {status.reason}')
        narrator.status(status.reason)
        # The learner must have received the panorama too.
        learner_has = int(robot.status_of('landmark_learner').values.get('panoramas', 0))
        return min(len(robot.panoramas), learner_has) > before

    robot.wait(made, 90.0, 'the panorama')
    if room.room_file is None:
        narrator.print_line('where that was is found when it learns')
        return PoseEstimate(robot.panoramas[-1].stamp_ns, np.zeros(3), np.zeros((3, 3)))
    place = base_from_axis(robot.panoramas[-1].axis, room.mount)
    x, y, heading = place.pose
    sigma_mm = 1e3 * float(np.sqrt(np.trace(place.covariance[:2, :2])))
    narrator.print_line(
        f'the papers say: base at ({x:.3f}, {y:.3f}) m, {np.degrees(heading):.2f} deg '
        f'(sigma {sigma_mm:.0f} mm)'
    )
    return place


def _follow(
    robot: RobotClient, path: FloatArray, pose: Callable[[], FloatArray], narrator: Narrator
) -> None:
    """Drive along a path to its end, controlled by `pose`."""
    follower = PathFollower(path, _SPEED_M_S)
    commanded_ns = 0

    def arrived() -> bool:
        nonlocal commanded_ns
        now = pose()
        stamp = robot.odometry.stamp_ns if robot.odometry is not None else 0
        if stamp - commanded_ns >= _CONTROL_NS:
            commanded_ns = stamp
            robot.drive(*follower.command(now))
        x, y, heading = now
        narrator.status(f'at ({x:.2f}, {y:.2f}) m, {np.degrees(heading):.0f} deg')
        return follower.finished

    way_m = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    try:
        robot.wait(arrived, 30.0 + 4.0 * way_m / _SPEED_M_S, 'the end of the way')
    finally:
        robot.drive(0.0, 0.0)
    x, y, _ = pose()
    narrator.print_line(f'at the end of {way_m:.1f} m, by its own account at ({x:.2f}, {y:.2f}) m')


def _odometry(robot: RobotClient) -> FloatArray:
    assert robot.odometry is not None
    return robot.odometry.pose_odom_base


def _fused(robot: RobotClient) -> FloatArray:
    assert robot.fused is not None
    return robot.fused.pose
