"""Checks of the streams of a drive: each separately, then all against the motion of images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from landmark_nav.arrays import FloatArray, IndexArray
from landmark_nav.calibration import Calibration
from landmark_nav.diagnosis import advice, parts
from landmark_nav.diagnosis.causes import late_odometry, verdict
from landmark_nav.diagnosis.findings import Code, Delays, Diagnosis, Finding
from landmark_nav.diagnosis.looks import look, look_corrected, Looks
from landmark_nav.diagnosis.motion import Clock, LEAST_PAIRS, Linear, linear, Motion, Track
from landmark_nav.diagnosis.odometry import check_jumps, check_path, check_speed, check_twist
from landmark_nav.diagnosis.streams import (
    by_arrival,
    check_stamps,
    clock_hints,
    IMAGES,
    in_step,
    JOINTS,
    lone_steps,
    longest_part,
    ODOMETRY,
    one_source,
    pan_stream,
    read_joints,
    read_stream,
    Stream,
    unwrapped,
)
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.walls import Room
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag

# Number of images that are decoded if fewer show a fault.
THOROUGH = 600
# Share of the images in the time of a stream below which its clock is a different one.
_COVERED = 0.1
# Least offset of a clock that times of recording show.
_BY_LOG_S = 0.5
# Least sigma of delays measured by the motion of images.
_LEAST_SIGMA_S = 1e-3
# Findings that follow from a constant pose, and from a wrong path or heading.
_OF_POSE = 'odom twist'
_OF_PATH = ('odom twist, forward', 'camera heading', 'odom unit')
# Least share of the images at whose times there is ground truth, and its least delay.
_ENOUGH, _TRUTH_S = 0.8, 0.05
# Greatest sigma of an offset by motion; above it, times of recording are used.
_KNOWN_S = 0.1
_INFOS = ('camera/camera_info',)
# Columns of odometry that are angles.
_YAW = np.array([False, False, True])

# Findings, delays, and whether joints and odometry explain the motion of the images.
_Judged = tuple[list[Finding], Delays, bool]


class DriveChecks:
    """Checks of the streams of a drive, each of which is read once."""

    def __init__(self, bag: Bag, images: str, known: Calibration, room: Room | None) -> None:
        self._bag, self._images, self._known, self._room = bag, images, known, room
        self._mount = known.mount

    def diagnosis(self, most_images: int) -> Diagnosis:
        """Check with `most_images` decoded images; with more if these show a fault."""
        source = self._bag, self._images, _INFOS, self._known
        looks, error = look_corrected(*source, most_images)
        # All other checks use the corrected setup.
        setup = error.setup if error else None
        self._mount = setup.mount if setup else self._mount
        of_camera = [advice.camera_finding(error)] if error else []
        found, delays, healthy = self._judged(looks)
        if not healthy and len(looks.strips) < min(len(looks.stream), THOROUGH):
            found, delays, _ = self._judged(look(*source, THOROUGH, setup))
        said = {finding.name for finding in of_camera}
        return Diagnosis((*of_camera, *(f for f in found if f.name not in said)), delays)

    @cached_property
    def _joints(self) -> dict[str, Stream]:
        """Streams of all joints, by name."""
        topic = self._bag.find(JOINTS)
        return read_joints(self._bag, topic) if topic else {}

    @cached_property
    def _pan(self) -> tuple[Stream | None, list[Finding]]:
        """Stream of the pan as it is read from the bag, and findings of the joints."""
        names, name = ', '.join(self._joints), self._mount.pan_joint
        found = [Code.JOINT_NAMES.found(names or name)]
        try:
            pan = pan_stream(self._bag, self._mount)
        except LandmarkNavError as error:
            if name not in self._joints:
                described = str(error).removeprefix(f'{self._bag.path}: ')
                unread = Code.NO_JOINT.found(described)
                return None, [Code.OTHER_NAMES.found(names, name) if names else unread]
            # The reader refuses its values; later checks find out why.
            pan, found = self._joints[name], []
        pan, second = one_source(pan, np.array([True]))
        return pan, [*found, *check_stamps(pan), *second]

    @cached_property
    def _odometry(self) -> tuple[Stream | None, list[Finding]]:
        """Odometry, and what its own values show."""
        if (topic := self._bag.find(ODOMETRY)) is None:
            return None, [Code.NO_ODOMETRY.found()]
        stream, second = one_source(read_stream(self._bag, ODOMETRY, topic, _odometry_of), _YAW)
        found = [*check_stamps(stream), *second]
        if len(stream) > 1:
            found += [check_speed(stream), *check_twist(stream)]
            found += [] if second else check_jumps(stream)
        return stream, found

    def _frames(self, images: Stream) -> list[Finding]:
        """Check the frames of odometry and images."""
        if (odometry := self._odometry[0]) is None:
            return []
        base = self._mount.base_frame
        children = {frame.partition(' -> ')[2].rpartition('/')[2] for frame in odometry.frames}
        other = children - {'', base.rpartition('/')[2], 'base_footprint', 'base_link'}
        code = Code.FRAMES_OTHER if other else Code.FRAMES
        code = Code.FRAMES_SEVERAL if len(odometry.frames) > 1 else code
        return [code.found(', '.join(odometry.frames), ', '.join(images.frames), base)]

    def _judged(self, looks: Looks) -> _Judged:
        content = [*parts.check_content(looks)]
        (pan, of_pan), (odometry, of_odometry) = self._pan, self._odometry
        found = [*check_stamps(looks.stream), *looks.findings, *content]
        found += [*of_pan, *of_odometry, *self._frames(looks.stream)]
        streams = [stream for stream in (pan, odometry) if stream is not None]
        usable = all(len(s) > 1 and s.stamps_ns.any() for s in (looks.stream, *streams))
        # A constant part of the images prevents the measurement of turns.
        covered = any(f.name == Code.COVERED.check and f.level == 'error' for f in content)
        if pan is None or covered or not usable:
            return found, Delays(), True
        looks = replace(looks, stream=by_arrival(looks.stream))
        streams = [by_arrival(stream) for stream in streams]
        streams[1:] = map(self._by_images, streams[1:])
        return self._against_images(looks, streams, found)

    def _by_images(self, stream: Stream) -> Stream:
        """Return odometry or truth by the clock of the images, as far as it is known."""
        late_ns = round(1e9 * self._mount.image_delay_s)
        return replace(stream, stamps_ns=stream.stamps_ns + late_ns)

    def _against_images(
        self, looks: Looks, streams: Sequence[Stream], found: list[Finding]
    ) -> _Judged:
        for step_s, at_s in lone_steps(looks.stream, streams):
            if abs(step_s) > advice.CORRECTED_S:
                found.append(advice.step_finding(IMAGES, step_s, at_s))
        first, last = longest_part(looks.stream)
        streams = [in_step(stream.logged_within(first, last)) for stream in streams]
        images = looks.stream.logged_within(first, last)
        if any(len(stream) < 2 for stream in (images, *streams)):
            return found, Delays(), True
        hints = clock_hints(images, dict(zip((JOINTS, ODOMETRY), streams, strict=False)))
        chosen = looks.pairs()
        logged, stamps_s = looks.stream.logged_ns[chosen], looks.stream.seconds[chosen]
        within = ((logged >= first) & (logged <= last)).all(1)
        chosen = chosen[within & (stamps_s[:, 1] > stamps_s[:, 0])]
        pairs = self._motion(looks, chosen, streams)
        if (mixed := parts.alternating_images(looks, pairs)) is not None:
            return [*found, mixed], Delays(), True
        motion = pairs.only(np.isfinite(pairs.turns_rad))
        if len(motion) < LEAST_PAIRS:
            found.append(Code.FEW_PAIRS.found(len(motion)))
            return [*found, *_clocks_by_log(motion, hints, None)], Delays(), True
        frozen = False
        for part in parts.PARTS:
            # A pan that stops for each image repeats its values, too, but explains the images.
            if part in parts.OF_VALUES and linear(motion).quiet:
                continue
            if (odd := part(motion)) is None:
                continue
            finding, motion = odd
            found.append(finding)
            still = part == parts.repeated_images and finding.level == 'error'
            if still or len(motion) < LEAST_PAIRS:
                return found, Delays(), False
            if part == parts.frozen_values:
                frozen = True
                odometry = finding.name.startswith(ODOMETRY)
                found = _without(found, _OF_POSE) if odometry else found
        slopes, follows = linear(motion), list[str]()
        if streams[1:] and (path := check_path(streams[1])) is not None:
            mended = replace(motion, odometry=_odometry_track(streams[1], path[1]))
            fitting, most = linear(mended), advice.HEADING_ERROR_RAD
            if fitting.fits and not fitting.heading_rad.beyond(most, most):
                motion, slopes, follows = mended, fitting, [*_OF_PATH]
                found.insert(0, path[0])
        if not slopes.fits:
            return self._caused(images, streams, motion, hints, found)
        jumps = list(parts.jumping_values(motion))
        if any(f.name == 'odom jumps' for f in found):
            jumps = _without(jumps, ODOMETRY)
        found += [*advice.motion_findings(motion, slopes, self._room), *jumps]
        found += _clocks_by_log(motion, hints, slopes)
        if not follows and not frozen:
            strange = parts.strange_images(looks, chosen, pairs)
            found += [f for f in strange if f.name not in {each.name for each in found}]
        found += self._truth(images, motion, Clock())
        return _without(found, *follows), Delays(), True

    def _caused(
        self,
        images: Stream,
        streams: Sequence[Stream],
        motion: Motion,
        hints: Mapping[str, Sequence[float]],
        found: list[Finding],
    ) -> _Judged:
        """Find the cause why joints and odometry do not explain the motion of the images."""
        others = {
            name: Track.of(stream.seconds, self._mount.pan_sense * _angles(stream))
            for name, stream in self._joints.items()
            if name != self._mount.pan_joint and len(stream) > 1
        }
        cause = verdict(motion, others, _by_twist(streams[1]) if streams[1:] else None, hints)
        found += advice.cause_findings(cause)
        slopes = linear(cause.motion)
        if slopes.quiet:
            found += advice.motion_findings(cause.motion, slopes, self._room)
            right = cause.motion.pan_clock if cause.stream == IMAGES else Clock()
            found += self._truth(images, cause.motion, right)
        if cause.stream == ODOMETRY and cause.kind in ('scale', 'twist'):
            # Consequences of a wrong heading are not separate faults.
            found = _without(found, *_OF_PATH, *([_OF_POSE] if cause.kind == 'scale' else []))
        if cause.kind == 'none':
            coarse = [f for s in streams for f in parts.coarse_values(s) if not cause.fits]
            found = [*(coarse or found), *_clocks_by_log(motion, hints, slopes)]
        late = cause.late
        if not late or not all(map(advice.is_corrected, late.values())):
            return found, Delays(), False
        by_stream = {IMAGES: 'images_s', JOINTS: 'joints_s', ODOMETRY: 'odometry_s'}
        delays = Delays(**{by_stream[name]: offset.value for name, offset in late.items()})
        if {*late} != {ODOMETRY}:
            delays = replace(delays, pan_sigma_s=max(slopes.pan_clock_s.sigma, _LEAST_SIGMA_S))
        return found, delays, False

    def _truth(self, images: Stream, motion: Motion, clock: Clock) -> list[Finding]:
        """Check the clock of the ground truth, used for metrics only, against a correct one."""
        topic = self._bag.find('ground_truth/odom')
        if not topic or motion.odometry is None:
            return []
        # Only the part of the recording with images counts.
        truth = read_stream(self._bag, 'ground_truth', topic, _odometry_of)
        truth = self._by_images(truth.logged_within(*images.logged_ns[[0, -1]].tolist()))
        if len(truth) < 2:
            return []
        # Odometry shows the turns of the base as they are, images also how near things are.
        still = Track(motion.pan.seconds, np.zeros_like(motion.pan.values))
        known = replace(motion, turns_rad=motion.yawed(), pan=still, yaw_scale=1.0)
        track = _odometry_track(truth, truth.values)
        known = replace(known, odometry=track, odometry_clock=clock)
        hints = clock_hints(images, {ODOMETRY: truth})[ODOMETRY]
        late = late_odometry(known, hints) - clock.offset_s
        if known.covered(ODOMETRY) < _ENOUGH:
            late = late or hints[0] or hints[1]
        return [] if abs(late) < _TRUTH_S else [Code.TRUTH_CLOCK.found(late_s=late)]

    def _motion(self, looks: Looks, pairs: IndexArray, streams: Sequence[Stream]) -> Motion:
        sense = self._mount.pan_sense * (1.0 + self._known['pan_scale'][0])
        joint_times = streams[0].seconds - self._known['joint_delay'][0]
        pan = Track.of(joint_times, sense * _angles(streams[0]))
        odometry = _odometry_track(streams[1], streams[1].values) if streams[1:] else None
        mount = self._mount
        levers = mount.axis_xyz[:2], mount.optical_center_offset[:2]
        hangs = mount.pan_sense * np.cos(mount.camera_roll_rad) < 0.0
        ahead_rad = float(mount.azimuth_base_rad(0.0))
        return Motion(*looks.turns(pairs), pan, odometry, *levers, ahead_rad, hangs)


def _without(found: list[Finding], *names: str) -> list[Finding]:
    """Findings whose names do not start with any of `names`."""
    return [finding for finding in found if not finding.name.startswith(names)]


def _odometry_of(message: Any) -> FloatArray:
    """Return x, y, yaw, forward speed and yaw rate of a message."""
    sample = decode.odometry(message)
    return np.array([*sample.pose_odom_base, sample.linear_m_s, sample.angular_rad_s])


def _odometry_track(stream: Stream, values: FloatArray) -> Track:
    """Return the track of a stream of odometry with the given values (n, k)."""
    poses = values[:, :3].copy()
    poses[:, 2] = np.unwrap(poses[:, 2])
    return Track.of(stream.seconds, poses)


def _angles(stream: Stream) -> FloatArray:
    return unwrapped(stream.values[:, 0])[:, None]


def _by_twist(stream: Stream) -> Track:
    """Odometry integrated from its twists, (n, 3)."""
    order = np.argsort(stream.seconds, kind='stable')
    times, values = stream.seconds[order], stream.values[order]
    steps = np.clip(np.diff(times, prepend=times[0]), 0.0, 1.0)
    yaw = np.cumsum(values[:, 4] * steps)
    x, y = np.cumsum(values[:, 3] * steps * [np.cos(yaw), np.sin(yaw)], axis=1)
    return Track.of(times, np.stack([x, y, yaw], -1))


def _clocks_by_log(
    motion: Motion, hints: Mapping[str, Sequence[float]], slopes: Linear | None
) -> list[Finding]:
    """Find clock offsets by times of recording if motion does not show them."""
    off = {}
    for name in (JOINTS, ODOMETRY):
        if slopes is not None and slopes.quiet:
            shown = slopes.pan_clock_s if name == JOINTS else slopes.odometry_clock_s
            if shown.sigma < _KNOWN_S:
                continue
        by_log, by_start, *_ = hints.get(name, (0.0, 0.0))
        if abs(by_log) > _BY_LOG_S:
            off[name] = by_log
        elif motion.covered(name) < _COVERED:
            off[name] = by_start
    if len(off) == 2 and np.ptp([*off.values()]) < _BY_LOG_S:
        off = {IMAGES: -float(np.mean([*off.values()]))}
    how = ' by times of recording'
    return [advice.clock_finding(name, late, how, corrected=False) for name, late in off.items()]
