"""Checks of the streams of sweeps: faults that learning cannot estimate are errors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from landmark_nav.diagnosis.advice import camera_finding, cause_findings, motion_findings
from landmark_nav.diagnosis.causes import verdict
from landmark_nav.diagnosis.findings import Finding
from landmark_nav.diagnosis.looks import look_corrected, Looks
from landmark_nav.diagnosis.motion import linear, Motion, Track
from landmark_nav.diagnosis.parts import check_content, moved_between
from landmark_nav.diagnosis.stamps import check_stamps
from landmark_nav.diagnosis.streams import pan_stream, unwrapped
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.bags.sweeps import measured_pans

# Least number of pairs of images from which motion is judged.
_LEAST_PAIRS = 12
# Greatest factor of focal length or pan that calibration corrects in a sweep; its logarithm is the
# bound of angles, rad.
_CALIBRATED = 1.2
# Greatest distance, in images, of pairs that confirm a jump.
_WIDEST = 8
# Least pause between two sweeps, in intervals between two images.
_PAUSE = 5.0
_INFOS = ('sweep/camera_info', 'camera/camera_info')


def check_sweeps(bag: Bag, images: str, mount: PanTiltMount, most_images: int) -> list[Finding]:
    """Check the sweeps of a bag with at most `most_images` decoded images of a topic."""
    looks, error = look_corrected(bag, images, _INFOS, mount, most_images)
    found = []
    if error is not None:
        found, mount = [camera_finding(error)], error.setup.mount
        if abs(error.value) < np.log(_CALIBRATED):
            found = [replace(found[0], level='warning')]
    found += check_stamps(replace(looks.stream, name='sweep images'))
    found += [*looks.findings, *check_content(looks)]
    plans = [*measured_pans(bag, mount)]
    samples = sorted((sample.stamp_ns, sample.pan_rad) for plan in plans for sample in plan)
    if not plans or not all(plans) or bag.damaged or not bag.complete:
        samples = sorted(_jointed(bag, mount)) or samples
    if len(samples) < 2:
        return found
    stamps, pans = np.array(samples).T
    pan = Track.of(1e-9 * (stamps - bag.start_ns), mount.pan_sense * unwrapped(pans)[:, None])
    motion = _motion(looks, pan, 1)
    if len(motion) < _LEAST_PAIRS:
        return found
    slopes = linear(motion)
    if slopes.fits:
        found += moved_between(motion, partial(_wider, looks, pan))
    else:
        judged = verdict(motion)
        each = _each(motion) if judged.cause.kind == 'none' else []
        found += each or [_learned(finding) for finding in cause_findings(judged)]
        slopes = linear(judged.cause.motion)
    return [*found, *motion_findings(motion, slopes, None)[:1]]


def _each(motion: Motion) -> list[Finding]:
    """Find faults of single sweeps if no fault is common to all."""
    pauses = motion.before_s[1:] - motion.after_s[:-1]
    usual = float(np.median(motion.after_s - motion.before_s))
    begins = np.flatnonzero(pauses > _PAUSE * usual) + 1
    parts = np.split(np.arange(len(motion)), begins)
    found = []
    for k, part in enumerate(parts if len(parts) > 1 else (), start=1):
        sweep = motion.only(np.isin(np.arange(len(motion)), part))
        if len(part) < _LEAST_PAIRS or linear(sweep).fits:
            continue
        for finding in cause_findings(verdict(sweep)):
            found.append(replace(finding, measured=f'sweep {k}: {finding.measured}'))
    return found


def _motion(looks: Looks, pan: Track, apart: int) -> Motion:
    """Pan, and turn between images `apart` apart."""
    firsts = np.array([k for k in looks.strips if k + apart in looks.strips], dtype=np.intp)
    first, second = looks.stream.seconds[np.stack([firsts, firsts + apart])]
    turns = np.array([looks.compared(k, k + apart)[0] for k in firsts.tolist()])
    good = np.isfinite(turns) & (second > first)
    # The robot moves between sweeps.
    good &= second - first < 3.0 * float(np.median(second - first)) if len(first) else good
    return Motion(first[good], second[good], turns[good], pan, None)


def _wider(looks: Looks, pan: Track) -> Motion:
    """Pan, and turns between all images 2 to `_WIDEST` apart."""
    each = [_motion(looks, pan, apart) for apart in range(2, _WIDEST + 1)]
    pairs = [(m.before_s, m.after_s, m.turns_rad) for m in each]
    before, after, turns = np.concatenate(pairs, axis=1)
    return Motion(before, after, turns, pan, None)


def _jointed(bag: Bag, mount: PanTiltMount) -> Iterator[tuple[int, float]]:
    if bag.find('joint_states') or bag.find('tf'):
        pan = pan_stream(bag, mount)
        yield from zip(pan.stamps_ns.tolist(), pan.values[:, 0].tolist(), strict=True)


def _learned(finding: Finding) -> Finding:
    """Reduce the level of an error that learning calibrates itself to a warning."""
    scale = abs(finding.values.get('scale', np.inf))
    calibrated = finding.name != 'pan sign' and 1.0 / _CALIBRATED < scale < _CALIBRATED
    return replace(finding, level='warning') if calibrated else finding
