"""Faults of parts of a recording: blank or repeated images, constant values, jumps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from landmark_nav.arrays import FloatArray
from landmark_nav.diagnosis.causes import JOINTS, ODOMETRY
from landmark_nav.diagnosis.findings import Finding
from landmark_nav.diagnosis.looks import Looks
from landmark_nav.diagnosis.motion import fit, Motion, NOISE_RAD, Track
from landmark_nav.diagnosis.streams import Stream

# Least texture of a strip, per pixel; normalised contrast is 1, a bare wall has less.
_BLANK = 0.02
# Relative contrast of fine details in images that are blurred by 3 of 512 pixels.
_BLURRED = 0.03
# Sigmas of grey levels over time: greatest of a covered part, least of a free one. Least change of
# brightness between images that flicker, as a logarithm (a factor of 1.2).
_STAYS_GREY, _CHANGES_GREY, _FLICKERS = 3.0, 10.0, 0.2
COVERED = 'images cover'
# Least share that is reported.
_SOME = 0.1
# A camera repeats one image if, in this share of the pairs, images turn by less than the first
# while the pan turns by more than the second; a single repeated image does not turn at all.
_STILL_RAD, _TURNING_RAD, _MOST = 1e-3, 0.03, 0.9
_SAME_RAD = 1e-7
_LEAST_PAIRS = 12
# Share of the time between two images in which a value is constant; least number of such pairs.
_ALL, _STAYS_PAIRS = 0.99, 6
# Least turn in as many other pairs: otherwise the value is that of another joint.
_WORKS_RAD = 0.01
# Least residuals that are not noise.
_OFF_RAD, _OFF_SIGMAS = 0.02, 6.0
# Least repetitions of each value; times of a constant value that are too long for localization.
_HELD, _HELD_S = 2.5, 0.1
# Least jump; relative tolerance of the residual of the images that it causes.
_JUMP_RAD, _SAME_JUMP = 0.1, 0.25
# Tolerance of multiples of a step, as a share of it.
_WHOLE = 1e-3
# Images of another camera: least share of pairs that do not match though they should overlap by
# half, or whose residual exceeds any parallax.
_MOST_STRANGE, _SHARED, _STRANGE_RAD = 0.3, 0.5, 0.15
# Least difference of correlation scores of more and less similar images.
_ALIKE = 0.1


def check_content(looks: Looks) -> list[Finding]:
    """Find faults of the images themselves: blank, out of focus, covered, flickering."""
    checks = (_blank_images, _blurred_images, _covered_images, _flickering_images)
    return [found for check in checks if (found := check(looks)) is not None]


def _blurred_images(looks: Looks) -> Finding | None:
    sharp = [value for value in looks.sharpness.values() if value > 0.0]
    usual = float(np.median(sharp)) if len(sharp) >= _LEAST_PAIRS else _BLURRED
    if usual >= _BLURRED:
        return None
    return Finding(
        'images sharpness',
        'warning',
        f'fine details have {100.0 * usual:.1f} % of the contrast of coarse ones: out of focus',
        'focus the lens, clean it; expose for a shorter time if the camera moves',
        {'sharpness': usual},
    )


def _covered_images(looks: Looks) -> Finding | None:
    small = np.array(list(looks.small.values()), dtype=np.float64)
    if len(small) < _LEAST_PAIRS:
        return None
    spread = small.std(axis=0)
    rows, columns = (np.linspace(-1.0, 1.0, n) for n in spread.shape)
    # The corners of a fisheye lens are always dark.
    inside = np.hypot(*np.meshgrid(columns, rows)) <= 1.0
    stays = inside & (spread < _STAYS_GREY)
    share = float(stays.sum() / inside.sum())
    changing = spread[inside & ~stays]
    if share < _SOME or not len(changing) or np.median(changing) < _CHANGES_GREY:
        return None
    x, y = (float(np.mean(values[stays])) for values in np.meshgrid(columns, rows))
    side = ('right' if x > 0.0 else 'left') if abs(x) > abs(y) else ('below' if y > 0 else 'above')
    return Finding(
        COVERED,
        'error' if share > _MOST_STRANGE else 'warning',
        f'{100.0 * share:.0f} % of each image stay the same, most on the side {side}: covered, '
        'or no image of the camera',
        'free the lens; no part of the robot, no text and no frame belongs into the image',
        {'share': share},
    )


def _flickering_images(looks: Looks) -> Finding | None:
    small = looks.small
    light = [
        np.log([max(float(small[k + n].mean()), 1.0) for n in range(3)])
        for k in small
        if k + 1 in small and k + 2 in small
    ]
    # Second differences ignore a trend, as when the camera turns towards a window.
    bends = np.abs(np.diff(light, 2)) / 2.0 if light else np.empty(0)
    usual = float(np.median(bends)) if len(bends) >= _LEAST_PAIRS else 0.0
    if usual < _FLICKERS:
        return None
    return Finding(
        'images exposure',
        'warning',
        f'the brightness changes by a factor of {np.exp(usual):.1f} from image to image',
        'fix exposure and gain, or bind them to the mains (50 or 60 Hz): light or camera flicker',
        {'factor': float(np.exp(usual))},
    )


def _blank_images(looks: Looks) -> Finding | None:
    blank = [energy[-1] < _BLANK * _pixels(looks) for _, energy in looks.strips.values()]
    share = float(np.mean(blank)) if blank else 0.0
    if share < _SOME:
        return None
    return Finding(
        'images content',
        'error' if share > _MOST else 'warning',
        f'{sum(blank)} of {len(blank)} show next to nothing: dark, white or covered',
        'look at exposure, lens cap and light; localization goes by odometry there',
        {'blank': int(sum(blank)), 'tried': len(blank)},
    )


def _pixels(looks: Looks) -> int:
    spectrum, energy = next(iter(looks.strips.values()))
    return len(spectrum) * (len(energy) - 1)


def repeated_images(motion: Motion) -> Finding | None:
    """Find images that do not turn though the pan does; None if there are few."""
    turning, turns = np.abs(motion.panned()) > _TURNING_RAD, np.abs(motion.turns_rad)
    if turning.sum() < _LEAST_PAIRS:
        return None
    if np.mean(turns < _STILL_RAD) > _MOST:
        return Finding(
            'images motion',
            'error',
            'images stay the same while joint_states turn',
            'the camera repeats an image, or the pan does not move: look at both drivers',
        )
    still = turning & (turns < _SAME_RAD)
    if still.sum() < _SOME * turning.sum():
        return None
    return Finding(
        'images motion',
        'error',
        f'{still.sum()} of {turning.sum()} images repeat the one before while the camera turns',
        'its driver stamps one image twice: publish each image once',
        {'repeated': int(still.sum()), 'turning': int(turning.sum())},
    )


def alternating_images(looks: Looks, motion: Motion) -> Finding | None:
    """Find images that resemble the one before the last, not the last; None if they are few."""
    if looks.view is None:
        return None
    seconds = looks.stream.seconds
    pans = motion.pan_scale * motion.pan.at(motion.pan_clock.at(seconds))[:, 0]
    alike = []
    for k in looks.strips:
        near = np.ptp(pans[k : k + 3]) < 0.5 * _SHARED * looks.view.width_rad
        if k + 1 in looks.strips and k + 2 in looks.strips and near:
            pairs = ((k, k + 1), (k + 1, k + 2), (k, k + 2))
            alike.append([looks.compared(*pair)[1] for pair in pairs])
    first, second, across = np.array(alike).reshape(-1, 3).T
    odd = across > np.maximum(first, second) + _ALIKE
    if len(odd) < _LEAST_PAIRS or odd.mean() < _MOST_STRANGE:
        return None
    return Finding(
        'images content',
        'error',
        f'{odd.sum()} of {len(odd)} images are like the one before the last, not like the last',
        'two cameras, or two settings of one, come in turns: stop one, or remap it',
        {'odd': int(odd.sum()), 'images': len(odd)},
    )


def strange_images(motion: Motion, width_rad: float) -> Finding | None:
    """
    Find images that do not match the previous one though they overlap; None if they are few.

    `motion` has no other fault, and turns of NaN if images do not match; images are `width_rad`
    wide.
    """
    expected = motion.panned() + motion.yawed()
    shared = np.abs(expected) < _SHARED * width_rad
    matched = np.abs(motion.turns_rad - expected) < _STRANGE_RAD
    pairs, strange = int(shared.sum()), int((shared & ~matched).sum())
    if pairs < _LEAST_PAIRS or strange < _MOST_STRANGE * pairs:
        return None
    return Finding(
        'images content',
        'warning',
        f'{strange} of {pairs} images show other things than the one before',
        'see that no second camera publishes there, and that they come in order',
        {'strange': strange, 'pairs': pairs},
    )


def staying_values(motion: Motion) -> tuple[Finding, Motion] | None:
    """Find a stream that is constant at times while images turn; return the motion without."""
    for stream, track in ((JOINTS, motion.pan), (ODOMETRY, motion.odometry)):
        if track is None:
            continue
        inside = _unchanged(track, motion) > _ALL
        left, sideways = motion.turns_rad - motion.panned() - motion.yawed(), motion.parallax()
        by_stream = motion.panned() if stream == JOINTS else motion.yawed()
        works = np.abs(by_stream[~inside]) > _WORKS_RAD
        if min(inside.sum(), works.sum()) < _STAYS_PAIRS or (~inside).sum() < _LEAST_PAIRS:
            continue
        rest = fit(left[~inside], sideways[~inside])
        away = np.abs(left - sideways @ rest.values)[inside]
        off = away > max(_OFF_RAD, _OFF_SIGMAS * rest.noise_rad)
        # A wrong scale of the other stream may explain these turns.
        others = np.column_stack([motion.panned() + motion.yawed() - by_stream, sideways])
        scaled = fit(left[inside], others[inside]).quiet and np.abs(others[:, 0]).max() > 0.0
        if rest.quiet and not scaled and off.sum() >= max(_STAYS_PAIRS, _SOME * inside.sum()):
            what = 'the pan' if stream == JOINTS else 'its pose'
            begin, end = motion.before_s[inside][off].min(), motion.after_s[inside][off].max()
            finding = Finding(
                f'{stream} values',
                'error',
                f'{what} stays as it is in {off.sum()} pairs of images that turn, from '
                f'{begin:.1f} to {end:.1f} s',
                'look at its driver: it hangs and repeats its last value, or is at its limit',
                {'begin_s': float(begin), 'end_s': float(end), 'pairs': int(off.sum())},
            )
            return finding, motion.only(~inside)
    return None


def limited_values(motion: Motion) -> tuple[Finding, Motion] | None:
    """Find a pan that stays at its extremes while images turn; return the motion without."""
    low, high = motion.pan.values.min(), motion.pan.values.max()
    left, parallax = motion.turns_rad - motion.panned() - motion.yawed(), motion.parallax()
    ends = motion.pan.at(motion.pan_clock.at(np.stack([motion.before_s, motion.after_s])))[..., 0]
    at = ((ends == low) | (ends == high)).any(0) & (_unchanged(motion.pan, motion) > 0.0)
    off = np.abs(left) > _JUMP_RAD
    if high - low < _JUMP_RAD or (at & off).sum() < max(_STAYS_PAIRS, _MOST * off.sum()):
        return None
    if fit(left[at], np.column_stack([motion.yawed(), parallax])[at]).quiet:
        return None  # explained by a wrong scale of the yaw
    finding = Finding(
        'pan limit',
        'error',
        f'the images turn on where the pan stays at {low:.2f} or {high:.2f} rad',
        'publish what the joint does beyond: its driver cuts values off there',
        {'low_rad': float(low), 'high_rad': float(high), 'pairs': int((at & off).sum())},
    )
    return finding, motion.only(~at)


def held_values(motion: Motion) -> tuple[Finding, Motion] | None:
    """Find a stream that repeats each value; return the motion without the repetitions."""
    turned = motion.turns_rad - motion.panned() - motion.yawed()
    for stream, track in ((JOINTS, motion.pan), (ODOMETRY, motion.odometry)):
        if track is None or len(track.seconds) < 3:
            continue
        by_stream = motion.panned() if stream == JOINTS else motion.yawed()
        changes = np.append(True, (np.diff(track.values, axis=0) != 0.0).any(1))
        times = track.seconds[changes]
        moves = np.abs(turned + by_stream) > _TURNING_RAD
        # Values that are constant while the stream should turn.
        at = np.searchsorted(times, motion.before_s[moves], side='right') - 1
        at = np.unique(at[(at >= 0) & (at + 1 < len(times))])
        if len(at) < _STAYS_PAIRS:
            continue
        period, held_s = float(np.median(np.diff(track.seconds))), np.diff(times)[at]
        usual = float(np.median(held_s))
        if usual < _HELD * period or np.mean(np.abs(held_s - usual) < 1.5 * period) < _MOST:
            continue
        once = Track(times, track.values[changes])
        finding = Finding(
            f'{stream} rate',
            'error' if usual > _HELD_S else 'warning',
            f'values change {1.0 / usual:.1f} times a second, messages come {1.0 / period:.0f} '
            'times: each is repeated',
            'publish each measurement once, with the time at which it was taken',
            {'changes_hz': 1.0 / usual, 'messages_hz': 1.0 / period},
        )
        part = {'pan': once} if stream == JOINTS else {'odometry': once}
        return finding, replace(motion, **part)  # type: ignore[arg-type]
    return None


def jumping_values(motion: Motion) -> list[Finding]:
    """Find jumps of pan or yaw that images do not show; `motion` has no other fault."""
    left = motion.turns_rad - motion.panned() - motion.yawed()
    left = fit(left, motion.parallax()).residuals_rad
    noise = fit(left, np.empty((len(left), 0))).noise_rad
    found = []
    for stream, track, column in ((JOINTS, motion.pan, 0), (ODOMETRY, motion.odometry, 2)):
        if track is None:
            continue
        clock = motion.pan_clock if stream == JOINTS else motion.odometry_clock
        steps = np.diff(track.values[:, column])
        for k in np.flatnonzero(np.abs(left) > max(_JUMP_RAD, _OFF_SIGMAS * noise)):
            span = np.array([motion.before_s[k], motion.after_s[k]])
            first, last = np.searchsorted(track.seconds, clock.at(span))
            inside = steps[max(first - 1, 0) : last]
            if not len(inside):
                continue
            jump = float(inside[np.abs(inside).argmax()] - np.median(inside))
            if abs(left[k] + jump) > _SAME_JUMP * abs(left[k]):
                continue
            name = 'pan' if stream == JOINTS else 'odom yaw'
            found.append(
                Finding(
                    f'{name} jumps',
                    'error' if stream == JOINTS else 'warning',
                    f'it jumps by {np.degrees(jump):.0f} deg at {motion.before_s[k]:.1f} s, the '
                    'images do not',
                    'its zero is another one since: see why it slips or was set anew',
                    {'jump_rad': jump, 'at_s': float(motion.before_s[k])},
                )
            )
            break
    return found


def moved_between(motion: Motion, wide: Motion) -> list[Finding]:
    """
    Find jumps of the camera in a sweep that consecutive images show and the pan does not.

    A turn of consecutive images may be an outlier; images farther apart, in `wide`, confirm it.
    """
    left, across = (m.turns_rad - m.panned() for m in (motion, wide))
    noise = fit(left, np.empty((len(left), 0))).noise_rad
    for k in np.flatnonzero(np.abs(left) > max(_JUMP_RAD, _OFF_SIGMAS * noise)):
        over = (wide.before_s <= motion.before_s[k]) & (wide.after_s >= motion.after_s[k])
        if not over.any() or np.abs(across[over] - left[k]).max() > _SAME_JUMP * abs(left[k]):
            continue
        turned = float(np.degrees(left[k]))
        return [
            Finding(
                'sweep motion',
                'error',
                f'at {motion.before_s[k]:.1f} s the images turn {abs(turned):.0f} deg farther to '
                f'the {"left" if turned > 0.0 else "right"} than the pan',
                'the base was turned, or the pan slipped: let the robot stand, sweep again',
                {'turned_rad': float(left[k]), 'at_s': float(motion.before_s[k])},
            )
        ]
    return []


def coarse_values(stream: Stream) -> Finding | None:
    """Find a resolution of pan or yaw that is coarser than that of the images; None if fine."""
    name, column = ('pan', 0) if stream.name == JOINTS else ('odom yaw', 2)
    values = np.unique(np.round(stream.values[:, column], 9))
    step = float(np.diff(values).min()) if len(values) > 2 else 0.0
    if step < NOISE_RAD or np.abs(values / step - np.round(values / step)).max() > _WHOLE:
        return None
    return Finding(
        f'{name} resolution',
        'error',
        f'comes in steps of {np.degrees(step):.2g} deg',
        'publish what the encoder measures, as it is: no rounding, no few set points',
        {'step_rad': step},
    )


def _unchanged(track: Track, motion: Motion) -> FloatArray:
    """Share (n,) of the time between two images in which no value changes at all."""
    same = (np.diff(track.values, axis=0) == 0.0).all(1)
    kept = np.append(0.0, np.cumsum(np.where(same, np.diff(track.seconds), 0.0)))
    before, after = np.interp(np.stack([motion.before_s, motion.after_s]), track.seconds, kept)
    return np.asarray((after - before) / (motion.after_s - motion.before_s))
