"""Sweeps and drives come out of bags and folders, with what is missing named."""

import copy
from itertools import count
import re

from bag_writers import (
    camera_image,
    FACTORY,
    full_turn,
    MOUNT,
    SECOND,
    START,
    write_drive,
    write_sweep,
)
import cv2
from drive_faults import EVERYTHING, recorded, rewritten, write_bag
import message_changes as m
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.learning_report import check_truth_frame
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.messages import encode
from landmark_nav.storage.bags import Bag, BagWriter, read_sweep_folder, read_sweeps, sensor_events
from landmark_nav.types import CameraFrame, PoseEstimate

CUT = m.field('data', lambda data: data[:30])


def sweep_bag(path, *sweeps, **options):
    """Bag of sweeps a minute and a half apart; each is given by what differs from a full turn."""
    with BagWriter(path) as bag:
        for k, given in enumerate(sweeps):
            given = {'pans': full_turn(), **options, **given}
            write_sweep(bag, START + 90 * k * SECOND, **given)
    return path


def sweeps_of(path):
    """Sweeps and warnings of a bag."""
    warnings = []
    return list(read_sweeps(Bag(path, warnings.append), MOUNT)), warnings


def test_sweeps_come_back_with_the_measured_pans(tmp_path):
    with BagWriter(tmp_path / 'learn') as bag:
        for number, start in enumerate((START, START + 60 * SECOND)):
            write_sweep(bag, start, full_turn())
            estimate = PoseEstimate(start, np.array([number, 2.0, 0.5]), np.eye(3))
            bag.write('sweep/pose', encode.pose(FACTORY, estimate), start)
    sweeps = list(read_sweeps(Bag(tmp_path / 'learn'), MOUNT))
    assert [s.stamp_ns for s in sweeps] == [START, START + 60 * SECOND]
    for number, sweep in enumerate(sweeps):
        np.testing.assert_array_equal([f.pan_rad for f in sweep.frames], full_turn())
        assert [f.image[0, 0] for f in sweep.frames] == list(range(24))
        assert sweep.pose_map_base.pose[0] == number


@pytest.mark.parametrize(
    ('sweep', 'frames', 'words'),
    [
        # The images are 56 degrees wide and 15 apart.
        ({'keep': lambda k: k != 8}, 23, r'missing, at pan -60 deg; their neighbours see it all'),
        ({'keep': lambda k: k not in range(8, 13)}, 19, r'is seen from pan -47 to -13 deg'),
        # What no trajectory shows, and a joint that cannot turn fully.
        ({'pans': np.delete(full_turn(), slice(8, 14))}, 18, 'nothing is .* pan -47 to 2 deg'),
        ({'pans': np.radians(np.arange(-120, 121, 15))}, 17, 'nothing is .* pan 148 to 212 deg'),
    ],
)
def test_a_sweep_with_a_gap_is_used_and_the_gap_named(tmp_path, sweep, frames, words):
    (found,), warnings = sweeps_of(sweep_bag(tmp_path / 'hole', sweep))
    assert len(found.frames) == frames
    assert re.search(words, warnings[0])


def at_one_time(message):
    for point in message.points:
        point.time_from_start.sec = 0


def stamped(sec):
    return lambda message: vars(message.header.stamp).update(sec=sec, nanosec=0)


def without_numbers(which):
    def change(message):
        for point in message.points[which]:
            point.positions = np.array([0.1, np.inf])

    return change


@pytest.mark.parametrize(
    ('change', 'frames', 'words'),
    [
        (stamped(0), 24, 'has no stamp'),
        (at_one_time, 24, 'two points .* time_from_start'),
        (stamped(6000), 24, 'no image at its times'),
        (without_numbers(slice(None)), 24, 'not a number'),
        (without_numbers(slice(5, 6)), 23, '1 of 24 points left out: .* not a number'),
    ],
)
def test_a_trajectory_that_cannot_be_used_is_left_out(tmp_path, change, frames, words):
    path = sweep_bag(tmp_path / 'learn', {'change': change}, {})
    sweeps, warnings = sweeps_of(path)
    assert [len(sweep.frames) for sweep in sweeps] == [frames, 24]
    pans = [pan for pan in full_turn() if frames == 24 or pan != full_turn()[5]]
    np.testing.assert_allclose([frame.pan_rad for frame in sweeps[0].frames], pans)
    assert re.search(words, warnings[0])


@pytest.mark.parametrize('trajectory', [True, False])
def test_an_image_that_does_not_decode_is_left_out_by_name(tmp_path, trajectory):
    path = sweep_bag(tmp_path / 'learn', {'damaged': {17}}, {}, trajectory=trajectory)
    (first, second), warnings = sweeps_of(path)
    kept = np.delete(full_turn(), 17)
    np.testing.assert_allclose([f.pan_rad for f in first.frames], kept)
    assert [f.image[0, 0] for f in first.frames] == [k for k in range(24) if k != 17]
    np.testing.assert_allclose([f.pan_rad for f in second.frames], full_turn())
    assert '1 of 24 frames of the sweep of 1000.0 s left out: image 18, at 1017' in warnings[-1]
    assert ('joint_states' in warnings[0]) == (not trajectory)


@pytest.mark.parametrize(
    ('damaged', 'which'),
    [
        ((5, 6, 7, 8), 'image 6, at 1005.000 s, and .* nothing is seen from pan -92 to -73 deg'),
        (range(24), 'image 1, at 1000.000 s'),
    ],
)
def test_images_that_nothing_makes_up_for_are_refused_by_their_gap(tmp_path, damaged, which):
    with pytest.raises(LandmarkNavError, match=which):
        sweeps_of(sweep_bag(tmp_path / 'learn', {'damaged': damaged}, {}))


@pytest.mark.parametrize(
    ('without', 'words'),
    [
        ({'keep': lambda k: False}, 'no image'),
        # One that was given up.
        ({'pans': full_turn()[:7], 'trajectory': False}, '7 frames belong to no sweep/trajectory'),
    ],
)
def test_a_sweep_without_images_or_end_is_left_out(tmp_path, without, words):
    (sweep,), warnings = sweeps_of(sweep_bag(tmp_path / 'learn', without, {}))
    assert len(sweep.frames) == 24
    assert words in warnings[0]


@pytest.mark.parametrize('comma', [',', ', '])
def test_a_folder_of_images_is_a_sweep(tmp_path, comma):
    rows = ['file,pan_rad,focal_px,width,height']
    for k, pan in enumerate(full_turn(6)):
        cv2.imwrite(str(tmp_path / f'{k}.png'), camera_image(k * 10))
        rows.append(f'{k}.png,{pan},{50 + k},64,48')
    (tmp_path / 'frames.csv').write_text('\n'.join(rows).replace(',', comma))
    sweep = read_sweep_folder(tmp_path)
    np.testing.assert_allclose([f.pan_rad for f in sweep.frames], full_turn(6))
    assert sweep.frames[3].camera == CameraModel(64, 48, 53.0, 53.0, 31.5, 23.5)
    assert sweep.frames[3].image[0, 0, 0] == 30

    for line, match in (
        ('gone.png,0.1,50,64,48', r'line 8: .*gone\.png: cannot be read: No such file'),
        ('1.png,abc,50,64,48', "line 8: pan_rad is 'abc', not a number"),
        ('1.png,0.1,50,64', 'line 8: height is None, not a number'),
        ('frames.csv,0.1,50,64,48', r'line 8: .*frames\.csv: is neither a PNG nor a JPEG'),
        ('1.png,0.1,50,65,48', "line 8: '1.png' is 64 x 48, not 65 x 48"),
        ('1.png,0.1,-50,64,48', 'line 8: .*not a calibrated camera'),
        ('1.png,90,50,64,48', r'frames.csv: pan_rad: the pan goes over 93 rad: are these deg'),
    ):
        (tmp_path / 'frames.csv').write_text('\n'.join([*rows, line]))
        with pytest.raises(LandmarkNavError, match=match):
            read_sweep_folder(tmp_path)
    (tmp_path / 'frames.csv').write_text('file,pan\n1.png,0')
    with pytest.raises(LandmarkNavError, match='lacks pan_rad, focal_px, width, height'):
        read_sweep_folder(tmp_path)


def changed_drive(tmp_path, topics, change):
    return rewritten(write_drive(tmp_path / 'drive'), tmp_path / 'changed', topics, change)


def frames_of(path, warn=print):
    return [e for e in sensor_events(Bag(path, warn), MOUNT) if isinstance(e, CameraFrame)]


def test_ground_truth_in_another_frame_than_the_map_is_reported(tmp_path, caplog):
    bag = Bag(write_drive(tmp_path / 'drive'))
    check_truth_frame(bag, 'map')
    assert not caplog.messages
    check_truth_frame(bag, 'hall')
    (words,) = caplog.messages
    assert 'ground_truth/odom is in frame map, the map in hall' in words


def test_joint_states_in_degrees_are_refused(tmp_path):
    path = changed_drive(tmp_path, (m.JOINTS,), m.joints(np.degrees))
    with pytest.raises(LandmarkNavError, match=r'joint_states: the pan turns by 17 rad/s: are th'):
        frames_of(path)


def test_what_was_recorded_twice_counts_once(tmp_path):
    drive = write_drive(tmp_path / 'drive')
    sent = [(t, m, log + again) for t, m, log in recorded(drive) for again in (0, 3_000_000)]
    once, again = (
        sorted(
            str((type(event), event.stamp_ns, getattr(event, 'pan_rad', None)))
            for event in sensor_events(Bag(path), MOUNT)
        )
        for path in (drive, write_bag(tmp_path / 'twice', sent))
    )
    assert again == once


def test_a_damaged_image_is_left_out_and_reported(tmp_path):
    warnings = []
    path = changed_drive(tmp_path, (m.CAMERA,), m.where(lambda k: k in (2, 5), CUT))
    frames = frames_of(path, warnings.append)
    assert len(frames) == 8
    (warning,) = warnings
    assert '2 of 10 images left out' in warning
    assert 'does not decode' in warning


def tilted_apart(rad_a_step):
    """Tilts have messages of their own, 10 ms before those of the pan."""
    number = count()

    def apart(message):
        alone, k = copy.deepcopy(message), next(number)
        alone.name, alone.position = message.name[1:], np.array([rad_a_step * (k - 0.2)])
        message.name, message.position = message.name[:1], message.position[:1]
        return [m.later(-0.01)(alone), message]

    return apart


@pytest.mark.parametrize('step_back_ns', [0, SECOND])
@pytest.mark.parametrize('tilt_a_step', [0.0, 0.01])
def test_pan_and_tilt_are_of_the_time_of_the_image(tmp_path, step_back_ns, tilt_a_step):
    """Also where the clock is set back, and where tilts come by themselves."""
    begin_ns = START + 21 * SECOND // 20
    set_back = m.stamps(lambda stamp: stamp - step_back_ns * (stamp >= begin_ns))
    path = changed_drive(tmp_path, EVERYTHING, set_back)
    if tilt_a_step:
        path = rewritten(path, tmp_path / 'apart', (m.JOINTS,), tilted_apart(tilt_a_step))
    frames = frames_of(path)
    known = 0.2 * np.arange(10) + 0.02
    if step_back_ns:
        # At the moment itself no joint state comes after the image.
        known = np.delete(known, 5)
    np.testing.assert_allclose([f.pan_rad for f in frames], 0.3 * known)
    tilts = tilt_a_step / 0.05 * known
    np.testing.assert_allclose([f.tilt_rad for f in frames], tilts, atol=1e-6)


@pytest.mark.parametrize(
    ('topic', 'change', 'match'),
    [
        (m.CAMERA, CUT, 'does not decode'),
        (m.INFO, m.nothing, 'camera/camera_info is missing'),
        (m.ODOMETRY, m.no_number, r'/odom: odometry position at .*nan'),
        (m.JOINTS, m.later(9.0), 'no joint state near it'),
    ],
)
def test_drives_that_cannot_be_used_are_refused(tmp_path, topic, change, match):
    bag = Bag(changed_drive(tmp_path, (topic,), change))
    with pytest.raises(LandmarkNavError, match=match):
        list(sensor_events(bag, MOUNT))
