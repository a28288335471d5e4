"""Makes a panorama of every sweep and finds where it was taken."""

from __future__ import annotations

from dataclasses import dataclass
from threading import Lock
import time
from typing import Any

import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup

from landmark_nav.errors import LandmarkNavError, one_line
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.geometry.coverage import describe_coverage
from landmark_nav.learning.pipeline import panorama_from_sweep, PanoramaStages
from landmark_nav.learning.reference_area import PaperRecord
from landmark_nav.learning.sweep import assemble_sweep, missing_frames
from landmark_nav.messages import decode, encode
from landmark_nav.parameters import parameter
from landmark_nav.quality import PanoramaQuality
from landmark_nav.ros.factory import ros_factory
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.run import run_node
from landmark_nav.storage.setup_files import load_robot, load_room
from landmark_nav.types import ImageArray, PoseEstimate, Sweep

__all__ = ['PanoramaSynthesizerNode', 'Parameters', 'main']

# Frames of the longest sweep, and their bytes; older ones belong to a sweep that was given up.
_MAX_FRAMES, _MAX_BYTES = 1440, 2**30


@dataclass(frozen=True)
class Parameters(PanoramaStages):
    """Of the node ``panorama_synthesizer``, beside those of the stages."""

    robot_file: str = parameter('', 'robot.yaml: where the turning camera sits')
    room_file: str = parameter('', 'room.yaml: walls and reference area')
    late_frames_s: float = parameter(
        3.0, 'how long to wait for frames that arrive after their trajectory, s', minimum=0.0
    )


class PanoramaSynthesizerNode(LandmarkNode):
    """``sweep/*`` to ``panorama/*``, by `learning.pipeline.panorama_from_sweep`."""

    def __init__(self, **options: Any) -> None:
        super().__init__('panorama_synthesizer', 'panorama', **options)
        self._config = self.configure(Parameters)
        self._mount = load_robot(self.required('robot_file', self._config.robot_file))
        self._room = load_room(self.required('room_file', self._config.room_file))
        self._outputs = [
            self.advertise(name)
            for name in ('panorama/image', 'panorama/camera_info', 'panorama/pose')
        ]
        self._lock = Lock()
        # Images and calibrations that wait for each other, and frames: pixels, camera, bit depth.
        self._images: dict[int, Any] = {}
        self._infos: dict[int, decode.CameraInfo] = {}
        self._views: dict[int, tuple[ImageArray, CameraModel, int]] = {}
        self._depth = decode.BitDepth()
        self._pose: PoseEstimate | None = None
        self._papers = PaperRecord(self._room, self._config.reference_area)
        self._health = Health(Level.OK, 'waiting for a sweep')
        # The next sweep may come in the other form.
        self.listen('sweep/image', self._on_image)
        self.listen('sweep/image/compressed', self._on_image)
        self.listen('sweep/camera_info', self._on_camera_info)
        self.listen('sweep/pose', self._on_pose)
        # A group of its own: frames go on arriving while it works.
        group = MutuallyExclusiveCallbackGroup()
        self.listen('sweep/trajectory', self._on_trajectory, group=group)

    def health(self) -> Health:
        """What became of the last sweep."""
        return self._health

    def _on_image(self, message: Any) -> None:
        self._join(self._images, decode.stamp_ns(message.header), message)

    def _on_camera_info(self, message: Any) -> None:
        info = decode.camera_info(message)
        self._join(self._infos, decode.stamp_ns(message.header), info)

    def _join(self, waiting: dict[int, Any], stamp_ns: int, item: Any) -> None:
        """Decode the image of a stamp once its calibration is there: frames are small."""
        with self._lock:
            _remember(waiting, stamp_ns, item)
            while sum(len(image.data) for image in self._images.values()) > _MAX_BYTES:
                del self._images[min(self._images)]
            if stamp_ns not in self._images or stamp_ns not in self._infos:
                return
            image, info = self._images.pop(stamp_ns), self._infos.pop(stamp_ns)
            pixels, camera = decode.camera_image(image, info, depth=self._depth)
            _remember(self._views, stamp_ns, (pixels, camera, self._depth.bits))

    def _on_pose(self, message: Any) -> None:
        decode.check_frame(message.header, self._room.frame_id, 'give it there')
        self._pose = decode.pose_estimate(message)

    def _on_trajectory(self, message: Any) -> None:
        self._health = Health(Level.OK, 'at work on a sweep')
        try:
            start = time.monotonic()
            sweep = self._sweep(message)
            view = panorama_from_sweep(
                sweep, self._room, self._mount, self._config, papers=self._papers
            )
            warning = self._papers.faults().text
        except LandmarkNavError as error:
            self._health = Health(Level.LOST, str(error))
            self.get_logger().error(one_line(f'no panorama: {error}'))
            return
        except Exception:
            self._health = Health(Level.LOST, 'no panorama of the last sweep')
            raise
        parts = encode.panorama(ros_factory, view, self._room.frame_id)
        for output, part in zip(self._outputs, parts, strict=True):
            output.publish(part)
        x, y, heading = *view.center_map[:2], np.degrees(view.heading_rad)
        sigma = np.sqrt(np.diag(view.covariance)[[0, 1, 3]])
        lacks = describe_coverage(
            [frame.pan_rad for frame in sweep.frames], sweep.frames[0].camera.half_fov_rad
        )
        place = f'panorama at ({x:.3f}, {y:.3f}) m, {heading:.2f} deg'
        if warning:
            self.get_logger().warning(warning)
        self._health = Health(
            Level.DEGRADED if warning else Level.OK,
            '; '.join(filter(None, [place, lacks, warning])),
            {
                'sigma_m': np.hypot(*sigma[:2]),
                'sigma_deg': np.degrees(sigma[2]),
                **_quality(view.quality),
            },
        )
        took_s = time.monotonic() - start
        self.get_logger().info(f'{self._health.reason} in {took_s:.1f} s')

    def _sweep(self, message: Any) -> Sweep:
        """Wait for its frames, then join those that came with their angles."""
        trajectory = decode.sweep_trajectory(message, self._mount)
        deadline = time.monotonic() + self._config.late_frames_s
        while True:
            with self._lock:
                complete = not missing_frames(trajectory, self._views)
            if complete or time.monotonic() > deadline:
                break
            time.sleep(0.05)
        with self._lock:
            views = {
                stamp: (self._depth.lowered(pixels, bits), camera)
                for stamp, (pixels, camera, bits) in self._views.items()
            }
            # What is older belongs to this sweep or to one that was given up.
            end_ns = max((sample.stamp_ns for sample in trajectory), default=0)
            for items in (self._images, self._infos, self._views):
                for stamp in [stamp for stamp in items if stamp <= end_ns]:
                    del items[stamp]
        pose, self._pose = self._pose, None
        return assemble_sweep(trajectory, views, pose)


def _quality(quality: PanoramaQuality | None) -> dict[str, object]:
    """Figures of a panorama for diagnostics."""
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
        **{
            f'calibration/{term.name}': f'{term}, {"used" if term.used else "not used"}'
            for term in quality.calibration
        },
    }


def _remember(items: dict[int, Any], stamp_ns: int, item: Any) -> None:
    items[stamp_ns] = item
    while len(items) > _MAX_FRAMES:
        del items[min(items)]


def main() -> int:
    """Entry point of the executable."""
    return run_node(PanoramaSynthesizerNode, threads=2)


if __name__ == '__main__':
    raise SystemExit(main())
