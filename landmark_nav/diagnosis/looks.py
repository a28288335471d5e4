"""The images of a bag: stamps, encodings and lens, and turns of the camera."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from landmark_nav.arrays import FloatArray, ImageArray, IndexArray
from landmark_nav.calibration import Calibration
from landmark_nav.diagnosis.camera_errors import (
    camera_error,
    CameraError,
    CameraSetup,
    Corners,
    corners,
    matched,
    Matches,
)
from landmark_nav.diagnosis.findings import Finding, Level
from landmark_nav.diagnosis.streams import Row, row_of, Stream, stream_of
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.matching.strips import Strip, StripView, without_cover
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.bags.reader import MessageFilter
from landmark_nav.storage.bags.timelines import CameraInfos, JointHistory
from landmark_nav.types import JointSample

# Length of the runs of images that are decoded; the runs are spread over the recording.
_RUN = 12
# Size of images for cover and exposure, and their width for sharpness, pixels.
_SMALL, _WIDTH = (16, 12), 256
# Number of pairs of images in which points are tracked.
_TRACKED = 30
# Bounds of the horizontal field of view; outside them the lens is wrong or not supported.
_LEAST_FOV_DEG, _MOST_FOV_DEG = 8.0, 200.0
# Greatest relative difference of fx and fy, and of focal lengths in one recording.
_SQUARE = 0.05
ZOOM = 'camera zoom'


@dataclass(frozen=True, eq=False)
class Looks:
    """
    Images of a bag: their stamps, and by index of the image what was measured in decoded ones.

    `small` are images in grey, 12 x 16 pixels; `sharpness` is the contrast of fine details over
    that of coarse ones, about 0.5 in focus; `points` are pixels (m, 2) in an image and in the next
    one. `findings` are those of encoding, size and lens; `view` is None if no image could be used.
    Images of other intrinsics than those of the first, `camera`, are resampled to these.
    """

    stream: Stream
    findings: tuple[Finding, ...]
    strips: dict[int, Strip]
    small: dict[int, ImageArray]
    sharpness: dict[int, float]
    view: StripView | None
    camera: CameraModel | None
    points: dict[int, tuple[FloatArray, FloatArray]]

    def pairs(self, apart: int = 1) -> IndexArray:
        """Indices (n, 2) of images that are `apart` apart and were both decoded."""
        found = [(k, k + apart) for k in self.strips if k + apart in self.strips]
        return np.array(found, np.intp).reshape(-1, 2)

    def turns(self, pairs: IndexArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Times (n,) of both images of pairs (n, 2), s, and the turns between them, rad."""
        before, after = self.stream.seconds[pairs.T]
        return before, after, np.array([self.compared(*pair)[0] for pair in pairs.tolist()])

    def compared(self, first: int, second: int) -> tuple[float, float]:
        """Turn between two images, rad, and their correlation; NaN if unknown."""
        if self.view is None or first not in self.strips or second not in self.strips:
            return float('nan'), float('nan')
        return self.view.turn(self.strips[first], self.strips[second])


def look(
    bag: Bag,
    topic: str,
    infos: tuple[str, ...],
    known: Calibration,
    most_images: int,
    setup: CameraSetup | None = None,
) -> Looks:
    """
    Decode and examine at most `most_images` images.

    `infos` are names in the contract of the topics that may hold the intrinsics. A `setup`
    replaces these and what is known of the robot, and then no points are tracked.
    """
    chosen = _chosen(bag.counts[topic], most_images)
    stamped = MessageFilter(bag, topic)
    rows: list[Row] = []
    failed: list[str] = []
    kinds: dict[str, None] = {}
    strips: dict[int, Strip] = {}
    small: dict[int, ImageArray] = {}
    sharpness: dict[int, float] = {}
    view: StripView | None = None
    camera: CameraModel | None = None
    lenses: list[CameraModel] = []
    cameras, refused = None, []
    try:
        cameras = CameraInfos.read(bag, *infos)
    except LandmarkNavError as error:
        text = str(error).removeprefix(f'{bag.path}: ')
        refused.append(Finding('camera lens', 'error', text, when_read=True))
    # First images of pairs, spread over the recording.
    firsts = [] if setup else [k for k in sorted(chosen) if k + 1 in chosen]
    tracked = set(firsts[:: max(1, -(-len(firsts) // _TRACKED))])
    points: dict[int, tuple[FloatArray, FloatArray]] = {}
    before: Corners | None = None
    for entry in bag.messages([topic]):
        index, row = len(rows), stamped.take(row_of, entry)
        if row is None:
            continue
        rows.append(row)
        if index not in chosen or cameras is None:
            continue
        try:
            image, seen_by = decode.camera_image(entry.message, cameras.at(row.stamp_ns), True)
            lenses.append(seen_by)
            image = _resampled(image, seen_by, lenses[0])
            if view is None:
                of_robot = known.camera(seen_by), known.mount, known['camera_tilt'][0]
                used = setup or CameraSetup(*of_robot)
                camera = used.camera
                view = StripView(camera, used.mount, used.tilt_rad)
            width, height = decode.published_size(entry.message)
            form = getattr(entry.message, 'encoding', None) or getattr(entry.message, 'format', '')
            kinds[f'{str(form)[:40] or "unnamed"} {width} x {height}'] = None
            strips[index] = view.strip(image)
            small[index] = _reduced(image, _SMALL)
            sharpness[index] = _sharpness(image)
            if index in tracked or index - 1 in tracked:
                now = corners(image)
                second = before is not None and index - 1 in tracked and index - 1 in strips
                found = matched(before, now) if before is not None and second else None
                if found is not None:
                    points[index - 1] = found
                before = now
        except LandmarkNavError as error:
            failed.append(str(error).removeprefix(f'{bag.path}: '))
    strips = dict(zip(strips, without_cover(list(strips.values())), strict=True))
    # In image widths: a driver may change the size.
    focal = [lens.fx / lens.width for lens in lenses] or [1.0]
    of_lens = *_lens(camera), *_zoom(max(focal) / min(focal))
    findings = (*refused, *_encoding(failed, kinds, len(chosen)), *of_lens)
    stream = stream_of(bag, 'images', topic, rows, stamped.complaints)
    return Looks(stream, findings, strips, small, sharpness, view, camera, points)


def _resampled(image: ImageArray, seen_by: CameraModel, camera: CameraModel) -> ImageArray:
    """Image of one camera in the pixels of another; its border is continued."""
    if seen_by == camera:
        return image
    along, down = _pixel_maps(seen_by, camera)
    border = cv2.BORDER_REPLICATE
    return np.asarray(cv2.remap(image, along, down, cv2.INTER_LINEAR, borderMode=border), np.uint8)


@lru_cache(maxsize=4)
def _pixel_maps(seen_by: CameraModel, camera: CameraModel) -> tuple[Any, Any]:
    """Pixels of `seen_by`, columns and rows, that see what each pixel of `camera` does."""
    grid = np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height)))
    pixels = seen_by.project(camera.unproject(np.stack(grid, -1)))
    along, down = np.nan_to_num(pixels, nan=-1.0).astype(np.float32).transpose(2, 0, 1)
    return np.ascontiguousarray(along), np.ascontiguousarray(down)


def _reduced(image: ImageArray, size: tuple[int, int]) -> ImageArray:
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _sharpness(image: ImageArray) -> float:
    """Contrast of fine details of a grey image over that of coarse ones."""
    # Natural scenes have equal contrast at each scale (Field, J. Opt. Soc. Am. A 4(12), 1987).
    # Images of any size are compared at the same width.
    height, width = image.shape
    sizes = ((columns, max(columns * height // width, 3)) for columns in (_WIDTH, _WIDTH // 4))
    fine, coarse = (cv2.Laplacian(_reduced(image, size), cv2.CV_32F).var() for size in sizes)
    return float(fine / max(coarse, 1.0))


def look_corrected(
    bag: Bag, topic: str, infos: tuple[str, ...], known: Calibration, most_images: int
) -> tuple[Looks, CameraError | None]:
    """Examine images as `look` does; if lens or mount have an error, with the corrected setup."""
    looks = look(bag, topic, infos, known, most_images)
    error = camera_error_of(bag, looks, known)
    return (look(bag, topic, infos, known, most_images, error.setup) if error else looks), error


def camera_error_of(bag: Bag, looks: Looks, known: Calibration) -> CameraError | None:
    """Find a relevant error of lens or mount by the tracked points; None if there is none."""
    if looks.camera is None or not looks.points:
        return None
    try:
        joints = JointHistory.read(bag, known.mount)
    except LandmarkNavError:
        joints = JointHistory(())  # reported elsewhere
    first = np.array(list(looks.points))
    stamps = looks.stream.stamps_ns[np.stack([first, first + 1], -1)]
    angles = [
        (sample.pan_rad, sample.tilt_rad) if isinstance(sample, JointSample) else (0.0, np.nan)
        for sample in map(joints.at, stamps.ravel().tolist())
    ]
    pans, tilts = np.array(angles).T.reshape(2, -1, 2)
    seen = np.isfinite(tilts)
    tilts[~seen] = np.median(tilts[seen]) if seen.any() else 0.0
    before, after = zip(*looks.points.values(), strict=True)
    pairs = np.repeat(np.arange(len(before)), [len(points) for points in before])
    matches = Matches(np.concatenate(before), np.concatenate(after), pairs, pans, tilts)
    return camera_error(matches, CameraSetup(looks.camera, known.mount, known['camera_tilt'][0]))


def _chosen(count: int, most: int) -> set[int]:
    """Indices of the images to decode out of `count`: all, or runs of them."""
    if count <= most:
        return set(range(count))
    runs = max(most // _RUN, 1)
    begins = np.linspace(0, count - _RUN, runs).astype(np.intp)
    return {int(begin) + k for begin in begins for k in range(_RUN)}


def _encoding(failed: list[str], kinds: Collection[str], tried: int) -> Iterable[Finding]:
    named = ', '.join(list(kinds)[:3])
    if failed:
        level: Level = 'error' if len(failed) == tried else 'warning'
        text = f'{len(failed)} of {tried} cannot be used'
        values = {'failed': len(failed), 'tried': tried}
        yield Finding('images encoding', level, text, failed[0], values, when_read=True)
    elif named:
        several = len(kinds) > 1
        advice = 'one camera must publish images of one size and encoding' if several else ''
        yield Finding('images encoding', 'warning' if several else 'ok', named, advice)


def _zoom(zoom: float) -> Iterable[Finding]:
    if zoom > 1.0 + _SQUARE:
        text = f'the focal length in camera_info changes by {100.0 * (zoom - 1.0):.0f} %'
        advice = 'publish one calibration if the lens neither zooms nor focuses'
        yield Finding(ZOOM, 'warning', text, advice, {'zoom': zoom})


def _lens(camera: CameraModel | None) -> Iterable[Finding]:
    if camera is None:
        return
    u = np.linspace(0.0, camera.width - 1.0, 21)
    rays = camera.unproject(np.stack([u, np.full_like(u, camera.cy)], -1))
    inside = np.flatnonzero(np.isfinite(rays[:, 0]))
    field = float(np.degrees(np.ptp(np.arctan(rays[inside[[0, -1]], 0]))))
    text = f'{field:.0f} deg wide, f {camera.fx:.0f} px, {camera.model}'
    level: Level = 'error'
    if not _LEAST_FOV_DEG < field < _MOST_FOV_DEG:
        advice = 'calibrate the camera: no lens that localization takes sees so much'
    elif abs(camera.fy / camera.fx - 1.0) > _SQUARE:
        level, text = 'warning', f'fy is {camera.fy:.0f} px beside an fx of {camera.fx:.0f} px'
        advice = 'calibrate again: pixels are square, if the driver does not stretch images'
    else:
        level, advice = 'ok', ''
    values = {'field_of_view_deg': field, 'fx_px': camera.fx}
    yield Finding('camera lens', level, text, advice, values)
