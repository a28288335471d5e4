"""Faults of a part of a recording: images that show nothing or repeat, values that stay."""

from __future__ import annotations

import numpy as np

from landmark_nav.arrays import BoolArray
from landmark_nav.diagnosis.causes import JOINTS, ODOMETRY
from landmark_nav.diagnosis.findings import Finding
from landmark_nav.diagnosis.looks import Looks
from landmark_nav.diagnosis.motion import fit, Motion, NOISE_RAD, Track
from landmark_nav.diagnosis.streams import Stream

__all__ = ['blank_images', 'coarse_values', 'repeated_images', 'staying_values', 'strange_images']

# Texture of a strip per pixel, where evened contrast is 1: less is a wall, much less is nothing.
_BLANK = 0.02
# A share of the images that is worth a word.
_SOME = 0.1
# Images that turn less, while the pan turns more, in most pairs, are one image; an image that is
# sent again does not turn at all.
_STILL_RAD, _TURNING_RAD, _MOST = 1e-3, 0.03, 0.9
_SAME_RAD = 1e-7
_LEAST_PAIRS = 12
# A value that stays so long, and in so many pairs of images that turn otherwise.
_STAYS_S, _STAYS_PAIRS = 2.0, 6
# It turned so far in as many pairs before, or after: else it is another joint's.
_WORKS_RAD = 0.01
# What is off by so much is no noise.
_OFF_RAD, _OFF_SIGMAS = 0.02, 6.0
# Values are whole multiples of a step to this share of it.
_WHOLE = 1e-3
# Images of another camera: of pairs that should share half of what they show, so many do not
# match, or are off by more than parallax may be.
_MOST_STRANGE, _SHARED, _STRANGE_RAD = 0.3, 0.5, 0.15


def blank_images(looks: Looks) -> Finding | None:
    """Images that show next to nothing; None where they are few."""
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
    """A stream whose values stay for a while though the images turn, and the motion without."""
    for stream, track in ((JOINTS, motion.pan), (ODOMETRY, motion.odometry)):
        if track is None or (run := _longest_stay(track)) is None:
            continue
        begin, end = run
        inside: BoolArray = (motion.before_s > begin) & (motion.after_s < end)
        left, sideways = motion.turns_rad - motion.panned() - motion.yawed(), motion.parallax()
        by_stream = motion.panned() if stream == JOINTS else motion.yawed()
        works = np.abs(by_stream[~inside]) > _WORKS_RAD
        if min(inside.sum(), works.sum()) < _STAYS_PAIRS or (~inside).sum() < _LEAST_PAIRS:
            continue
        rest = fit(left[~inside], sideways[~inside])
        away = np.abs(left - sideways @ rest.values)[inside]
        off = away > max(_OFF_RAD, _OFF_SIGMAS * rest.noise_rad)
        if rest.quiet and off.sum() >= max(_STAYS_PAIRS, _SOME * inside.sum()):
            what = 'the pan' if stream == JOINTS else 'its pose'
            finding = Finding(
                f'{stream} values',
                'error',
                f'{what} stays as it is from {begin:.1f} to {end:.1f} s while the images turn',
                'look at its driver: an encoder or a source that hangs repeats its last value',
                {'begin_s': begin, 'end_s': end},
            )
            return finding, motion.only(~inside)
    return None


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


def _longest_stay(track: Track) -> tuple[float, float] | None:
    """Begin and end, seconds, of the longest time in which no value changes at all."""
    same = (np.diff(track.values, axis=0) == 0.0).all(1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(np.int8), [0]])))
    if not len(edges):
        return None
    begins, ends = track.seconds[edges[::2]], track.seconds[edges[1::2]]
    longest = int(np.argmax(ends - begins))
    if ends[longest] - begins[longest] < _STAYS_S:
        return None
    return float(begins[longest]), float(ends[longest])
