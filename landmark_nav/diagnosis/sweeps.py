"""Checks of the streams of sweeps: faults that learning cannot estimate are errors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from landmark_nav.diagnosis.advice import (
    camera_finding,
    cause_findings,
    motion_findings,
)
from landmark_nav.diagnosis.causes import verdict
from landmark_nav.diagnosis.findings import Finding
from landmark_nav.diagnosis.looks import camera_error_of, look, Looks
from landmark_nav.diagnosis.motion import linear, Motion, Track
from landmark_nav.diagnosis.parts import check_content, moved_between
from landmark_nav.diagnosis.stamps import check_stamps
from landmark_nav.diagnosis.streams import pan_stream, unwrapped
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.bags.reader import naming

# Least number of pairs of images from which motion is judged.
_LEAST_PAIRS = 12
# Greatest factor of focal length or pan that calibration corrects in a sweep; its logarithm is the
# bound of angles, rad.
_CALIBRATED = 1.2
# Least pause between two sweeps, in intervals between two images.
_PAUSE = 5.0


class SweepChecks:
    """Checks of the streams of sweeps."""

    def __init__(self, bag: Bag, images: str, mount: PanTiltMount) -> None:
        self._bag, self._images, self._mount = bag, images, mount

    def findings(self, most_images: int) -> list[Finding]:
        """Check with at most `most_images` decoded images."""
        infos = ('sweep/camera_info', 'camera/camera_info')
        looks = look(self._bag, self._images, infos, self._mount, most_images)
        of_camera = []
        if error := camera_error_of(self._bag, looks, self._mount):
            of_camera = [camera_finding(error)]
            if abs(error.value) < np.log(_CALIBRATED):
                of_camera = [replace(of_camera[0], level='warning')]
            self._mount = error.setup.mount
            looks = look(self._bag, self._images, infos, error.setup, most_images)
        stream = replace(looks.stream, name='sweep images')
        found = [*of_camera, *check_stamps(stream), *looks.findings, *check_content(looks)]
        motion = self._motion(looks, 1)
        if motion is None or len(motion) < _LEAST_PAIRS:
            return found
        slopes = linear(motion)
        if not slopes.fits:
            judged = verdict(motion)
            each = self._each(motion) if judged.cause.kind == 'none' else []
            found += each or [_learned(finding) for finding in cause_findings(judged)]
            slopes = linear(judged.cause.motion)
        elif (wide := self._motion(looks, 2)) is not None:
            found += moved_between(motion, wide)
        return [*found, *motion_findings(motion, slopes, None)[:1]]

    def _each(self, motion: Motion) -> list[Finding]:
        """Find faults of single sweeps if no fault is common to all."""
        pauses = motion.before_s[1:] - motion.after_s[:-1]
        usual = float(np.median(motion.after_s - motion.before_s))
        begins = np.flatnonzero(pauses > _PAUSE * usual) + 1
        parts = np.split(np.arange(len(motion)), begins)
        found = []
        for k, part in enumerate(parts if len(parts) > 1 else (), start=1):
            inside = np.isin(np.arange(len(motion)), part)
            if len(part) < _LEAST_PAIRS or linear(motion.only(inside)).fits:
                continue
            for finding in cause_findings(verdict(motion.only(inside))):
                found.append(replace(finding, measured=f'sweep {k}: {finding.measured}'))
        return found

    def _motion(self, looks: Looks, apart: int) -> Motion | None:
        """Pan and turn between images `apart` apart."""
        samples = [*self._planned()] or [*self._jointed()]
        if len(samples) < 2:
            return None
        stamps, pans = np.array(sorted(samples)).T
        seconds = 1e-9 * (stamps - self._bag.start_ns)
        firsts = np.array([k for k in looks.strips if k + apart in looks.strips], dtype=np.intp)
        first, second = looks.stream.seconds[np.stack([firsts, firsts + apart])]
        turns = np.array([looks.turn(int(k), int(k + apart)) for k in firsts])
        good = np.isfinite(turns) & (second > first)
        # The robot moves between sweeps.
        good &= second - first < 3.0 * float(np.median(second - first)) if len(first) else good
        pan = Track.of(seconds, self._mount.pan_sense * unwrapped(pans)[:, None])
        return Motion(first[good], second[good], turns[good], pan, None)

    def _planned(self) -> Iterator[tuple[int, float]]:
        topic = self._bag.find('sweep/trajectory')
        for entry in self._bag.messages([topic]) if topic else ():
            with naming(self._bag, topic or ''):
                for sample in decode.sweep_trajectory(entry.message, self._mount):
                    yield sample.stamp_ns, sample.pan_rad

    def _jointed(self) -> Iterator[tuple[int, float]]:
        if self._bag.find('joint_states'):
            pan = pan_stream(self._bag, self._mount)
            yield from zip(pan.stamps_ns.tolist(), pan.values[:, 0].tolist(), strict=True)


def _learned(finding: Finding) -> Finding:
    """Reduce the level of an error that learning calibrates itself to a warning."""
    scale = abs(finding.values.get('scale', np.inf))
    calibrated = finding.name != 'pan sign' and 1.0 / _CALIBRATED < scale < _CALIBRATED
    return replace(finding, level='warning') if calibrated else finding
