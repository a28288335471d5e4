"""Pictures with the calibration and the angles they were taken at."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
import time
from typing import Any

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.messages import decode
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.storage.bags.timelines import CameraInfos, JointHistory
from landmark_nav.types import CameraFrame, JointSample

__all__ = ['CameraFrames']

# Two seconds at 100 Hz.
_HISTORY = 200
_POLL_S = 0.005


class CameraFrames:
    """
    Listens to ``joint_states`` and ``camera/camera_info`` and completes pictures by them.

    Parameters
    ----------
    node : LandmarkNode
        Whose subscriptions they are.
    mount : PanTiltMount
        Names of the joints.

    """

    def __init__(self, node: LandmarkNode, mount: PanTiltMount) -> None:
        self._mount = mount
        self._joints: deque[JointSample] = deque(maxlen=_HISTORY)
        self._camera: CameraModel | None = None
        node.listen('joint_states', self._on_joints, depth=50)
        node.listen('camera/camera_info', self._on_camera_info)

    @property
    def camera(self) -> CameraModel | None:
        """The last calibration, if any came."""
        return self._camera

    @property
    def pan_rad(self) -> float | None:
        """The last measured pan, if any came."""
        return self._joints[-1].pan_rad if self._joints else None

    @property
    def tilt_rad(self) -> float:
        """The last measured tilt, level before any came."""
        return self._joints[-1].tilt_rad if self._joints else 0.0

    def joints_at(self, stamp_ns: int) -> JointSample | None:
        """Angles at a time, interpolated; None if no joint state is near enough to tell."""
        return JointHistory(tuple(self._joints)).at(stamp_ns)

    def complete(self, message: Any, seconds: float, also: Callable[[int], bool]) -> CameraFrame:
        """
        Frame of an image message.

        Waits, up to `seconds`, for joint states of its stamp and until `also` holds for it.

        Raises
        ------
        LandmarkNavError
            No calibration of its size, or no joint states near its stamp.

        """
        stamp = decode.stamp_ns(message.header)
        # Meanwhile what belongs to it arrives.
        picture = decode.image(message, grey=True)
        self._wait(stamp, seconds, also)
        joints = self.joints_at(stamp)
        if joints is None or self._camera is None:
            missing = 'joint_states' if joints is None else 'camera/camera_info'
            raise LandmarkNavError(f'nothing on {missing} near its stamp')
        camera = CameraInfos([(stamp, self._camera)]).for_picture(stamp, picture.shape)
        return CameraFrame(
            stamp,
            picture,
            camera,
            joints.pan_rad,
            joints.tilt_rad,
            pan_rate_rad_s=joints.pan_rate_rad_s,
        )

    def _on_joints(self, message: Any) -> None:
        sample = decode.joint_sample(message, self._mount)
        if sample is not None:
            self._joints.append(sample)

    def _on_camera_info(self, message: Any) -> None:
        self._camera = decode.camera_model(message)

    def _wait(self, stamp_ns: int, seconds: float, also: Callable[[int], bool]) -> None:
        """Block until there are joint states of `stamp_ns`, and `also` holds, or time is up."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if self._joints and self._joints[-1].stamp_ns >= stamp_ns and also(stamp_ns):
                return
            time.sleep(_POLL_S)
