"""Faults of a part of a recording: images that show nothing or repeat, values that stay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from landmark_nav.arrays import FloatArray
from landmark_nav.diagnosis.causes import JOINTS, ODOMETRY
from landmark_nav.diagnosis.findings import Finding
from landmark_nav.diagnosis.looks import Looks
from landmark_nav.diagnosis.motion import fit, Motion, NOISE_RAD, Track
from landmark_nav.diagnosis.streams import Stream

# Texture of a strip per pixel, where evened contrast is 1: less is a wall, much less is nothing.
_BLANK = 0.02
# Contrast of fine details in images that are blurred by 3 pixels of 512.
_BLURRED = 0.03
# Grey levels by which a part of images that is covered, and one that is not, change; brightness
# that changes by a factor of 1.2 from one image to the next.
_STAYS_GREY, _CHANGES_GREY, _FLICKERS = 3.0, 10.0, 0.2
COVERED = 'images cover'
# A share of the images that is worth a word.
_SOME = 0.1
# Images that turn less, while the pan turns more, in most pairs, are one image; an image that is
# sent again does not turn at all.
_STILL_RAD, _TURNING_RAD, _MOST = 1e-3, 0.03, 0.9
_SAME_RAD = 1e-7
_LEAST_PAIRS = 12
# A value that stays all the time between two images, in so many pairs of them that turn.
_ALL, _STAYS_PAIRS = 0.99, 6
# It turned so far in as many pairs before, or after: else it is another joint's.
_WORKS_RAD = 0.01
# What is off by so much is no noise.
_OFF_RAD, _OFF_SIGMAS = 0.02, 6.0
# Values that each come more often than this; such a time is too long for localization.
_HELD, _HELD_S = 2.5, 0.1
# A jump that is no noise; what the images lack is as large, to this share.
_JUMP_RAD, _SAME_JUMP = 0.1, 0.25
# Values are whole multiples of a step to this share of it.
_WHOLE = 1e-3
# Images of another camera: of pairs that should share half of what they show, so many do not
# match, or are off by more than parallax may be.
_MOST_STRANGE, _SHARED, _STRANGE_RAD = 0.3, 0.5, 0.15
# By so much images are more alike, of 1.
_ALIKE = 0.1


def check_content(looks: Looks) -> list[Finding]:
    """What is wrong with images as such: blank, out of focus, covered, of unsteady exposure."""
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
    # A trend, as of a camera that turns to a window, is none.
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
    """Images that do not turn though the pan does; None where they do."""
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
    """Images that are like the one before the last, not like the last; None where they are few."""
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
    Images that do not show what the one before shows, though they should; None where they are few.

    `motion` is right, with turns of NaN where images do not match; images are `width_rad` wide.
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
    """A stream whose values stay now and then though the images turn, and the motion without."""
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
        # What turns then may be another stream that is off by a scale.
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
    """A pan that stays at its least or greatest value though images turn; the motion without."""
    low, high = motion.pan.values.min(), motion.pan.values.max()
    left, parallax = motion.turns_rad - motion.panned() - motion.yawed(), motion.parallax()
    ends = motion.pan.at(motion.pan_clock.at(np.stack([motion.before_s, motion.after_s])))[..., 0]
    at = ((ends == low) | (ends == high)).any(0) & (_unchanged(motion.pan, motion) > 0.0)
    off = np.abs(left) > _JUMP_RAD
    if high - low < _JUMP_RAD or (at & off).sum() < max(_STAYS_PAIRS, _MOST * off.sum()):
        return None
    if fit(left[at], np.column_stack([motion.yawed(), parallax])[at]).quiet:
        return None  # a yaw of another scale
    finding = Finding(
        'pan limit',
        'error',
        f'the images turn on where the pan stays at {low:.2f} or {high:.2f} rad',
        'publish what the joint does beyond: its driver cuts values off there',
        {'low_rad': float(low), 'high_rad': float(high), 'pairs': int((at & off).sum())},
    )
    return finding, motion.only(~at)


def held_values(motion: Motion) -> tuple[Finding, Motion] | None:
    """A stream that sends each of its values several times, and the motion by these once each."""
    turned = motion.turns_rad - motion.panned() - motion.yawed()
    for stream, track in ((JOINTS, motion.pan), (ODOMETRY, motion.odometry)):
        if track is None or len(track.seconds) < 3:
            continue
        by_stream = motion.panned() if stream == JOINTS else motion.yawed()
        changes = np.append(True, (np.diff(track.values, axis=0) != 0.0).any(1))
        times = track.seconds[changes]
        moves = np.abs(turned + by_stream) > _TURNING_RAD
        # Values that hold while the stream should turn.
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
    """Jumps of pan or yaw in which the images do not turn; `motion` is right but for these."""
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
    Jumps of the camera in a sweep that the pan does not show, seen by images next to each other.

    Images farther apart, in `wide`, show them as well; those next to each other may be mistaken.
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
    """Pan or yaw in steps that are coarser than what images show; None where it is fine."""
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
