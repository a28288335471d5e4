"""Fixed-interval smoothing of a recording by the joint estimator."""

from __future__ import annotations

from drawn_drives import Drive, driven, NS, simulated
import numpy as np
import pytest

from landmark_nav.calibration import Calibration
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import compose
from landmark_nav.localization.estimator import ImagePoints, JointFilter
from landmark_nav.localization.estimator.smoothing import smoothed_poses
from landmark_nav.localization.odometry.noise import Motion, OdometryNoiseConfig
from landmark_nav.localization.odometry.track import OdometryTrack
from landmark_nav.types import FloatArray, OdometrySample


def line(drive: Drive, lost_at: int = -1) -> tuple[FloatArray, FloatArray]:
    """Errors (n, 3) of the smoothed poses, and their squares (n,) over the covariance."""
    odometry = OdometryNoiseConfig()
    track, stamp, pose = OdometryTrack(odometry), 0, np.zeros(3)
    track.add(OdometrySample(0, pose))
    images: list[ImagePoints] = []
    for event in drive.events:
        if isinstance(event, Motion):
            stamp += round(event.seconds * NS)
            pose = compose(pose, event.increment)
            track.add(OdometrySample(stamp, pose))
        else:
            images.append(event)
    joint = JointFilter(drive.landmark_map, drive.prior, drive.start, odometry=odometry)
    smoothed = smoothed_poses(joint, track, images, np.arange(len(images)) == lost_at)
    off = np.array([each.pose for each in smoothed]) - np.array(drive.poses)
    off[:, 2] = wrap_rad(off[:, 2])
    squares = [
        error @ np.linalg.solve(each.covariance, error)
        for error, each in zip(off, smoothed, strict=True)
    ]
    return off, np.array(squares)


def test_what_comes_later_shows_what_was_before() -> None:
    drives = [simulated(seed, seconds=12.0) for seed in range(4)]
    smoothed, squares = map(np.concatenate, zip(*map(line, drives), strict=True))
    filtered = np.concatenate([driven(drive).errors for drive in drives])

    def rms(errors: FloatArray) -> float:
        return float(np.sqrt(np.mean(np.sum(errors[:, :2] ** 2, axis=1))))

    assert rms(smoothed) < 0.9 * rms(filtered)
    assert 1.0 < squares.mean() < 5.0


def test_the_mount_found_at_the_end_corrects_the_beginning() -> None:
    prior = Calibration.of_mount(simulated(0, seconds=1.0).prior.mount)
    drive = simulated(7, prior, prior.with_values(center_x=0.03, axis_pitch=0.014), seconds=16.0)
    smoothed, squares = line(drive)
    assert np.hypot(*smoothed[:20, :2].T).max() < 0.03
    assert squares.mean() < 9.0


def test_a_robot_that_was_carried_off_is_found() -> None:
    drive = simulated(3, seconds=16.0)
    images = [k for k, event in enumerate(drive.events) if isinstance(event, ImagePoints)]
    # It is taken from one place to another, with the wheels at rest.
    for k in range(len(drive.events)):
        if images[30] <= k < images[45]:
            event = drive.events[k]
            drive.events[k] = (
                Motion(np.zeros(3), event.seconds)
                if isinstance(event, Motion)
                else event.chosen(np.zeros(len(event), dtype=np.bool_))
            )
    smoothed, _ = line(drive, lost_at=45)
    assert np.hypot(*smoothed[50:, :2].T).max() < 0.03
    assert np.hypot(*smoothed[:30, :2].T).max() < 0.03


@pytest.mark.parametrize('count', [0, 1])
def test_few_images_are_enough(count: int) -> None:
    drive = simulated(1, seconds=2.0)
    images = [event for event in drive.events if isinstance(event, ImagePoints)][:count]
    joint = JointFilter(drive.landmark_map, drive.prior, drive.start)
    track = OdometryTrack(OdometryNoiseConfig())
    track.add(OdometrySample(0, np.zeros(3)))
    assert len(smoothed_poses(joint, track, images)) == count
