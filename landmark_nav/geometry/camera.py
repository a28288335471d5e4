"""
Camera model (pixel <-> ray) and pan-tilt mount (joint angles -> pose of the camera).

Pixel centres lie at integer coordinates, as in OpenCV and ROS `CameraInfo`. Optical frames are
x right, y down, z forward (REP-103).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
import math

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import FloatArray
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import compose, rot_y, rot_z, rotation_rpy

# Largest number of distortion coefficients of each ROS distortion model. OpenCV distinguishes its
# polynomial models by the number of coefficients only, and drivers use the first two names for all
# of them.
_COEFFICIENTS = {'plumb_bob': 12, 'rational_polynomial': 12, 'equidistant': 4}
# Resolution to which images are reduced on arrival. It bounds time and memory for any camera;
# bearings are more accurate than a pixel anyway.
MAX_PX_PER_RAD = 600.0
# Length of `CameraModel.intrinsics`.
INTRINSICS = 5
# A lens is used up to the angle where its distorted radius grows more slowly than this, relative
# to the undistorted one, and up to this angle at most.
_MIN_SLOPE, _MAX_ANGLE_RAD = 0.2, float(np.radians(85.0))
# Smallest usable share of the image, and smallest view to either side of the principal point.
_MIN_USED_SHARE, _MIN_HALF_FOV_RAD = 0.5, float(np.radians(1.5))
# Largest tangent at the border of a perspective image: it is stretched 30 times there.
_MAX_TANGENT = math.tan(math.radians(80.0))
# Limit of Newton iterations: enough for 1e-9 px with any usable lens; most take three.
_POLISH_ITERATIONS = 30
# Spacing of the rays that `ray_grid` computes exactly.
_GRID_PX = 8
# Number of nearest grid nodes, along each axis, between which rays are interpolated.
_NODES = 6
# Optical frame (x right, y down, z forward) -> body frame (x forward, y left, z up).
BODY_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class CameraModel:
    """
    A calibrated camera.

    Raises `LandmarkNavError`: unknown model, too many coefficients, values that are impossible for
    a camera, or a lens model that folds back within most of the image.

    Parameters
    ----------
    width, height : int
        Image size, pixels.
    fx, fy, cx, cy : float
        Focal lengths and principal point, pixels.
    model : str
        ROS distortion model: ``plumb_bob``, ``rational_polynomial`` or ``equidistant``.
    distortion : tuple of float
        Coefficients in the order of ROS and OpenCV (thin prism terms last); empty: none.
    full_size : (int, int), optional
        Width and height of the original image, if this camera is that of a reduced one.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = 'plumb_bob'
    distortion: tuple[float, ...] = field(default=())
    full_size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        """Check model, coefficients, intrinsics and size."""
        if self.model not in _COEFFICIENTS:
            raise LandmarkNavError(
                f'camera model {self.model!r} is not supported: '
                f'publish camera_info as one of {", ".join(sorted(_COEFFICIENTS))}'
            )
        if len(self.distortion) > _COEFFICIENTS[self.model]:
            raise LandmarkNavError(
                f'camera model {self.model} takes {_COEFFICIENTS[self.model]} distortion '
                f'coefficients at most, camera_info has {len(self.distortion)}: calibrate without '
                'the others'
            )
        values = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not np.all(np.isfinite(values)) or min(self.fx, self.fy) <= 0.0:
            finite = np.isfinite(self.distortion).all()
            raise LandmarkNavError(
                f'camera_info is not a calibrated camera (fx {self.fx:g}, fy {self.fy:g}, '
                f'cx {self.cx:g}, cy {self.cy:g}{"" if finite else ", d not a number"}): '
                'calibrate it'
            )
        if min(self.width, self.height) < 16:
            raise LandmarkNavError(f'camera_info has a {self.width} x {self.height} image')
        self._check_view()

    def _check_view(self) -> None:
        """Raise `LandmarkNavError` if the view is impossible or too little of it is usable."""
        what = f'camera_info: {self.width} x {self.height} with fx {self.fx:g}, fy {self.fy:g}'
        row_near = -self.height <= self.cy <= 2 * self.height
        if not (0.0 <= self.cx <= self.width - 1.0 and row_near):
            raise LandmarkNavError(
                f'{what} has its principal point at {self.cx:g}, {self.cy:g}, outside of the '
                'image: calibrate it, or give K at the size of the image'
            )
        sides = (self.cx + 0.5) / self.fx, (self.width - 0.5 - self.cx) / self.fx
        rims = (self.cy + 0.5) / self.fy, (self.height - 0.5 - self.cy) / self.fy
        if self.model != 'equidistant' and max(*sides, *rims) > _MAX_TANGENT:
            wide = math.degrees(max(sum(map(math.atan, ends)) for ends in (sides, rims)))
            raise LandmarkNavError(
                f'{what} is {wide:.0f} deg wide, more than any lens: K is of another image or in '
                'another unit'
            )
        if self._used_share < _MIN_USED_SHARE:
            raise LandmarkNavError(f'camera_info: {self.restriction}: calibrate it')
        angle, _, distorted = self._lens
        aside = min(self.cx + 0.5, self.width - 0.5 - self.cx) / self.fx
        seen = float(np.interp(aside, distorted, angle))
        if seen < _MIN_HALF_FOV_RAD:
            raise LandmarkNavError(
                f'{what}, cx {self.cx:g} sees {math.degrees(seen):.2g} deg to one side of its '
                'principal point: calibrate it'
            )

    @property
    def restriction(self) -> str:
        """Why a part of the image is not used; empty if all is that localization needs."""
        tangent, distorted = self._usable_border
        angle = math.degrees(math.atan(tangent))
        # A fisheye lens may well see more than is used.
        wide = self._is_fisheye and angle > math.degrees(_MAX_ANGLE_RAD) - 1.0
        if self._used_share == 1.0 or (wide and self._used_share >= _MIN_USED_SHARE):
            return ''
        lens = ', '.join(f'{value:.3g}' for value in self.distortion[:3])
        why = f'the lens ({self.model} {lens}) folds back'
        if angle > math.degrees(_MAX_ANGLE_RAD) - 1.0:
            why = f'fx {self.fx:g} for {self.width} x {self.height} sees too wide'
        return (
            f'{why} at {angle:.0f} deg, {distorted * self.fx:.0f} px from the centre; '
            f'{100.0 * self._used_share:.0f} % of the image lies inside'
        )

    @cached_property
    def _used_share(self) -> float:
        """Share of the image inside the usable radius of the lens."""
        u = (np.linspace(-0.5, self.width - 0.5, 33) - self.cx) / self.fx
        v = (np.linspace(-0.5, self.height - 0.5, 33) - self.cy) / self.fy
        return float(np.mean(np.hypot(u, v[:, None]) <= self._usable_border[1]))

    @cached_property
    def _usable_border(self) -> tuple[float, float]:
        """Tangent of the largest usable angle, and its least distorted radius."""
        _, tangent, distorted = self._lens
        with np.errstate(invalid='ignore'):
            inside = distorted[-1] - self._greatest_shift(tangent[-1:])[0]
        return float(tangent[-1]), float(inside)

    @cached_property
    def _lens(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Table of angles, their tangents and distorted radii, (n,), within the usable part."""
        angle = np.linspace(0.0, _MAX_ANGLE_RAD, 1025)
        tangent = np.tan(angle)
        with np.errstate(all='ignore'):
            distorted = self._distorted(tangent)
            slope = np.diff(distorted) / np.diff(angle if self._is_fisheye else tangent)
            slope -= np.gradient(self._greatest_shift(tangent), tangent)[1:]
            # Negated, so that NaN counts as folded.
            folds = np.flatnonzero(~(slope > _MIN_SLOPE))
        end = int(folds[0]) + 1 if len(folds) else len(angle)
        return angle[:end], tangent[:end], distorted[:end]

    def _greatest_shift(self, tangent: FloatArray) -> FloatArray:
        """Greatest tangential and prism distortion (n,), in focal lengths, at tangents (n,)."""
        if self._is_fisheye:
            return np.zeros_like(tangent)
        _, _, p1, p2, *_, s1, s2, s3, s4 = self._polynomial
        square = tangent * tangent
        of_second_order = 3.0 * math.hypot(p1, p2) + math.hypot(s1, s3)
        return np.asarray(square * (of_second_order + math.hypot(s2, s4) * square))

    @cached_property
    def _slopes(self) -> FloatArray:
        """Derivatives (n,) of these radii by the angles."""
        angle, _, distorted = self._lens
        return np.asarray(np.gradient(distorted, angle))

    @property
    def _is_fisheye(self) -> bool:
        return self.model == 'equidistant'

    def _distorted(self, tangent: FloatArray) -> FloatArray:
        """Radii (n,) after radial distortion, in focal lengths, at tangents (n,) of angles."""
        if self._is_fisheye:
            angle = np.arctan(tangent)
            k1, k2, k3, k4 = self.coefficients
            square = angle * angle
            return np.asarray(
                angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
            )
        return np.asarray(tangent * self._radial(tangent * tangent))

    def _radial(self, square: FloatArray) -> FloatArray:
        """Radial distortion factor (n,) at squared radii (n,)."""
        k1, k2, _, _, k3, k4, k5, k6 = self._polynomial[:8]
        radial = 1.0 + square * (k1 + square * (k2 + square * k3))
        if k4 or k5 or k6:
            radial /= 1.0 + square * (k4 + square * (k5 + square * k6))
        return np.asarray(radial)

    def by_distortion(self, tangents: FloatArray) -> FloatArray:
        """Derivatives (n, 2) of ``(u - cx) / fx, (v - cy) / fy`` at tangents (n, 2) by k1."""
        square = np.sum(tangents**2, axis=1)
        if self._is_fisheye:
            radius = np.sqrt(square)
            share = np.arctan(radius) ** 3 / np.maximum(radius, 1e-12)
        else:
            k4, k5, k6 = self._polynomial[5:8]
            share = square / (1.0 + square * (k4 + square * (k5 + square * k6)))
        return np.asarray(tangents * share[:, None])

    def resized(self, width: int, height: int) -> CameraModel:
        """Camera of the same image, resampled to another size."""
        across, down = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * across,
            fy=self.fy * down,
            # Pixel centres are integers: borders lie half a pixel outside.
            cx=(self.cx + 0.5) * across - 0.5,
            cy=(self.cy + 0.5) * down - 0.5,
            full_size=self.full_size or (self.width, self.height),
        )

    def adjusted(self, scale: float, shift: float = 0.0, distortion: float = 0.0) -> CameraModel:
        """
        Camera with an image magnified by `scale`, which keeps the distortion coefficients.

        `shift` moves the principal point to the right, in given focal lengths; `distortion` is
        added to the first coefficient.
        """
        if scale == 1.0 and shift == 0.0 and distortion == 0.0:
            return self
        first, *others = self.distortion or (0.0,)
        return replace(
            self,
            fx=scale * self.fx,
            fy=scale * self.fy,
            cx=self.cx + shift * self.fx,
            distortion=(first + distortion, *others),
        )

    @property
    def reduced_size(self) -> tuple[int, int]:
        """Width and height at `MAX_PX_PER_RAD` at most; 0 if the field of view is tiny."""
        scale = min(1.0, MAX_PX_PER_RAD / max(self.fx, self.fy))
        return round(self.width * scale), round(self.height * scale)

    @cached_property
    def reduced(self) -> CameraModel:
        """The camera at `MAX_PX_PER_RAD` at most."""
        size = self.reduced_size
        return self if size == (self.width, self.height) else self.resized(*size)

    def in_full_image(self, pixels: FloatArray) -> FloatArray:
        """Pixels (..., 2) of this image in the original image that it was reduced from."""
        if self.full_size is None:
            return pixels
        scale = np.array(self.full_size) / [self.width, self.height]
        return np.asarray((pixels + 0.5) * scale - 0.5)

    @property
    def matrix(self) -> FloatArray:
        """Intrinsic matrix K, (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @cached_property
    def intrinsics(self) -> FloatArray:
        """
        Numbers (5,) that identify the lens at any size of the image.

        Focal lengths and principal point over the size, and the first distortion coefficient: that
        of the cubed tangent, which in the angle of ``equidistant`` is -1/3.
        """
        width, height = self.width, self.height
        center = (self.cx + 0.5) / width, (self.cy + 0.5) / height
        bend = (self.distortion or (0.0,))[0] - self._is_fisheye / 3.0
        return np.array([self.fx / width, self.fy / height, *center, bend])

    @cached_property
    def coefficients(self) -> FloatArray:
        """Distortion coefficients, padded with zeros to a length of OpenCV (4, 5, 8 or 12)."""
        counts = {'equidistant': [4], 'plumb_bob': [5, 8, 12], 'rational_polynomial': [8, 12]}
        padded = np.zeros(next(n for n in counts[self.model] if n >= len(self.distortion)))
        padded[: len(self.distortion)] = self.distortion
        return padded

    @cached_property
    def _scale(self) -> tuple[FloatArray, FloatArray]:
        """Focal lengths and principal point, each (2,)."""
        return np.array([self.fx, self.fy]), np.array([self.cx, self.cy])

    @cached_property
    def _polynomial(self) -> list[float]:
        """Distortion coefficients, padded with zeros to twelve."""
        return [*self.coefficients.tolist(), *[0.0] * 7][:12]

    @cached_property
    def _max_radius(self) -> float:
        """Largest normalised radius in the image; beyond it the polynomial may fold back."""
        u = np.linspace(-0.5, self.width - 0.5, 17)
        v = np.linspace(-0.5, self.height - 0.5, 17)
        grid = np.stack(np.meshgrid(u, v), -1)
        border = np.concatenate([grid[0], grid[-1], grid[:, 0], grid[:, -1]])
        return float(np.linalg.norm(self.unproject(border)[:, :2], axis=1).max())

    def project(self, points_optical: npt.ArrayLike) -> FloatArray:
        """
        Pixels (..., 2) of points (..., 3) in the optical frame; NaN behind or far outside.

        Brown, Decentering distortion of lenses, 1966; Kannala and Brandt, PAMI 28(8), 2006.
        """
        points = np.asarray(points_optical, dtype=np.float64)
        flat = points.reshape(-1, 3)
        depth = flat[:, 2]
        radius = np.hypot(flat[:, 0], flat[:, 1])
        widest = min(1.05 * self._max_radius, self._usable_border[0])
        good = (depth > 1e-9) & (radius < widest * depth)
        if len(flat) and good.all():
            pixels = self._pixels(flat[:, :2] / flat[:, 2:])
        else:
            pixels = np.full((len(flat), 2), np.nan)
            if good.any():
                pixels[good] = self._pixels(flat[good, :2] / flat[good, 2:])
        return pixels.reshape((*points.shape[:-1], 2))

    def unproject(self, pixels: npt.ArrayLike) -> FloatArray:
        """
        Rays (..., 3) with z = 1 in the optical frame, of pixels (..., 2).

        Pixels outside the usable part of the image get the ray at its border.
        """
        uv = np.asarray(pixels, dtype=np.float64)
        flat = uv.reshape(-1, 2)
        if not len(flat):
            return np.empty((*uv.shape[:-1], 3))
        focal, center = self._scale
        angle, _, distorted = self._lens
        wanted = (flat - center) / focal
        x, y = wanted.T
        radius = np.maximum(np.sqrt(x * x + y * y), 1e-12)[:, None]
        wanted *= np.minimum(1.0, self._usable_border[1] / radius)
        radius = np.minimum(radius, self._usable_border[1])
        flat = center + wanted * focal
        # First the radial distortion, by the table. Then Newton's method with approximate radial
        # and tangential derivatives.
        angles = np.interp(radius, distorted, angle)
        slope = np.interp(angles, angle, self._slopes)
        tangent = np.tan(angles)
        along, across = slope * np.cos(angles) ** 2, radius / np.maximum(tangent, 1e-12)
        outward = wanted / radius
        tangents = outward * tangent
        for _ in range(_POLISH_ITERATIONS):
            residual = self._pixels(tangents) - flat
            if np.abs(residual).max() < 1e-9:
                break
            off = residual / focal
            radial = (off * outward).sum(axis=-1, keepdims=True) * outward
            tangents -= radial / along + (off - radial) / across
        rays = np.ones((*uv.shape[:-1], 3))
        rays[..., :2] = tangents.reshape(uv.shape)
        return rays

    def _pixels(self, tangents: FloatArray) -> FloatArray:
        """Pixels (n, 2) of rays in front of the camera, by their x/z and y/z (n, 2)."""
        if self._is_fisheye:
            zero = np.zeros(3)
            rays = np.column_stack([tangents, np.ones(len(tangents))]).reshape(-1, 1, 3)
            found = cv2.fisheye.projectPoints(rays, zero, zero, self.matrix, self.coefficients)
            return np.asarray(found[0], dtype=np.float64).reshape(-1, 2)
        # cv2.projectPoints also computes derivatives, and takes three times as long.
        _, _, p1, p2, *_ = self._polynomial
        focal, center = self._scale
        x, y = tangents.T
        square = x * x + y * y
        along = self._radial(square) + 2.0 * (p1 * y + p2 * x)
        distorted = tangents * along[:, None] + square[:, None] * np.array([p2, p1])
        pixels = focal * distorted + center
        s1, s2, s3, s4 = self._polynomial[8:]
        if s1 or s2 or s3 or s4:
            pixels[:, 0] += self.fx * square * (s1 + s2 * square)
            pixels[:, 1] += self.fy * square * (s3 + s4 * square)
        return np.asarray(pixels)

    @property
    def ray_grid(self) -> npt.NDArray[np.float32]:
        """Normalised ray x/z, y/z of every pixel, (height, width, 2); cached."""
        return _ray_grid(self)

    def contains(self, pixels: npt.ArrayLike, margin_px: float = 0.0) -> npt.NDArray[np.bool_]:
        """Whether pixels (..., 2) lie in the image, `margin_px` inside its border."""
        uv = np.asarray(pixels, dtype=np.float64)
        most = np.array([self.width, self.height]) - 1 - margin_px
        with np.errstate(invalid='ignore'):
            return np.asarray(((uv >= margin_px) & (uv <= most)).all(axis=-1))

    @cached_property
    def half_fov_rad(self) -> float:
        """Smaller of the two horizontal half angles of view, radians."""
        edge = self.unproject([[0.0, self.cy], [self.width - 1.0, self.cy]])
        return float(np.arctan(np.abs(edge[:, 0])).min())


@lru_cache(maxsize=4)
def _ray_grid(camera: CameraModel) -> npt.NDArray[np.float32]:
    # Cached by value: every message creates a new camera, equal to the one before. Rays are exact
    # on a grid and interpolated by polynomials between: errors are below 1e-3 px, 0.02 px at the
    # border of a fisheye.
    (u, across), (v, down) = _interpolation(camera.width), _interpolation(camera.height)
    coarse = camera.unproject(np.stack(np.meshgrid(u, v), -1))
    return np.stack([down @ coarse[..., k] @ across.T for k in (0, 1)], -1).astype(np.float32)


@lru_cache(maxsize=8)
def _interpolation(size: int) -> tuple[FloatArray, FloatArray]:
    """
    Nodes (n,) along `size` pixels, and weights (size, n) that interpolate between them.

    The weights are those of Lagrange polynomials through the nearest nodes, so that steep changes
    at the border of a fisheye affect only pixels nearby.
    """
    nodes = np.linspace(0.0, size - 1.0, max(_NODES, size // _GRID_PX))
    place = np.linspace(0.0, len(nodes) - 1.0, size)
    first = np.floor(place).astype(np.intp) + 1 - _NODES // 2
    first = np.clip(first, 0, len(nodes) - _NODES)[:, None]
    step = np.arange(_NODES)
    away = place[:, None] - first - step
    weights = np.zeros((size, len(nodes)))
    for k in step:
        others = np.delete(step, k)
        share = np.prod(away[:, others] / (k - others), axis=1)
        np.put_along_axis(weights, first + k, share[:, None], axis=1)
    return nodes, weights


@dataclass(frozen=True)
class PanTiltMount:
    """
    Geometry of the pan-tilt unit on the robot.

    Raises `LandmarkNavError`: the lower pan limit is not below the upper one.

    Parameters
    ----------
    axis_xyz : tuple of float
        Lever arm: position of the pan axis in ``base_link``, metres.
    axis_rpy : tuple of float
        Orientation of the axis frame at pan 0 in ``base_link``, radians.
    optical_center_offset : tuple of float
        Vector from the axis to the optical centre, metres, in the frame that turns with pan and
        tilt (x along the view, y left, z up).
    camera_roll_rad : float
        Rotation of the camera about its optical axis, clockwise in the direction of view; pi if it
        is mounted upside down.
    pan_sigma_rad : float
        Standard deviation of the measured joint angles; the error is common to one image.
    base_frame, pan_joint, tilt_joint : str
        Names of the base frame and of the joints.
    has_tilt : bool
        Whether there certainly is a tilt joint; otherwise it is 0 if no message has it.
    pan_min_rad, pan_max_rad : float
        Limits of the pan joint.
    pan_rate_rad_s, pan_acceleration_rad_s2 : float
        Rate and acceleration of the pan joint, for the duration of moves.
    image_delay_s : float
        Time by which the stamps of images lag those of odometry.
    """

    axis_xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis_rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    optical_center_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    camera_roll_rad: float = 0.0
    pan_sigma_rad: float = 2e-4
    base_frame: str = 'base_link'
    pan_joint: str = 'pan_joint'
    tilt_joint: str = 'tilt_joint'
    pan_min_rad: float = -math.pi
    pan_max_rad: float = math.pi
    pan_rate_rad_s: float = 1.0
    pan_acceleration_rad_s2: float = 8.0
    image_delay_s: float = 0.0
    has_tilt: bool = field(default=False, compare=False)

    def __post_init__(self) -> None:
        """Check the limits."""
        if self.pan_min_rad >= self.pan_max_rad:
            raise LandmarkNavError(
                f'pan_min is {self.pan_min_rad:g}, pan_max {self.pan_max_rad:g}: swap them'
            )

    @property
    def pan_limits_rad(self) -> tuple[float, float]:
        """Least and largest pan."""
        return self.pan_min_rad, self.pan_max_rad

    @cached_property
    def _axis_rotation(self) -> FloatArray:
        return rotation_rpy(self.axis_rpy)

    @cached_property
    def pan_sense(self) -> float:
        """1 if larger pans look farther left and larger tilts higher; -1 if the unit hangs."""
        return math.copysign(1.0, self._axis_rotation[2, 2])

    @cached_property
    def _pan_zero_base_rad(self) -> float:
        """Azimuth of pan 0 in ``base_link``."""
        return math.atan2(self._axis_rotation[1, 0], self._axis_rotation[0, 0])

    def azimuth_base_rad(self, pan_rad: npt.ArrayLike) -> FloatArray:
        """Azimuths (...) of the view in ``base_link`` at pans (...), not wrapped."""
        return np.asarray(self._pan_zero_base_rad + self.pan_sense * np.asarray(pan_rad))

    def pan_toward_rad(self, azimuth_base_rad: npt.ArrayLike) -> FloatArray:
        """Pans (...) at which the camera looks at azimuths (...) in ``base_link``."""
        ahead = np.asarray(azimuth_base_rad) - self._pan_zero_base_rad
        return np.asarray(wrap_rad(self.pan_sense * ahead))

    def axis_pose_map(self, pose_map_base: npt.ArrayLike) -> FloatArray:
        """Planar poses (..., 3) of the pan axis, with the orientation of the base."""
        return compose(pose_map_base, [*self.axis_xyz[:2], 0.0])

    def camera_pose_base(
        self,
        pan_rad: npt.ArrayLike,
        tilt_rad: npt.ArrayLike = 0.0,
        roll_rad: npt.ArrayLike = 0.0,
    ) -> tuple[FloatArray, FloatArray]:
        """
        Pose of the optical frame in ``base_link``.

        Parameters
        ----------
        pan_rad, tilt_rad : array_like, shape (...)
            Joint angles; pan positive to the left, tilt positive upwards, in the axis frame.
        roll_rad : float or array_like, shape (...)
            Additional rotation about the optical axis, clockwise in the direction of view.

        Returns
        -------
        rotation : ndarray, shape (..., 3, 3)
            Optical frame -> base.
        translation : ndarray, shape (..., 3)
            Optical centre in base, metres.
        """
        turned = self._axis_rotation @ rot_z(pan_rad) @ rot_y(np.negative(tilt_rad))
        center = np.asarray(self.axis_xyz) + turned @ np.asarray(self.optical_center_offset)
        roll = rot_z(np.add(roll_rad, self.camera_roll_rad))
        return turned @ BODY_FROM_OPTICAL @ roll, center

    def camera_pose_map(
        self,
        pose_map_base: FloatArray,
        pan_rad: npt.ArrayLike,
        tilt_rad: npt.ArrayLike = 0.0,
        roll_rad: npt.ArrayLike = 0.0,
    ) -> tuple[FloatArray, FloatArray]:
        """Pose of the optical frame in map, as `camera_pose_base`, for a base at a pose (3,)."""
        rotation, center = self.camera_pose_base(pan_rad, tilt_rad, roll_rad)
        x, y, heading = pose_map_base
        turn = rot_z(heading)
        return turn @ rotation, center @ turn.T + [x, y, 0.0]
