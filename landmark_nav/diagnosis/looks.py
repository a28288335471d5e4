"""The images of a bag: stamps, encodings and lens, and turns of the camera."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy import fft

from landmark_nav.arrays import FloatArray, ImageArray, IndexArray
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
from landmark_nav.diagnosis.streams import Row, Stream, stream_of
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag, BagMessage
from landmark_nav.storage.bags.timelines import CameraInfos, JointHistory
from landmark_nav.types import JointSample

# Size of a strip, pixels.
_COLUMNS, _ROWS = 128, 48
# Shifts tried per column: between columns, the correlation is interpolated by its spectrum.
_FINER = 4
# Window in which the contrast is normalised, pixels; least contrast, grey levels per column.
_CONTRAST, _LEAST_CONTRAST = (41, 41), 6.0
# Least overlap of two images that are compared, as a share of their width.
_LEAST_OVERLAP = 0.25
# Energy per pixel of the fixed pattern of a camera; that of texture is 1.
_BLANK = 0.1
# Least peak of the correlation; lower ones are by chance.
_LEAST_SCORE = 0.4

# Spectrum of each row, and cumulative energy of the columns.
Strip = tuple[npt.NDArray[np.complexfloating], FloatArray]


class StripView:
    """
    Map from the images of a camera to strips of azimuth by slope, at pan 0.

    Of the mount, tilt and roll are used; `tilt_rad` is the usual tilt of the joints.
    """

    def __init__(self, camera: CameraModel, mount: PanTiltMount, tilt_rad: float = 0.0) -> None:
        upright = PanTiltMount(
            axis_rpy=mount.axis_rpy, camera_roll_rad=mount.camera_roll_rad
        ).camera_pose_base(0.0, tilt_rad)[0]
        ahead = upright[:, 2]
        turn = np.arctan2(ahead[1], ahead[0])
        c, s = np.cos(turn), np.sin(turn)
        upright = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ upright
        u = np.linspace(0.0, camera.width - 1.0, 33)
        v = np.linspace(0.0, camera.height - 1.0, 33)
        inside = camera.unproject(np.stack(np.meshgrid(u, v), -1)) @ upright.T
        azimuth = np.arctan2(inside[..., 1], inside[..., 0])
        slope = inside[..., 2] / np.hypot(inside[..., 0], inside[..., 1])
        # The largest rectangle around the middle that is inside the border of the image.
        middle = (float(azimuth[16, 16]), float(slope[16, 16]))
        sides, rims = azimuth[:, [0, -1]] - middle[0], slope[[0, -1]] - middle[1]
        least, most = (
            sides[:, sides.mean(0).argmin()].max(),
            sides[:, sides.mean(0).argmax()].min(),
        )
        low, high = rims[rims.mean(1).argmin()].max(), rims[rims.mean(1).argmax()].min()
        azimuths = np.linspace(least, most, _COLUMNS) + middle[0]
        slopes = np.linspace(high, low, _ROWS) + middle[1]
        self.step_rad = float(azimuths[1] - azimuths[0])
        self.width_rad = float(most - least)
        grid, rise = np.meshgrid(azimuths, slopes)
        rays = np.stack([np.cos(grid), np.sin(grid), rise], -1) @ upright
        self._reduction = max(1, camera.width // _COLUMNS)
        pixels = (camera.project(rays) + 0.5) / self._reduction - 0.5
        self._pixels = pixels.astype(np.float32)

    def strip(self, image: ImageArray) -> Strip:
        """Return the strip of a grey image (height, width)."""
        if self._reduction > 1:
            size = (image.shape[1] // self._reduction, image.shape[0] // self._reduction)
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
        along, down = self._pixels[..., 0], self._pixels[..., 1]
        strip = cv2.remap(image, along, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        seen = np.asarray(strip, dtype=np.float32)
        # Structures along the azimuth carry no information about turns.
        seen = np.asarray(cv2.Sobel(seen, cv2.CV_32F, 1, 0, ksize=3, scale=0.125))
        seen /= np.maximum(np.sqrt(cv2.blur(seen * seen, _CONTRAST)), _LEAST_CONTRAST)
        energy = np.concatenate([[0.0], np.cumsum((seen * seen).sum(0))])
        return fft.rfft(seen, 2 * _COLUMNS, axis=1), energy

    def turn(self, first: Strip, second: Strip) -> tuple[float, float]:
        """
        Turn of the camera from one strip to another, rad, counter-clockwise, and its score.

        The turn has the largest likelihood ratio. The score is the normalised cross-correlation of
        the overlap. The turn is NaN if the overlap or the score is too small.
        """
        count = 2 * _COLUMNS * _FINER
        shifts = np.arange(-_COLUMNS, _COLUMNS, 1.0 / _FINER)
        product = _FINER * fft.irfft((first[0] * np.conj(second[0])).sum(0), count)
        product = np.roll(product, count // 2)
        low, high = np.maximum(shifts, 0.0), np.minimum(_COLUMNS + shifts, _COLUMNS)
        width = high - low
        shared = width >= _LEAST_OVERLAP * _COLUMNS
        columns = np.arange(_COLUMNS + 1)
        energies = [
            np.interp(high - off, columns, strip[1]) - np.interp(low - off, columns, strip[1])
            for strip, off in ((first, 0.0), (second, shifts))
        ]
        # The JPEG grid and dirt on the lens, which do not turn, dominate on a bare wall.
        blank = _BLANK * _ROWS * width
        energy = (energies[0] + blank) * (energies[1] + blank)
        score = np.where(shared, product / np.sqrt(np.maximum(energy, 1e-9)), -1.0)
        # The likelihood ratio of a match: jambs of a window are alike in a small overlap.
        evidence = -width * np.log1p(-np.square(np.clip(score, 0.0, 1.0 - 1e-9)))
        best = int(np.argmax(evidence))
        peak = float(score[best])
        if peak < _LEAST_SCORE or not (shared[best - 1] and shared[(best + 1) % len(shared)]):
            return float('nan'), peak
        before, after = score[best - 1], score[best + 1]
        bend = before - 2.0 * peak + after
        part = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
        return float((shifts[best] + part / _FINER) * self.step_rad), peak


# Length of the runs of images that are decoded; the runs are spread over the recording.
_RUN = 12
# Size of images for cover and exposure, and their width for sharpness, pixels.
_SMALL, _WIDTH = (16, 12), 256
# Number of pairs of images in which points are tracked.
_TRACKED = 30
# Bounds of the horizontal field of view; outside them the lens is wrong or not supported.
_LEAST_FOV_DEG, _MOST_FOV_DEG = 8.0, 200.0
# Greatest relative difference of fx and fy.
_SQUARE = 0.05


@dataclass(frozen=True, eq=False)
class Looks:
    """
    Images of a bag: their stamps, and by index of the image what was measured in decoded ones.

    `pairs` (n, 2) are consecutive images that were both decoded. `small` are images in grey, 12 x
    16 pixels; `sharpness` is the contrast of fine details over that of coarse ones, about 0.5 in
    focus; `points` are pixels (m, 2) in an image and in the next one. `findings` are those of
    encoding, size and lens; `view` is None if no image could be used.
    """

    stream: Stream
    pairs: IndexArray
    findings: tuple[Finding, ...]
    strips: dict[int, Strip]
    small: dict[int, ImageArray]
    sharpness: dict[int, float]
    view: StripView | None
    camera: CameraModel | None
    points: dict[int, tuple[FloatArray, FloatArray]]

    def compared(self, first: int, second: int) -> tuple[float, float]:
        """Turn between two images, rad, and their correlation; NaN if unknown."""
        if self.view is None or first not in self.strips or second not in self.strips:
            return float('nan'), float('nan')
        return self.view.turn(self.strips[first], self.strips[second])


def look(
    bag: Bag,
    topic: str,
    infos: tuple[str, ...],
    mounted: PanTiltMount | CameraSetup,
    most_images: int,
) -> Looks:
    """
    Decode and examine at most `most_images` images.

    `infos` are names in the contract of the topics that may hold the intrinsics; a `CameraSetup`
    replaces the recorded ones, and then no points are tracked.
    """
    chosen = _chosen(bag.counts[topic], most_images)
    rows: list[Row] = []
    failed: list[str] = []
    kinds: dict[str, None] = {}
    strips: dict[int, Strip] = {}
    small: dict[int, ImageArray] = {}
    sharpness: dict[int, float] = {}
    view: StripView | None = None
    camera: CameraModel | None = None
    cameras, refused = None, []
    try:
        cameras = CameraInfos.read(bag, *infos)
    except LandmarkNavError as error:
        text = str(error).removeprefix(f'{bag.path}: ')
        refused.append(Finding('camera lens', 'error', text, when_read=True))
    setup = mounted if isinstance(mounted, CameraSetup) else None
    # First images of pairs, spread over the recording.
    firsts = [] if setup else [k for k in sorted(chosen) if k + 1 in chosen]
    tracked = set(firsts[:: max(1, -(-len(firsts) // _TRACKED))])
    points: dict[int, tuple[FloatArray, FloatArray]] = {}
    before: Corners | None = None
    for index, entry in enumerate(bag.messages([topic])):
        stamp, frame = decode.stamp_ns(entry.message.header), str(entry.message.header.frame_id)
        rows.append(Row(stamp, entry.stamp_ns, frame, np.empty(0), entry.header_ns == 0))
        if index not in chosen or cameras is None:
            continue
        try:
            image, seen_by = decode.camera_image(entry.message, cameras.at(stamp), True)
            if view is None:
                camera = setup.camera if setup else seen_by
                view = StripView(camera, *((setup.mount, setup.tilt_rad) if setup else (mounted,)))
            width, height = decode.published_size(entry.message)
            kinds[f'{_kind(entry)} {width} x {height}'] = None
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
    pairs = np.array([(k, k + 1) for k in strips if k + 1 in strips], np.intp).reshape(-1, 2)
    findings = (*refused, *_encoding(failed, kinds, len(chosen)), *_lens(camera))
    stream = stream_of(bag, 'images', topic, rows)
    return Looks(stream, pairs, findings, strips, small, sharpness, view, camera, points)


def _reduced(image: ImageArray, size: tuple[int, int]) -> ImageArray:
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _sharpness(image: ImageArray) -> float:
    """
    Contrast of fine details of a grey image over that of coarse ones.

    Natural scenes have equal contrast at each scale (Field, J. Opt. Soc. Am. A 4(12), 1987).
    Images of any size are compared at the same width.
    """
    height, width = image.shape
    fine, coarse = (
        cv2.Laplacian(
            _reduced(image, (columns, max(columns * height // width, 3))), cv2.CV_32F
        ).var()
        for columns in (_WIDTH, _WIDTH // 4)
    )
    return float(fine / max(coarse, 1.0))


def look_corrected(
    bag: Bag, topic: str, infos: tuple[str, ...], mount: PanTiltMount, most_images: int
) -> tuple[Looks, CameraError | None]:
    """Examine images as `look` does; if lens or mount have an error, with the corrected setup."""
    looks = look(bag, topic, infos, mount, most_images)
    error = camera_error_of(bag, looks, mount)
    return (look(bag, topic, infos, error.setup, most_images) if error else looks), error


def camera_error_of(bag: Bag, looks: Looks, mount: PanTiltMount) -> CameraError | None:
    """Find a relevant error of lens or mount by the tracked points; None if there is none."""
    if looks.camera is None or not looks.points:
        return None
    try:
        joints = JointHistory.read(bag, mount)
    except LandmarkNavError:
        joints = JointHistory(())  # reported elsewhere
    first = np.array(list(looks.points))
    stamps = looks.stream.stamps_ns[np.stack([first, first + 1], -1)]
    angles = [
        (sample.pan_rad, sample.tilt_rad) if isinstance(sample, JointSample) else (0.0, np.nan)
        for sample in map(joints.at, stamps.ravel().tolist())
    ]
    pans, tilts = np.array(angles).T.reshape(2, -1, 2)
    known = tilts[np.isfinite(tilts)]
    tilts[~np.isfinite(tilts)] = np.median(known) if len(known) else 0.0
    before, after = zip(*looks.points.values(), strict=True)
    pairs = np.repeat(np.arange(len(before)), [len(points) for points in before])
    matches = Matches(np.concatenate(before), np.concatenate(after), pairs, pans, tilts)
    return camera_error(matches, CameraSetup(looks.camera, mount))


def _chosen(count: int, most: int) -> set[int]:
    """Indices of the images to decode out of `count`: all, or runs of them."""
    if count <= most:
        return set(range(count))
    runs = max(most // _RUN, 1)
    begins = np.linspace(0, count - _RUN, runs).astype(np.intp)
    return {int(begin) + k for begin in begins for k in range(_RUN)}


def _kind(entry: BagMessage) -> str:
    """Return the encoding of an image as stated in its message."""
    name = getattr(entry.message, 'encoding', None) or getattr(entry.message, 'format', '')
    return str(name)[:40] or 'unnamed'


def _encoding(failed: list[str], kinds: Collection[str], tried: int) -> Iterable[Finding]:
    named = ', '.join(list(kinds)[:3])
    if failed:
        level: Level = 'error' if len(failed) == tried else 'warning'
        text = f'{len(failed)} of {tried} cannot be used'
        values = {'failed': len(failed), 'tried': tried}
        yield Finding('images encoding', level, text, failed[0][:110], values, when_read=True)
    elif named:
        several = len(kinds) > 1
        advice = 'one camera must publish images of one size and encoding' if several else ''
        yield Finding('images encoding', 'warning' if several else 'ok', named, advice)


def _lens(camera: CameraModel | None) -> Iterable[Finding]:
    if camera is None:
        return
    u = np.linspace(0.0, camera.width - 1.0, 21)
    rays = camera.unproject(np.stack(np.meshgrid(u, [0.0, camera.cy]), -1))
    field = float(np.degrees(np.ptp(np.arctan(rays[1, [0, -1], 0]))))
    text = f'{field:.0f} deg wide, f {camera.fx:.0f} px, {camera.model}'
    level: Level = 'error'
    if not np.isfinite(field) or not _LEAST_FOV_DEG < field < _MOST_FOV_DEG:
        advice = 'calibrate the camera: no lens that localization takes sees so much'
    elif (
        not np.isfinite(rays).all()
        or (np.diff(rays[..., 0], axis=1) <= 0.0).any()
        or np.nanmax(np.abs(camera.project(rays)[..., 0] - u)) > 1.0
    ):
        text = f'{text}: its distortion folds back inside the image'
        advice = 'calibrate it again with points up to the corners of the image'
    elif abs(camera.fy / camera.fx - 1.0) > _SQUARE:
        level, text = 'warning', f'fy is {camera.fy:.0f} px beside an fx of {camera.fx:.0f} px'
        advice = 'calibrate again: pixels are square, if the driver does not stretch images'
    else:
        level, advice = 'ok', ''
    values = {'field_of_view_deg': field, 'fx_px': camera.fx}
    yield Finding('camera lens', level, text, advice, values)
