"""Triangulated poses in the filter, and what bearings show of them."""

from __future__ import annotations

from dataclasses import replace

from fusion_drives import (
    bearings,
    detections,
    drive,
    error_of,
    landmark_map,
    MOUNT,
    START,
    start_estimate,
)
import numpy as np
import pytest

from landmark_nav.localization.fusion import FusionConfig, PoseFilter
from landmark_nav.localization.fusion.state import BORESIGHT
from landmark_nav.localization.triangulation import Fix, triangulate
from landmark_nav.localization.triangulation.model import base_from_axis
from landmark_nav.types import FloatArray, LandmarkMap, OdometrySample, PoseEstimate, Refusal

MAP = landmark_map(10)
EXACT = landmark_map(10, shared=1e-9, own=1e-9)
SIGMA = 5e-4


def started(mode: str = 'poses', known: LandmarkMap = MAP) -> PoseFilter:
    fused = PoseFilter(known, MOUNT, FusionConfig(mode=mode))
    fused.initialize(start_estimate())
    return fused


def fix_of(
    pose: FloatArray, stamp_ns: int, places: list[int], off_rad: FloatArray | float = 0.0
) -> PoseEstimate:
    """Triangulate from the bearings of some landmarks."""
    fix = triangulate(
        MAP.positions[places, :2],
        bearings(MAP, pose)[places] + off_rad,
        np.full(len(places), SIGMA**2),
        MAP.joint_covariance_of(np.array(places)),
    )
    assert isinstance(fix, Fix)
    return base_from_axis(fix.at(stamp_ns), MOUNT)


def test_never_both() -> None:
    pose = PoseEstimate(0, START, np.eye(3) * 1e-4)
    assert started('bearings').add_pose(pose).refusal is not None
    fused = started()
    seen = detections(MAP, START, 0, [0, 1, 2], SIGMA)
    assert fused.add_detections(seen).refusal is not None
    assert fused.add_pose(pose).refusal is None


def test_gate() -> None:
    fused = started()
    far = PoseEstimate(0, START + np.array([0.5, 0.0, 0.0]), np.eye(3) * 1e-4)
    update = fused.add_pose(far)
    assert update.refusal is not None
    assert 'NIS' in str(update.refusal)
    broken = PoseEstimate(0, START * np.nan, np.eye(3))
    assert fused.add_pose(broken).refusal is not None


@pytest.mark.parametrize(
    'known',
    [EXACT, LandmarkMap(EXACT.landmarks[:2]), LandmarkMap(())],
    ids=['of landmarks', 'of two', 'from elsewhere'],
)
def test_is_the_weighted_mean(known: LandmarkMap) -> None:
    fused = started(known=known)
    offset = np.array([0.01, -0.02, 0.01])
    same = start_estimate().covariance
    assert fused.add_pose(PoseEstimate(0, START + offset, same)).degrees == 3
    np.testing.assert_allclose(error_of(fused.estimate(), START), offset / 2.0, atol=1e-9)
    np.testing.assert_allclose(fused.estimate().covariance, same / 2.0, atol=1e-9)  # type: ignore[union-attr]


@pytest.mark.parametrize('given', [True, False])
def test_a_standing_robot_never_claims_more_than_the_map_knows(given: bool) -> None:
    """Three hundred poses err with the same landmarks; bearings have it exactly."""
    rng = np.random.default_rng(0)
    places = [0, 1, 3, 4, 6]
    poses, single = started(), started('bearings')
    for k in range(1, 301):
        stamp_ns, noise = k * 200_000_000, rng.normal(0.0, SIGMA, len(places))
        seen = detections(MAP, START, stamp_ns, places, SIGMA, noise)
        for fused in (poses, single):
            fused.add_odometry(OdometrySample(stamp_ns, np.zeros(3)))
        single.add_detections(seen)
        if given:
            poses.add_detections(seen)
        poses.add_pose(fix_of(START, stamp_ns, places, noise))
    claims = [
        float(np.sqrt(np.trace(f.estimate().covariance[:2, :2])))  # type: ignore[union-attr]
        for f in (poses, single)
    ]
    if given:
        assert claims[0] == pytest.approx(claims[1], rel=0.3)
    # Else it is taken to be made of all landmarks: at least what they share remains.
    assert claims[0] > 0.004
    assert poses.status == ('tracking', '')


def test_a_bumped_camera_leaves_the_heading_uncertain() -> None:
    fused, bump = started(), np.radians(2.0)
    rng = np.random.default_rng(1)
    for k, moment in enumerate(drive(200)):
        fused.add_odometry(moment.odometry)
        if k % 4 == 0:
            places = sorted(((k + np.array([0, 1, 3, 4, 6])) % 10).tolist())
            off = rng.normal(0.0, SIGMA, 5) + (bump if k >= 80 else 0.0)
            stamp_ns = moment.odometry.stamp_ns
            fused.add_detections(detections(MAP, moment.pose, stamp_ns, places, SIGMA, off))
            fused.add_pose(fix_of(moment.pose, stamp_ns, places, off))
            error, state = error_of(fused.estimate(), moment.pose), fused.state
            assert state is not None
            assert error @ np.linalg.solve(state.covariance[:3, :3], error) < 16.0
            if k == 80:
                status, reason = fused.status
                assert status == 'coasting'
                assert 'turned' in reason
                assert ': +2.0' in reason
                assert np.degrees(np.sqrt(state.covariance[2, 2])) > 1.0
    assert fused.status == ('tracking', '')
    assert state.mean[BORESIGHT] == pytest.approx(bump, abs=np.radians(0.7))
    assert np.hypot(*error[:2]) < 0.02


def test_poses_that_keep_disagreeing_lose_the_old_place_and_then_hold() -> None:
    fused, verdicts = started(), []
    for k, moment in enumerate(drive(60)):
        fused.add_odometry(moment.odometry)
        carried = moment.pose + np.array([0.8, 0.6, 0.0])
        if k % 4 == 0:
            stamp_ns = moment.odometry.stamp_ns
            fused.add_pose(fix_of(carried, stamp_ns, [0, 1, 3, 4, 6]))
            verdicts.append(fused.status)
    assert any(status == 'lost' and 'pose does not fit' in why for status, why in verdicts)
    assert verdicts[-1] == ('tracking', '')
    assert np.hypot(*error_of(fused.estimate(), carried)[:2]) < 0.02


def test_why_no_pose_came_is_reported() -> None:
    fused = started()
    for moment in drive(40):
        fused.add_odometry(moment.odometry)
        fused.no_pose(moment.odometry.stamp_ns, Refusal('fewer than three bearings', '2 given'))
    status, reason = fused.status
    assert status == 'coasting'
    assert 'fewer than three bearings: 2 given' in reason


def test_a_pose_of_a_few_that_chance_may_have_made_does_not_end_the_search() -> None:
    fused, given = started(), []
    for k, moment in enumerate(drive(60)):
        fused.add_odometry(moment.odometry)
        if k % 4 == 0:
            stamp_ns = moment.odometry.stamp_ns
            carried = moment.pose + np.array([0.8, 0.6, 0.0])
            seen = detections(MAP, carried, stamp_ns, [0, 1, 3], SIGMA)
            fused.add_detections(replace(seen, missed=np.delete(MAP.ids, [0, 1, 3])))
            given.append(fused.add_pose(fix_of(carried, stamp_ns, [0, 1, 3])).refusal)
    assert fused.status[0] == 'lost'
    assert str(given[-1]) == 'too few found: 3 of 10 landmarks'
