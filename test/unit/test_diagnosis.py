"""The doctor: known errors of motion are recovered, and the cause is named in a recorded drive."""

from dataclasses import replace
import json
import re

import cv2
from drive_faults import rewritten, write_bag
from harness import BAGS
from message_changes import each_second, no_number, nothing
import numpy as np
import pytest
from stream_errors import of_drives, of_sweeps

from landmark_nav.calibration import Calibration
from landmark_nav.cli.main import main
from landmark_nav.diagnosis import diagnose, QUICK
from landmark_nav.diagnosis.advice import cause_findings, motion_findings
from landmark_nav.diagnosis.causes import late_odometry, verdict
from landmark_nav.diagnosis.looks import Looks
from landmark_nav.diagnosis.motion import Clock, driven_again, explained, linear, Motion, Track
from landmark_nav.diagnosis.odometry import check_speed, check_twist
from landmark_nav.diagnosis.parts import (
    alternating_images,
    check_content,
    frozen_values,
    jumping_values,
    limited_values,
    moved_between,
    repeated_values,
)
from landmark_nav.diagnosis.streams import (
    check_stamps,
    IMAGES,
    JOINTS,
    ODOMETRY,
    one_source,
    Stream,
)
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.matching.strips import StripView
from landmark_nav.storage.bags import Bag, sensor_events
from landmark_nav.storage.bags.definitions import relative_name
from landmark_nav.storage.robot_files import load_calibration, load_robot
from landmark_nav.storage.setup_files import load_room
from landmark_nav.types import OdometrySample

CAMERA = CameraModel(320, 240, 300.0, 300.0, 159.5, 119.5)


@pytest.fixture(scope='module')
def drive():
    """A robot that turns and pans for 30 s, things 3 m away, noise of 2 mrad."""
    seconds = np.arange(-1.0, 32.0, 0.05)
    yaw = 0.8 * np.sin(0.31 * seconds) + 0.3 * np.sin(1.1 * seconds + 1.0)
    speed = 0.3 + 0.1 * np.sin(0.7 * seconds)
    x, y = np.cumsum(0.05 * speed * [np.cos(yaw), np.sin(yaw)], axis=1)
    pan = np.sin(0.9 * seconds) + 0.5 * np.sin(2.3 * seconds)
    before = np.arange(0.0, 30.0, 0.2)
    motion = Motion(
        before, before + 0.2, np.zeros(len(before)), Track(seconds, pan[:, None]),
        Track(seconds, np.stack([x, y, yaw], -1)), (0.1, 0.0),
    )  # fmt: skip
    return replace(motion, turns_rad=measured_anew(motion, 5))


def track(motion, stream, change):
    """The motion with another track of a stream."""
    if stream == JOINTS:
        return replace(motion, pan=change(motion.pan))
    assert motion.odometry is not None
    return replace(motion, odometry=change(motion.odometry))


def test_without_a_fault_nothing_is_named(drive):
    found = linear(drive)
    assert found.fits
    assert found.nearness.value == pytest.approx(1.0 / 3.0, abs=4.0 * found.nearness.sigma)
    for estimate in (found.pan_scale, found.yaw_scale, found.pan_clock_s, found.odometry_clock_s):
        assert abs(estimate.value) < 4.0 * estimate.sigma
    judged = verdict(drive)
    assert judged.kind == 'none'
    assert judged.fits
    assert not any(part(drive) for part in (repeated_values, limited_values, frozen_values))
    assert not [*jumping_values(drive)]


def late(stream, late_s):
    """A row of the table: a stream that is late."""

    def images(m):
        return replace(m, before_s=m.before_s + late_s, after_s=m.after_s + late_s)

    def track_of(m):
        return track(m, stream, lambda t: replace(t, seconds=t.seconds + late_s))

    is_images = stream == IMAGES
    return stream, images if is_images else track_of, 'clock', late_s, 0.01 if is_images else 0.02


def scaled(stream, scale, tolerance):
    """A row of the table: a stream whose angles are scaled."""
    columns = scale if stream == JOINTS else [1.0, 1.0, scale]

    def change(m):
        return track(m, stream, lambda t: replace(t, values=t.values * columns))

    return stream, change, 'scale', 1.0 / scale, tolerance


def fast(t):
    return replace(t, seconds=1.04 * t.seconds)


def stepped(t):
    return replace(t, seconds=t.seconds + 0.4 * (t.seconds > 12.0))


def filtered(t):
    share, values = 1.0 - np.exp(-0.05 / 0.4), t.values.copy()
    for k in range(1, len(values)):
        values[k] = values[k - 1] + share * (t.values[k] - values[k - 1])
    return replace(t, values=values)


@pytest.mark.parametrize(
    ('stream', 'change', 'kind', 'value', 'tolerance'),
    [
        *(late(JOINTS, s) for s in (0.06, 1.7e9)),
        *(late(ODOMETRY, s) for s in (-47.0, 0.06)),
        *(late(IMAGES, s) for s in (0.25, -2.0)),
        (JOINTS, lambda m: track(m, JOINTS, fast), 'drift', 0.04, 0.003),
        (ODOMETRY, lambda m: track(m, ODOMETRY, fast), 'drift', 0.04, 0.003),
        (JOINTS, lambda m: track(m, JOINTS, stepped), 'step', 0.4, 0.01),
        (JOINTS, lambda m: track(m, JOINTS, filtered), 'filter', 0.4, 0.05),
        *(scaled(JOINTS, k, 0.02 / abs(k)) for k in (-1.0, 57.29578)),
        *(scaled(ODOMETRY, k, 0.05 / abs(k)) for k in (-1.0, 0.5)),
        (IMAGES, lambda m: replace(m, turns_rad=0.8 * m.turns_rad), 'scale', 0.8, 0.01),
    ],
)
def test_a_single_fault_is_named_and_measured(drive, stream, change, kind, value, tolerance):
    hints = {stream: [value + 0.4]} if kind == 'clock' and stream != IMAGES else {}
    judged = verdict(change(drive), offsets=hints)
    assert (judged.stream, judged.kind) == (stream, kind)
    assert judged.value == pytest.approx(value, abs=tolerance)
    if kind == 'step':
        assert judged.offset_s == pytest.approx(12.0, abs=0.4)


@pytest.mark.parametrize(('late_s', 'level'), [(0.3, 'warning'), (0.4, 'error')])
def test_a_clock_at_the_bound_is_corrected_as_far_as_its_sigma_allows(drive, late_s, level):
    _, change, *_ = late(ODOMETRY, late_s)
    for seed in range(4):
        motion = change(replace(drive, turns_rad=measured_anew(drive, seed)))
        (found,) = cause_findings(verdict(motion, offsets={ODOMETRY: [late_s + 0.4]}))
        assert (found.name, found.level) == ('odom clock', level)


@pytest.mark.parametrize('stream', [JOINTS, ODOMETRY])
def test_values_that_are_sent_several_times_are_seen(drive, stream):
    def held(t):
        return replace(t, values=t.values[np.arange(len(t.values)) // 10 * 10])

    found = repeated_values(track(drive, stream, held))
    finding, _ = found
    assert finding.name.startswith(stream)
    assert finding.values['changes_hz'] == pytest.approx(2.0, rel=0.1)


def test_a_pan_that_is_cut_off_is_seen(drive):
    cut = track(drive, JOINTS, lambda t: replace(t, values=np.clip(t.values, -0.7, 0.9)))
    found = limited_values(cut)
    finding, rest = found
    assert (finding.values['low_rad'], finding.values['high_rad']) == (-0.7, 0.9)
    assert explained(rest).quiet


@pytest.mark.parametrize(('stream', 'name'), [(JOINTS, 'pan jumps'), (ODOMETRY, 'odom yaw jumps')])
def test_a_jump_is_measured(drive, stream, name):
    def slipped(t):
        values = t.values.copy()
        values[t.seconds > 14.9, -1] += 0.3
        return replace(t, values=values)

    (found,) = jumping_values(track(drive, stream, slipped))
    assert found.name == name
    assert found.values['jump_rad'] == pytest.approx(0.3, abs=0.03)
    assert found.values['at_s'] == pytest.approx(14.9, abs=0.25)


def strip_of(view, wall, pan_rad, mount):
    """Strip of a wall around the camera, 500 pixels per radian, that is seen at a pan."""
    pixels = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), -1)
    rays = CAMERA.unproject(pixels) @ mount.camera_pose_base(pan_rad)[0].T
    azimuth = np.arctan2(rays[..., 1], rays[..., 0])
    slope = rays[..., 2] / np.hypot(rays[..., 0], rays[..., 1])
    where = np.stack([900.0 - 500.0 * azimuth, 350.0 - 500.0 * slope]).astype(np.float32)
    seen = cv2.remap(wall, *where, cv2.INTER_LINEAR)
    return view.strip(np.clip(seen, 0.0, 255.0).astype(np.uint8))


@pytest.mark.parametrize('roll_rad', [0.0, np.pi])
@pytest.mark.parametrize('turn_rad', [-0.31, 0.0, 0.123])
def test_turns_are_read_off_images(turn_rad, roll_rad):
    rng = np.random.default_rng(4)
    wall = cv2.GaussianBlur(rng.normal(128.0, 80.0, (700, 1800)), (0, 0), 3.0) * 4.0 - 380.0
    mount = PanTiltMount(camera_roll_rad=roll_rad)
    view = StripView(CAMERA, mount)
    turn, score = view.turn(*(strip_of(view, wall, pan, mount) for pan in (0.2, 0.2 + turn_rad)))
    assert turn == pytest.approx(turn_rad, abs=0.002)
    assert score > 0.6


NAMED = {name: error for errors in of_drives().values() for name, error in errors.items()}
# One of each kind; `make degraded` has all.
SOME = (
    *('odom clock 5 % fast', 'yaw reversed', 'odom in cm', 'zeros between joint_states'),
    *('truth +30 s', 'pan and tilt exchanged', 'odom x and y exchanged'),
    *('pan stays from half on', 'each second image repeated', 'images turned by 90 deg'),
    *('images of two cameras', 'focal length x 0.02'),
    *('image stamps rounded down to 0.4 s', 'all clocks set by 54 years'),
    *('odom orientation all zero', 'images of two sizes', 'joint_states without joints'),
    *('images clock set back by 1 s', 'pan hangs', 'odom hangs'),
    *('focal length steps by 20 %', 'one image in seven stamped before 1970'),
)


@pytest.mark.parametrize('name', SOME)
def test_the_cause_is_named_in_a_recorded_drive(name, tmp_path):
    error = NAMED[name]
    bag = Bag(error.write(BAGS / 'drive', tmp_path / 'drive'))
    mount, room = load_robot(BAGS / 'robot.yaml'), load_room(BAGS / 'room.yaml')
    known = Calibration.of_mount(error.robot(mount) if error.robot else mount)
    found = diagnose(bag, known, room)
    wrong = [*found.errors, *found.warnings]
    assert any(re.match(error.names, f.name) and re.search(error.finding, f.line()) for f in wrong)
    assert len(wrong) <= 3, 'what follows from a fault is no fault of its own'


@pytest.mark.parametrize(
    ('name', 'level'), [('one image for 4 s', 'warning'), ('each second image repeated', 'error')]
)
def test_only_a_camera_that_always_repeats_images_spoils_a_drive(name, level, tmp_path):
    bag = Bag(NAMED[name].write(BAGS / 'drive', tmp_path / 'drive'))
    found = diagnose(bag, load_calibration(BAGS / 'robot.yaml'))
    (motion,) = (k for k in found.findings if k.name == 'images motion')
    assert motion.level == level
    assert bool(found.errors) is (level == 'error')


@pytest.mark.parametrize(
    ('name', 'off', 'finding'),
    [
        ('pan_scale', 0.1, 'pan scale'),
        ('focal_scale', 0.25, 'camera lens'),
        ('joint_delay', 0.1, 'joint_states clock'),
    ],
)
def test_checks_use_all_that_robot_yaml_gives(name, off, finding):
    given = load_calibration(BAGS / 'robot.yaml')
    wrong = given.with_values(**{name: given[name][0] + off})
    found = diagnose(Bag(BAGS / 'drive'), wrong, load_room(BAGS / 'room.yaml'))
    assert finding in [f.name for f in (*found.errors, *found.warnings)]


@pytest.mark.parametrize('recording', ['drive', 'learn'])
def test_a_good_recording_passes(recording, tmp_path, capsys):
    files = ['--robot', str(BAGS / 'robot.yaml'), '--room', str(BAGS / 'room.yaml')]
    out = tmp_path / 'check.json'
    assert main(['check', str(BAGS / recording), *files, '--json', str(out)]) == 0
    report = json.loads(out.read_text())
    assert report['status'] == 'ok'
    names = [check['name'] for check in report['checks']]
    assert len(set(names)) == len(names)
    assert all(name in capsys.readouterr().out for name in names[:1])


def test_a_bag_written_in_a_wrong_order_is_no_fault_of_clocks(tmp_path):
    rng = np.random.default_rng(4)

    messages = [
        (
            relative_name(entry.topic),
            entry.message,
            entry.stamp_ns + int(rng.integers(-(10**9), 10**9)),
        )
        for entry in Bag(BAGS / 'drive').messages()
    ]
    bag = Bag(write_bag(tmp_path / 'drive', messages))
    (found,) = diagnose(bag, Calibration.of_mount(load_robot(BAGS / 'robot.yaml'))).findings
    assert (found.name, found.level) == ('recording order', 'error')


@pytest.mark.parametrize('name', ['pan reversed', 'pan in degrees'])
def test_learning_refuses_what_it_cannot_calibrate(name, tmp_path, capsys):
    error = of_sweeps()[name]
    bag = error.write(BAGS / 'learn', tmp_path / 'learn')
    files = ['--room', str(BAGS / 'room.yaml'), '--robot', str(BAGS / 'robot.yaml')]
    assert main(['learn', str(bag), *files, '--out', str(tmp_path / 'map')]) == 1
    reported = capsys.readouterr().err
    assert error.names in reported
    assert error.finding in reported
    assert not (tmp_path / 'map').exists()


def test_degrees_as_the_mount_of_a_camera_are_refused(tmp_path):
    robot = tmp_path / 'robot.yaml'
    robot.write_text('pan_axis:\n  xyz: [0.0, 0.0, 1.0]\n  rpy: [0, 0, 5]\n')
    assert main(['check', str(BAGS / 'drive'), '--robot', str(robot)]) == 1


def test_a_bag_without_images_is_refused(tmp_path, capsys):
    bag = rewritten(BAGS / 'drive', tmp_path / 'drive', ('camera/image_raw/compressed',), nothing)
    assert main(['check', str(bag)]) == 1
    assert 'camera/image_raw' in capsys.readouterr().err


@pytest.mark.parametrize(('frame', 'fits'), [('base_footprint', True), ('laser', False)])
def test_odometry_may_be_of_the_footprint(frame, fits, tmp_path):
    def about(message):
        message.child_frame_id = frame
        return message

    bag = Bag(rewritten(BAGS / 'drive', tmp_path / 'drive', ('odom',), about))
    mount = load_robot(BAGS / 'robot.yaml')
    found = diagnose(bag, Calibration.of_mount(mount), most_images=QUICK)
    assert [f.name for f in (*found.errors, *found.warnings)] == ([] if fits else ['frames'])
    kept = [e for e in sensor_events(bag, mount) if isinstance(e, OdometrySample)]
    whole = [e for e in sensor_events(Bag(BAGS / 'drive'), mount) if isinstance(e, OdometrySample)]
    assert len(kept) == len(whole)


def test_damaged_messages_are_counted(tmp_path):
    path = rewritten(BAGS / 'drive', tmp_path / 'drive', (JOINTS,), each_second(no_number))
    found = diagnose(Bag(path), load_calibration(BAGS / 'robot.yaml'))
    assert 'reading' in [finding.name for finding in found.warnings]
    assert not found.errors


def test_a_curve_of_the_path_and_a_turn_of_the_camera_are_distinguished(drive):
    curved = replace(drive, odometry=driven_again(drive.odometry, curve_rad_m=0.15))
    turned = replace(drive, ahead_rad=-0.3)
    curve, turn = (
        {f.name: f for f in motion_findings(motion, linear(motion), None)}
        for motion in (curved, turned)
    )
    assert 'camera heading' not in curve
    assert curve['odom yaw'].values['curve_rad_m'] == pytest.approx(0.15, abs=0.05)
    assert turn['camera heading'].values['heading_rad'] == pytest.approx(0.3, abs=0.06)


def measured_anew(motion, seed):
    """The motion with turns of images that fit its tracks and clocks, and noise."""
    turns = motion.panned() + motion.yawed() + motion.parallax() @ [1.0 / 3.0, 0.0]
    return turns + np.random.default_rng(seed).normal(0.0, 0.002, len(turns))


@pytest.mark.parametrize('seed', range(1, 6))
def test_a_delay_is_laid_to_the_joints_where_undecided(seed, drive):
    measured = replace(drive, turns_rad=measured_anew(replace(drive, pan_clock=Clock(0.05)), seed))
    for share in (1.0, 0.02):
        # With little yaw, odometry does not show whose clock is off.
        yaw = drive.odometry.values * [1.0, 1.0, share]
        given = replace(measured, odometry=replace(drive.odometry, values=yaw))
        given = replace(given, turns_rad=measured.turns_rad + given.yawed() - measured.yawed())
        judged = verdict(given)
        assert (judged.stream, judged.kind) == (JOINTS, 'clock')
        assert judged.value == pytest.approx(0.05, abs=0.01)


@pytest.mark.parametrize(('scale', 'level'), [(1.0, 'ok'), (3.0, 'warning')])
def test_noise_of_the_twist_is_no_other_unit(scale, level):
    rng = np.random.default_rng(3)
    logged = np.arange(0, 20 * 10**9, 5 * 10**7)
    rate = 0.05 * np.sin(1e-9 * logged)
    yaw = scale * np.append(0.0, np.cumsum(0.025 * (rate[1:] + rate[:-1])))
    still = np.zeros(len(logged))
    twist = np.stack([still, rate + rng.normal(0.0, 0.03, len(logged))], -1)
    values = np.column_stack([still, still, yaw, twist])
    (found,) = check_twist(Stream('odom', '', logged, logged, values))
    assert (found.name, found.level) == ('odom twist, turn', level)


def found_in_sweep(pushed_rad, passing=0):
    """
    Of a sweep of 5 deg a frame: consecutive images, and those 2 to 8 apart.

    The last `passing` images before 36 look turned from that one, as if somebody walked by.
    """
    seconds, step = np.arange(72.0), np.radians(5.0)
    pan = Track(seconds, (step * seconds)[:, None])
    looks = step * seconds + pushed_rad * (seconds > 35.0)
    first, second = np.array([(i, i + n) for n in range(1, 9) for i in range(72 - n)]).T
    turns = looks[second] - looks[first]
    turns[(first >= 36 - passing) & (second == 36)] += 0.3
    every = Motion(seconds[first], seconds[second], turns, pan, None)
    one, wide = every.only(second == first + 1), every.only(second > first + 1)
    return [*moved_between(one, lambda: wide)]


def _pans(stamps_s, logged_s, angles):
    order = np.argsort(logged_s, kind='stable')
    stamps, logged = (np.round(1e9 * t[order]).astype(np.int64) for t in (stamps_s, logged_s))
    return Stream('joint_states', '', stamps, logged, angles[order, None])


@pytest.mark.parametrize('behind_s', [0.0, 1000.0])
def test_two_sources_are_separated_even_if_each_has_its_own_clock(behind_s):
    times = np.arange(0.0, 20.0, 0.03)
    second = np.arange(len(times)) % 3 == 0
    angles = np.where(second, 1.5 - 0.05 * times, np.sin(times))
    main, (found,) = one_source(_pans(times - behind_s * second, times, angles), np.array([True]))
    assert main.values[:, 0].tolist() == angles[~second].tolist()
    assert found.values['messages'] == second.sum()


def test_the_speed_of_odometry_that_arrives_in_another_order_is_that_of_its_stamps():
    stamps = np.arange(0.0, 20.0, 0.05)
    order = np.argsort(stamps + np.random.default_rng(3).uniform(0.0, 0.4, len(stamps)))
    nanoseconds = np.repeat(np.round(1e9 * stamps[order]).astype(np.int64), 2)
    values = np.zeros((len(nanoseconds), 5))
    values[:, 0] = 0.3e-9 * nanoseconds
    found = check_speed(Stream('odom', '', nanoseconds, nanoseconds, values))
    assert found.values['speed_m_s'] == pytest.approx(0.3, rel=0.01)


def test_a_base_that_is_pushed_in_a_sweep_is_seen():
    (found,) = found_in_sweep(np.radians(8.0))
    assert found.values['turned_rad'] == pytest.approx(np.radians(8.0))
    assert found.values['at_s'] == 35.0


@pytest.mark.parametrize('frames', range(4))
def test_somebody_who_passes_in_a_sweep_is_no_push(frames):
    assert not found_in_sweep(0.0, passing=frames)


def seen(images, sharpness=0.5):
    """What was looked at, but for turns."""
    small = dict(enumerate(images))
    nothing = Stream('images', '', *2 * (np.arange(len(images)),), np.empty((len(images), 0)))
    sharp = dict.fromkeys(small, sharpness)
    return Looks(nothing, small=small, sharpness=sharp)


def content_of(looks):
    return [*check_content(looks)]


def test_images_that_are_covered_blurred_or_flicker_are_named():
    rng = np.random.default_rng(4)
    images = list(rng.integers(60, 200, (40, 12, 16), dtype=np.uint8))
    assert not content_of(seen(images))
    (blurred,) = content_of(seen(images, sharpness=0.02))
    assert blurred.name == 'images sharpness'
    darker = [image // (1 + k % 2) for k, image in enumerate(images)]
    (flickers,) = content_of(seen(darker))
    assert flickers.values['factor'] == pytest.approx(2.0, rel=0.1)
    for image in images:
        image[:, :5] = 0
    (covered,) = content_of(seen(images))
    assert covered.level == 'warning'
    assert 'side left' in covered.measured
    assert not content_of(seen([images[0]] * 40)), 'a camera that stands shows no cover'
    assert not content_of(seen([*[images[0]] * 20, *images[:3]])), 'one wall is in view for long'
    assert content_of(seen([*[images[0]] * 20, *images])), 'covered all the same'


@pytest.mark.parametrize(('share', 'named'), [(0.55, False), (0.9, True)])
def test_two_cameras_are_named_where_images_match_clearly(share, named):
    rng = np.random.default_rng(4)
    view = StripView(CAMERA, PanTiltMount())
    textures = [
        10.0 * cv2.GaussianBlur(rng.normal(size=(240, 320)), (0, 0), 3.0) for _ in range(42)
    ]
    each = [
        np.sqrt(share) * textures[k % 2] + np.sqrt(1.0 - share) * textures[k] for k in range(2, 42)
    ]
    grey = [np.clip(128.0 + 50.0 * image, 0.0, 255.0).astype(np.uint8) for image in each]
    looks = seen(grey)
    looks = replace(
        looks, strips={k: view.strip(image) for k, image in enumerate(grey)}, view=view
    )
    still = Track(np.array([0.0]), np.zeros((1, 1)))
    motion = Motion(np.empty(0), np.empty(0), np.empty(0), still, None)
    assert (alternating_images(looks, motion) is not None) == named


@pytest.mark.parametrize(('unit_ns', 'named'), [(1, None), (1000, 'microseconds')])
def test_nanoseconds_of_another_unit_are_named(unit_ns, named):
    logged = np.arange(0, 10**10, 2 * 10**8)
    stamps = logged // 10**9 * 10**9 + logged % 10**9 // unit_ns
    found = check_stamps(Stream('images', '', stamps, logged, np.empty((len(logged), 0))))
    units = [f.measured for f in found if f.name == 'images stamps']
    assert len(units) == (named is not None)
    assert named is None or named in units[0]


@pytest.mark.parametrize(
    ('odometry_s', 'stream'), [(0.0, JOINTS), (0.018, JOINTS), (0.05, IMAGES)]
)
def test_odometry_that_is_a_little_late_does_not_speak_for_images(odometry_s, stream, drive):
    late = replace(drive, pan_clock=Clock(0.05), odometry_clock=Clock(odometry_s))
    cause = verdict(replace(drive, turns_rad=measured_anew(late, 3)))
    assert (cause.stream, cause.kind) == (stream, 'clock')


@pytest.mark.parametrize('odometry_s', [-0.3, -0.1, 0.15])
def test_a_clock_of_odometry_is_found_beside_joints_that_are_late(odometry_s, drive):
    late = replace(drive, pan_clock=Clock(0.02), odometry_clock=Clock(odometry_s))
    cause = verdict(replace(drive, turns_rad=measured_anew(late, 3)))
    assert (cause.stream, cause.kind) == (ODOMETRY, 'clocks')
    assert cause.value == pytest.approx(odometry_s, abs=0.02)
    assert cause.offset_s == pytest.approx(0.02, abs=0.005)


@pytest.mark.parametrize(
    ('late_s', 'turning', 'found_s'), [(0.0, 1, 0.0), (0.2, 1, 0.2), (0.2, 0, 0.0)]
)
def test_a_clock_is_another_one_only_if_turns_show_it(late_s, turning, found_s, drive):
    right = track(drive, ODOMETRY, lambda t: replace(t, values=t.values * [1.0, 1.0, turning]))
    right = track(right, JOINTS, lambda t: replace(t, values=0.0 * t.values))
    turns = replace(right, odometry_clock=Clock(late_s)).yawed()
    turns += np.random.default_rng(5).normal(0.0, 1e-3, len(turns))
    assert late_odometry(replace(right, turns_rad=turns), []) == pytest.approx(found_s, abs=0.02)
