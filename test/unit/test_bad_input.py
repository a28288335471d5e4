"""
What goes wrong on a real robot, fed to the localizer: it says so, survives, and comes back.

One drive is drawn; every test spoils it in its own way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import fusion_drives
import numpy as np
from picture_drives import drive, error_of, FRAME_NS, MAP, MOUNT, picture, START, START_SIGMA, Step
import pytest
from scipy.stats import chi2

from landmark_nav.evaluation.camera_offsets import camera_offsets
from landmark_nav.evaluation.replay import replay as replay_events
from landmark_nav.geometry import se2
from landmark_nav.localization.fusion import FusionConfig, PoseFilter
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.localization.pipeline import LocalizationConfig, LocalizationUpdate, Localizer
from landmark_nav.localization.relocalization import RelocalizationConfig
from landmark_nav.types import CameraFrame, FloatArray, LandmarkMap, OdometrySample, PoseEstimate

SECONDS = 12.0
FAULT_S = 3.2


def pan_rad(seconds: float) -> float:
    """Look about."""
    return float(1.8 * np.sin(0.6 * seconds))


Sensed = tuple[Step, CameraFrame | None]
Change = Callable[[Step, CameraFrame | None], Sensed]


@pytest.fixture(scope='module')
def sensed() -> list[Sensed]:
    """A drive: truth and odometry, every eighth time a picture."""
    rng = np.random.default_rng(5)
    found: list[Sensed] = []
    for step in drive(rng, SECONDS):
        frame = None
        if step.stamp_ns % FRAME_NS == 0:
            frame = picture(step.pose, pan_rad(step.stamp_ns * 1e-9), rng)
            frame = replace(frame, stamp_ns=step.stamp_ns)
        found.append((step, frame))
    return found


@dataclass(frozen=True, eq=False)
class Moment:
    """After a picture: seconds since the fault, verdict, error, and sigmas of the pose."""

    after_s: float
    status: str
    reason: str
    error: FloatArray
    sigma: FloatArray
    update: LocalizationUpdate

    @property
    def nees(self) -> float:
        """Of x, y and heading."""
        return float(self.error @ np.linalg.solve(self.update.fused.covariance, self.error))


def run(
    sensed: list[Sensed],
    change: Change,
    landmarks: LandmarkMap = MAP,
    start: FloatArray = START,
    config: LocalizationConfig | None = None,
) -> Iterator[Moment]:
    """Drive with what `change` makes of each moment after the fault begins."""
    localizer = Localizer(landmarks, MOUNT, config or LocalizationConfig())
    localizer.initialize(PoseEstimate(0, start, np.diag(START_SIGMA**2)))
    for step, frame in sensed:
        seconds = step.stamp_ns * 1e-9 - FAULT_S
        if seconds >= 0.0:
            step, frame = change(step, frame)
        localizer.add_odometry(step.odometry)
        if frame is None:
            continue
        update = localizer.add_frame(frame)
        assert isinstance(update, LocalizationUpdate)
        assert np.isfinite(update.fused.pose).all()
        error = error_of(update.fused, step.pose)
        sigma = np.sqrt(np.diag(update.fused.covariance))
        yield Moment(seconds, update.status, update.reason, error, sigma, update)


def untouched(step: Step, frame: CameraFrame | None) -> Sensed:
    """No fault."""
    return step, frame


def check_honest(moments: list[Moment]) -> None:
    """Never sure and wrong: three numbers whose errors are Gaussian reach 40 once in 10^8."""
    for moment in moments:
        assert moment.status != 'tracking' or moment.after_s < 2.0 or moment.nees < 40.0


def first(moments: list[Moment], status: str) -> Moment:
    """When a verdict is first given after the fault."""
    return next(m for m in moments if m.after_s >= 0.0 and m.status == status)


def test_without_faults_it_tracks(sensed: list[Sensed]) -> None:
    moments = list(run(sensed, untouched))
    check_honest(moments)
    # Towards the end the camera looks where no landmark is.
    assert {m.status for m in moments if m.after_s < 6.0} == {'tracking'}
    assert all(m.update.search is None for m in moments)


@pytest.mark.parametrize(
    ('offset', 'mode'),
    [((0.8, 0.6, 0.0), 'bearings'), ((-0.6, 0.1, 0.8), 'bearings'), ((0.8, 0.6, 0.0), 'poses')],
)
def test_a_wrong_start_is_noticed_and_put_right(
    sensed: list[Sensed], offset: tuple[float, float, float], mode: str
) -> None:
    config = LocalizationConfig(fusion=FusionConfig(mode=mode))
    moments = list(run(sensed, untouched, start=START + np.array(offset), config=config))
    lost = next(m for m in moments if m.status == 'lost')
    assert lost.after_s + FAULT_S <= 2.0
    assert 'were found' in lost.reason
    found = next(m for m in moments if isinstance(m.update.search, PoseEstimate))
    assert found.status == 'tracking'
    assert np.hypot(*found.error[:2]) < 0.05
    assert {m.status for m in moments if found.after_s < m.after_s < 6.0} == {'tracking'}
    check_honest([m for m in moments if m.after_s >= lost.after_s])


def test_a_wrong_start_stays_lost_if_nothing_is_searched(sensed: list[Sensed]) -> None:
    config = LocalizationConfig(relocalization=RelocalizationConfig(when_lost=False))
    moments = list(run(sensed, untouched, start=START + np.array([0.8, 0.6, 0.0]), config=config))
    lost = [m for m in moments if m.after_s + FAULT_S > 2.0]
    assert {m.status for m in lost} == {'lost'}
    assert all(m.update.search is None for m in lost)
    # What is claimed grows until it holds the truth.
    assert np.hypot(*lost[-1].sigma[:2]) > 0.5
    assert lost[-1].nees < 16.0


def test_a_kidnapped_robot_finds_its_place(sensed: list[Sensed]) -> None:
    """From one picture to the next it is where it comes seconds later; the wheels know nothing."""
    begin, back = round(FAULT_S * 20), 64
    before, after = (sensed[k][0].odometry.pose_odom_base for k in (begin, begin - back))
    offset = se2.compose(before, se2.inverse(after))
    # Carried back within the time between two samples, it drives the same way again.
    again: list[Sensed] = []
    for (now, _), (then, frame) in zip(sensed[begin:], sensed[begin - back :], strict=False):
        wheels = replace(
            then.odometry,
            stamp_ns=now.stamp_ns,
            pose_odom_base=se2.compose(offset, then.odometry.pose_odom_base),
        )
        moved = replace(frame, stamp_ns=now.stamp_ns) if frame is not None else None
        again.append((Step(now.stamp_ns, then.pose, wheels), moved))

    moments = list(run([*sensed[:begin], *again], untouched))
    lost = first(moments, 'lost')
    assert lost.after_s <= 2.0
    assert moments[-1].status == 'tracking'
    assert np.hypot(*moments[-1].error[:2]) < 0.05
    check_honest(moments)


def test_a_covered_lens_is_told_and_forgotten_when_free(sensed: list[Sensed]) -> None:
    def covered(step: Step, frame: CameraFrame | None) -> Sensed:
        if frame is not None and step.stamp_ns * 1e-9 < FAULT_S + 3.0:
            frame = replace(frame, image=np.zeros_like(frame.image))
        return step, frame

    moments = list(run(sensed, covered))
    lost = first(moments, 'lost')
    assert lost.after_s <= 2.0
    assert 'landmarks that should be in the last' in lost.reason
    hidden = [m for m in moments if 0.0 <= m.after_s < 2.9]
    assert all(np.diff([np.hypot(*m.sigma[:2]) for m in hidden]) > 0.0)
    back = next(m for m in moments if m.after_s > 3.0 and m.status == 'tracking')
    assert back.after_s <= 4.5
    assert np.hypot(*back.error[:2]) < 0.05
    check_honest(moments)


def test_a_map_of_another_room_is_not_believed(sensed: list[Sensed]) -> None:
    rng = np.random.default_rng(0)
    patches = [np.ascontiguousarray(k.patch[::-1, ::-1]) for k in MAP.landmarks]
    landmarks = tuple(
        replace(k, patch=patches[p])
        for k, p in zip(MAP.landmarks, rng.permutation(len(patches)), strict=True)
    )
    moments = list(run(sensed, untouched, landmarks=replace(MAP, landmarks=landmarks)))
    assert all(m.status == 'lost' for m in moments if m.after_s + FAULT_S >= 2.0)
    assert not any(isinstance(m.update.search, PoseEstimate) for m in moments)


def test_a_covered_and_an_exchanged_landmark_do_no_harm(sensed: list[Sensed]) -> None:
    landmarks = list(MAP.landmarks)
    rng = np.random.default_rng(1)
    for k in range(0, len(landmarks), 4):
        landmarks[k] = replace(landmarks[k], patch=landmarks[k - 1].patch)
        noise = rng.integers(0, 255, landmarks[k + 1].patch.shape).astype(np.uint8)
        landmarks[k + 1] = replace(landmarks[k + 1], patch=noise)
    moments = list(run(sensed, untouched, replace(MAP, landmarks=tuple(landmarks))))
    assert 'lost' not in {m.status for m in moments}
    assert np.sqrt(np.mean([np.sum(m.error[:2] ** 2) for m in moments])) < 0.04
    check_honest(moments)


def jumping(k: int, step: Step) -> Step | None:
    """Odometry that starts anew somewhere else."""
    moved = se2.compose([5.0, 1.0, 1.0], step.odometry.pose_odom_base)
    return replace(step, odometry=replace(step.odometry, pose_odom_base=moved))


def standing(k: int, step: Step) -> Step | None:
    """Odometry that repeats its last sample."""
    return replace(step, odometry=replace(step.odometry, stamp_ns=round(FAULT_S * 1e9)))


def silent(k: int, step: Step) -> Step | None:
    """Odometry that stops."""
    return None


def broken(k: int, step: Step) -> Step | None:
    """Odometry that is not a number."""
    bad = replace(step.odometry, pose_odom_base=np.array([np.nan, 0.0, np.inf]))
    return replace(step, odometry=bad)


def behind(k: int, step: Step) -> Step | None:
    """Stamps that go back, a little more each time."""
    return replace(step, odometry=replace(step.odometry, stamp_ns=step.stamp_ns - 2 * k * 10**8))


@pytest.mark.parametrize(
    ('fault', 'reason'),
    [
        (jumping, 'odometry jumped'),
        (standing, 'repeated a stamp'),
        (silent, 'no odometry for'),
        (broken, 'not a number'),
        (behind, 'back'),
    ],
)
def test_odometry_that_fails_is_told_while_the_camera_goes_on(
    sensed: list[Sensed], fault: Callable[[int, Step], Step | None], reason: str
) -> None:
    localizer = Localizer(MAP, MOUNT, LocalizationConfig())
    localizer.initialize(PoseEstimate(0, START, np.diag(START_SIGMA**2)))
    told: list[tuple[float, str, str]] = []
    for k, (step, frame) in enumerate(sensed):
        seconds = step.stamp_ns * 1e-9 - FAULT_S
        wrong = fault(k, step) if 0.0 < seconds < 4.0 else step
        if seconds > 7.0:
            break
        if wrong is not None:
            localizer.add_odometry(wrong.odometry)
        if frame is None:
            continue
        update = localizer.add_frame(frame)
        assert isinstance(update, LocalizationUpdate)
        assert np.isfinite(update.fused.pose).all()
        told.append((seconds, update.status, update.reason))
        error = error_of(update.fused, step.pose)
        spread = np.linalg.solve(update.fused.covariance, error)
        assert update.status == 'lost' or error @ spread < 40.0
    assert any(reason in text for seconds, _, text in told if 0.0 <= seconds <= 2.0)
    assert all(status != 'tracking' for _, status, text in told if reason in text)
    # It is over soon after the fault is.
    assert told[-1][1] == 'tracking'
    assert np.hypot(*error[:2]) < 0.05


def test_pictures_that_stop_or_come_from_another_clock(sensed: list[Sensed]) -> None:
    def shifted(step: Step, frame: CameraFrame | None) -> Sensed:
        if frame is not None and step.stamp_ns * 1e-9 < FAULT_S + 2.5:
            frame = replace(frame, stamp_ns=frame.stamp_ns - 100 * 10**9)
        return step, frame

    moments = list(run(sensed, shifted))
    coasting = first(moments, 'coasting')
    assert coasting.after_s <= 2.0
    assert 'too late' in coasting.reason
    assert {m.status for m in moments if 3.0 < m.after_s < 6.0} == {'tracking'}


def test_a_picture_angle_that_is_not_a_number_is_left_out(sensed: list[Sensed]) -> None:
    def broken_pan(step: Step, frame: CameraFrame | None) -> Sensed:
        if frame is not None and step.stamp_ns * 1e-9 < FAULT_S + 2.0:
            frame = replace(frame, pan_rad=float('nan'))
        return step, frame

    moments = list(run(sensed, broken_pan))
    assert first(moments, 'coasting').after_s <= 2.0
    assert {m.status for m in moments if 2.5 < m.after_s < 6.0} == {'tracking'}


@pytest.mark.parametrize('angle_deg', [2.0, -2.0])
def test_a_camera_bumped_against_the_base_goes_on(sensed: list[Sensed], angle_deg: float) -> None:
    def bumped(step: Step, frame: CameraFrame | None) -> Sensed:
        if frame is not None:
            frame = replace(frame, pan_rad=frame.pan_rad + np.radians(angle_deg))
        return step, frame

    moments = list(run(sensed, bumped))
    told = next(m for m in moments if m.after_s >= 0.0 and 'turned' in m.reason)
    assert told.after_s <= 2.0
    assert told.status == 'coasting'
    assert np.degrees(told.sigma[2]) > 1.0
    assert {m.status for m in moments if 3.0 < m.after_s < 6.0} == {'tracking'}
    assert max(np.hypot(*m.error[:2]) for m in moments if m.after_s > 2.0) < 0.05
    check_honest(moments)


@pytest.mark.parametrize('ahead_m', [0.2, -0.2])
def test_wheels_that_spin_are_not_taken_for_a_turned_camera_alone(
    sensed: list[Sensed], ahead_m: float
) -> None:
    """From here a few landmarks are off by one angle, as they are when the camera is turned."""
    pivot = sensed[round(FAULT_S * 20)][0].odometry.pose_odom_base

    def spun(step: Step, frame: CameraFrame | None) -> Sensed:
        done = np.clip((step.stamp_ns * 1e-9 - FAULT_S) / 0.5, 0.0, 1.0)
        since = se2.compose(se2.inverse(pivot), step.odometry.pose_odom_base)
        pose = se2.compose(pivot, se2.compose([done * ahead_m, 0.0, 0.0], since))
        return replace(step, odometry=replace(step.odometry, pose_odom_base=pose)), frame

    moments = list(run(sensed[: round(20 * (FAULT_S + 4.0))], spun))
    assert first(moments, 'coasting').after_s <= 1.0
    assert all(m.nees < 25.0 for m in moments if m.after_s >= 0.0)
    assert {m.status for m in moments if m.after_s > 2.5} == {'tracking'}
    assert all(np.hypot(*m.error[:2]) < 0.03 for m in moments if m.after_s > 1.5)


@pytest.mark.parametrize('angle_deg', [1.0, -2.0])
def test_a_camera_bumped_in_its_tilt_finds_all_as_before(
    sensed: list[Sensed], angle_deg: float, caplog: pytest.LogCaptureFixture
) -> None:
    def tilted(step: Step, frame: CameraFrame | None) -> Sensed:
        if frame is not None:
            frame = replace(frame, tilt_rad=frame.tilt_rad + np.radians(angle_deg))
        return step, frame

    short = sensed[: round(20 * (FAULT_S + 4.0))]
    moments, usual = list(run(short, tilted)), list(run(short, untouched))
    assert {m.status for m in moments} == {'tracking'}
    assert max(np.hypot(*m.error[:2]) for m in moments) < 0.03
    check_honest(moments)
    seen, without = (
        sum(len(m.update.observation.detections) for m in ms) for ms in (moments, usual)
    )
    assert seen > 0.9 * without
    # The joints say too much, so the camera looks lower.
    (told,) = [float(word) for word in caplog.text.split() if word[0] in '+-' and word[1:]]
    assert told == pytest.approx(-angle_deg, abs=0.2)


@pytest.mark.parametrize('late_s', [0.0, 0.04, -0.04])
def test_joint_states_that_are_late_are_measured(sensed: list[Sensed], late_s: float) -> None:
    events: list[CameraFrame | OdometrySample] = []
    for step, frame in sensed:
        events.append(step.odometry)
        if frame is None or step.stamp_ns * 1e-9 > 9.0:
            continue
        seconds = step.stamp_ns * 1e-9 - late_s
        rate = (pan_rad(seconds + 0.025) - pan_rad(seconds - 0.025)) / 0.05
        events.append(replace(frame, pan_rad=pan_rad(seconds), pan_rate_rad_s=rate))
    config = LocalizationConfig()
    done = replay_events(events, MAP, MOUNT, config, START, np.diag(START_SIGMA**2))
    offsets = camera_offsets(done, MAP, MOUNT, config)
    assert offsets.delay_sigma_s < 0.008
    assert abs(offsets.delay_s - late_s) < 4.0 * offsets.delay_sigma_s
    assert offsets.delay_matters == (late_s != 0.0)
    assert abs(offsets.boresight_rad) < 4.0 * offsets.boresight_sigma_rad


def test_joint_states_far_too_late_lose_the_pose_for_as_long_as_they_last(
    sensed: list[Sensed],
) -> None:
    """The camera turns at up to 62 deg/s; where it is said to look it looked 0.2 s before."""

    def late(step: Step, frame: CameraFrame | None) -> Sensed:
        seconds = step.stamp_ns * 1e-9
        if frame is not None and seconds < FAULT_S + 1.5:
            frame = replace(frame, pan_rad=pan_rad(seconds - 0.2))
        return step, frame

    moments = list(run(sensed, late))
    told = next(m for m in moments if m.after_s >= 0.0 and m.status != 'tracking')
    assert told.after_s <= 2.0
    assert told.reason
    back = next(m for m in moments if m.after_s > 1.5 and m.status == 'tracking')
    assert back.after_s <= 5.0
    assert np.hypot(*back.error[:2]) < 0.05
    check_honest(moments)


def test_without_joint_states_no_picture_counts_and_odometry_goes_on(
    sensed: list[Sensed],
) -> None:
    """Pictures without joint angles reach nobody: readers and nodes leave them out."""
    fused = PoseFilter(MAP, MOUNT)
    fused.initialize(PoseEstimate(0, START, np.diag(START_SIGMA**2)))
    sigmas = []
    for step, _ in sensed:
        fused.add_odometry(step.odometry)
        estimate = fused.estimate()
        assert estimate is not None
        sigmas.append(float(np.hypot(*np.sqrt(np.diag(estimate.covariance)[:2]))))
        if step.stamp_ns > 2 * 10**9:
            status, reason = fused.status
            assert status == 'coasting'
            assert 'nothing accepted for' in reason
    assert np.all(np.diff(sigmas) > 0.0)


def test_a_minute_without_landmarks_is_told_and_survived() -> None:
    """Along walls without landmarks; the claim grows with the error, and ends with a sighting."""
    nees = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        noise = OdometryNoiseConfig()
        true_map = fusion_drives.landmark_map(14, seed=seed)
        fused = PoseFilter(true_map, fusion_drives.MOUNT)
        fused.initialize(fusion_drives.start_estimate())
        for k, moment in enumerate(fusion_drives.drive(1400, rng, noise)):
            fused.add_odometry(moment.odometry)
            seconds = k * fusion_drives.PERIOD_NS * 1e-9
            if k % 4 == 0:
                places = range(14) if not 5.0 < seconds < 65.0 else ()
                scatter = rng.normal(0.0, 1e-3, len(places))
                seen = fusion_drives.detections(
                    true_map, moment.pose, moment.odometry.stamp_ns, places, 1e-3, scatter
                )
                fused.add_detections(seen)
            if 7.0 < seconds < 65.0:
                assert fused.status[0] != 'tracking'
                assert fused.status[1]
            if seconds == 64.0:
                estimate = fused.estimate()
                assert estimate is not None
                error = fusion_drives.error_of(estimate, moment.pose)
                nees.append(error @ np.linalg.solve(estimate.covariance, error))
                assert np.hypot(*np.sqrt(np.diag(estimate.covariance)[:2])) > 0.05
        assert fused.status == ('tracking', '')
        back = fusion_drives.error_of(fused.estimate(), moment.pose)
        assert np.hypot(*back[:2]) < 0.03
    low, high = chi2.ppf([0.005, 0.995], 3 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high


@pytest.mark.parametrize('count', [5, 2])
def test_a_picture_exchanged_for_a_similar_one_does_not_pull_again_and_again(count: int) -> None:
    """It is found about there, a little less alike, and off by the same amount each time."""
    true_map = fusion_drives.landmark_map(14)
    errors = {}
    for score in (1.0, 0.89):
        fused = PoseFilter(true_map, fusion_drives.MOUNT)
        fused.initialize(fusion_drives.start_estimate())
        for k, moment in enumerate(fusion_drives.drive(120)):
            fused.add_odometry(moment.odometry)
            if k % 4 == 0:
                stamp = moment.odometry.stamp_ns
                # Pictures that show many show what to expect of those that show few.
                shown = slice(5 - (count if k > 16 else 5), 5)
                offset = np.array([0.0, 0.0, 0.0, 0.0, 1.4e-3])[shown]
                places = np.arange(5)[shown]
                seen = fusion_drives.detections(true_map, moment.pose, stamp, places, 5e-4, offset)
                scores = np.array([0.998, 0.995, 0.997, 0.996, score])[shown]
                update = fused.add_detections(replace(seen, score=scores))
        errors[score] = np.hypot(*fusion_drives.error_of(fused.estimate(), moment.pose)[:2])
        assert ('less alike' in str(update.rejected)) == (score < 0.9)
    assert errors[0.89] < 0.2 * errors[1.0]
