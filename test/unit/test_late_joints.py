"""Joint states with late stamps or frozen values are reported, and the delay is estimated."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from degraded_drives import check_consistent, FAULT_S, first, KNOWN, pan_rad, run, Sensed
import numpy as np
import pytest
from rendered_drives import camera_image, MAP, MOUNT, START, START_SIGMA, Step

from landmark_nav.calibration import Calibration
from landmark_nav.geometry.angles import PanTrack
from landmark_nav.localization.late_joints import in_time
from landmark_nav.localization.localizer import (
    LocalizationConfig,
    LocalizationUpdate,
    Localizer,
)
from landmark_nav.localization.observer import FrozenImage
from landmark_nav.types import (
    CameraFrame,
    FloatArray,
    OdometrySample,
    PoseEstimate,
)

LATE_S = 0.2


def stamped_late(step: Step, frame: CameraFrame | None, late_s: float = LATE_S) -> Sensed:
    """Joint states give for every moment where the camera looked a while before."""
    if frame is None:
        return step, frame
    about = np.linspace(-0.4, 0.4, 17)
    given = np.array([pan_rad(step.stamp_ns * 1e-9 - late_s + t) for t in about])
    rate = float((given[9] - given[7]) / (about[9] - about[7]))
    track = PanTrack(about, given)
    frame = replace(frame, pan_rad=float(given[8]), pan_rate_rad_s=rate, pan_track=track)
    return step, frame


@pytest.mark.parametrize('rpy', [(np.pi, 0.0, 0.0), (np.pi, 0.0, 0.3), (0.0, 0.0, 0.3)], ids=str)
def test_the_same_camera_on_a_unit_that_hangs_or_is_turned_gives_the_same(
    sensed: list[Sensed], rpy: tuple[float, float, float]
) -> None:
    """Pan and tilt are counted otherwise, and the images are the same."""
    sense = np.cos(rpy[0])
    x, y, z = MOUNT.optical_center_offset
    hung = replace(
        MOUNT,
        axis_rpy=rpy,
        optical_center_offset=(x, sense * y, sense * z),
        camera_roll_rad=MOUNT.camera_roll_rad + rpy[0],
    )

    def pan_of(pan: FloatArray | float) -> Any:
        return sense * (pan - rpy[2])

    def counted(step: Step, frame: CameraFrame | None) -> Sensed:
        if frame is not None:
            track = frame.pan_track
            frame = replace(
                frame,
                pan_rad=pan_of(frame.pan_rad),
                tilt_rad=sense * frame.tilt_rad,
                pan_rate_rad_s=sense * frame.pan_rate_rad_s,
                pan_track=track and PanTrack(track.seconds, pan_of(track.pans_rad)),
            )
        return step, frame

    same = [
        moment.update.fused.pose
        for given, mount, change in (
            (sensed, MOUNT, stamped_late),
            (
                [counted(*each) for each in sensed],
                hung,
                # The tilt was counted anew before.
                lambda step, frame: counted(
                    *stamped_late(step, frame and replace(frame, tilt_rad=sense * frame.tilt_rad))
                ),
            ),
        )
        for moment in run(given, change, calibration=Calibration.of_mount(mount))
    ]
    half = len(same) // 2
    np.testing.assert_allclose(same[half:], same[:half], atol=1e-3)


def test_joint_states_that_are_late_for_good_are_put_right(sensed: list[Sensed]) -> None:
    moments = list(run(sensed, stamped_late))
    check_consistent(moments)
    assert max(m.nees for m in moments) < 25.0
    later = [m for m in moments if 3.0 < m.after_s < 6.0]
    assert {m.status for m in later} == {'tracking'}
    assert max(np.hypot(*m.error[:2]) for m in later) < 0.03


def test_how_late_they_are_is_known_after_a_few_images(sensed: list[Sensed]) -> None:
    localizer = Localizer(MAP, KNOWN, LocalizationConfig())
    localizer.initialize(PoseEstimate(0, START, np.diag(START_SIGMA**2)))
    for step, frame in sensed:
        localizer.add_odometry(step.odometry)
        if step.stamp_ns * 1e-9 > FAULT_S:
            _, frame = stamped_late(step, frame)
        if frame is not None and step.stamp_ns * 1e-9 < FAULT_S + 5.0:
            localizer.add_frame(frame)
    late = localizer.late
    assert late.sigma_s < 0.02
    assert late.delay_s == pytest.approx(LATE_S, abs=4.0 * late.sigma_s + 0.005)


@pytest.mark.parametrize('seconds', [1.5, 2.0, 3.0, 4.0])
def test_a_delay_that_is_over_is_taken_back(sensed: list[Sensed], seconds: float) -> None:
    localizer = Localizer(MAP, KNOWN, LocalizationConfig())
    localizer.initialize(PoseEstimate(0, START, np.diag(START_SIGMA**2)))
    delays = []
    for step, frame in sensed:
        since = step.stamp_ns * 1e-9 - FAULT_S
        localizer.add_odometry(step.odometry)
        _, frame = stamped_late(step, frame, LATE_S if 0.0 < since < seconds else 0.0)
        if frame is not None and since < seconds + 3.0:
            localizer.add_frame(frame)
            delays.append(localizer.late.delay_s)
    assert max(delays) > 0.15
    # The joints show nothing of longer ones.
    assert np.abs(delays).max() < 0.4
    assert abs(delays[-1]) < max(0.02, 4.0 * localizer.late.sigma_s)


def test_joint_states_that_freeze_are_soon_rejected(sensed: list[Sensed]) -> None:
    stands = pan_rad(FAULT_S)

    def frozen(step: Step, frame: CameraFrame | None) -> Sensed:
        if frame is not None and step.stamp_ns * 1e-9 < FAULT_S + 3.0:
            frame = replace(frame, pan_rad=stands)
        return step, frame

    moments = list(run(sensed, frozen))
    assert next(m for m in moments if m.after_s >= 0.0 and m.status != 'tracking').after_s <= 2.0
    check_consistent(moments)


def test_images_that_freeze_are_reported_and_not_used(sensed: list[Sensed]) -> None:
    shown = next(f for s, f in sensed if f is not None and s.stamp_ns * 1e-9 >= FAULT_S - 0.3)

    def frozen(step: Step, frame: CameraFrame | None) -> Sensed:
        if frame is not None and step.stamp_ns * 1e-9 < FAULT_S + 2.5:
            frame = replace(frame, image=shown.image)
        return step, frame

    moments = list(run(sensed, frozen))
    coasting = first(moments, 'coasting')
    assert coasting.after_s <= 2.0
    hidden = [m for m in moments if 0.5 < m.after_s < 2.5]
    assert not any(m.update.used for m in hidden)
    assert {m.status for m in moments if 3.0 < m.after_s < 6.0} == {'tracking'}
    check_consistent(moments)


def test_an_image_may_stay_the_same_while_nothing_moves(sensed: list[Sensed]) -> None:
    _, frame = next(pair for pair in sensed if pair[1] is not None)
    assert frame is not None
    frozen = FrozenImage()
    assert not any(frozen.repeats(frame) for _ in range(3))
    turned = replace(frame, pan_rad=frame.pan_rad + 0.02)
    assert frozen.repeats(turned)
    for moved in ([0.03, 0.0, 0.0], [0.0, 0.0, 0.02]):
        frozen.add_odometry(OdometrySample(0, np.array(moved)))
        assert frozen.repeats(frame)
    frozen.add_odometry(OdometrySample(0, np.zeros(3)))
    assert not frozen.repeats(frame)
    black = replace(turned, image=np.zeros_like(frame.image))
    assert not frozen.repeats(black)
    assert not frozen.repeats(replace(black, pan_rad=0.0))


def test_a_camera_without_noise_that_stands_goes_on() -> None:
    """As in a simulator; the first image corrects a start that was a little off."""
    localizer = Localizer(MAP, KNOWN, LocalizationConfig())
    covariance = np.diag(np.square([0.05, 0.05, 0.035]))
    localizer.initialize(PoseEstimate(0, START + np.array([0.03, -0.02, 0.01]), covariance))
    frame = camera_image(START, 0.0)
    for k in range(12):
        stamp_ns = k * 200_000_000
        localizer.add_odometry(OdometrySample(stamp_ns, np.zeros(3)))
        update = localizer.add_frame(replace(frame, stamp_ns=stamp_ns))
        assert isinstance(update, LocalizationUpdate)
        assert update.status == 'tracking'
        assert update.used >= 3


def test_an_image_gets_the_pan_of_its_true_time(sensed: list[Sensed]) -> None:
    _, frame = next(pair for pair in sensed if pair[1] is not None)
    assert frame is not None
    about = np.linspace(-0.4, 0.4, 81)
    turning = replace(frame, pan_track=PanTrack(about, about**3))
    assert in_time(turning, 0.2).pan_rad - frame.pan_rad == pytest.approx(0.008)


def test_without_a_track_the_pan_goes_on_at_its_rate(sensed: list[Sensed]) -> None:
    _, frame = next(pair for pair in sensed if pair[1] is not None)
    assert frame is not None
    frame = replace(frame, pan_rate_rad_s=0.5, pan_track=None)
    assert in_time(frame, 0.0).pan_rad == frame.pan_rad
    assert in_time(frame, 0.1).pan_rad - frame.pan_rad == pytest.approx(0.05)
