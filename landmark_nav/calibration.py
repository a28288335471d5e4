"""
The calibration of a robot: values of its mount, lens and clocks, with their covariance.

It is the prior and the result of every stage that estimates some of its values. A sigma of 0
declares a value exact: it is never changed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import FloatArray
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, PanTiltMount

# Name -> unit, default sigma, meaning. Default sigmas are those of a measurement with tape and
# spirit level (2 cm, 1 degree), and for lens, clocks and encoders those of usual calibrations.
_QUANTITIES: dict[str, tuple[str, float, str]] = {
    'axis_x': ('m', 0.02, 'pan axis ahead of base_link'),
    'axis_y': ('m', 0.02, 'pan axis to the left of base_link'),
    'axis_z': ('m', 0.02, 'pan axis above base_link'),
    'axis_roll': ('rad', 0.017, 'pan axis is tilted to the right'),
    'axis_pitch': ('rad', 0.017, 'pan axis is tilted ahead'),
    'axis_yaw': ('rad', 0.017, 'direction of pan 0, to the left of ahead'),
    'center_x': ('m', 0.02, 'optical centre ahead of the pan axis, in the frame that turns'),
    'center_y': ('m', 0.02, 'optical centre to the left of the pan axis, in the frame that turns'),
    'center_z': ('m', 0.02, 'optical centre above the origin of the frame that turns'),
    'camera_roll': ('rad', 0.017, 'camera turned about its optical axis'),
    'camera_tilt': ('rad', 0.017, 'camera tilted against its joint'),
    'pan_scale': ('1', 0.001, 'relative error of the pan angle'),
    'focal_scale': ('1', 0.01, 'relative error of the focal length'),
    'principal_point': ('1', 0.001, 'principal point to the right, over the focal length'),
    'distortion': ('1', 0.02, 'error of the first radial distortion coefficient, k1'),
    'joint_delay': ('s', 0.03, 'time by which joint_states lag the images'),
    'row_delay': ('s', 0.03, 'time by which rows a focal length further down are exposed later'),
}
NAMES: tuple[str, ...] = tuple(_QUANTITIES)
# Those of the lens, which follow each other.
LENS = ('focal_scale', 'principal_point', 'distortion')
UNITS: dict[str, str] = {name: unit for name, (unit, *_) in _QUANTITIES.items()}
MEANINGS: dict[str, str] = {name: words for name, (*_, words) in _QUANTITIES.items()}
DEFAULT_SIGMAS = np.array([sigma for _, sigma, _ in _QUANTITIES.values()])

# Sigma of the values of a calibrated mount, by unit.
_EXACT = {'m': 1e-4, 'rad': 1e-4, '1': 1e-5, 's': 1e-4}
# Greatest deviation of a measurement from an exact value, in sigmas.
_CONTRADICTION = 5.0
# Degrees of freedom of the t distribution of errors of the prior, and rounds of its estimate.
_FREEDOM, _ROUNDS = 4.0, 20
# Least difference that is reported, in prior sigmas.
_WORTH_REPORTING = 0.3
# Greatest rounding of a covariance in a file or message, relative to its largest eigenvalue.
_ROUNDING = 1e-6
# Least change of `CameraModel.intrinsics` that counts: half the sigma of a lens that was learned.
_SAME_LENS = 1e-4
# Greatest sigma of a lens whose intrinsics were changed, in sigmas of the robot file.
_SAME_SIGMAS = 3.0
# Least relative decrease of the sigma of an observed quantity.
_OBSERVED = 0.3


@dataclass(frozen=True, eq=False)
class Calibration:
    """
    Values (17,) of `NAMES` with their joint covariance, and the mount that they belong to.

    They are the position [m] of the pan axis in ``base_link`` and its roll, pitch and yaw [rad] at
    pan 0; the position [m] of the optical centre in the frame that turns; roll and tilt [rad] of
    the camera in that frame; relative errors of the pan and of the focal length; the shift of the
    principal point to the right over the focal length; the error of k1; the time [s] by which the
    stamps of ``joint_states`` lag those of the images; the time [s] by which a rolling shutter
    exposes rows later that are one focal length further down. `by_map` (17, m) is their covariance
    with the m factors of unit variance that all landmarks of a map share, if the map was learned
    with this calibration. `intrinsics` (5,) are the `CameraModel.intrinsics` by camera_info that
    the values of the lens correct; None: those of any camera.

    Raises `LandmarkNavError`: a value is not finite, the matrix is not a covariance, or it is less
    than the shared factors make of it.
    """

    values: FloatArray
    covariance: FloatArray
    base: PanTiltMount = field(default_factory=PanTiltMount)
    by_map: FloatArray | None = None
    intrinsics: FloatArray | None = None

    def __post_init__(self) -> None:
        n = len(NAMES)
        if self.values.shape != (n,) or self.covariance.shape != (n, n):
            raise LandmarkNavError(f'a calibration has {n} values and their covariance')
        if not (np.isfinite(self.values).all() and np.isfinite(self.covariance).all()):
            raise LandmarkNavError('calibration: a value or sigma is not finite')
        spread = np.linalg.eigvalsh(self.covariance)
        if spread[0] < -1e-9 * max(spread[-1], 1e-12):
            raise LandmarkNavError('calibration: the covariance has a negative eigenvalue')
        if self.by_map is None:
            return
        own = self.covariance - self.by_map @ self.by_map.T
        if np.linalg.eigvalsh(own)[0] < -_ROUNDING * spread[-1]:
            raise LandmarkNavError('calibration: the covariance is less than shared errors alone')

    @classmethod
    def of_mount(
        cls,
        mount: PanTiltMount,
        sigmas: Mapping[str, float] | None = None,
        values: Mapping[str, float] | None = None,
    ) -> Calibration:
        """
        Return the calibration of a mount, with independent errors.

        `sigmas` replaces default sigmas, by name; `values` gives the quantities that a mount does
        not hold (camera_tilt and those after it).
        """
        of_mount = (*mount.axis_xyz, *mount.axis_rpy, *mount.optical_center_offset)
        known = dict(zip(NAMES, (*of_mount, mount.camera_roll_rad), strict=False))
        known |= values or {}
        every = dict(zip(NAMES, DEFAULT_SIGMAS.tolist(), strict=True))
        every |= sigmas or {}
        variances = np.array([every[name] for name in NAMES]) ** 2
        return cls(np.array([known.get(k, 0.0) for k in NAMES]), np.diag(variances), mount)

    @classmethod
    def exact(cls, mount: PanTiltMount) -> Calibration:
        """Return the calibration of a calibrated mount: sigmas of 0.1 mm and 0.006 degrees."""
        return cls.of_mount(mount, {name: _EXACT[unit] for name, unit in UNITS.items()})

    @cached_property
    def sigmas(self) -> FloatArray:
        """Sigmas of the values, (17,)."""
        return np.sqrt(np.clip(np.diag(self.covariance), 0.0, None))

    @cached_property
    def mount(self) -> PanTiltMount:
        """Mount with these values."""
        x = self.values.tolist()
        return replace(
            self.base,
            axis_xyz=tuple(x[0:3]),
            axis_rpy=tuple(x[3:6]),
            optical_center_offset=tuple(x[6:9]),
            camera_roll_rad=x[9],
        )

    def __getitem__(self, name: str) -> tuple[float, float]:
        """Value and sigma of a quantity."""
        k = NAMES.index(name)
        return float(self.values[k]), float(self.sigmas[k])

    def camera(self, camera: CameraModel) -> CameraModel:
        """Return the camera with the calibrated lens."""
        focal, shift, distortion = (self[name][0] for name in LENS)
        return camera.adjusted(1.0 + focal, shift, distortion)

    def for_camera(self, intrinsics: FloatArray, given: Calibration) -> Calibration:
        """
        Return the calibration for these intrinsics by camera_info.

        If they are not those that the values of the lens correct, these are less certain by the
        change, as a driver that resizes images may round them, and so is the tilt, which the
        images do not tell from the height of the principal point. If the lens would be far less
        certain than in `given`, it is as there again.
        """
        known = self.intrinsics
        if known is None:
            return replace(self, intrinsics=intrinsics)
        off = np.abs(known - intrinsics)
        if off.max() < _SAME_LENS:
            return self
        # In the units of `LENS`.
        steps = [float((off[:2] / known[:2]).max()), float(off[2] / known[0]), float(off[4])]
        tilted = self.widened({'camera_tilt': float(off[3] / known[1])})
        changed = tilted.widened(dict(zip(LENS, steps, strict=True)))
        if any(changed[name][1] > _SAME_SIGMAS * given[name][1] for name in LENS):
            changed = tilted.with_lens(given)
        return replace(changed, intrinsics=intrinsics)

    def same_camera(self, other: Calibration) -> bool:
        """Whether the values of the lens correct the same intrinsics, or one is of any camera."""
        if self.intrinsics is None or other.intrinsics is None:
            return True
        return bool(np.abs(self.intrinsics - other.intrinsics).max() < _SAME_LENS)

    def with_lens(self, other: Calibration) -> Calibration:
        """Return a copy with the lens of another calibration, with independent errors."""
        lens = np.isin(NAMES, LENS)
        covariance = np.where(np.logical_or.outer(lens, lens), 0.0, self.covariance)
        return replace(
            self,
            values=np.where(lens, other.values, self.values),
            covariance=covariance + np.diag(np.where(lens, other.sigmas**2, 0.0)),
            by_map=None if self.by_map is None else np.where(lens[:, None], 0.0, self.by_map),
            intrinsics=other.intrinsics,
        )

    def measured(self, name: str, value: float, sigma: float) -> Calibration:
        """Return the calibration after a measurement of one quantity; raises as `observed`."""
        row = (np.array(NAMES) == name).astype(np.float64)
        return self.observed(row[None], np.array([value]), np.array([[sigma**2]]))

    def observed(
        self, rows: FloatArray, values: FloatArray, covariance: FloatArray
    ) -> Calibration:
        """
        Return the calibration after a measurement of m linear combinations (`rows`) of quantities.

        Errors of the prior have a t distribution: a measurement far off shows that its sigmas were
        too small, and decides. Raises `LandmarkNavError`: the measurement contradicts an exact
        value.
        """
        prior, off = self.covariance.copy(), values - rows @ self.values
        known = np.einsum('mi,ij,mj->m', rows, prior, rows)
        sigmas = np.sqrt(np.diag(covariance))
        wrong = (known <= 0.0) & (np.abs(off) > _CONTRADICTION * sigmas)
        if wrong.any():
            raise LandmarkNavError(_contradiction(rows[wrong], off[wrong], sigmas[wrong]))
        for row, size, spread, sigma in zip(rows, off, known, sigmas, strict=True):
            if spread <= 0.0:
                continue
            loose = row**2 * (np.diag(prior) > 0.0)
            # Variance of the prior by its error, and the error by its variance, in turn.
            error, factor = size, 1.0
            for _ in range(_ROUNDS):
                factor = max(1.0, (_FREEDOM + error**2 / spread) / (_FREEDOM + 1.0))
                error = size * factor * spread / (factor * spread + sigma**2)
            prior += np.diag(loose * (factor - 1.0) * spread / loose.sum())
        gain = prior @ rows.T @ np.linalg.inv(rows @ prior @ rows.T + covariance)
        left = np.eye(len(prior)) - gain @ rows
        after = left @ prior @ left.T + gain @ covariance @ gain.T
        return replace(
            self,
            values=self.values + gain @ off,
            covariance=0.5 * (after + after.T),
            by_map=None if self.by_map is None else left @ self.by_map,
        )

    def same_as(self, other: Calibration) -> bool:
        """Whether values and sigmas are equal except for rounding in a file."""
        return bool(
            np.allclose(self.values, other.values, rtol=0.0, atol=1e-8)
            and np.allclose(self.sigmas, other.sigmas, rtol=0.0, atol=1e-8)
        )

    def with_values(self, **values: float) -> Calibration:
        """Return a copy with other values, by name."""
        changed = self.values.copy()
        for name, value in values.items():
            changed[NAMES.index(name)] = value
        return replace(self, values=changed)

    def widened(self, sigmas: Mapping[str, float]) -> Calibration:
        """Return a copy with additional independent errors of `sigmas`, by name."""
        added = np.diag([sigmas.get(name, 0.0) ** 2 for name in NAMES])
        return replace(self, covariance=self.covariance + added)

    def unobserved(self, prior: Calibration) -> tuple[str, ...]:
        """Names of quantities that are not observed beyond `prior`, without exact ones."""
        hardly = (self.sigmas > (1.0 - _OBSERVED) * prior.sigmas) & (prior.sigmas > 0.0)
        return tuple(name for name, unknown in zip(NAMES, hardly, strict=True) if unknown)

    def contradictions(self, prior: Calibration) -> tuple[str, ...]:
        """Names of quantities that deviate by more than five prior sigmas."""
        off = np.abs(self.values - prior.values) > 5.0 * prior.sigmas + 1e-12
        return tuple(name for name, far in zip(NAMES, off, strict=True) if far)

    def surprises(self, prior: Calibration) -> str:
        """
        Text of the significant differences from the prior; empty if there are none.

        Differences far below the prior sigma are left out. The height is one quantity, the sum of
        axis_z and center_z, which images do not make observable separately.
        """
        words = []
        for what, names in (('height', ('axis_z', 'center_z')), *((n, (n,)) for n in NAMES)):
            if what in ('axis_z', 'center_z'):
                continue
            row = np.isin(NAMES, names)
            off = float((self.values - prior.values)[row].sum())
            sigma = float(np.sqrt(max(self.covariance[np.ix_(row, row)].sum(), 0.0)))
            given = float(np.sqrt(prior.covariance[np.ix_(row, row)].sum()))
            if abs(off) > max(3.0 * sigma, _WORTH_REPORTING * given) + 1e-9:
                words.append(f'{what} {shown(off, sigma, UNITS[names[0]])}')
        return ', '.join(words)

    def differences(self, prior: Calibration) -> dict[str, dict[str, float | bool | str]]:
        """Table of the quantities by name: prior, value, sigma, unit, observed."""
        hidden = self.unobserved(prior)
        table: dict[str, dict[str, float | bool | str]] = {}
        for name in NAMES:
            (value, sigma), (before, _) = self[name], prior[name]
            table[name] = {'prior': before, 'value': value, 'sigma': sigma, 'unit': UNITS[name]}
            table[name]['observed'] = name not in hidden
        return table

    def sigmas_from(self, first: str) -> npt.NDArray[np.float64]:
        """Sigmas (2,) of the quantity `first` and the next one."""
        k = NAMES.index(first)
        return self.sigmas[k : k + 2]


# Unit -> factor and unit for texts.
SHOWN_IN = {'m': (1e3, 'mm'), 'rad': (180.0 / np.pi, 'deg'), 's': (1e3, 'ms'), '1': (100.0, '%')}


def shown(value: float, sigma: float, unit: str) -> str:
    """Text of a difference with its sigma."""
    factor, name = SHOWN_IN[unit]
    # A digit of the sigma at least.
    digits = max(2, -int(np.floor(np.log10(max(factor * sigma, 1e-6)))))
    return f'{factor * value:+.{digits}f} +- {factor * sigma:.{digits}f} {name}'


def _contradiction(rows: FloatArray, off: FloatArray, sigmas: FloatArray) -> str:
    """Message for measured combinations (m, n) of exact values that are off: the two worst."""
    parts = []
    for k in np.argsort(-np.abs(off) / sigmas)[:2]:
        names = [name for name, part in zip(NAMES, rows[k], strict=True) if abs(part) > 0.5]
        parts.append(f'{" and ".join(names)} by {shown(off[k], sigmas[k], UNITS[names[0]])}')
    more = [f'{len(off) - 2} more'] if len(off) > 2 else []
    wrong = '; '.join([*parts, *more])
    return f'images contradict exact values: {wrong}: fix robot.yaml, or give sigmas'
