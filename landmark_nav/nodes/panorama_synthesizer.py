"""Makes a panorama of each sweep and estimates its pose."""

from __future__ import annotations

from functools import partial
import time
from typing import Any

import numpy as np

from landmark_nav.errors import LandmarkNavError, one_line
from landmark_nav.geometry.cylinder import describe_coverage
from landmark_nav.learning import sweep_pipeline
from landmark_nav.learning.reference_area.faults import PaperRecord
from landmark_nav.learning.stages import StageLog
from landmark_nav.messages import decode, encode
from landmark_nav.nodes.configured import ConfiguredNode
from landmark_nav.nodes.recorded_sweeps import RecordedSweep, SweepInbox
from landmark_nav.quality import PanoramaQuality
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.run import run_node
from landmark_nav.ros.topics import PANORAMA_TOPICS, ros_factory
from landmark_nav.storage.setup_files import load_room
from landmark_nav.types import Panorama, Sweep


class PanoramaSynthesizerNode(ConfiguredNode):
    """
    Turns ``sweep/*`` into ``panorama/*`` by `learning.sweep_pipeline.panorama_from_sweep`.

    Without ``room_file`` the pose of a panorama is relative to ``base_link``.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('panorama_synthesizer', 'panorama', **options)

    def set_up(self) -> None:
        """Read parameters and files; create topics and services."""
        super().set_up()
        self._given = self._known = self._robot()
        self._room = load_room(self.config.room_file) if self.config.room_file else None
        self._outputs = [*map(self.advertise, PANORAMA_TOPICS)]
        self._depth = decode.BitDepth()
        self._papers = PaperRecord(self._room) if self._room else None
        self._health = Health(Level.OK, 'waiting for a sweep')
        frame = self._room.frame_id if self._room else 'map'
        SweepInbox(self, self._known.mount, frame, self._on_sweep)

    def health(self) -> Health:
        """Result of the last sweep."""
        return self._health

    def _on_sweep(self, recorded: RecordedSweep) -> None:
        self._health = Health(Level.OK, 'at work on a sweep')
        start = time.monotonic()
        try:
            sweep = recorded.decoded(self._depth, self.drop)
            view, place, frame_id = self._panorama(sweep)
            warning = self._papers.faults().text if self._papers else ''
        except LandmarkNavError as error:
            self._health = Health(Level.LOST, str(error))
            self.get_logger().error(one_line(f'no panorama: {error}'))
            return
        except Exception:
            self._health = Health(Level.LOST, 'no panorama of the last sweep')
            raise
        parts = encode.panorama(ros_factory, view, frame_id)
        for output, part in zip(self._outputs, parts, strict=True):
            output.publish(part)
        if warning:
            self.get_logger().warning(warning)
        pans = [frame.pan_rad for frame in sweep.frames]
        lacks = describe_coverage(pans, sweep.frames[0].camera.half_fov_rad)
        self._health = Health(
            Level.DEGRADED if warning else Level.OK,
            '; '.join(filter(None, [place, lacks, warning])),
            (_sigmas(view) if self._room else {}) | _quality(view.quality),
        )
        self.get_logger().info(f'{self._health.reason} in {time.monotonic() - start:.1f} s')

    def _panorama(self, sweep: Sweep) -> tuple[Panorama, str, str]:
        """Panorama, description of its pose, and frame of the pose."""
        if self._room is None:
            view = sweep_pipeline.unplaced_panorama(sweep, self._known, StageLog())
            return view, 'panorama; its pose comes with learning', self._known.mount.base_frame
        self._known = self._known.for_camera(sweep.frames[0].camera.intrinsics, self._given)
        view = sweep_pipeline.panorama_from_sweep(
            sweep, self._room, self._known, papers=self._papers
        )
        self._known = sweep_pipeline.next_prior(self._given, self._known, view)
        x, y, heading = *view.center_map[:2], np.degrees(view.heading_rad)
        return view, f'panorama at ({x:.3f}, {y:.3f}) m, {heading:.2f} deg', self._room.frame_id


def _sigmas(view: Panorama) -> dict[str, object]:
    """Sigmas of the pose of a panorama, for diagnostics."""
    x, y, heading = np.sqrt(np.diag(view.covariance)[[0, 1, 3]])
    return {'sigma_m': np.hypot(x, y), 'sigma_deg': np.degrees(heading)}


def _quality(quality: PanoramaQuality | None) -> dict[str, object]:
    """Quality figures of a panorama, for diagnostics."""
    if quality is None:
        return {}
    closure = quality.closure_rad
    unknown = quality.closure or 'no full turn'
    return {
        'sharpness': quality.sharpness,
        'closure_deg': unknown if closure is None else abs(np.degrees(closure)),
        'residual_px': quality.residual_px,
        'vignetting': quality.vignetting,
        'gain_spread': quality.gain_spread,
        **{f'calibration/{term.name}': str(term) for term in quality.calibration},
    }


main = partial(run_node, PanoramaSynthesizerNode, threads=2)

if __name__ == '__main__':
    raise SystemExit(main())
