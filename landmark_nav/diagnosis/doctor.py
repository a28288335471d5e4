"""All checks of a bag of a drive or of sweeps, and of the papers in its sweeps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from landmark_nav.calibration import Calibration
from landmark_nav.diagnosis.advice import camera_finding, cause_findings, motion_findings
from landmark_nav.diagnosis.causes import verdict
from landmark_nav.diagnosis.drives import DriveChecks, THOROUGH
from landmark_nav.diagnosis.findings import Code, Delays, Diagnosis, Finding
from landmark_nav.diagnosis.looks import look_corrected, Looks
from landmark_nav.diagnosis.motion import LEAST_PAIRS, linear, Motion, Track
from landmark_nav.diagnosis.parts import check_content, moved_between
from landmark_nav.diagnosis.streams import (
    check_recording,
    check_stamps,
    pan_stream,
    read_stream,
    unwrapped,
)
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.sweep_pipeline import panorama_from_sweep
from landmark_nav.storage.bags import Bag, read_sweeps
from landmark_nav.storage.bags.definitions import DRIVE_IMAGES, SWEEP_IMAGES
from landmark_nav.storage.bags.sweeps import measured_pans

# Number of images that `learn` and `evaluate` decode at their start.
QUICK = 60
# Greatest factor of focal length or pan that calibration corrects in a sweep; its logarithm is the
# bound of angles, rad.
_CALIBRATED = 1.2
# Greatest distance, in images, of pairs that confirm a jump.
_WIDEST = 8
# Least pause between two sweeps, in intervals between two images.
_PAUSE = 5.0
_INFOS = ('sweep/camera_info', 'camera/camera_info')


def check_sweeps(bag: Bag, images: str, known: Calibration, most_images: int) -> list[Finding]:
    """Check the sweeps of a bag with at most `most_images` decoded images of a topic."""
    looks, error = look_corrected(bag, images, _INFOS, known, most_images)
    found, mount = list[Finding](), known.mount
    if error is not None:
        found, mount = [camera_finding(error)], error.setup.mount
        if abs(error.value) < np.log(_CALIBRATED):
            found = [replace(found[0], level='warning')]
    found += check_stamps(replace(looks.stream, name='sweep images'))
    found += [*looks.findings, *check_content(looks)]
    samples = sorted(_pans(bag, mount))
    if len(samples) < 2:
        return found
    stamps, pans = np.array(samples).T
    sense = mount.pan_sense * (1.0 + known['pan_scale'][0])
    pan = Track.of(1e-9 * (stamps - bag.start_ns), sense * unwrapped(pans)[:, None])
    motion = _motion(looks, pan, 1)
    if len(motion) < LEAST_PAIRS:
        return found
    slopes = linear(motion)
    if slopes.fits:
        found += moved_between(motion, partial(_motion, looks, pan, *range(2, _WIDEST + 1)))
    else:
        cause = verdict(motion)
        each = [*_each(motion)] if cause.kind == 'none' else []
        found += each or [_learned(finding) for finding in cause_findings(cause)]
        slopes = linear(cause.motion)
    return [*found, *motion_findings(motion, slopes, None)[:1]]


def _each(motion: Motion) -> Iterator[Finding]:
    """Find faults of single sweeps if no fault is common to all."""
    pauses = motion.before_s[1:] - motion.after_s[:-1]
    usual = float(np.median(motion.after_s - motion.before_s))
    begins = np.flatnonzero(pauses > _PAUSE * usual) + 1
    parts = np.split(np.arange(len(motion)), begins)
    for k, part in enumerate(parts if len(parts) > 1 else (), start=1):
        sweep = motion.only(part)
        if len(part) >= LEAST_PAIRS and not linear(sweep).fits:
            for finding in cause_findings(verdict(sweep)):
                yield replace(finding, measured=f'sweep {k}: {finding.measured}')


def _motion(looks: Looks, pan: Track, *apart: int) -> Motion:
    """Pan, and turns between images that are `apart` apart."""
    pairs = []
    for step in apart:
        first, second, turns = looks.turns(looks.pairs(step))
        good = np.isfinite(turns) & (second > first)
        # The robot moves between sweeps.
        good &= second - first < 3.0 * float(np.median(second - first)) if len(first) else good
        pairs.append((first[good], second[good], turns[good]))
    before, after, turned = np.concatenate(pairs, axis=1)
    return Motion(before, after, turned, pan, None)


def _pans(bag: Bag, mount: PanTiltMount) -> list[tuple[int, float]]:
    """Stamps and pans of the trajectories, or of the joint states if trajectories are lost."""
    plans = [*measured_pans(bag, mount)]
    found = [(sample.stamp_ns, sample.pan_rad) for plan in plans for sample in plan]
    lost = not plans or not all(plans) or bag.damaged or not bag.complete
    if lost and bag.find('joint_states', 'tf'):
        pan = pan_stream(bag, mount)
        jointed = zip(pan.stamps_ns.tolist(), pan.values[:, 0].tolist(), strict=True)
        found = list(jointed) or found
    return found


def _learned(finding: Finding) -> Finding:
    """Reduce the level of an error that learning calibrates itself to a warning."""
    scale = abs(finding.values.get('scale', np.inf))
    calibrated = finding.name != 'pan sign' and 1.0 / _CALIBRATED < scale < _CALIBRATED
    return replace(finding, level='warning') if calibrated else finding


def diagnose(
    bag: Bag, known: Calibration, room: Room | None = None, most_images: int = THOROUGH
) -> Diagnosis:
    """
    Check the streams of a bag of a drive, or of sweeps, of a robot as it is `known`.

    The size of a `room` determines the unit of the odometry more exactly. `most_images` are
    decoded, more if these show a fault. Raises `LandmarkNavError`: the bag cannot be read at all.
    """
    # Warnings of the readers become findings.
    described: dict[str, None] = {}
    bag = bag.warning_to(lambda text: described.update({text: None}))
    if (disorder := check_recording(bag.stamps_ns)) is not None:
        return Diagnosis((disorder,))
    found, delays = list[Finding](), Delays()
    images, sweeps = bag.find(*DRIVE_IMAGES), bag.find(*SWEEP_IMAGES)
    if images:
        diagnosis = DriveChecks(bag, images, known, room).diagnosis(most_images)
        found, delays = [*diagnosis.findings], diagnosis.delays
    elif bag.find('detections'):
        for name in ('detections', 'odom'):
            if topic := bag.find(name):
                found += check_stamps(read_stream(bag, name, topic))
    if sweeps:
        checked = check_sweeps(bag, sweeps, known, most_images)
        if most_images < THOROUGH and any(finding.level == 'error' for finding in checked):
            checked = check_sweeps(bag, sweeps, known, THOROUGH)
        found += checked
    if not found:
        bag.require(*DRIVE_IMAGES, *SWEEP_IMAGES)
    lines = [text.replace(f'{bag.path}: ', '') for text in described]
    found += [Code.READING.found(line) for line in lines]
    return Diagnosis(tuple(found), delays)


def check_papers(bag: Bag, known: Calibration, room: Room) -> list[Finding]:
    """Locate each sweep of a bag, if any, by the papers or markers of a room, as `learn` does."""
    found: list[Finding] = []
    if not bag.find(*SWEEP_IMAGES):
        return found
    sweeps = read_sweeps(bag, known.mount)
    while True:
        name = f'{"papers" if room.papers else "markers"}, sweep {len(found) + 1}'
        try:
            if (sweep := next(sweeps, None)) is None:
                return found
            axis = panorama_from_sweep(sweep, room, known).axis
        except LandmarkNavError as error:
            text = str(error).removeprefix(f'{bag.path}: ')
            found.append(Code.NOT_PLACED.found(name, text))
            continue
        x, y, heading = axis.pose.tolist()
        sigma_m = float(np.sqrt(np.trace(axis.covariance[:2, :2])))
        words = name, x, y, np.degrees(heading), 1e3 * sigma_m
        found.append(Code.PLACED.found(*words, pose=[x, y, heading], sigma_m=sigma_m))
