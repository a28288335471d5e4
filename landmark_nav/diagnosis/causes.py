"""
The single fault that explains the residuals: without it, all streams agree.

Each candidate removes one fault from the streams, with the value that fits best. Candidates are
compared by the Bayesian information criterion (Schwarz, Annals of Statistics 6(2), 1978).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.optimize import minimize

from landmark_nav.arrays import FloatArray
from landmark_nav.diagnosis.motion import (
    ALIKE,
    CERTAIN,
    Clock,
    driven_again,
    Estimate,
    explained,
    Fit,
    fit,
    FREEDOM,
    linear,
    Motion,
    MOUNT,
    Track,
)
from landmark_nav.diagnosis.streams import IMAGES, JOINTS, ODOMETRY

# Scales that are tried: reversed sign, gears, degrees, no motion.
_SCALES = (-1.0, 0.5, 2.0, -0.5, -2.0, np.pi / 180.0, -np.pi / 180.0, 180.0 / np.pi, 0.0)
# Greatest factor between the true and the given focal length.
_LENS = 3.0
# Drifts that are tried, as shares.
_DRIFTS = np.arange(-0.1, 0.1001, 0.0025)
# Steps of the near and the far search of clock offsets, range of the far one, and near offsets.
_NEAR_STEP_S, _FAR_STEP_S, _FAR_S = 0.02, 0.05, 120.0
_NEAR = np.arange(-3.0, 3.0, _NEAR_STEP_S)
# Drifts with a smaller effect over the recording are regarded as offsets.
_LEAST_DRIFT_S = 0.05
CLOCKS = ('clock', 'clocks', 'drift', 'step')
# Least drift: a clock at less than a tenth of its rate would explain a scale.
_SLOWEST = -0.9
# Logarithms of how much rarer faults are than others: a clock with an offset is likelier than one
# with two parameters, and the joints are late more often than the images.
_RARE = {
    **{
        (stream, kind): ALIKE
        for stream in (JOINTS, ODOMETRY, IMAGES)
        for kind in ('drift', 'step')
    },
    (IMAGES, 'clock'): ALIKE,
    (JOINTS, 'filter'): ALIKE,
    (ODOMETRY, 'clocks'): 2.0 * ALIKE,
}
# Offset of the clock of odometry up to which it is usual.
_USUAL_S = 0.03
# Greatest sigma with which an offset is refined.
_POLISH_S = 0.02
# Least share of the image pairs at whose times the other streams have messages.
_LEAST_COVERED = 0.3
# Number of image pairs in the coarse search, and their noise.
_PAIRS = 160
_FIRST_NOISE_RAD = 0.01
# Sigma of the angle between path and heading, and time of a step.
_ALONG_RAD, _STEP_S = 0.1, 0.2
# Prior sigmas of the pan axis from the base, and of the optical centre from the pan axis.
_AXIS_M, _OFFSET_M = 0.3, 0.1
# Grid of the coarse search of one parameter, as shares of its range.
_GRID = np.linspace(-1.0, 1.0, 21)


@dataclass(frozen=True, eq=False)
class Cause:
    """
    A fault of a stream (``images``, ``joint_states``, ``odom``) or of the ``pan_axis``.

    Kinds are ``none``, ``scale``, ``clock``, ``clocks`` (of joints and odometry, each its own),
    ``drift``, ``step``, ``joint``, ``speed``, ``filter`` and ``heading`` (of the pan), ``twist``,
    ``bias`` and ``curve`` (of odometry), ``ahead``, ``left``, ``offset`` and ``upside down`` (of
    the mount).

    `motion` is without it; `left` is the regression of its residuals, `score` the log-likelihood
    less the cost of its parameters. `value` is a scale, the offset by which the clock is ahead of
    the others, s, the drift as a share, a step, s, or the error of other kinds; `offset_s` is the
    offset of a drifting clock, the time of a step, or that of the joints of two clocks; `name` is
    that of a joint; `rivals` are as likely.
    """

    stream: str
    kind: str
    motion: Motion
    left: Fit = field(repr=False)
    score: float
    value: float = 0.0
    name: str = ''
    offset_s: float = 0.0
    rivals: tuple[Cause, ...] = ()

    @property
    def fits(self) -> bool:
        """Whether the residuals are noise."""
        return linear(self.motion).quiet

    @property
    def late(self) -> dict[str, Estimate]:
        """Constant offsets of the clocks that are off, s, by stream."""
        if self.kind not in ('clock', 'clocks'):
            return {}
        late_s = {self.stream: self.value}
        late_s |= {JOINTS: self.offset_s} if self.kind == 'clocks' else {}
        found = linear(self.motion)
        known = {ODOMETRY: found.odometry_clock_s}
        return {
            name: Estimate(late, known.get(name, found.pan_clock_s).sigma)
            for name, late in late_s.items()
        }


def verdict(
    motion: Motion,
    joints: Mapping[str, Track] | None = None,
    by_twist: Track | None = None,
    offsets: Mapping[str, Sequence[float]] | None = None,
) -> Cause:
    """
    Find the likeliest single fault, of kind ``none`` if there is none or none is certain.

    `joints` are other joints that could be the pan, `by_twist` is odometry integrated from its
    twists, and `offsets` are start values of the clocks of streams, s, by stamps and times of
    recording.
    """
    none = _cause(IMAGES, 'none', motion, 0)
    found = [none]
    for name, track in (joints or {}).items():
        found.append(_cause(JOINTS, 'joint', replace(motion, pan=track), 1, name=name))
    if by_twist is not None:
        found.append(_cause(ODOMETRY, 'twist', replace(motion, odometry=by_twist), 1))
    found += [*_others(motion), *_scales(motion), *_clocks(motion, offsets or {})]
    top = max(found, key=lambda cause: cause.score)
    alike = [cause for cause in found if cause.score > top.score - ALIKE]
    best = none
    if top.score > none.score + CERTAIN:
        best = max(
            found, key=lambda cause: cause.score - _RARE.get((cause.stream, cause.kind), 0.0)
        )
    if best.kind == 'clocks' and abs(best.value) < _USUAL_S:
        # The odometry is as usual: the joints are late.
        best = next(c for c in found if (c.stream, c.kind) == (JOINTS, 'clock'))
    best = best if best.fits else none
    best = _polished(best)
    # Faults of one clock are not different ones.
    fault = best.stream, best.kind in CLOCKS
    # Nor are two, one of which is off by nothing, another one than the other.
    no_rival = {'none', 'clocks' if best.kind == 'clock' else ''}
    rivals = [c for c in alike if c.kind not in no_rival and (c.stream, c.kind in CLOCKS) != fault]
    return replace(best, rivals=() if best.kind == 'none' else tuple(rivals))


def late_odometry(motion: Motion, hints: Sequence[float]) -> float:
    """Delay of the stamps of odometry, s: another than given only if it is certain."""
    now, now_s = _cause(ODOMETRY, 'none', motion, 1), motion.odometry_clock.offset_s
    found = _polished(_offset(motion, ODOMETRY, _best_offset(motion, ODOMETRY, hints)))
    return found.value if found.score > now.score + CERTAIN else now_s


def _polished(cause: Cause) -> Cause:
    """Refine the offset of each clock that is off, together with small errors of the scales."""
    for _ in range(2 if cause.kind in ('clock', 'clocks') else 0):
        motion, slopes = cause.motion, linear(cause.motion)
        pan, odometry = (
            clock.later(more.value if more.sigma < _POLISH_S else 0.0)
            for clock, more in (
                (motion.pan_clock, slopes.pan_clock_s),
                (motion.odometry_clock, slopes.odometry_clock_s),
            )
        )
        if cause.kind == 'clocks':
            cause = _two_clocks(motion, pan, odometry)
        else:
            cause = _clocked(motion, cause.stream, odometry if cause.stream == ODOMETRY else pan)
    return cause


def _cause(
    stream: str, kind: str, motion: Motion, parameters: int, value: float = 0.0, **more: Any
) -> Cause:
    left = explained(motion)
    score = left.log_likelihood - 0.5 * parameters * np.log(max(len(motion), 2))
    score += _along(motion)
    score -= 0.5 * float(np.sum(np.square(motion.axis_xy) / _AXIS_M**2))
    score -= 0.5 * float(np.sum(np.square(motion.offset_xy) / _OFFSET_M**2))
    return Cause(stream, kind, motion, left, float(score), value, **more)


def _along(motion: Motion) -> float:
    """Log-likelihood of the path by the heading, up to a constant."""
    # A robot drives along its heading, or at a constant angle to it, forwards and backwards.
    if motion.odometry is None:
        return 0.0
    begin, end = motion.odometry.seconds[[0, -1]]
    x, y, yaw = motion.odometry.at(np.linspace(begin, end, max(int((end - begin) / _STEP_S), 2))).T
    step = np.diff(x + 1j * y)
    far = np.abs(step) > 0.2 * float(np.quantile(np.abs(step), 0.9))
    aside = step[far] * np.exp(-0.5j * motion.yaw_scale * (yaw[1:] + yaw[:-1]))[far]
    doubled = (aside / np.maximum(np.abs(aside), 1e-12)) ** 2
    off = 0.5 * np.angle(doubled * np.conj(doubled.sum()))
    return -0.5 * (FREEDOM + 1.0) * float(np.sum(np.log1p((off / _ALONG_RAD) ** 2 / FREEDOM)))


def _likeliest(make: Callable[..., Cause], first: Sequence[float], *steps: float) -> Cause:
    """Find the cause with the likeliest values near the first ones."""
    start = np.array(first)
    simplex = start + np.vstack([np.zeros(len(start)), np.diag(steps)])
    enough = {'initial_simplex': simplex, 'xatol': 1e-4, 'fatol': 1e-2, 'maxfev': 120}
    best = minimize(lambda x: -make(*x).score, start, method='Nelder-Mead', options=enough)
    return make(*best.x.tolist())


def _others(motion: Motion) -> Iterator[Cause]:
    """Yield faults of another quantity instead of the pan, and errors of a single number."""
    pan, odometry = motion.pan, motion.odometry
    steps = np.diff(pan.seconds, prepend=pan.seconds[0])[:, None]
    summed = replace(pan, values=np.cumsum(pan.values * steps, axis=0))
    yield _cause(JOINTS, 'speed', replace(motion, pan=summed), 1)
    if odometry is None:
        return
    yaw = odometry.at(pan.seconds)[:, 2:]
    yield _cause(JOINTS, 'heading', replace(motion, pan=replace(pan, values=pan.values - yaw)), 1)
    # With a camera upside down, the images turn in the opposite direction.
    hanging = replace(motion, turns_rad=-motion.turns_rad, pan=replace(pan, values=-pan.values))
    yield _cause(MOUNT, 'upside down', hanging, 1 if motion.hangs else 3)
    rate = np.gradient(pan.values[:, 0], pan.seconds)[:, None] if len(pan.seconds) > 1 else 0.0
    (x, y), (ahead, left) = motion.axis_xy, motion.offset_xy

    def again(**change: float) -> Motion:
        return replace(motion, odometry=driven_again(odometry, **change))

    def tried(stream: str, kind: str, reach: float, change: Callable[[float], Motion]) -> Cause:
        def make(value: float) -> Cause:
            return _cause(stream, kind, change(float(value)), 1, float(value))

        first = max(map(make, reach * _GRID), key=lambda cause: cause.score)
        return _likeliest(make, [first.value], 0.05 * reach)

    # The pan before a filter of the first order.
    filtered = 1.0, lambda v: replace(motion, pan=replace(pan, values=pan.values + v * rate))
    yield tried(JOINTS, 'filter', *filtered)
    yield tried(ODOMETRY, 'bias', 1.0, lambda v: again(bias_rad_s=v))
    yield tried(ODOMETRY, 'curve', 3.0, lambda v: again(curve_rad_m=v))
    yield tried(MOUNT, 'ahead', 2.0, lambda v: replace(motion, axis_xy=(x + v, y)))
    yield tried(MOUNT, 'left', 2.0, lambda v: replace(motion, axis_xy=(x, y + v)))
    yield tried(MOUNT, 'offset', 1.0, lambda v: replace(motion, offset_xy=(ahead + v, left)))


def _scales(motion: Motion) -> Iterator[Cause]:
    """Yield wrong scales and signs of pan, of yaw, and of both, which is that of the lens."""
    panned, yawed, turns = motion.panned(), motion.yawed(), motion.turns_rad
    odometry, parallax = motion.odometry, motion.parallax()
    for stream, factor, rest in (
        (JOINTS, panned, turns - yawed),
        (ODOMETRY, yawed, turns - panned),
        (IMAGES, panned + yawed, turns),
    ):
        # Without odometry, the scale of the lens is that of the pan.
        if np.abs(factor).max(initial=0.0) < 1e-6 or (odometry is None and stream != JOINTS):
            continue
        least = float((factor @ rest) / (factor @ factor))
        # Very different units, such as ticks, show only in the magnitudes.
        ratio = float(np.median(np.abs(rest)) / max(np.median(np.abs(factor)), 1e-12))
        tried = np.array([*_SCALES, least, ratio, -ratio])
        left = (rest - tried[:, None] * factor) / _FIRST_NOISE_RAD
        scale = float(tried[np.argmin(np.log1p(left**2).sum(1))])
        for _ in range(3):
            near = fit(rest - scale * factor, np.column_stack([factor, parallax]))
            scale += float(near.values[0])
        if stream == JOINTS:
            yield _cause(stream, 'scale', replace(motion, pan_scale=scale), 1, scale)
        elif stream == ODOMETRY and odometry is not None:
            yield _cause(stream, 'scale', replace(motion, yaw_scale=scale), 1, scale)
            # The path may have been integrated with the wrong yaw.
            for value in (scale, float(np.sign(scale))):
                track = driven_again(odometry, yaw_scale=value)
                yield _cause(stream, 'scale', replace(motion, odometry=track), 1, value)
        elif 1.0 / _LENS < abs(scale) < _LENS:
            # Another lens, or a mirror image; larger factors are not from the camera.
            cause = _cause(stream, 'scale', replace(motion, turns_rad=turns / scale), 1, scale)
            # The likelihood refers to the measured turns, as for all others.
            yield replace(cause, score=cause.score - len(motion) * float(np.log(abs(scale))))


def _clocks(motion: Motion, hints: Mapping[str, Sequence[float]]) -> Iterator[Cause]:
    few = motion.only(np.linspace(0, len(motion) - 1, min(_PAIRS, len(motion))).astype(np.intp))
    begin, middle = float(motion.before_s.min()), float(np.mean(motion.before_s))
    span = max(float(np.ptp(motion.before_s)), 1.0)
    for stream in (JOINTS, ODOMETRY, IMAGES):
        if motion.odometry is None and stream != JOINTS:
            continue
        hinted = hints.get(stream, ())
        offset = _offset(motion, stream, _best_offset(few, stream, hinted))
        starts = {0.0, *hinted}
        grid = [(Clock(s, d, begin), _NEAR[::7]) for d in _DRIFTS for s in starts]
        first = _best_of(few, stream, grid)

        def drifted(offset_s: float, drift: float, of: str = stream, at: Clock = first) -> Cause:
            return _clocked(motion, of, replace(at, offset_s=offset_s, drift=drift))

        drift = _likeliest(drifted, [first.offset_s, first.drift], 0.1, 0.1 / span)
        if abs(drift.value) * span < _LEAST_DRIFT_S:
            _, clock = drift.motion.stream(ODOMETRY if stream == ODOMETRY else JOINTS)
            drift = _offset(motion, stream, Clock(float(clock.at(np.array(middle))) - middle))
        for found in (offset, drift):
            # Implausible: the clock hardly runs, or other streams have no messages at these times.
            streams = (JOINTS, ODOMETRY)
            runs = all(found.motion.stream(name)[1].drift > _SLOWEST for name in streams)
            if runs and min(map(found.motion.covered, streams)) > _LEAST_COVERED:
                yield found
                if found.kind == 'clock' and stream == JOINTS and motion.odometry is not None:
                    # Joints are often a little late; that must not hide a fault of odometry.
                    yield _both(motion, few, found.motion.pan_clock, hints.get(ODOMETRY, ()))
        yield _step(motion, stream)


def _both(motion: Motion, few: Motion, pan: Clock, hinted: Sequence[float]) -> Cause:
    """Find the likeliest clocks of joints and odometry, from the one of the joints."""
    odometry = _best_offset(replace(few, pan_clock=pan), ODOMETRY, hinted)
    return _likeliest(
        lambda a, b: _two_clocks(motion, pan.later(a), odometry.later(b)), [0.0, 0.0], 0.05, 0.05
    )


def _two_clocks(motion: Motion, pan: Clock, odometry: Clock) -> Cause:
    changed = replace(motion, pan_clock=pan, odometry_clock=odometry)
    value, offset_s = odometry.offset_s, pan.offset_s
    return _cause(ODOMETRY, 'clocks', changed, 2, value, offset_s=offset_s)


def _clocked(motion: Motion, stream: str, clock: Clock) -> Cause:
    """Return the cause that a stream has a clock; late images are the others that are early."""
    sign = -1.0 if stream == IMAGES else 1.0
    changed = _with_clock(motion, stream, clock)
    if clock.step_s:
        value = sign * clock.step_s
        return _cause(stream, 'step', changed, 2, value, offset_s=clock.step_at_s)
    offset_s = sign * clock.offset_s
    if clock.drift:
        return _cause(stream, 'drift', changed, 2, sign * clock.drift, offset_s=offset_s)
    return _cause(stream, 'clock', changed, 1, offset_s, offset_s=offset_s)


def _with_clock(motion: Motion, stream: str, clock: Clock) -> Motion:
    if stream != ODOMETRY:
        motion = replace(motion, pan_clock=clock)
    return motion if stream == JOINTS else replace(motion, odometry_clock=clock)


def _misfit(motion: Motion, stream: str, clocks: Clock) -> FloatArray:
    """Robust (Cauchy) misfit of each pair with several clocks, (m, n)."""
    left = _with_clock(motion, stream, clocks).unexplained()
    return np.asarray(np.log1p((left / _FIRST_NOISE_RAD) ** 2))


def _best_offset(motion: Motion, stream: str, hinted: Sequence[float]) -> Clock:
    """Return the best offset of a coarse search around the hints and around no offset."""
    reach = min(float(motion.after_s.max() - motion.before_s.min()), _FAR_S)
    far = np.arange(-reach, reach, _FAR_STEP_S)
    offsets = [*map(Clock, hinted), Clock()]
    grids = [(clock, _NEAR) for clock in offsets]
    return _best_of(motion, stream, [*grids, (offsets[0], far), (Clock(), far)])


def _best_of(motion: Motion, stream: str, grids: list[tuple[Clock, FloatArray]]) -> Clock:
    """Clock with the least misfit, of clocks with grids of offsets on top of them."""
    least, found = np.inf, Clock()
    for base, grid in grids:
        misfit = _misfit(motion, stream, base.later(grid[:, None, None])).sum(1)
        # Of equally good offsets, take the smallest.
        best = int(np.argmin(misfit + 1e-6 * np.abs(grid)))
        if misfit[best] < least:
            least, found = float(misfit[best]), base.later(float(grid[best]))
    return found


def _offset(motion: Motion, stream: str, first: Clock) -> Cause:
    """Find the likeliest clock with another offset than `first`, within two steps of it."""

    def make(later_s: float) -> Cause:
        near_s = float(np.clip(later_s, -2.0 * _FAR_STEP_S, 2.0 * _FAR_STEP_S))
        return _clocked(motion, stream, first.later(near_s))

    return _likeliest(make, [0.0], _FAR_STEP_S)


def _step(motion: Motion, stream: str) -> Cause:
    """Find the likeliest clock that is off by a constant before, or after, some moment."""
    order = np.argsort(motion.before_s)
    each = _misfit(motion, stream, Clock(_NEAR[:, None, None]))[:, order]
    right = each[np.abs(_NEAR).argmin()]
    # Sums over the pairs before each pair, and from each pair on.
    off_before = np.cumsum(each, axis=1) - each
    off_after = each.sum(1)[:, None] - off_before
    right_before = np.cumsum(right) - right
    right_after = right.sum() - right_before
    becomes, was = right_before + off_after, off_before + right_after
    late = becomes.min() < was.min()
    offset, at = np.unravel_index(int((becomes if late else was).argmin()), becomes.shape)
    moment = float(motion.before_s[order][at])

    def make(step_s: float) -> Cause:
        clock = Clock(0.0 if late else step_s, 0.0, 0.0, step_s if late else -step_s, moment)
        return _clocked(motion, stream, clock)

    return _likeliest(make, [float(_NEAR[offset])], _NEAR_STEP_S)
