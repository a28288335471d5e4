"""The joint estimator where odometry stops, and where a pose is found within a wide prior."""

from __future__ import annotations

from drawn_drives import driven, NS, simulated
import numpy as np
import pytest

from landmark_nav.geometry.se2 import compose
from landmark_nav.localization.estimator import filter, Integrity, JointFilter, Status
from landmark_nav.localization.estimator.timeline import Timeline
from landmark_nav.localization.odometry.noise import Motion, OdometryNoiseConfig
from landmark_nav.localization.odometry.track import OdometryTrack
from landmark_nav.types import OdometrySample, PoseEstimate, Refusal


@pytest.mark.parametrize('gap_s', [0.5, 1.5, 4.0])
def test_odometry_that_stops_and_comes_back_does_no_harm(gap_s: float) -> None:
    drive = simulated(12, seconds=14.0)
    odometry, begin = OdometryNoiseConfig(), round(6.0 * NS)
    joint = JointFilter(drive.landmark_map, drive.prior, drive.start, odometry=odometry)
    line = Timeline(joint, OdometryTrack(odometry), window_s=1.0)
    stamp, pose, image = 0, np.zeros(3), 0
    line.add_odometry(OdometrySample(0, pose))
    for event in drive.events:
        if isinstance(event, Motion):
            stamp += round(event.seconds * NS)
            pose = compose(pose, event.increment)
            if not begin < stamp < begin + round(gap_s * NS):
                forward, _, turn = (event.increment / event.seconds).tolist()
                line.add_odometry(OdometrySample(stamp, pose, forward, turn))
            continue
        update = line.add_image(event)
        assert not isinstance(update, Refusal)
        assert not update.stepped
        found = line.estimate(event.stamp_ns)
        error = found.pose - drive.poses[image]
        assert error @ np.linalg.solve(found.covariance, error) < 31.8
        image += 1
    assert np.hypot(*error[:2]) < 0.02


def test_an_image_without_what_should_be_seen_degrades_at_once() -> None:
    integrity, good = Integrity(), PoseEstimate(0, np.zeros(3), 1e-6 * np.eye(3))
    update = driven(simulated(5, seconds=4.0)).updates[-1]
    for missed, status in ((0, Status.OK), (0, Status.OK), (8, Status.DEGRADED), (0, Status.OK)):
        integrity.add(0, None if missed else update, missed)
        assert integrity.status(good)[0] is status


def test_errors_of_landmarks_are_bounded_in_number_and_stay_consistent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(filter, '_MOST_LANDMARKS', 10)
    runs = [driven(simulated(seed, seconds=10.0)) for seed in range(4)]
    assert max(len(run.filter.snapshot.landmarks) for run in runs) <= 10
    assert all(np.mean(run.nees < 31.8) == 1.0 for run in runs)
    assert max(np.hypot(*run.errors[-1, :2]) for run in runs) < 0.02
