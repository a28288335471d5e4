"""All bearings of a picture off by one angle: odometry that strays, or a camera that turned."""

from __future__ import annotations

from fusion_drives import detections, drive, landmark_map, Moment, MOUNT, start_estimate
import numpy as np
import pytest

from landmark_nav.localization.fusion import FusionUpdate, PoseFilter
from landmark_nav.localization.fusion.state import BORESIGHT, HEADING

MAP = landmark_map(10)
SIGMA_RAD = 5e-4
LAST = 120


@pytest.fixture
def fused() -> PoseFilter:
    filter_ = PoseFilter(MAP, MOUNT)
    filter_.initialize(start_estimate())
    return filter_


def drive_and_turn(fused: PoseFilter, angle_sigmas: float) -> tuple[FusionUpdate, float, Moment]:
    """Drive with good bearings, the last off by so many sigmas of the heading."""
    for k, moment in enumerate(drive(LAST)):
        fused.add_odometry(moment.odometry)
        stamp_ns = moment.odometry.stamp_ns
        if k % 4 == 0 and k < LAST - 12:
            fused.add_detections(detections(MAP, moment.pose, stamp_ns, range(8), SIGMA_RAD))
    assert fused.state is not None
    variance = fused.state.covariance[HEADING, HEADING] + 2e-4**2 + SIGMA_RAD**2 / 8
    angle_rad = angle_sigmas * float(np.sqrt(variance))
    seen = detections(MAP, moment.pose, stamp_ns, range(8), SIGMA_RAD, angle_rad)
    return fused.add_detections(seen), angle_rad, moment


def test_an_angle_just_outside_the_gates_is_laid_to_the_odometry(fused: PoseFilter) -> None:
    update, angle_rad, moment = drive_and_turn(fused, 3.4)
    state = fused.state
    assert state is not None
    assert update.degrees == 8
    assert update.turned_rad == 0.0
    assert state.mean[BORESIGHT] == 0.0
    assert state.covariance[BORESIGHT, BORESIGHT] == 0.0
    assert moment.pose[2] - state.mean[HEADING] == pytest.approx(angle_rad, rel=0.2)
    assert fused.status[0] == 'tracking'


@pytest.mark.parametrize('angle_sigmas', [-7.0, 9.0])
def test_a_larger_one_is_doubted_by_as_much_as_was_seen(
    fused: PoseFilter, angle_sigmas: float
) -> None:
    update, angle_rad, moment = drive_and_turn(fused, angle_sigmas)
    state = fused.state
    assert state is not None
    assert update.turned_rad == pytest.approx(angle_rad, rel=0.2)
    together = moment.pose[2] - state.mean[HEADING] + state.mean[BORESIGHT]
    assert together == pytest.approx(angle_rad, rel=0.2)
    for k in (HEADING, BORESIGHT):
        assert 0.3 * abs(angle_rad) < np.sqrt(state.covariance[k, k]) < abs(angle_rad)
    status, reason = fused.status
    assert status == 'coasting'
    assert 'turned' in reason
