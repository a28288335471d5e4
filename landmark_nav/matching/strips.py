"""Turns of a camera by its images: strips of azimuth by slope, correlated along the azimuth."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt
from scipy import fft

from landmark_nav.arrays import FloatArray, ImageArray
from landmark_nav.geometry.camera import CameraModel, PanTiltMount

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
# Least number of images that show what stays in place.
_LEAST_SEQUENCE = 12
# Least peak of the correlation; lower ones are by chance.
_LEAST_SCORE = 0.4
# Least peak that a match of two images would have, so that a lower one means that they differ.
CLEAR_SCORE = 1.5 * _LEAST_SCORE

# Spectrum of each row, and cumulative energy of the columns.
Strip = tuple[npt.NDArray[np.complexfloating], FloatArray]


def _strip_of(seen: npt.NDArray[np.float32]) -> Strip:
    energy = np.concatenate([[0.0], np.cumsum((seen * seen).sum(0))])
    return fft.rfft(seen, 2 * _COLUMNS, axis=1), energy


def comparable(first: Strip, second: Strip) -> bool:
    """Whether two strips have so much texture that they would match if they showed the same."""
    energies = np.array([first[1][-1], second[1][-1]])
    share = energies / (energies + _BLANK * _ROWS * _COLUMNS)
    return bool(np.sqrt(share.prod()) >= CLEAR_SCORE)


def without_cover(strips: Sequence[Strip]) -> list[Strip]:
    """
    Return the strips of a sequence without what stays in place while the camera turns.

    Bars, text or a part of the robot in the image would correlate best without a turn. Where most
    of the image stays, the camera did not turn, and all is kept.
    """
    if len(strips) < _LEAST_SEQUENCE:
        return list(strips)
    seen = np.stack([fft.irfft(spectrum, 2 * _COLUMNS, axis=1) for spectrum, _ in strips])
    seen = seen[..., :_COLUMNS].astype(np.float32)
    stays = np.abs(seen.mean(0)) > seen.std(0)
    if not stays.any() or stays.mean() > 0.5:
        return list(strips)
    seen[:, stays] = 0.0
    return [_strip_of(each) for each in seen]


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
        return _strip_of(seen)

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
