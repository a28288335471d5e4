"""
Turns of the camera: pan and odometry compared with the motion of the images.

From one image to the next the camera turns by

    turn = pan scale * pan sense * (pan after - pan before)
         + yaw scale * (yaw after - yaw before)
         + nearness * (displacement to the left of the view, by odometry)
         + sideways * (displacement along the view)
         + bias * (time) + curve * (path by odometry)

and without faults both scales are 1, and bias and curve 0. `nearness` is the mean inverse distance
of visible things; `sideways` is 0 unless the heading of the camera is wrong. The noise is
Student's t, as turns by images have outliers (Lange, Little, Taylor, J. Am. Stat. Assoc. 84,
1989).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import FloatArray
from landmark_nav.diagnosis.streams import JOINTS, ODOMETRY

ComplexArray = npt.NDArray[np.complex128]

# What may be at fault beside the streams.
MOUNT = 'pan_axis'
# Degrees of freedom of Student's t.
FREEDOM = 3.0
# Least number of pairs of images from which motion is judged.
LEAST_PAIRS = 12
# Scores within the first difference are equivalent; a fault exceeds the score without faults by
# the second.
ALIKE, CERTAIN = 5.0, 12.0
_ITERATIONS = 25
# Relative sigma of the nearness of one view, and how long a camera that turns has it, s.
_NEARNESS_SPREAD, _SAME_VIEW_S = 0.4, 2.0
# Bounds of the noise of images: greatest scale; greatest share of residuals beyond these sigmas.
NOISE_RAD = 0.02
_FAR_SIGMAS, _MOST_AWAY = 5.0, 0.15
# Greatest errors that localization estimates, and greatest sigmas with which they are judged.
# Those of bias, curve and axis are twice what unequal distances cause without these errors.
_ESTIMATED = {
    'pan_scale': (0.03, 0.1),
    'yaw_scale': (0.12, 0.2),
    'pan_clock_s': (0.01, 0.1),
    'odometry_clock_s': (0.03, 0.1),
    'bias_rad_s': (0.06, 0.1),
    'curve_rad_m': (0.2, 0.2),
    'ahead_m': (0.4, 0.4),
    'left_m': (0.4, 0.4),
}
# Tolerance of the first and last time of a stream.
_LEEWAY_S = 0.02
# Step of the numerical derivative by time.
_STEP_S = 0.05
# Sigma of the position of pan axis and optical centre, if measured with a tape.
_LEVER_SIGMA_M = 0.02
# Least sigma of turns between images.
_LEAST_SIGMA_RAD = 1e-3


@dataclass(frozen=True)
class Clock:
    """
    A clock relative to that of the images.

    It is ahead by `offset_s` at `anchor_s`, and runs faster by the share `drift`. At `step_at_s`
    it is set ahead by `step_s`. Several offsets, of shape (m, 1, 1), are several clocks.
    """

    offset_s: Any = 0.0
    drift: float = 0.0
    anchor_s: float = 0.0
    step_s: float = 0.0
    step_at_s: float = 0.0

    def at(self, seconds: FloatArray) -> FloatArray:
        """Times of this clock at times of the images' clock."""
        ahead = self.offset_s + self.drift * (seconds - self.anchor_s)
        return np.asarray(seconds + ahead + self.step_s * (seconds >= self.step_at_s))

    def later(self, seconds: Any) -> Clock:
        """Return the clock that is ahead by `seconds` more."""
        return replace(self, offset_s=self.offset_s + seconds)


@dataclass(frozen=True, eq=False)
class Track:
    """Values (n, k) at ascending times (n,), constant before the first and after the last."""

    seconds: FloatArray
    values: FloatArray

    @classmethod
    def of(cls, seconds: FloatArray, values: FloatArray) -> Track:
        """Sort values by time; of several at one time the last is kept."""
        order = np.argsort(seconds, kind='stable')
        times, values = seconds[order], values[order]
        last = np.append(np.diff(times) > 0.0, True)
        return cls(times[last], values[last])

    def at(self, seconds: npt.ArrayLike) -> FloatArray:
        """Values (..., k) at times (...)."""
        times = np.asarray(seconds, dtype=np.float64)
        columns = [np.interp(times, self.seconds, column) for column in self.values.T]
        return np.stack(columns, -1)


def driven_again(
    track: Track, yaw_scale: float = 1.0, bias_rad_s: float = 0.0, curve_rad_m: float = 0.0
) -> Track:
    """
    Integrate odometry (n, 3) again with the same steps in the frame of the base and other turns.

    Each turn is multiplied by `yaw_scale`; `bias_rad_s` and `curve_rad_m` times duration and path
    are added.
    """
    x, y, yaw = track.values.T
    ahead = np.diff(x + 1j * y) * np.exp(-0.5j * (yaw[1:] + yaw[:-1]))
    turns = yaw_scale * np.diff(yaw)
    turns += bias_rad_s * np.diff(track.seconds) + curve_rad_m * np.abs(ahead)
    again = np.append(yaw[0], yaw[0] + np.cumsum(turns))
    place = np.cumsum(np.append(0.0, ahead * np.exp(0.5j * (again[1:] + again[:-1]))))
    return replace(track, values=np.stack([x[0] + place.real, y[0] + place.imag, again], -1))


@dataclass(frozen=True, eq=False)
class Motion:
    """
    Turns between images, and joints and odometry that explain them.

    Parameters
    ----------
    before_s, after_s, turns_rad : ndarray, shape (n,)
        Times of the first and second image of each pair, and measured turn of the camera,
        counter-clockwise.
    pan, odometry : Track
        Pan (n, 1), unwrapped, times the sense of the mount; x, y in metres and unwrapped yaw
        in radians, (n, 3), if there is odometry.
    axis_xy, offset_xy : tuple of float
        Position of the pan axis in ``base_link``, and of the optical centre from the axis, in
        the frame that turns, m.
    ahead_rad, hangs : float, bool
        Azimuth of pan 0 in ``base_link``, and whether the given mount has the camera upside
        down.
    pan_clock, odometry_clock, pan_scale, yaw_scale : Clock, float
        Clocks and factors of these streams.
    """

    before_s: FloatArray
    after_s: FloatArray
    turns_rad: FloatArray
    pan: Track
    odometry: Track | None
    axis_xy: tuple[float, float] = (0.0, 0.0)
    offset_xy: tuple[float, float] = (0.0, 0.0)
    ahead_rad: float = 0.0
    hangs: bool = False
    pan_clock: Clock = field(default_factory=Clock)
    odometry_clock: Clock = field(default_factory=Clock)
    pan_scale: float = 1.0
    yaw_scale: float = 1.0

    def __len__(self) -> int:
        return len(self.turns_rad)

    def only(self, chosen: Any) -> Motion:
        """Return the pairs selected by an index or a mask (n,)."""
        return replace(
            self,
            before_s=self.before_s[chosen],
            after_s=self.after_s[chosen],
            turns_rad=self.turns_rad[chosen],
        )

    def stream(self, name: str) -> tuple[Track | None, Clock]:
        """Values and clock of a stream, `JOINTS` or `ODOMETRY`."""
        if name == JOINTS:
            return self.pan, self.pan_clock
        return self.odometry, self.odometry_clock

    def turned(self, name: str) -> FloatArray:
        """Turns by a stream, (n,)."""
        return self.panned() if name == JOINTS else self.yawed()

    def unexplained(self) -> FloatArray:
        """Turns less those by joints and odometry, (n,)."""
        return self.turns_rad - self.panned() - self.yawed()

    def covered(self, name: str) -> float:
        """Share of the pairs of images within the time of a stream."""
        track, clock = self.stream(name)
        if track is None or not len(self):
            return 1.0
        before, after = clock.at(self._times)
        inside = before > track.seconds[0] - _LEEWAY_S
        inside &= after < track.seconds[-1] + _LEEWAY_S
        return float(np.mean(inside))

    def panned(self) -> FloatArray:
        """Turns by the joints, (n,)."""
        return np.asarray(np.diff(self._pans(self._times), axis=-2)[..., 0, :])

    def yawed(self) -> FloatArray:
        """Turns by the odometry, (n,)."""
        return np.asarray(np.diff(self._yaws(), axis=-2)[..., 0, :])

    def parallax(self) -> FloatArray:
        """
        Columns (n, 2) of `nearness` and `sideways`, m.

        They are the displacements of the optical centre by odometry, to the left of the view and
        along it.
        """
        if self.odometry is None:
            return np.zeros((len(self), 2))
        x, y, _ = self.odometry.at(self.odometry_clock.at(self._times)).T
        seen = self._seen(np.diff(x + 1j * y, axis=1)[:, 0])
        for (ahead, left), lever in zip(
            (self.axis_xy, self.offset_xy), self._levers(), strict=True
        ):
            seen += (ahead + 1j * left) * lever
        return np.stack([seen.imag, seen.real], -1)

    def levers(self) -> FloatArray:
        """
        Displacements (n, 4) to the left of the view by levers of 1 m.

        The first two are of the pan axis, ahead and to the left of the base, the others of the
        optical centre, in the frame that turns.
        """
        if self.odometry is None:
            return np.zeros((len(self), 4))
        axis, offset = self._levers()
        return np.stack([axis.imag, axis.real, offset.imag, offset.real], -1)

    def passed(self) -> FloatArray:
        """Duration, s, and length of the path, m, between the images, (n, 2)."""
        if self.odometry is None:
            return np.zeros((len(self), 2))
        times = self.odometry_clock.at(self._times)
        steps = np.hypot(*np.diff(self.odometry.values[:, :2], axis=0).T)
        path = np.interp(times, self.odometry.seconds, np.append(0.0, np.cumsum(steps)))
        return np.asarray(np.diff([times, path], axis=1)[:, 0].T)

    @cached_property
    def _times(self) -> FloatArray:
        """Times of both images, (2, n)."""
        return np.stack([self.before_s, self.after_s])

    def _pans(self, times: FloatArray) -> FloatArray:
        at = self.pan_clock.at(times)
        return np.asarray(self.pan_scale * np.interp(at, self.pan.seconds, self.pan.values[:, 0]))

    def _yaws(self) -> FloatArray:
        """Headings of the base at both images, (..., 2, n)."""
        if self.odometry is None:
            return np.zeros((2, len(self)))
        times = self.odometry_clock.at(self._times)
        yaws = np.interp(times, self.odometry.seconds, self.odometry.values[:, 2])
        return np.asarray(self.yaw_scale * yaws)

    def _levers(self) -> list[ComplexArray]:
        """Displacements (n,) of 1 m ahead of the base, and of the pan, by turns; see `_seen`."""
        base = self._yaws()
        look = base + self.ahead_rad + self._pans(self._times)
        return [self._seen(np.diff(np.exp(1j * angle), axis=0)[0]) for angle in (base, look)]

    def _seen(self, moved: ComplexArray) -> ComplexArray:
        """Displacements (n,) in the map, along the view + 1j to its left."""
        pan = self._pans(0.5 * self._times.sum(0))
        return np.asarray(moved * np.exp(-1j * (self._yaws().mean(0) + self.ahead_rad + pan)))


@dataclass(frozen=True, eq=False)
class Fit:
    """
    Coefficients (k,), their sigmas, the noise and the log-likelihood of a regression.

    `gain` (k, n) are the derivatives of the coefficients by the turns.
    """

    values: FloatArray
    sigmas: FloatArray
    gain: FloatArray
    noise_rad: float
    log_likelihood: float
    residuals_rad: FloatArray

    @property
    def quiet(self) -> bool:
        """Whether the residuals are noise of images."""
        away = np.abs(self.residuals_rad) > max(NOISE_RAD, _FAR_SIGMAS * self.noise_rad)
        return self.noise_rad < NOISE_RAD and bool(np.mean(away) < _MOST_AWAY)


def fit(turns: FloatArray, columns: FloatArray) -> Fit:
    """
    Regress turns (n,) on columns (n, k) with Student's t noise of unknown scale.

    Expectation maximisation; a column of zeros gets the coefficient 0 and an infinite sigma.
    """
    n, k = columns.shape
    seen = np.abs(columns).max(0, initial=0.0) > 1e-9
    used = columns[:, seen]
    values = np.zeros(used.shape[1])
    residuals = turns
    scale = max(float(np.median(np.abs(turns))), _LEAST_SIGMA_RAD)
    information = np.zeros((used.shape[1], used.shape[1]))
    for _ in range(_ITERATIONS):
        weights = (FREEDOM + 1.0) / (FREEDOM + (residuals / scale) ** 2)
        if used.shape[1]:
            information = used.T @ (weights[:, None] * used)
            ridge = 1e-9 * np.diag(np.diag(information) + 1e-12)
            values = np.linalg.solve(information + ridge, used.T @ (weights * turns))
            residuals = turns - used @ values
        new = max(float(np.sqrt(np.mean(weights * residuals**2))), _LEAST_SIGMA_RAD)
        if abs(new - scale) < 1e-6 * scale:
            scale = new
            break
        scale = new
    all_values, sigmas, gain = np.zeros(k), np.full(k, np.inf), np.zeros((k, n))
    all_values[seen] = values
    if used.shape[1]:
        # The ridge keeps what collinear columns leave open uncertain.
        spread = np.linalg.inv(information + ridge)
        sigmas[seen] = scale * np.sqrt(np.maximum(np.diag(spread), 0.0))
        gain[seen] = spread @ used.T * weights
    likelihood = -n * np.log(scale) - 0.5 * (FREEDOM + 1.0) * float(
        np.sum(np.log1p((residuals / scale) ** 2 / FREEDOM))
    )
    return Fit(all_values, sigmas, gain, scale, likelihood, residuals)


def explained(motion: Motion) -> Fit:
    """Fit the turns by joints and odometry as they are; only the parallax is free."""
    return fit(motion.unexplained(), motion.parallax())


class Estimate(NamedTuple):
    """A value and its sigma, which is infinite if the value is not observable."""

    value: float
    sigma: float

    def beyond(self, least: float, known: float) -> bool:
        """Whether it exceeds `least` by 3 sigma, and the sigma is less than `known`."""
        return self.sigma < known and abs(self.value) - 3.0 * self.sigma > least


@dataclass(frozen=True, eq=False)
class Linear:
    """
    Small errors of the values of a motion, estimated together.

    `pan_scale` and `yaw_scale` are relative errors, `pan_clock_s` and `odometry_clock_s` delays of
    the stamps; `nearness`, 1/m, `sideways`, `bias_rad_s` and `curve_rad_m` are those of the
    module's equation; `ahead_m` and `left_m` are displacements of the pan axis from its given
    position. Bias, curve and the two displacements are each estimated as if the other three were
    0. `straight` is the logarithm of a likelihood ratio: a correct heading of the camera on a
    robot that curves by `curved_rad_m`, over a wrong heading. `varied_per_m` is the sigma of
    `sideways` by things near by and far away that follow each other in view.
    """

    quiet: bool
    straight: float
    curved_rad_m: float
    varied_per_m: float
    pan_scale: Estimate
    yaw_scale: Estimate
    pan_clock_s: Estimate
    odometry_clock_s: Estimate
    nearness: Estimate
    sideways: Estimate
    bias_rad_s: Estimate
    curve_rad_m: Estimate
    ahead_m: Estimate
    left_m: Estimate

    @property
    def parallax(self) -> Estimate:
        """Size of the parallax in any direction, 1/m."""
        size = float(np.hypot(self.nearness.value, self.sideways.value))
        return Estimate(size, max(self.nearness.sigma, self.sideways.sigma))

    @property
    def heading_rad(self) -> Estimate:
        """Heading error of the camera relative to pan and mount, positive to the left."""
        turned = float(np.arctan2(-self.sideways.value, self.nearness.value))
        sigma = np.hypot(self.parallax.sigma, self.varied_per_m)
        return Estimate(turned, float(sigma) / max(self.parallax.value, 1e-9))

    @property
    def fits(self) -> bool:
        """Whether joints and odometry explain the images without any fault."""
        return self.quiet and not any(
            getattr(self, name).beyond(*bounds) for name, bounds in _ESTIMATED.items()
        )


def linear(motion: Motion) -> Linear:
    """Estimate small errors; the sigma of unobservable ones is infinite."""
    panned, yawed = motion.panned(), motion.yawed()

    early, late = (
        replace(
            motion,
            pan_clock=motion.pan_clock.later(step),
            odometry_clock=motion.odometry_clock.later(step),
        )
        for step in (-_STEP_S, _STEP_S)
    )
    pan_rate, yaw_rate = (
        (late.turned(name) - early.turned(name)) / (2.0 * _STEP_S) for name in (JOINTS, ODOMETRY)
    )
    base = np.stack([panned, yawed, pan_rate, yaw_rate, *motion.parallax().T], -1)
    left = motion.unexplained()
    found = fit(left, base)
    levers, near = motion.levers(), max(abs(found.values[4]), 1e-3)
    # Each view has a nearness of its own, which lasts while the camera sees the same things.
    view = np.unique(motion.before_s // _SAME_VIEW_S, return_inverse=True)[1]
    own = np.bincount(view, found.gain[5] * base[:, 4])
    varied = _NEARNESS_SPREAD * near * float(np.linalg.norm(own))
    # Errors of the levers are no part of the residuals.
    mounted = _LEVER_SIGMA_M * near * np.linalg.norm(found.gain @ levers, axis=1)
    pairs = zip(found.values.tolist(), np.hypot(found.sigmas, mounted).tolist(), strict=True)
    small = [Estimate(*pair) for pair in pairs]
    # One at a time: at constant speed, time and path are correlated, as are levers and distances.
    passed = motion.passed()
    for column in np.column_stack([passed, levers[:, :2]]).T:
        alone = fit(left, np.column_stack([base, column]))
        small.append(Estimate(float(alone.values[-1]), float(alone.sigmas[-1])))
    # Turns by a lever are proportional to the nearness.
    small[-2:] = (Estimate(*(float(v) / near for v in lever)) for lever in small[-2:])
    # With a constant pan, a curved path has the same effect as a wrong heading of the camera.
    curved = fit(left, np.column_stack([base[:, :-1], passed[:, 1]]))
    straight = curved.log_likelihood - found.log_likelihood
    return Linear(found.quiet, straight, float(curved.values[-1]), varied, *small)
