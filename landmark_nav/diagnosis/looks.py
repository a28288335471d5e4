"""The images of a bag: stamps, encodings and lens, and turns of the camera."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
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
from landmark_nav.diagnosis.findings import Code, Finding, Level
from landmark_nav.diagnosis.streams import IMAGES, read_stream, Stream
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.matching.strips import Strip, StripView, without_cover
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag
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
    findings: tuple[Finding, ...] = ()
    strips: dict[int, Strip] = field(default_factory=dict)
    small: dict[int, ImageArray] = field(default_factory=dict)
    sharpness: dict[int, float] = field(default_factory=dict)
    view: StripView | None = None
    camera: CameraModel | None = None
    points: dict[int, tuple[FloatArray, FloatArray]] = field(default_factory=dict)

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
    # First images of pairs, spread over the recording.
    firsts = [] if setup else [k for k in sorted(chosen) if k + 1 in chosen]
    tracked = set(firsts[:: max(1, -(-len(firsts) // _TRACKED))])
    strips, small = dict[int, Strip](), dict[int, ImageArray]()
    sharpness, points = dict[int, float](), dict[int, tuple[FloatArray, FloatArray]]()
    failed, kinds, lenses = list[str](), dict[str, None](), list[CameraModel]()
    cameras, findings = None, list[Finding]()
    view: StripView | None = None
    before: Corners | None = None
    count = 0
    try:
        cameras = CameraInfos.read(bag, *infos)
    except LandmarkNavError as error:
        text = str(error).removeprefix(f'{bag.path}: ')
        findings.append(Code.NO_LENS.found(text))

    def examine(message: Any, index: int) -> None:
        nonlocal setup, view, before
        assert cameras is not None
        given = cameras.at(decode.stamp_ns(message.header))
        image, seen_by = decode.camera_image(message, given, True)
        lenses.append(seen_by)
        image = _resampled(image, seen_by, lenses[0])
        if view is None:
            of_robot = known.camera(seen_by), known.mount, known['camera_tilt'][0]
            setup = setup or CameraSetup(*of_robot)
            view = StripView(setup.camera, setup.mount, setup.tilt_rad)
        width, height = decode.published_size(message)
        form = getattr(message, 'encoding', None) or getattr(message, 'format', '')
        kinds[f'{str(form)[:40] or "unnamed"} {width} x {height}'] = None
        strips[index] = view.strip(image)
        small[index] = _reduced(image, _SMALL)
        sharpness[index] = _sharpness(image)
        if index in tracked or index - 1 in tracked:
            now = corners(image)
            second = index - 1 in tracked and index - 1 in strips
            found = matched(before, now) if before is not None and second else None
            if found is not None:
                points[index - 1] = found
            before = now

    def take(message: Any) -> tuple[()]:
        nonlocal count
        try:
            if count in chosen and cameras is not None:
                examine(message, count)
        except LandmarkNavError as error:
            failed.append(str(error).removeprefix(f'{bag.path}: '))
        count += 1
        return ()

    stream = read_stream(bag, IMAGES, topic, take)
    strips = dict(zip(strips, without_cover(list(strips.values())), strict=True))
    findings += _encoding(failed, kinds, len(chosen))
    camera = setup.camera if setup is not None and view is not None else None
    findings += _lens(camera, lenses) if camera is not None else []
    return Looks(stream, tuple(findings), strips, small, sharpness, view, camera, points)


def _chosen(count: int, most: int) -> set[int]:
    """Indices of the images to decode out of `count`: all, or runs of them."""
    if count <= most:
        return set(range(count))
    begins = np.linspace(0, count - _RUN, max(most // _RUN, 1)).astype(np.intp)
    return {int(begin) + k for begin in begins for k in range(_RUN)}


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
    error = _camera_error(bag, looks, known)
    return (look(bag, topic, infos, known, most_images, error.setup) if error else looks), error


def _camera_error(bag: Bag, looks: Looks, known: Calibration) -> CameraError | None:
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


def _encoding(failed: list[str], kinds: Collection[str], tried: int) -> Iterator[Finding]:
    if failed:
        level: Level = 'error' if len(failed) == tried else 'warning'
        counts = {'failed': len(failed), 'tried': tried}
        yield Code.UNDECODED.at(level, failed[0], **counts)
    elif kinds:
        level = 'warning' if len(kinds) > 1 else 'ok'
        yield Code.ENCODING.at(level, ', '.join(list(kinds)[:3]))


def _lens(camera: CameraModel, lenses: list[CameraModel]) -> Iterator[Finding]:
    """Check the field of view of the camera, and whether it zooms."""
    u = np.linspace(0.0, camera.width - 1.0, 21)
    rays = camera.unproject(np.stack([u, np.full_like(u, camera.cy)], -1))
    inside = np.flatnonzero(np.isfinite(rays[:, 0]))
    field_deg = float(np.degrees(np.ptp(np.arctan(rays[inside[[0, -1]], 0]))))
    values = {'field_of_view_deg': field_deg, 'fx_px': camera.fx}
    possible = _LEAST_FOV_DEG < field_deg < _MOST_FOV_DEG
    if possible and abs(camera.fy / camera.fx - 1.0) > _SQUARE:
        yield Code.NOT_SQUARE.found(camera.fy, **values)
    else:
        yield Code.LENS.at('ok' if possible else 'error', camera.model, **values)
    # In image widths: a driver may change the size.
    focal = [lens.fx / lens.width for lens in lenses]
    if (zoom := max(focal) / min(focal)) > 1.0 + _SQUARE:
        yield Code.ZOOM.found(100.0 * (zoom - 1.0), zoom=zoom)
