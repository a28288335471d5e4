"""When a place that was found is sure, and when a pose that was contradicted is again."""

from __future__ import annotations

from dataclasses import replace

from filter_runs import MAP, measurement, run, SIGMA, started
from fusion_drives import detections, drive, MOUNT
import numpy as np
import pytest

from landmark_nav.localization.fusion import FusionConfig, PoseFilter
from landmark_nav.localization.fusion.config import HealthConfig
from landmark_nav.localization.fusion.contradictions import Contradictions
from landmark_nav.localization.fusion.health import Health
from landmark_nav.localization.fusion.start import Found
from landmark_nav.localization.fusion.update import FusionUpdate
from landmark_nav.localization.fusion.witnesses import Witnesses
from landmark_nav.types import FloatArray, LandmarkMap, PoseEstimate, Refusal

NS = 10**9
EAST, NORTH = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
NOBODY = np.empty(0, dtype=np.int64)


def on_walls(normals: list[list[float]]) -> LandmarkMap:
    landmarks = [
        replace(MAP.landmarks[k], normal=np.array(normal)) for k, normal in enumerate(normals)
    ]
    return LandmarkMap(tuple(landmarks))


def test_one_wall_does_not_speak_for_a_place_but_two_do() -> None:
    witnesses = Witnesses(on_walls([EAST] * 5 + [NORTH] * 3))
    assert witnesses.vouched
    witnesses.restart(vouched=False)
    witnesses.hear(np.arange(5))
    assert not witnesses.vouched
    witnesses.hear(np.array([5, 6]))
    assert not witnesses.vouched
    witnesses.hear(np.array([7]))
    assert witnesses.vouched


@pytest.mark.parametrize(('apart_m', 'enough'), [(1.5, False), (2.5, True)])
def test_one_wall_speaks_far_apart_for_a_robot_that_lost_track_in_its_room(
    apart_m: float, enough: bool
) -> None:
    """Two groups of landmarks are not one poster; but another room may have the same wall."""
    walls = on_walls([EAST] * 6 + [NORTH] * 3)
    along = np.array([0.0, 0.1, 0.2, 0.2 + apart_m, 0.3 + apart_m, 5.0])
    east = tuple(
        replace(landmark, position=np.array([4.0, y, 1.2]))
        for landmark, y in zip(walls.landmarks, along, strict=False)
    )
    room = LandmarkMap(east + walls.landmarks[6:])

    def sure_again(vouched: bool) -> bool:
        witnesses = Witnesses(room, vouched)
        for wide in (False, True):
            witnesses.note_width(wide)
        witnesses.hear(np.arange(5))
        assert not witnesses.vouched
        witnesses.hear(np.array([5]))
        return witnesses.vouched

    assert sure_again(vouched=True) == enough
    assert not sure_again(vouched=False)


def test_a_map_of_one_wall_cannot_ask_for_two() -> None:
    witnesses = Witnesses(on_walls([EAST] * 5 + [NORTH] * 2))
    witnesses.restart(vouched=False)
    witnesses.hear(np.array([0, 1]))
    assert not witnesses.vouched
    witnesses.hear(np.array([2]))
    assert witnesses.vouched


def found_at(pose: FloatArray, stamp_ns: int, landmark_map: LandmarkMap) -> PoseFilter:
    fused = PoseFilter(landmark_map, MOUNT)
    start = PoseEstimate(stamp_ns, pose, np.diag(np.square([0.02, 0.02, 0.005])))
    fused.initialize(start, found=Found(NOBODY))
    return fused


def test_a_found_place_is_coasting_until_landmarks_of_two_walls_speak_for_it() -> None:
    walls = on_walls([EAST] * 5 + [NORTH] * 5)
    moments = list(drive(20))
    fused = found_at(moments[0].pose, 0, walls)
    reported = {}
    for k, moment in enumerate(moments):
        fused.add_odometry(moment.odometry)
        seen = range(5) if k < 10 else range(10)
        fused.add_detections(detections(walls, moment.pose, moment.odometry.stamp_ns, seen, SIGMA))
        reported[k] = fused.status
    assert reported[9][0] == 'coasting'
    assert 'only one wall' in reported[9][1]
    assert reported[11] == ('tracking', '')


def test_what_the_search_saw_speaks_once_an_image_agrees() -> None:
    """It may be wrong itself: an image that shows nothing is no second opinion."""
    walls = on_walls([EAST] * 5 + [NORTH] * 5)
    moment = next(iter(drive(0)))
    fused = PoseFilter(walls, MOUNT)
    start = PoseEstimate(0, moment.pose, np.diag(np.square([0.02, 0.02, 0.005])))
    fused.initialize(start, found=Found(walls.ids))
    fused.add_odometry(moment.odometry)
    for seen, status in ((range(0), 'coasting'), (range(5), 'tracking')):
        assert fused.status[0] == 'coasting'
        fused.add_detections(detections(walls, moment.pose, 0, seen, SIGMA))
        assert fused.status[0] == status


def last_status(
    fused: PoseFilter,
    landmark_map: LandmarkMap,
    first: int,
    last: int,
    seen: range,
    off_rad: float,
) -> tuple[str, str]:
    """Drive on and look, 20 times a second, with all bearings off by one angle."""
    for moment in list(drive(last))[first:]:
        stamp_ns = moment.odometry.stamp_ns
        fused.add_odometry(moment.odometry)
        fused.add_detections(detections(landmark_map, moment.pose, stamp_ns, seen, SIGMA, off_rad))
    return fused.status


def test_a_wall_that_takes_a_knock_to_fit_does_not_speak_for_a_found_place() -> None:
    walls, east, north = on_walls([EAST] * 5 + [NORTH] * 5), range(5), range(5, 10)
    fused = found_at(next(iter(drive(0))).pose, 0, walls)
    assert last_status(fused, walls, 0, 10, east, 0.0)[0] == 'coasting'
    status, reason = last_status(fused, walls, 10, 100, north, 0.04)
    assert status == 'coasting'
    assert 'only one wall' in reason
    assert last_status(fused, walls, 100, 180, east, 0.04)[0] == 'tracking'


def test_a_camera_that_is_displaced_again_and_again_is_no_accident() -> None:
    health = Health(HealthConfig())
    health.restart(0)
    reported = []
    for second in range(0, 30, 2):
        for tenth in range(5):
            stamp_ns = second * NS + tenth * NS // 10
            health.note_surprise(stamp_ns, Refusal('the camera was turned'))
        reported.append(health.repeats)
    assert reported == [False] * 3 + [True] * 12
    health.note_surprise(90 * NS, Refusal('the camera was turned'))
    assert not health.repeats


def test_a_heading_from_a_turning_camera_leaves_the_lateness_of_its_joints_open() -> None:
    moment = next(iter(drive(0)))
    fused = PoseFilter(MAP, MOUNT)
    start = PoseEstimate(0, moment.pose, np.diag(np.square([0.02, 0.02, 0.2])))
    fused.initialize(start, found=Found(MAP.ids))
    fused.add_odometry(moment.odometry)
    # The same late pan again is no evidence for the heading; a camera that stands is.
    seen = measurement(moment, 0, np.full(4, 0.2))
    fused.add_detections(replace(seen, pan_rate_rad_s=2.0))
    before = fused.estimate()
    assert before is not None
    assert np.sqrt(before.covariance[2, 2]) > 0.1
    fused.add_detections(measurement(moment, 0))
    after = fused.estimate()
    assert after is not None
    assert abs(after.pose[2] - moment.pose[2]) < 0.005
    assert fused.late.delay_s == pytest.approx(-0.1, abs=0.01)


@pytest.mark.parametrize(('off_rad', 'open_'), [(0.0, False), (0.02, False), (0.4, True)])
def test_joints_that_led_to_the_heading_that_is_found_are_in_time(
    off_rad: float, open_: bool
) -> None:
    fused = started()
    moment, _ = run(fused, 60)
    pose = moment.pose + np.array([0.0, 0.0, off_rad])
    place = PoseEstimate(moment.odometry.stamp_ns, pose, np.diag(np.square([0.02, 0.02, 0.2])))
    fused.initialize(place, found=Found(MAP.ids))
    assert (fused.late.sigma_s > 0.05) == open_


def test_one_that_lies_just_within_its_gate_is_no_evidence_after_many_in_vain() -> None:
    """A normalized innovation squared of 7: 0.8 % of those of a right pose are as large."""

    def seen(angle_rad: float, vain: int = 0) -> FusionUpdate:
        fused = started()
        moment, _ = run(fused, 60)
        stamp = moment.odometry.stamp_ns
        one = detections(MAP, moment.pose, stamp, [0], SIGMA, np.full(1, angle_rad))
        nothing = replace(one.chosen(np.zeros(1, np.bool_)), missed=MAP.ids[:4])
        for _ in range(vain):
            fused.add_detections(nothing)
        return fused.add_detections(one)

    offset, small = seen(0.0).innovation_rad[0], 1e-3
    per_rad = np.sqrt(seen(small - offset).nis) / small
    barely = float(np.sqrt(7.0) / per_rad) - offset
    assert seen(barely).degrees == 1
    assert seen(barely, vain=3).refusal is not None


def test_who_reported_a_place_does_not_vouch_for_where_the_robot_went_blindly() -> None:
    """From metres about, landmarks of one wall fit at a wrong place."""
    walls = on_walls([EAST] * 5 + [NORTH] * 5)
    fused = started(true_map=walls)
    moment, _ = run(fused, 60)
    assert fused.status == ('tracking', '')
    stands = replace(moment.odometry, linear_m_s=0.0, angular_rad_s=0.0)
    blind_ns = stands.stamp_ns + 6 * NS
    for stamp in (blind_ns - NS // 5, blind_ns):
        fused.add_odometry(replace(stands, stamp_ns=stamp))
    assert fused.status[0] == 'lost'
    reported = []
    for k in range(10):
        stamp = blind_ns + (k + 1) * NS // 5
        fused.add_odometry(replace(stands, stamp_ns=stamp))
        seen = range(5) if k < 5 else range(10)
        fused.add_detections(detections(walls, moment.pose, stamp, seen, SIGMA))
        reported.append(fused.status)
    assert 'only one wall' in reported[4][1]
    assert reported[-1] == ('tracking', '')


def test_turns_that_are_given_again_and_again_are_flagged_for_longer() -> None:
    health = Health(HealthConfig(coasting_after_s=1000.0))
    health.restart(0)

    def coasts_s(after_ns: int) -> float:
        """In steps of half a second."""
        for k in range(40):
            now_ns = after_ns + k * NS // 2
            here = PoseEstimate(now_ns, np.zeros(3), 1e-6 * np.eye(3))
            if health.status(here, now_ns)[0] == 'tracking':
                return 0.5 * k
        return np.inf

    for seconds, coasts in (
        (10.0, 2.0),
        (15.0, 2.0),
        (15.8, 2.0),
        (16.6, 2.5),
        (17.5, 3.0),
        (25.0, 3.5),
    ):
        health.note_surprise(round(seconds * NS), Refusal('turned'))
        assert coasts_s(round(seconds * NS)) == coasts
    health.note_surprise(100 * NS, Refusal('turned'))
    assert coasts_s(100 * NS) == 2.0


def test_bearings_that_others_contradict_are_reported_if_there_are_many() -> None:
    """As of a camera whose focal length is wrong: some of each image fit, and some do not."""
    few, many = (started() for _ in range(2))
    for fused, every in ((few, 5), (many, 1)):
        for k, moment in enumerate(drive(80)):
            fused.add_odometry(moment.odometry)
            if k % 4 == 0:
                off = 0.03 if k > 40 and k // 4 % every == 0 else 0.0
                stamp = moment.odometry.stamp_ns
                noise = np.array([0.0, off, 0.0, 0.0, 0.0])
                fused.add_detections(
                    detections(MAP, moment.pose, stamp, np.arange(5), SIGMA, noise)
                )
    assert few.status == ('tracking', '')
    status, reason = many.status
    assert status == 'coasting'
    assert 'landmarks lie elsewhere' in reason


def test_images_in_a_row_are_one_contradiction() -> None:
    contradictions = Contradictions()
    lasted = [contradictions.note(k * NS // 5) for k in range(6)]
    np.testing.assert_allclose(lasted, 0.25 + 0.2 * np.arange(6))
    assert contradictions.note(4 * NS) == 1.5
    assert contradictions.note(60 * NS) == 0.25


def test_nor_does_one_that_takes_it_in_fixes() -> None:
    walls = on_walls([EAST] * 5 + [NORTH] * 5)
    fused = PoseFilter(walls, MOUNT, FusionConfig(mode='poses'))
    moments = list(drive(100))
    start = PoseEstimate(0, moments[0].pose, np.diag(np.square([0.02, 0.02, 0.005])))
    fused.initialize(start, found=Found(NOBODY))
    for k, moment in enumerate(moments):
        fused.add_odometry(moment.odometry)
        stamp_ns = moment.odometry.stamp_ns
        seen, off_rad = (range(5), 0.0) if k < 12 else (range(5, 10), 0.04)
        fused.add_detections(detections(walls, moment.pose, stamp_ns, seen, SIGMA, off_rad))
        fixed = moment.pose - np.array([0.0, 0.0, off_rad])
        covariance = np.diag(np.square([0.005, 0.005, 0.002]))
        update = fused.add_pose(PoseEstimate(stamp_ns, fixed, covariance))
        assert (update.turned_rad != 0.0) == (k == 12)
    assert fused.status[0] == 'coasting'
    assert 'only one wall' in fused.status[1]
