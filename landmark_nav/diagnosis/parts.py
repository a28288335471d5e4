"""Faults of parts of a recording: blank or repeated images, constant values, jumps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from landmark_nav.arrays import FloatArray, IndexArray
from landmark_nav.diagnosis.findings import Code, Finding, Level
from landmark_nav.diagnosis.looks import Looks
from landmark_nav.diagnosis.motion import explained, fit, LEAST_PAIRS, Motion, NOISE_RAD, Track
from landmark_nav.diagnosis.streams import JOINTS, ODOMETRY, Stream
from landmark_nav.matching.strips import CLEAR_SCORE, comparable

# Least texture of a strip, per pixel; normalised contrast is 1, a bare wall has less.
_BLANK = 0.02
# Relative contrast of fine details in images that are blurred by 3 of 512 pixels.
_BLURRED = 0.03
# Greatest sigma of grey levels of a covered part, over images between which the median change of
# the rest is at least the second value; least number of these: fewer may all show one wall.
_STAYS_GREY, _CHANGES_GREY, _LEAST_VIEWS = 3.0, 10.0, 6
# Least change of brightness between images that flicker, as a logarithm (a factor of 1.2).
_FLICKERS = 0.2
# Least share that is reported, and that of blank images which is an error.
_SOME, _MOST_BLANK = 0.1, 0.9
# A camera repeats one image if, in this share of the pairs, images turn by less than the first
# while the pan turns by more than the second; a single repeated image does not turn at all.
_STILL_RAD, _TURNING_RAD, _MOST_STILL = 1e-3, 0.03, 0.9
_SAME_RAD = 1e-7
# Share of the time between two images in which a value is constant; least number of such pairs.
_ALL, _STAYS_PAIRS = 0.99, 6
# Least turn in as many other pairs: otherwise the value is that of another joint.
_WORKS_RAD = 0.01
# Least residuals that are not noise.
_OFF_RAD, _OFF_SIGMAS = 0.02, 6.0
# Least repetitions of each value, share of the values that are repeated so often, and times of a
# constant value that are too long for localization.
_HELD, _MOST_EVEN, _HELD_S = 2.5, 0.9, 0.1
# Least share of unexplained turns that are at an end of the pan.
_MOST_LIMITED = 0.9
# Least jump; relative tolerance of the residual of the images that it causes.
_JUMP_RAD, _SAME_JUMP = 0.1, 0.25
# Tolerance of multiples of a step, as a share of it.
_WHOLE = 1e-3
# Images of another camera: least share of pairs that do not match though they should overlap by
# half, or whose residual exceeds any parallax.
_MOST_STRANGE, _SHARED, _STRANGE_RAD = 0.3, 0.5, 0.15
# Least difference of correlation scores of more and less similar images.
_ALIKE = 0.1


# A fault of a part, and the motion without that part.
Part = tuple[Finding, Motion]


def check_content(looks: Looks) -> Iterator[Finding]:
    """Find faults of the images themselves: blank, out of focus, covered, flickering."""
    strips = looks.strips.values()
    blank = [e[-1] < _BLANK * len(spectrum) * (len(e) - 1) for spectrum, e in strips]
    if blank and np.mean(blank) >= _SOME:
        level: Level = 'error' if np.mean(blank) > _MOST_BLANK else 'warning'
        yield Code.BLANK.at(level, blank=int(sum(blank)), tried=len(blank))
    sharp = [value for value in looks.sharpness.values() if value > 0.0]
    if len(sharp) >= LEAST_PAIRS and (usual := float(np.median(sharp))) < _BLURRED:
        yield Code.BLURRED.found(sharpness=usual)
    if len(looks.small) >= LEAST_PAIRS:
        yield from _covered(np.array(list(looks.small.values()), dtype=np.float64))
    light = {k: np.log(max(float(image.mean()), 1.0)) for k, image in looks.small.items()}
    # Second differences ignore a trend, as when the camera turns towards a window.
    firsts = [k for k in light if k + 1 in light and k + 2 in light]
    bends = [0.5 * abs(light[k] - 2.0 * light[k + 1] + light[k + 2]) for k in firsts]
    if len(bends) >= LEAST_PAIRS and (usual := float(np.median(bends))) >= _FLICKERS:
        yield Code.FLICKERING.found(factor=float(np.exp(usual)))


def _covered(small: FloatArray) -> Iterator[Finding]:
    """Find what stays the same in grey images (n, rows, columns) of different views."""
    x, y = np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in small.shape[:0:-1]))
    # The corners of a fisheye lens are always dark.
    inside = np.hypot(x, y) <= 1.0
    free = inside & (small.std(axis=0) >= _STAYS_GREY)
    if not free.any():
        return
    views = small[:1]
    for image in small[1:]:
        if (np.median(np.abs(views - image)[:, free], axis=1) > _CHANGES_GREY).all():
            views = np.append(views, image[None], axis=0)
    stays = inside & (views.std(axis=0) < _STAYS_GREY)
    share = float(stays.sum() / inside.sum())
    if share >= _SOME and len(views) >= _LEAST_VIEWS:
        right, down = x[stays].mean(), y[stays].mean()
        side = ('left', 'right') if abs(right) > abs(down) else ('above', 'below')
        where = side[int(max(right, down, key=abs) > 0.0)]
        level: Level = 'error' if share > _MOST_STRANGE else 'warning'
        yield Code.COVERED.at(level, where, share=share)


def repeated_images(motion: Motion) -> Part | None:
    """
    Find images that do not turn though the pan does; return the motion without, None if few.

    It is an error if the rest is too little to judge, as where each image comes twice.
    """
    turning, turns = np.abs(motion.panned()) > _TURNING_RAD, np.abs(motion.turns_rad)
    same = turns < _SAME_RAD
    still = turning & same
    # The first image after repeated ones has turned for longer.
    rest = motion.only(~(same | np.append(False, same[:-1])))
    code = Code.STILL
    if turning.sum() < LEAST_PAIRS:
        return None
    if np.mean(turns < _STILL_RAD) <= _MOST_STILL:
        if still.sum() < _SOME * turning.sum():
            return None
        code = Code.REPEATED if len(rest) < LEAST_PAIRS else Code.REPEATED_AT_TIMES
    return code.found(repeated=int(still.sum()), turning=int(turning.sum())), rest


def alternating_images(looks: Looks, motion: Motion) -> Finding | None:
    """Find images that resemble the one before the last, not the last; None if they are few."""
    if looks.view is None:
        return None
    pans = motion.pan.at(motion.pan_clock.at(looks.stream.seconds))[:, 0]
    alike = [
        [looks.compared(*pair)[1] for pair in ((k, k + 1), (k + 1, k + 2), (k, k + 2))]
        for k in looks.strips
        if k + 1 in looks.strips
        and k + 2 in looks.strips
        and np.ptp(pans[k : k + 3]) < 0.5 * _SHARED * looks.view.width_rad
    ]
    scores = np.array(alike).reshape(-1, 3)
    # Where no two images match, the scores are by chance.
    first, second, across = scores[(scores > CLEAR_SCORE).any(axis=1)].T
    odd = across > np.maximum(first, second) + _ALIKE
    if len(odd) < LEAST_PAIRS or odd.mean() < _MOST_STRANGE:
        return None
    return Code.ALTERNATING.found(odd=int(odd.sum()), images=len(odd))


def strange_images(looks: Looks, pairs: IndexArray, motion: Motion) -> Iterator[Finding]:
    """
    Find images that do not match the previous one though they overlap.

    `motion` has no other fault, the turns of `pairs` (n, 2), and NaN if images do not match.
    """
    if looks.view is None:
        return
    clear = [comparable(looks.strips[k], looks.strips[n]) for k, n in pairs.tolist()]
    motion = motion.only(np.array(clear, np.bool_))
    shared = np.abs(motion.panned() + motion.yawed()) < _SHARED * looks.view.width_rad
    matched = np.abs(motion.unexplained()) < _STRANGE_RAD
    count, strange = int(shared.sum()), int((shared & ~matched).sum())
    if count >= LEAST_PAIRS and strange >= _MOST_STRANGE * count:
        yield Code.STRANGE.found(strange=strange, pairs=count)


def frozen_values(motion: Motion) -> Part | None:
    """Find a stream that is constant at times while images turn; return the motion without."""
    left, sideways = motion.unexplained(), motion.parallax()
    for stream, what in ((JOINTS, 'the pan'), (ODOMETRY, 'its pose')):
        inside, by_stream = _unchanged(motion, stream) > _ALL, motion.turned(stream)
        works = np.abs(by_stream[~inside]) > _WORKS_RAD
        if min(inside.sum(), works.sum()) < _STAYS_PAIRS or (~inside).sum() < LEAST_PAIRS:
            continue
        rest = fit(left[~inside], sideways[~inside])
        off = np.abs(left - sideways @ rest.values) > max(_OFF_RAD, _OFF_SIGMAS * rest.noise_rad)
        off &= inside
        # A wrong scale of the other stream may explain these turns.
        others = np.column_stack([motion.turns_rad - left - by_stream, sideways])[inside]
        scaled = fit(left[inside], others).quiet and np.abs(others[:, 0]).max() > 0.0
        if rest.quiet and not scaled and off.sum() >= max(_STAYS_PAIRS, _SOME * inside.sum()):
            begin, end = float(motion.before_s[off].min()), float(motion.after_s[off].max())
            values = {'begin_s': begin, 'end_s': end, 'pairs': int(off.sum())}
            return Code.FROZEN.found(stream, what, **values), motion.only(~inside)
    return None


def limited_values(motion: Motion) -> Part | None:
    """Find a pan that stays at its extremes while images turn; return the motion without."""
    low, high = float(motion.pan.values.min()), float(motion.pan.values.max())
    left, others = motion.unexplained(), np.column_stack([motion.yawed(), motion.parallax()])
    ends = motion.pan.at(motion.pan_clock.at(np.stack([motion.before_s, motion.after_s])))[..., 0]
    at = ((ends == low) | (ends == high)).any(0) & (_unchanged(motion, JOINTS) > 0.0)
    off = np.abs(left) > _JUMP_RAD
    if high - low < _JUMP_RAD or (at & off).sum() < max(_STAYS_PAIRS, _MOST_LIMITED * off.sum()):
        return None
    if fit(left[at], others[at]).quiet:
        return None  # explained by a wrong scale of the yaw
    found = Code.PAN_LIMIT.found(low_rad=low, high_rad=high, pairs=int((at & off).sum()))
    return found, motion.only(~at)


def repeated_values(motion: Motion) -> Part | None:
    """Find a stream that repeats each value; return the motion without the repetitions."""
    for stream in (JOINTS, ODOMETRY):
        track, _ = motion.stream(stream)
        if track is None or len(track.seconds) < 3:
            continue
        changes = np.append(True, (np.diff(track.values, axis=0) != 0.0).any(1))
        times = track.seconds[changes]
        moves = np.abs(motion.unexplained() + motion.turned(stream)) > _TURNING_RAD
        # Values that are constant while the stream should turn.
        at = np.searchsorted(times, motion.before_s[moves], side='right') - 1
        at = np.unique(at[(at >= 0) & (at + 1 < len(times))])
        if len(at) < _STAYS_PAIRS:
            continue
        period, held_s = float(np.median(np.diff(track.seconds))), np.diff(times)[at]
        usual = float(np.median(held_s))
        even = np.mean(np.abs(held_s - usual) < 1.5 * period) >= _MOST_EVEN
        if usual < _HELD * period or not even:
            continue
        level: Level = 'error' if usual > _HELD_S else 'warning'
        rates = {'changes_hz': 1.0 / usual, 'messages_hz': 1.0 / period}
        once = Track(times, track.values[changes])
        rest = replace(motion, pan=once) if stream == JOINTS else replace(motion, odometry=once)
        return Code.HELD.at(level, stream, **rates), rest
    return None


def jumping_values(motion: Motion) -> Iterator[Finding]:
    """Find jumps of pan or yaw that images do not show; `motion` has no other fault."""
    left = explained(motion).residuals_rad
    levels: tuple[Level, Level] = ('error', 'warning')
    streams = zip((JOINTS, ODOMETRY), ('pan', 'odom yaw'), levels, strict=True)
    for stream, name, level in streams:
        track, clock = motion.stream(stream)
        if track is None:
            continue
        for k in _jumps(left):
            at_s = float(motion.before_s[k])
            span = clock.at(np.array([at_s, motion.after_s[k]]))
            first, last = np.searchsorted(track.seconds, span)
            inside = np.diff(track.values[max(first - 1, 0) : last + 1, -1])
            jump = float(inside[np.abs(inside).argmax()] - np.median(inside)) if len(inside) else 0
            if abs(left[k] + jump) <= _SAME_JUMP * abs(left[k]):
                yield Code.JUMP.at(level, name, jump_rad=jump, at_s=at_s)
                break


def moved_between(motion: Motion, wider: Callable[[], Motion]) -> Iterator[Finding]:
    """
    Find a jump of the camera in a sweep that consecutive images show and the pan does not.

    Consecutive images may be mistaken, as where somebody walks by; most of those farther apart,
    which `wider` returns, must show the jump too.
    """
    left = motion.unexplained()
    if not len(jumps := _jumps(left)):
        return
    wide = wider()
    across = wide.unexplained()
    for k in jumps:
        over = (wide.before_s <= motion.before_s[k]) & (wide.after_s >= motion.after_s[k])
        if over.any() and abs(np.median(across[over]) - left[k]) <= _SAME_JUMP * abs(left[k]):
            yield Code.PUSHED.found(turned_rad=float(left[k]), at_s=float(motion.before_s[k]))
            return


def _jumps(left: FloatArray) -> IndexArray:
    """Indices of turns (n,) that neither joints nor odometry explain, far beyond their noise."""
    noise = fit(left, np.empty((len(left), 0))).noise_rad
    return np.flatnonzero(np.abs(left) > max(_JUMP_RAD, _OFF_SIGMAS * noise))


def coarse_values(stream: Stream) -> Iterator[Finding]:
    """Find a resolution of pan or yaw that is coarser than that of the images."""
    name, column = ('pan', 0) if stream.name == JOINTS else ('odom yaw', 2)
    values = np.unique(np.round(stream.values[:, column], 9))
    step = float(np.diff(values).min()) if len(values) > 2 else 0.0
    if step >= NOISE_RAD and np.abs(values / step - np.round(values / step)).max() <= _WHOLE:
        yield Code.RESOLUTION.found(name, step_rad=step)


def _unchanged(motion: Motion, stream: str) -> FloatArray:
    """Share (n,) of the time between two images in which no value of a stream changes at all."""
    track, _ = motion.stream(stream)
    if track is None:
        return np.zeros(len(motion))
    same = (np.diff(track.values, axis=0) == 0.0).all(1)
    kept = np.append(0.0, np.cumsum(np.where(same, np.diff(track.seconds), 0.0)))
    before, after = np.interp(np.stack([motion.before_s, motion.after_s]), track.seconds, kept)
    return np.asarray((after - before) / (motion.after_s - motion.before_s))


# In the order in which they are looked for; the second are values that are judged only where they
# do not explain the images.
PARTS = (repeated_images, repeated_values, limited_values, frozen_values)
OF_VALUES = (repeated_values, limited_values)
