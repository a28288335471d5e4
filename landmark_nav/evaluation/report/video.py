"""Video of a drive: plan, camera image and error, by the same data as the page."""

from __future__ import annotations

import base64
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.report.collect import Page
from landmark_nav.storage.atomic_io import write_atomically
from landmark_nav.types import ImageArray

_WIDTH, _HEIGHT, _PLAN, _MARGIN = 1280, 720, 800, 40
# Blue, green, red of the page's colours (Okabe and Ito).
_FUSED, _TRUTH, _ODOMETRY = (178, 114, 0), (34, 34, 34), (0, 94, 213)
_LANDMARK, _LEVEL, _QUIET = (115, 158, 0), (149, 81, 122), (150, 150, 150)
_MOST_FPS = 30.0
# A pause between two images is shown for this time at most.
_LONGEST_S = 5.0
# Fractional bits of pixel coordinates: 1/16 pixel.
_SHIFT = 4


def write_video(path: Path, page: Page) -> None:
    """
    Write a drive as MPEG-4, in real time but for pauses, which are shortened.

    Raises `LandmarkNavError`: the file cannot be written.
    """
    drive = page['data']['run']
    times_s = np.append(0.0, np.cumsum(np.clip(np.diff(drive['t']), 0.0, _LONGEST_S)))
    span_s = float(times_s[-1])
    fps = min((len(times_s) - 1) / span_s, _MOST_FPS) if span_s > 0.0 else 1.0
    shown = np.searchsorted(times_s, np.arange(1 + int(span_s * fps)) / fps)
    with TemporaryDirectory() as folder:
        raw = Path(folder) / 'drive.mp4'
        fourcc = cv2.VideoWriter.fourcc(*'mp4v')
        writer = cv2.VideoWriter(str(raw), fourcc, fps, (_WIDTH, _HEIGHT))
        if not writer.isOpened():
            raise LandmarkNavError(f'{path}: this OpenCV writes no MPEG-4: leave out --video')
        scene = _Scene(page['data'])
        for k in np.minimum(shown, len(drive['t']) - 1):
            writer.write(scene.at(int(k)))
        writer.release()
        write_atomically(path, raw.read_bytes())


class _Scene:
    """The static plan, and the moving parts drawn on it."""

    def __init__(self, data: dict[str, Any]) -> None:
        self._drive, self._images = data['run'], data['images']
        self._landmarks = {k['id']: k['at'][:2] for k in data['map']['landmarks']}
        walls = [wall['ends'] for wall in data['map']['walls']]
        poses = [pose[:2] for pose in self._drive['pose']]
        every = np.concatenate([*walls, [*self._landmarks.values()], poses])
        self._low, high = every.min(0), every.max(0)
        size = np.maximum(high - self._low, 1e-3)
        self._scale = min((_PLAN - 2 * _MARGIN) / size[0], (_HEIGHT - 2 * _MARGIN) / size[1])
        self._left, self._top = 0.5 * (np.array([_PLAN, _HEIGHT]) - self._scale * size)
        self._plan: ImageArray = np.full((_HEIGHT, _WIDTH, 3), 255, np.uint8)
        for ends in walls:
            self._line(self._plan, ends, (85, 85, 85), 3)
        for name, color in (('odometry', _ODOMETRY), ('truth', _TRUTH), ('fused', _FUSED)):
            self._line(self._plan, self._drive['lines'][name], color, 2)
        for place in self._landmarks.values():
            cv2.circle(self._plan, self._pixels([place])[0].tolist(), 4 << _SHIFT, _LANDMARK, -1,
                       cv2.LINE_AA, _SHIFT)  # fmt: skip

    def at(self, k: int) -> ImageArray:
        """Draw one frame (720, 1280, 3), BGR."""
        drive = self._drive
        frame: ImageArray = self._plan.copy()
        pose = np.array(drive['pose'][k])
        for one in drive['seen'][k]:
            if one['id'] in self._landmarks:
                color = _LANDMARK if one.get('used') else _QUIET
                self._line(frame, [pose[:2], self._landmarks[one['id']]], color, 1)
        if drive['camera'][k] is not None:
            sides = pose[2] + drive['camera'][k] + drive['half_view'] * np.array([-1.0, 1.0])
            ends = pose[:2] + np.column_stack([np.cos(sides), np.sin(sides)])
            self._line(frame, [ends[0], pose[:2], ends[1]], _FUSED, 2)
        if drive['level'][k][0] is not None:
            radius = round(max(10.0 * drive['level'][k][0] * self._scale, 1.0) * 2**_SHIFT)
            center = self._pixels([pose[:2]])[0].tolist()
            cv2.circle(frame, center, radius, _LEVEL, 1, cv2.LINE_AA, _SHIFT)
        arrow = np.array([[0.18, 0.0], [-0.12, 0.11], [-0.07, 0.0], [-0.12, -0.11]])
        turn = np.array([[np.cos(pose[2]), -np.sin(pose[2])], [np.sin(pose[2]), np.cos(pose[2])]])
        robot = self._pixels(pose[:2] + arrow @ turn.T)
        cv2.fillPoly(frame, [robot], _FUSED, cv2.LINE_AA, _SHIFT)
        top = self._camera(frame, drive['image'][k])
        for row, text in enumerate(self._texts(k)):
            cv2.putText(frame, text, (_PLAN, top + 30 + 26 * row), cv2.FONT_HERSHEY_SIMPLEX, 0.55,
                        _TRUTH, 1, cv2.LINE_AA)  # fmt: skip
        return frame

    def _camera(self, frame: ImageArray, number: int) -> int:
        """Draw a camera image with its detections; return the row below it."""
        if number < 0:
            return _MARGIN
        data = np.frombuffer(base64.b64decode(self._images[number]), np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_COLOR)
        assert image is not None, 'it was encoded here'
        width, height = self._drive['image_size']
        scale = min((_WIDTH - _PLAN - 10) / width, 0.6 * _HEIGHT / height)
        shown = cv2.resize(image, (round(scale * width), round(scale * height)))
        for one in self._drive['seen'][self._drive['image_moment'][number]]:
            color = (176, 230, 46) if one.get('used') else (0, 176, 255)
            if 'outline' in one:
                corners = np.round(scale * np.array(one['outline']) * 2**_SHIFT).astype(np.int32)
                cv2.polylines(shown, [corners], True, color, 1, cv2.LINE_AA, _SHIFT)
        frame[: shown.shape[0], _PLAN : _PLAN + shown.shape[1]] = shown
        return int(shown.shape[0])

    def _texts(self, k: int) -> list[str]:
        """Format time, state, error and level in ASCII."""
        drive = self._drive
        pose, truth, level = drive['pose'][k], drive['truth'][k], drive['level'][k]
        texts = [
            f'{drive["t"][k]:.2f} s   {drive["status"][k]}',
            drive['reasons'][drive['reason'][k]],
        ]
        if truth[0] is not None:
            off_m = np.hypot(pose[0] - truth[0], pose[1] - truth[1])
            texts.append(f'error {100.0 * off_m:.1f} cm')
        if level[0] is not None:
            texts.append(f'protection level {100.0 * level[0]:.1f} cm (drawn 10 x)')
        used = sum(bool(one.get('used')) for one in drive['seen'][k])
        texts.append(f'{used} of {len(drive["seen"][k])} landmarks used')
        return [text.encode('ascii', 'replace').decode()[:54] for text in texts]

    def _pixels(self, points: npt.ArrayLike) -> npt.NDArray[np.int32]:
        """Project points (n, 2) [m] to the plan, in units of 1/16 pixel."""
        x, y = (self._scale * (np.asarray(points, dtype=np.float64) - self._low)).T
        pixels = np.column_stack([self._left + x, _HEIGHT - self._top - y])
        return np.asarray(np.round(np.clip(pixels, -1e4, 1e4) * 2**_SHIFT), np.int32)

    def _line(
        self, frame: ImageArray, points: Any, color: tuple[int, int, int], width: int
    ) -> None:
        if len(points):
            pixels = [self._pixels(points)]
            cv2.polylines(frame, pixels, False, color, width, cv2.LINE_AA, _SHIFT)
