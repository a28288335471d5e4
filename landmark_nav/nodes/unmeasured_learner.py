"""Learning without a plan in a node, which keeps sweeps and odometry."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from landmark_nav.calibration import Calibration
from landmark_nav.configuration import Configuration
from landmark_nav.errors import LandmarkNavError
from landmark_nav.learning.pipeline import LearningResult
from landmark_nav.learning.stages import StageLog
from landmark_nav.learning.unmeasured import learn_located, locate_sweeps
from landmark_nav.localization.sweep_places import carried_on, known_places
from landmark_nav.localization.triangulation.model import base_from_axis
from landmark_nav.messages import decode
from landmark_nav.nodes.recorded_sweeps import RecordedSweep, SweepInbox
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.types import OdometrySample, PlaceChain, PoseEstimate, Sweep

# Least interval of odometry samples that are kept, which gives 50 ms at usual rates, and their
# greatest number, which lasts for 1.8 hours.
_STEP_NS, _MOST_SAMPLES = 45_000_000, 2**17
# Least step back of a stamp that shows that the clock was set back.
_SET_BACK_NS = 1_000_000_000
# Greatest size of the images of all sweeps that are kept.
_MAX_BYTES = 2**29


class UnmeasuredLearner:
    """Learns a map from ``sweep/*`` and ``odom`` by `learning.unmeasured`."""

    def __init__(self, node: LandmarkNode, given: Calibration, config: Configuration) -> None:
        self._node, self._given, self.config = node, given, config
        self._sweeps: dict[int, RecordedSweep] = {}
        self._odometry: deque[OdometrySample] = deque(maxlen=_MOST_SAMPLES)
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

        given = [sweep.pose_map_base for sweep in recorded]
        spans = [sweep.span_ns for sweep in recorded]
        odometry = list(self._odometry)
        sheets = self.config.unmeasured.sheets
        if not (any(given) or odometry or sheets.has_papers or sheets.has_markers):
            raise LandmarkNavError(
                'nothing gives the scale: connect odom and sweep again, publish sweep/pose, hang '
                'sheets (unmeasured.sheets), or measure walls and papers and give room_file'
            )

        def known(_stamped: Sequence[Sweep]) -> list[PlaceChain]:
            return known_places(given, spans, odometry, self.config.odometry)

        unmeasured = self.config.unmeasured
        mount = self._given.mount
        located = locate_sweeps(sweeps, known, mount, self.config, unmeasured, StageLog())
        result = learn_located(located, self.config, unmeasured)
        learned = replace(result.map, prior=self._given, provenance=located.provenance)
        return replace(result, map=learned)

    def place_now(self, result: LearningResult) -> PoseEstimate | None:
        """Pose of the base in the map, by odometry since the last sweep; None without odometry."""
        if not self._odometry:
            return None
        place = base_from_axis(result.map.panorama_poses[-1], self._given.mount)
        return carried_on(place, list(self._odometry), self.config.odometry)

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
            ahead_ns = sample.stamp_ns - self._odometry[-1].stamp_ns
            if ahead_ns < -_SET_BACK_NS:
                self._odometry.clear()
            elif ahead_ns < _STEP_NS:
                return
        self._odometry.append(sample)
