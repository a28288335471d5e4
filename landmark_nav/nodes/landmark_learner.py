"""Learns landmarks from panoramas, stores the map and publishes it."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
import time
from typing import Any

import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup

from landmark_nav.calibration import Calibration
from landmark_nav.errors import LandmarkNavError
from landmark_nav.learning.pipeline import learn_from_panoramas, LearningResult
from landmark_nav.learning.stages import StageLog
from landmark_nav.learning.unmeasured import learn_located, locate_sweeps
from landmark_nav.localization.odometry.track import ClockStep, ClockWatch
from landmark_nav.localization.sweep_places import carried_on, known_places
from landmark_nav.localization.triangulation.model import base_from_axis
from landmark_nav.messages import decode, encode
from landmark_nav.nodes.configured import ConfiguredNode
from landmark_nav.nodes.recorded_sweeps import RecordedSweep, SweepInbox
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.run import run_node
from landmark_nav.ros.topics import PANORAMA_TOPICS, ros_factory
from landmark_nav.storage.bags.definitions import MAP_TOPICS
from landmark_nav.storage.maps import load_map, save_map
from landmark_nav.storage.setup_files import load_room
from landmark_nav.types import (
    LandmarkMap,
    OdometrySample,
    Panorama,
    PlaceChain,
    PoseEstimate,
    Sweep,
)

# Least interval of odometry samples that are kept, which gives 50 ms at usual rates, and their
# greatest number, which lasts for 1.8 hours.
_STEP_NS, _MOST_SAMPLES = 45_000_000, 2**17
# Least step back of a stamp that shows that the clock was set back.
_SET_BACK_NS = 1_000_000_000
# Greatest size of the images of all sweeps that are kept.
_MAX_BYTES = 2**29


class UnmeasuredLearner:
    """Learns a map from ``sweep/*`` and ``odom`` by `learning.unmeasured`."""

    def __init__(self, node: ConfiguredNode, given: Calibration) -> None:
        self._node, self._given = node, given
        self._sweeps: dict[int, RecordedSweep] = {}
        self._odometry: deque[OdometrySample] = deque(maxlen=_MOST_SAMPLES)
        self._clock = ClockWatch()
        SweepInbox(node, given.mount, 'map', self._on_sweep)
        node.listen('odom', self._on_odometry)

    def __len__(self) -> int:
        """Return the number of sweeps that are kept."""
        return len(self._sweeps)

    def clear(self) -> None:
        """Drop all sweeps."""
        self._sweeps.clear()

    def learn(self) -> LearningResult:
        """
        Learn a map from the sweeps that are kept.

        Raises `LandmarkNavError`: the scale is not observable, or a stage fails.
        """
        recorded = [self._sweeps[stamp] for stamp in sorted(self._sweeps)]

        def sweeps() -> Iterator[Sweep]:
            depth = decode.BitDepth()
            return (sweep.decoded(depth, self._node.drop) for sweep in recorded)

        config, odometry = self._node.config, list(self._odometry)
        given = [sweep.pose_map_base for sweep in recorded]
        spans = [sweep.span_ns for sweep in recorded]
        sheets = config.unmeasured.sheets
        if not (any(given) or odometry or sheets.has_papers or sheets.has_markers):
            raise LandmarkNavError(
                'nothing gives the scale: connect odom and sweep again, publish sweep/pose, hang '
                'sheets (unmeasured.sheets), or measure walls and papers and give room_file'
            )

        def known(_stamped: Sequence[Sweep]) -> list[PlaceChain]:
            return known_places(given, spans, odometry, config.odometry)

        located = locate_sweeps(sweeps, known, self._given, config.unmeasured, StageLog())
        result = learn_located(located, config)
        return replace(result, map=replace(result.map, provenance=located.provenance))

    def place_now(self, result: LearningResult) -> PoseEstimate | None:
        """Pose of the base in the map, by odometry since the last sweep; None without odometry."""
        if not self._odometry:
            return None
        place = base_from_axis(result.map.panorama_poses[-1], self._given.mount)
        return carried_on(place, list(self._odometry), self._node.config.odometry)

    def _on_sweep(self, sweep: RecordedSweep) -> None:
        if not sweep.frames:
            raise LandmarkNavError('the sweep has no frames: take it again')
        kept = sum(one.size_bytes for one in self._sweeps.values())
        if kept + sweep.size_bytes > _MAX_BYTES:
            raise LandmarkNavError(
                f'{len(self)} sweeps fill the memory for images: call learn_landmarks and '
                'clear_panoramas, or publish compressed images'
            )
        self._sweeps[sweep.stamp_ns] = sweep
        self._node.get_logger().info(f'sweep {len(self)} received')

    def _on_odometry(self, message: Any) -> None:
        sample = decode.odometry(message)
        if self._odometry:
            newest_ns = self._odometry[-1].stamp_ns
            ahead_ns = sample.stamp_ns - newest_ns
            step = self._clock.judge(sample.stamp_ns, newest_ns, _SET_BACK_NS)
            if step is ClockStep.OFF:
                raise LandmarkNavError(f'its stamp is off: {1e-9 * ahead_ns:+.1f} s')
            if step is ClockStep.BACK and ahead_ns < -_SET_BACK_NS:
                self._odometry.clear()
            elif ahead_ns < _STEP_NS:
                return
        self._odometry.append(sample)


_NOT_SAVED = 'not saved yet: call save_map'
# Greatest distance between two measurements of one wall.
_SAME_WALL_M = 0.3


class LandmarkLearnerNode(ConfiguredNode):
    """
    Turns ``panorama/*`` into ``landmarks`` by `learning.pipeline.learn_from_panoramas`.

    Without ``room_file`` it uses ``sweep/*`` and ``odom`` instead, by `learning.unmeasured`.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('landmark_learner', 'learning', **options)

    def set_up(self) -> None:
        """Read parameters and files; create topics and services."""
        super().set_up()
        self._outputs = [*map(self.advertise, MAP_TOPICS)]
        self._panoramas: dict[int, Panorama] = {}
        self._swept_ns = 0
        self._map: LandmarkMap | None = None
        self._on_disk = False
        room_file, robot_file = self.config.room_file, self.config.robot_file
        self._room = load_room(room_file) if room_file else None
        self._given = self._robot() if robot_file or not room_file else None
        if self._room is not None:
            self.listen_together(PANORAMA_TOPICS, self._on_panorama)
            self.listen('sweep/trajectory', self._on_trajectory)
        else:
            assert self._given is not None, 'it is read without a room'
            self._unmeasured = UnmeasuredLearner(self, self._given)
            self._start = self.advertise('initialpose')
        # Services exclude each other, but panoramas still arrive.
        group = MutuallyExclusiveCallbackGroup()
        self.offer('learn_landmarks', self._learn, group=group)
        self.offer('clear_panoramas', self._clear, group=group)
        self.offer('save_map', self._save, group=group)
        self.offer('load_map', self._load, group=group)
        self._why_none = 'no map yet'
        if self.config.load_on_start:
            try:
                self.get_logger().info(self._load())
            except LandmarkNavError as error:  # a map can still be learned
                self._why_none = f'no map loaded ({error})'
                self.get_logger().warning(self._why_none)

    def health(self) -> Health:
        """Degraded without a map or with one of another room; else OK."""
        values = {'panoramas': self._count}
        if self._map is None:
            words = f'{self._why_none}: call learn_landmarks or load_map'
            return Health(Level.DEGRADED, words, values)
        words = f'{len(self._map.landmarks)} landmarks'
        if not self._on_disk:
            words += f', {_NOT_SAVED}'
        if warning := self._why_foreign(self._map):
            return Health(Level.DEGRADED, f'{words}; {warning}', values)
        return Health(Level.OK, words, values)

    @property
    def _count(self) -> int:
        """Number of panoramas or sweeps to learn from."""
        return len(self._panoramas) if self._room else len(self._unmeasured)

    def _on_panorama(self, image: Any, info: Any, pose: Any) -> None:
        assert self._room is not None
        decode.check_frame(pose.header, self._room.frame_id, 'give both nodes one room_file')
        view = decode.panorama(image, info, pose)
        if not view.stamp_ns:
            # Without stamps only its pixels show whether a panorama came before.
            if any(np.array_equal(view.image, one.image) for one in self._panoramas.values()):
                return
            newest_ns = max(self._panoramas, default=0)
            now_ns = int(self.get_clock().now().nanoseconds)
            view = replace(view, stamp_ns=max(now_ns, newest_ns + 1))
        self._panoramas[view.stamp_ns] = view
        self.get_logger().info(f'panorama {len(self._panoramas)} received')

    def _on_trajectory(self, message: Any) -> None:
        self._swept_ns = decode.stamp_ns(message.header)

    def _learn(self) -> str:
        start = time.monotonic()
        if self._room is None:
            result = self._unmeasured.learn()
        else:
            panoramas = [self._panoramas[stamp] for stamp in sorted(self._panoramas)]
            try:
                result = learn_from_panoramas(panoramas, self._room, self.config)
            except LandmarkNavError as error:
                if self._swept_ns <= max(self._panoramas, default=0):
                    raise
                raise LandmarkNavError(
                    'the panorama of the last sweep is still in the making, or was refused '
                    f'(panorama_synthesizer); without it {error}'
                ) from error
        result = replace(result, map=replace(result.map, prior=self._given))
        self._publish(result.map, on_disk=False)
        walls = len({landmark.wall_id for landmark in result.map.landmarks} - {''})
        done = (
            f'{len(result.map.landmarks)} landmarks on {walls} walls out of '
            f'{len(result.panoramas)} panoramas in {time.monotonic() - start:.1f} s'
        )
        own = self._start_at(result) if self._room is None else ''
        return '; '.join(filter(None, [done, own, _NOT_SAVED, result.warning]))

    def _start_at(self, result: LearningResult) -> str:
        """Publish the pose of the robot in the new map; report it and the origin of the scale."""
        known = result.map.provenance
        words = f'metres from {known["scale"]}, good to {100 * float(known["scale_sigma"]):.1f} %'
        place = self._unmeasured.place_now(result)
        if place is None:
            return words
        self._start.publish(encode.pose(ros_factory, place, result.map.frame_id))
        x, y, heading = *place.pose[:2], np.degrees(place.pose[2])
        return f'{words}; the robot is at ({x:.2f}, {y:.2f}) m, {heading:.1f} deg by odom'

    def _clear(self) -> str:
        count = self._count
        self._panoramas.clear()
        if self._room is None:
            self._unmeasured.clear()
        return f'{count} panoramas forgotten; the map stays'

    def _save(self) -> str:
        if self._map is None:
            raise LandmarkNavError('there is no map to save: call learn_landmarks first')
        save_map(self._map, self.config.map_folder)
        self._on_disk = True
        return self._report(f'{len(self._map.landmarks)} landmarks saved in', self._map)

    def _load(self) -> str:
        loaded = load_map(self.config.map_folder)
        self._publish(loaded, on_disk=True)
        return self._report(f'{len(loaded.landmarks)} landmarks loaded from', loaded)

    def _report(self, done: str, landmarks: LandmarkMap) -> str:
        """Describe what was done with the map folder, and warn of a map of another room."""
        warning = self._why_foreign(landmarks)
        if warning:
            self.get_logger().warning(warning)
        return '; '.join(filter(None, [f'{done} {self.config.map_folder}', warning]))

    def _why_foreign(self, landmarks: LandmarkMap) -> str:
        """Reason why a map and the room file are of different rooms; empty if they are not."""
        room, files = self._room, f'{self.config.map_folder} and {self.config.room_file}'
        if room is None:
            return ''
        if landmarks.frame_id != room.frame_id:
            why = f'{landmarks.frame_id!r} and {room.frame_id!r} are their frames'
        elif landmarks.walls and not room.shares_wall(landmarks.walls, _SAME_WALL_M):
            why = f'no wall of the one is within {_SAME_WALL_M:g} m of one of the other'
        else:
            return ''
        return f'{files} are of different rooms: {why}'

    def _publish(self, landmarks: LandmarkMap, on_disk: bool) -> None:
        self._map, self._on_disk = landmarks, on_disk
        stamp_ns = self.get_clock().now().nanoseconds
        messages = encode.landmark_map(ros_factory, landmarks, stamp_ns)
        for output, message in zip(self._outputs, messages, strict=True):
            output.publish(message)


# One thread learns, another waits for the frames of a sweep, and the third receives them.
main = partial(run_node, LandmarkLearnerNode, threads=3)

if __name__ == '__main__':
    raise SystemExit(main())
