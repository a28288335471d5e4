"""A drive comes out of a bag as frames with their pans, odometry and ground truth."""

from bag_writers import camera_image, FACTORY, MOUNT, SECOND, START, write_drive
from drive_faults import write_bag
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.learning_report import check_truth_frame
from landmark_nav.messages import encode
from landmark_nav.storage.bags import Bag, sensor_events
from landmark_nav.types import CameraFrame


def recorded(path):
    """Topics, messages and log times of a bag, to be written again."""
    return [(entry.topic, entry.message, entry.stamp_ns) for entry in Bag(path).messages()]


def frames_of(path, warn=print):
    return [e for e in sensor_events(Bag(path, warn), MOUNT) if isinstance(e, CameraFrame)]


def test_ground_truth_in_another_frame_than_the_map_is_reported(tmp_path, caplog):
    bag = Bag(write_drive(tmp_path / 'drive'))
    check_truth_frame(bag, 'map')
    assert not caplog.messages
    check_truth_frame(bag, 'hall')
    (words,) = caplog.messages
    assert 'ground_truth/odom is in frame map, the map in hall' in words


def test_raw_images_are_preferred_to_compressed_ones(tmp_path):
    stamp = START + SECOND
    raw = 'camera/image_raw', encode.image(FACTORY, camera_image(9), stamp, ''), stamp
    path = write_bag(tmp_path / 'both', [*recorded(write_drive(tmp_path / 'drive')), raw])
    assert [f.stamp_ns for f in frames_of(path)] == [stamp]


def test_joint_states_in_degrees_are_refused(tmp_path):
    sent = recorded(write_drive(tmp_path / 'drive'))
    for topic, message, _ in sent:
        if topic == '/joint_states':
            message.position = np.degrees(message.position)
    with pytest.raises(LandmarkNavError, match=r'joint_states: the pan turns by 17 rad/s: are th'):
        frames_of(write_bag(tmp_path / 'degrees', sent))


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
    frames = frames_of(write_drive(tmp_path / 'drive', damaged=(2, 5)), warnings.append)
    assert len(frames) == 8
    (warning,) = warnings
    assert '2 of 10 images left out' in warning
    assert 'does not decode' in warning


@pytest.mark.parametrize('step_back_ns', [0, SECOND])
@pytest.mark.parametrize('tilt_a_step', [0.0, 0.01])
def test_pan_and_tilt_are_of_the_time_of_the_image(tmp_path, step_back_ns, tilt_a_step):
    """Also where the clock is set back, and where tilts come by themselves."""
    drive = write_drive(
        tmp_path / 'drive',
        set_back=lambda k: step_back_ns if k >= 21 else 0,
        lone_tilt=(lambda k: tilt_a_step * k) if tilt_a_step else None,
    )
    frames = frames_of(drive)
    known = 0.2 * np.arange(10) + 0.02
    if step_back_ns:
        # At the moment itself no joint state comes after the image.
        known = np.delete(known, 5)
    np.testing.assert_allclose([f.pan_rad for f in frames], 0.3 * known)
    tilts = tilt_a_step / 0.05 * known
    np.testing.assert_allclose([f.tilt_rad for f in frames], tilts, atol=1e-6)


@pytest.mark.parametrize(
    ('drive', 'match'),
    [
        ({'damaged': range(10)}, 'does not decode'),
        ({'info': False}, 'camera/camera_info is missing'),
        ({'bad': lambda topic, k: topic == 'odom'}, r'/odom: odometry position at .*nan'),
        ({'late_joints': True}, 'no joint state near it'),
    ],
)
def test_drives_that_cannot_be_used_are_refused(tmp_path, drive, match):
    bag = Bag(write_drive(tmp_path / 'drive', **drive))
    with pytest.raises(LandmarkNavError, match=match):
        list(sensor_events(bag, MOUNT))
