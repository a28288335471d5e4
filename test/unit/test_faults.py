"""Faults on a real robot: the localizer reports them, survives, and recovers."""

from collections.abc import Callable
import copy
from dataclasses import dataclass, replace
from typing import Any

from builders import nees, pose_error
import numpy as np
import pytest
from rendered_drives import camera_image, drive, FRAME_NS, MAP, MOUNT, START, START_SIGMA, Step

from landmark_nav.calibration import Calibration, UNITS
from landmark_nav.evaluation.replay import replay as replay_events
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import PanTrack
from landmark_nav.localization import observer
from landmark_nav.localization.joint_delay import JointDelay
from landmark_nav.localization.localizer import LocalizationConfig, LocalizationUpdate, Localizer
from landmark_nav.localization.relocalization.search import localize_within_prior
from landmark_nav.types import CameraFrame, FloatArray, OdometrySample, PoseEstimate, Refusal

SECONDS = 12.0
FAULT_S = 3.2

# The mount is measured well, and may be displaced.
KNOWN = Calibration.of_mount(
    MOUNT, {name: 1e-3 if unit == 'm' else 2e-3 for name, unit in UNITS.items() if unit != 's'}
)


def pan_rad(seconds):
    """Look about."""
    return float(1.8 * np.sin(0.6 * seconds))


Sensed = tuple[Step, CameraFrame | None]
Change = Callable[[Step, CameraFrame | None], Sensed]


@pytest.fixture(scope='module')
def sensed():
    """A drive: truth and odometry, every eighth time an image."""
    rng = np.random.default_rng(5)
    found: list[Sensed] = []
    for step in drive(rng, SECONDS):
        frame = None
        if step.stamp_ns % FRAME_NS == 0:
            frame = camera_image(step.pose, pan_rad(step.stamp_ns * 1e-9), rng)
            frame = replace(frame, stamp_ns=step.stamp_ns)
        found.append((step, frame))
    return found


@dataclass(frozen=True, eq=False)
class Moment:
    """After an image: time since the fault, verdict, error, odometry refused by then."""

    after_s: float
    status: str
    error: FloatArray
    update: LocalizationUpdate
    refused: int

    @property
    def nees(self):
        """Of x, y and heading."""
        return float(nees(self.error, self.update.fused.covariance))


def begin(sensed, landmarks=MAP, start=START, calibration=KNOWN):
    """Localizer just before the fault, and the moments until then."""
    localizer = Localizer(landmarks, calibration, LocalizationConfig())
    localizer.initialize(PoseEstimate(0, start, np.diag(START_SIGMA**2)))
    return localizer, list(_moments(localizer, sensed[: round(20 * FAULT_S)], untouched, 0))


@pytest.fixture(scope='module')
def begun(sensed):
    return begin(sensed)


def run(sensed, change, begun=None, **given):
    """Drive with what `change` makes of each moment after the fault; odometry may be None."""
    localizer, before = copy.deepcopy(begun) if begun else begin(sensed, **given)
    after = sensed[round(20 * FAULT_S) :]
    return [*before, *_moments(localizer, after, change, before[-1].refused)]


def _moments(localizer, sensed, change, refused):
    for step, frame in (change(*each) for each in sensed):
        if step.odometry is not None:
            refused += localizer.add_odometry(step.odometry) is not None
        if frame is None:
            continue
        update = localizer.add_frame(frame)
        assert np.isfinite(update.fused.pose).all()
        error = pose_error(update.fused, step.pose)
        yield Moment(step.stamp_ns * 1e-9 - FAULT_S, update.status, error, update, refused)


def untouched(step, frame):
    """No fault."""
    return step, frame


def check_consistent(moments):
    """No undetected failure: three numbers whose errors are Gaussian reach 40 once in 10^8."""
    for moment in moments:
        assert moment.status != 'OK' or moment.after_s < 2.0 or moment.nees < 40.0


LATE_S = 0.2


def images(change):
    return lambda step, frame: (step, frame and change(frame))


def wheels(change):
    return lambda step, frame: (replace(step, odometry=change(step.odometry)), frame)


def moved(sample, pose):
    return replace(sample, pose_odom_base=np.asarray(pose, float))


def at_fault(sensed):
    return sensed[round(FAULT_S * 20)][0].odometry


def stamped_late(frame, late_s=LATE_S):
    """Joint states give for every moment where the camera looked a while before."""
    about = np.linspace(-0.4, 0.4, 17)
    given = np.array([pan_rad(frame.stamp_ns * 1e-9 - late_s + t) for t in about])
    rate = float((given[9] - given[7]) / (about[9] - about[7]))
    return replace(
        frame, pan_rad=float(given[8]), pan_rate_rad_s=rate, pan_track=PanTrack(about, given)
    )


def turned(**off_deg):
    """A camera whose joints say too much by so many degrees."""

    def change(frame):
        off = {f'{name}_rad': np.radians(deg) for name, deg in off_deg.items()}
        return replace(frame, **{name: getattr(frame, name) + rad for name, rad in off.items()})

    return lambda sensed: images(change)


def frozen_image(sensed):
    shown = next(f for s, f in sensed if f is not None and s.stamp_ns * 1e-9 >= FAULT_S - 0.3)
    return images(lambda frame: replace(frame, image=shown.image))


def spinning(ahead_m):
    """Wheels that claim a way within half a second which the robot does not go."""

    def change(sensed):
        pivot = at_fault(sensed).pose_odom_base

        def spun(sample):
            done = np.clip((sample.stamp_ns * 1e-9 - FAULT_S) / 0.5, 0.0, 1.0)
            since = se2.compose(
                [done * ahead_m, 0.0, 0.0], se2.relative(pivot, sample.pose_odom_base)
            )
            return moved(sample, se2.compose(pivot, since))

        return wheels(spun)

    return change


def clock_set(by_s):
    """One clock for all: odometry is not late for that."""

    def change(step, frame):
        by_ns = round(1e9 * by_s)
        frame = frame and replace(frame, stamp_ns=frame.stamp_ns + by_ns)
        stamp_ns = step.odometry.stamp_ns + by_ns
        return replace(step, odometry=replace(step.odometry, stamp_ns=stamp_ns)), frame

    return lambda _: change


def one_of_another_clock(sensed):
    """The first odometry of the fault is stamped an hour early."""
    at_ns = at_fault(sensed).stamp_ns
    return wheels(lambda s: replace(s, stamp_ns=s.stamp_ns - (s.stamp_ns == at_ns) * 3600 * 10**9))


def behind(sample):
    """Stamps that go back, more each time."""
    since_ns = sample.stamp_ns - round(FAULT_S * 1e9)
    return replace(sample, stamp_ns=sample.stamp_ns - 4 * since_ns)


NEVER = np.inf
# Change; seconds it lasts, to be noticed within, and after which all is tracked again.
FAULTS: dict[str, tuple[Callable[[list[Sensed]], Change], float, float, float]] = {
    'nothing': (lambda _: untouched, 0.0, NEVER, 0.0),
    'images of another clock': (
        lambda _: images(lambda f: replace(f, stamp_ns=f.stamp_ns - 10**11)), 2.5, 2.0, 3.0),
    'pan is no number': (lambda _: images(lambda f: replace(f, pan_rad=np.nan)), 2.0, 2.0, 2.5),
    'lens is covered': (
        lambda _: images(lambda f: replace(f, image=np.zeros_like(f.image))), 3.0, 2.0, 4.5),
    'images freeze': (frozen_image, 2.5, 2.0, 3.0),
    'joint states freeze': (
        lambda _: images(lambda f: replace(f, pan_rad=pan_rad(FAULT_S))), 3.0, 2.0, NEVER),
    'joint states late for a while': (
        lambda _: images(lambda f: replace(f, pan_rad=pan_rad(f.stamp_ns * 1e-9 - LATE_S))),
        1.5, 2.0, 5.0),
    'joint states late for good': (lambda _: images(stamped_late), NEVER, NEVER, 3.0),
    'camera bumped to the left': (turned(pan=2.0), NEVER, 2.0, 3.0),
    'camera bumped to the right': (turned(pan=-2.0), NEVER, 2.0, 3.0),
    'camera bumped up': (turned(tilt=1.0), NEVER, NEVER, 2.0),
    'camera bumped down': (turned(tilt=-2.0), NEVER, NEVER, 2.0),
    'camera rolled to the left': (turned(roll=3.0), NEVER, NEVER, 2.0),
    'camera rolled to the right': (turned(roll=-2.0), NEVER, NEVER, 2.0),
    'wheels spin ahead': (spinning(0.2), NEVER, 1.0, 2.5),
    'wheels spin back': (spinning(-0.2), NEVER, 1.0, 2.5),
    'wheels stand': (
        lambda sensed: wheels(lambda s: replace(
            at_fault(sensed), stamp_ns=s.stamp_ns, linear_m_s=0.0, angular_rad_s=0.0)),
        4.0, 2.0, NEVER),
    'clock set back': (clock_set(-1.0), NEVER, NEVER, 2.5),
    'clock set back by an hour': (clock_set(-3600.0), NEVER, NEVER, 2.5),
    # As after a computer slept: the robot may be anywhere meanwhile.
    'clock set ahead by a day': (clock_set(86400.0), NEVER, 0.5, 2.5),
    'odometry once of another clock': (one_of_another_clock, NEVER, NEVER, 2.5),
    'odometry starts anew': (
        lambda _: wheels(lambda s: moved(s, se2.compose([5.0, 1.0, 1.0], s.pose_odom_base))),
        4.0, 2.0, 7.0),
    'odometry repeats its stamp': (
        lambda _: wheels(lambda s: replace(s, stamp_ns=round(FAULT_S * 1e9))), 4.0, 2.0, 7.0),
    'odometry stops': (lambda _: wheels(lambda s: None), 4.0, 2.0, 7.0),
    'odometry is no number': (lambda _: wheels(lambda s: moved(s, [np.nan, 0.0, np.inf])),
                              4.0, 2.0, 7.0),
    'odometry goes back': (lambda _: wheels(behind), 4.0, 2.0, 7.0),
}  # fmt: skip


@pytest.mark.parametrize('name', FAULTS)
def test_a_fault_is_noticed_and_got_over(sensed, begun, name):
    make, lasts_s, noticed_s, back_s = FAULTS[name]
    change = make(sensed)

    def until(step, frame):
        return change(step, frame) if step.stamp_ns * 1e-9 < FAULT_S + lasts_s else (step, frame)

    # After six seconds the camera looks where no landmark is, for a while.
    until_s = FAULT_S + max(6.0, min(back_s, 8.0) + 0.5)
    moments = run(sensed[: round(20 * until_s)], until, begun)
    check_consistent(moments)
    if np.isfinite(noticed_s):
        soon = [m for m in moments if 0.0 <= m.after_s <= noticed_s]
        assert any(m.refused or m.status != 'OK' for m in soon)
    else:
        assert 'lost' not in {m.status for m in moments}
    if np.isfinite(back_s):
        later = [m for m in moments if m.after_s > back_s and not 6.0 <= m.after_s <= 7.0]
        assert {m.status for m in later} == {'OK'}
        assert max(np.hypot(*m.error[:2]) for m in later) < 0.07


# The last one lies behind the walls, where no landmark is to be seen: no image contradicts it.
@pytest.mark.parametrize('offset', [(0.8, 0.6, 0.0), (-0.6, 0.1, 0.8), (-30.0, 0.0, 0.0)])
def test_a_wrong_start_is_noticed_and_put_right(sensed, offset):
    moments = run(sensed, untouched, start=START + np.array(offset))
    found = next(m for m in moments if isinstance(m.update.search, PoseEstimate))
    assert found.after_s + FAULT_S <= (2.0 if offset[0] > -1.0 else 6.0)
    before = [m for m in moments if m.after_s + FAULT_S > 2.0 and m.after_s < found.after_s]
    assert 'OK' not in {m.status for m in before}
    later = [m for m in moments if found.after_s < m.after_s < 6.0]
    assert {m.status for m in later} == {'OK'}
    assert max(np.hypot(*m.error[:2]) for m in later) < 0.05
    check_consistent(later)


def test_a_kidnapped_robot_finds_its_place(sensed):
    """From one image to the next it is where it comes seconds later; the wheels know nothing."""
    begin, back = round(FAULT_S * 20), 64
    before, after = (sensed[k][0].odometry.pose_odom_base for k in (begin, begin - back))
    offset = se2.compose(before, se2.inverse(after))
    # Carried back within the time between two samples, it drives the same way again.
    again: list[Sensed] = []
    for (now, _), (then, frame) in zip(sensed[begin:], sensed[begin - back :], strict=False):
        pose = se2.compose(offset, then.odometry.pose_odom_base)
        sample = replace(moved(then.odometry, pose), stamp_ns=now.stamp_ns)
        frame = frame and replace(frame, stamp_ns=now.stamp_ns)
        again.append((Step(now.stamp_ns, then.pose, sample), frame))
    moments = run([*sensed[:begin], *again], untouched)
    assert 'OK' not in {m.status for m in moments if 0.0 <= m.after_s <= 2.0}
    assert moments[-1].status == 'OK'
    assert np.hypot(*moments[-1].error[:2]) < 0.05
    check_consistent(moments)


def test_a_map_of_another_room_is_not_accepted(sensed, monkeypatch):
    tried: dict[int, Any] = {}

    def counted(frame, *arguments):
        tried[frame.stamp_ns] = place = localize_within_prior(frame, *arguments)
        return place

    monkeypatch.setattr(observer, 'localize_within_prior', counted)
    order = np.random.default_rng(0).permutation(len(MAP.landmarks))
    landmarks = tuple(
        replace(k, patch=np.ascontiguousarray(MAP.landmarks[p].patch[::-1, ::-1]))
        for k, p in zip(MAP.landmarks, order, strict=True)
    )
    moments = run(sensed, untouched, landmarks=replace(MAP, landmarks=landmarks))
    assert all(m.status == 'lost' for m in moments if m.after_s + FAULT_S >= 2.0)
    assert not any(isinstance(m.update.search, PoseEstimate) for m in moments)
    # A search that found nothing is not repeated with each image.
    assert all(isinstance(place, Refusal) for place in tried.values())
    assert 5 < len(tried) < 0.6 * sum(m.status == 'lost' for m in moments)


def delay_of(sensed, late_s, slips_rad=0.0):
    """Delay of the joints as it is known after nine seconds, in which wheels may slip."""
    events: list[CameraFrame | OdometrySample] = []
    given = before = sensed[0][0].odometry.pose_odom_base
    for step, frame in sensed:
        odometry, seconds = step.odometry, step.stamp_ns * 1e-9
        way, before = se2.relative(before, odometry.pose_odom_base), odometry.pose_odom_base
        given = se2.compose(given, way - [0.0, 0.0, slips_rad if 7.0 < seconds < 7.6 else 0.0])
        events.append(moved(odometry, given))
        if frame is not None and seconds <= 9.0:
            events.append(replace(stamped_late(frame, late_s), pan_track=None))
    calibration, config = Calibration.of_mount(MOUNT), LocalizationConfig()
    done = replay_events(events, MAP, calibration, config, START, np.diag(START_SIGMA**2))
    return JointDelay(*done.calibration['joint_delay'])


@pytest.mark.parametrize(
    ('late_s', 'slips_rad'), [(0.0, 0.0), (0.04, 0.0), (-0.04, 0.0), (0.0, 0.003)]
)
def test_the_delay_of_joint_states_is_measured(sensed, late_s, slips_rad):
    """A wheel that slips is not taken for one."""
    late = delay_of(sensed, late_s, slips_rad)
    assert late.sigma_s < 0.008
    assert abs(late.delay_s - late_s) < 4.0 * late.sigma_s
    assert late.matters == (late_s != 0.0)


@pytest.mark.parametrize('rpy', [(np.pi, 0.0, 0.3), (0.0, 0.0, 0.3)], ids=str)
def test_the_same_camera_on_a_unit_that_hangs_or_is_turned_gives_the_same(sensed, rpy):
    """Pan and tilt are counted otherwise, and the images are the same."""
    sense = np.cos(rpy[0])
    x, y, z = MOUNT.optical_center_offset
    hung = replace(
        MOUNT,
        axis_rpy=rpy,
        optical_center_offset=(x, sense * y, sense * z),
        camera_roll_rad=MOUNT.camera_roll_rad + rpy[0],
    )

    def pan_of(pan):
        return sense * (pan - rpy[2])

    def counted(step, frame):
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

    late = images(stamped_late)
    known = [
        sensed,
        [counted(*(late(*each) if k >= 64 else each)) for k, each in enumerate(sensed)],
    ]
    poses = [
        [m.update.fused.pose for m in run(given, change, calibration=Calibration.of_mount(mount))]
        for given, mount, change in zip(known, (MOUNT, hung), (late, untouched), strict=True)
    ]
    np.testing.assert_allclose(poses[1], poses[0], atol=1e-3)


def test_images_of_a_known_delay_give_poses_at_their_stamps(sensed):
    behind, late_s = 2, 0.1
    given = [
        (step, frame and replace(frame, stamp_ns=step.stamp_ns))
        for (step, _), (_, frame) in zip(sensed[behind:], sensed, strict=False)
    ]
    known = replace(KNOWN, base=replace(MOUNT, image_delay_s=late_s))
    nees, unknown = (
        np.mean([m.nees for m in run(given, untouched, calibration=calibration)])
        for calibration in (known, KNOWN)
    )
    assert nees < 5.0 < unknown


@pytest.mark.parametrize('seconds', [1.5, 3.0])
def test_a_delay_that_is_over_is_taken_back(sensed, seconds):
    localizer = Localizer(MAP, KNOWN, LocalizationConfig())
    localizer.initialize(PoseEstimate(0, START, np.diag(START_SIGMA**2)))
    delays = []
    for step, frame in sensed:
        since = step.stamp_ns * 1e-9 - FAULT_S
        localizer.add_odometry(step.odometry)
        if frame is not None and since < seconds + 3.0:
            localizer.add_frame(stamped_late(frame, LATE_S if 0.0 < since < seconds else 0.0))
            delays.append(localizer.fusion.late.delay_s)
    assert max(delays) > 0.15
    # The joints show nothing of longer ones.
    assert np.abs(delays).max() < 0.4
    assert abs(delays[-1]) < max(0.02, 4.0 * localizer.fusion.late.sigma_s)


def test_poses_that_jitter_are_weighed_as_such(sensed):
    rng = np.random.default_rng(3)
    jitter = wheels(lambda s: moved(s, s.pose_odom_base + rng.normal(0.0, [0.01, 0.01, 0.005])))
    nees = [m.nees for m in run(sensed, jitter) if m.after_s > 2.0]
    assert np.mean(nees) < 4.5
    assert np.max(nees) < 25.0
