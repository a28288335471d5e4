"""Sweeps come out of bags and folders of images, with what is missing named."""

from __future__ import annotations

import re

from bag_writers import camera_image, FACTORY, full_turn, MOUNT, SECOND, START, write_sweep
import cv2
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.messages import encode
from landmark_nav.storage.bags import Bag, BagWriter, read_sweep_folder, read_sweeps
from landmark_nav.types import PoseEstimate


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
    ('lost', 'frames', 'words'),
    [
        # The images are 56 degrees wide and 15 apart.
        ([8], 23, r'1 frame is missing, at pan -60 deg; their neighbours see it all'),
        (range(8, 13), 19, r'at pan -60, .* deg; nothing is seen from pan -47 to -13 deg'),
    ],
)
def test_a_sweep_with_missing_frames_is_used_and_the_gap_named(tmp_path, lost, frames, words):
    with BagWriter(tmp_path / 'hole') as bag:
        write_sweep(bag, START, full_turn(), keep=lambda k: k not in lost)
    warnings = []
    (sweep,) = read_sweeps(Bag(tmp_path / 'hole', warnings.append), MOUNT)
    assert len(sweep.frames) == frames
    assert re.search(words, warnings[0])


def test_a_sweep_without_any_frame_is_refused(tmp_path):
    with BagWriter(tmp_path / 'none') as bag:
        write_sweep(bag, START, full_turn())
        write_sweep(bag, START + 60 * SECOND, full_turn(), keep=lambda k: False)
    with pytest.raises(LandmarkNavError, match='has no frames'):
        list(read_sweeps(Bag(tmp_path / 'none'), MOUNT))


def test_a_gap_that_no_trajectory_shows_is_found_too(tmp_path):
    with BagWriter(tmp_path / 'gap') as bag:
        write_sweep(bag, START, np.delete(full_turn(), slice(8, 14)))
    warnings = []
    list(read_sweeps(Bag(tmp_path / 'gap', warnings.append), MOUNT))
    assert 'nothing is seen from pan -47 to 2 deg' in warnings[0]


def test_a_joint_that_cannot_turn_fully_is_lived_with(tmp_path):
    with BagWriter(tmp_path / 'limited') as bag:
        write_sweep(bag, START, np.radians(np.arange(-120, 121, 15)))
    warnings = []
    (sweep,) = read_sweeps(Bag(tmp_path / 'limited', warnings.append), MOUNT)
    assert len(sweep.frames) == 17
    assert 'nothing is seen from pan 148 to 212 deg' in warnings[0]


@pytest.mark.parametrize('trajectory', [True, False])
def test_an_image_that_does_not_decode_is_left_out_by_name(tmp_path, trajectory):
    with BagWriter(tmp_path / 'learn') as bag:
        write_sweep(bag, START, full_turn(), damaged={17}, trajectory=trajectory)
        write_sweep(bag, START + 90 * SECOND, full_turn(), trajectory=trajectory)
    warnings = []
    first, second = read_sweeps(Bag(tmp_path / 'learn', warnings.append), MOUNT)
    kept = np.delete(full_turn(), 17)
    np.testing.assert_allclose([f.pan_rad for f in first.frames], kept)
    assert [f.image[0, 0] for f in first.frames] == [k for k in range(24) if k != 17]
    assert len(second.frames) == 24
    assert (
        '1 of 24 frames of the sweep of 1000.0 s left out: image 18, at 1017.000 s' in warnings[-1]
    )


@pytest.mark.parametrize(
    ('damaged', 'which'),
    [
        ((5, 6, 7, 8), 'image 6, at 1005.000 s, and then nothing is seen from pan -92 to -73 deg'),
        (range(24), 'image 1, at 1000.000 s'),
    ],
)
def test_images_that_nothing_makes_up_for_are_refused_by_their_gap(tmp_path, damaged, which):
    with BagWriter(tmp_path / 'learn') as bag:
        write_sweep(bag, START, full_turn(), damaged=damaged)
    with pytest.raises(LandmarkNavError) as error:
        list(read_sweeps(Bag(tmp_path / 'learn'), MOUNT))
    assert which in str(error.value)


def test_without_trajectory_the_joint_states_give(tmp_path):
    with BagWriter(tmp_path / 'learn') as bag:
        write_sweep(bag, START, full_turn(), trajectory=False)
        write_sweep(bag, START + 90 * SECOND, full_turn(), trajectory=False)
    warnings = []
    sweeps = list(read_sweeps(Bag(tmp_path / 'learn', warnings.append), MOUNT))
    assert [len(s.frames) for s in sweeps] == [24, 24]
    np.testing.assert_allclose([f.pan_rad for f in sweeps[1].frames], full_turn())
    assert 'joint_states' in warnings[0]


def test_a_sweep_that_was_given_up_is_left_out(tmp_path):
    with BagWriter(tmp_path / 'learn') as bag:
        write_sweep(bag, START, full_turn()[:7], trajectory=False)
        write_sweep(bag, START + 90 * SECOND, full_turn())
    warnings = []
    (sweep,) = read_sweeps(Bag(tmp_path / 'learn', warnings.append), MOUNT)
    assert len(sweep.frames) == 24
    assert '7 frames belong to no sweep/trajectory' in warnings[0]


def test_recording_cut_off_in_a_sweep_keeps_the_whole_ones(tmp_path):
    folder = tmp_path / 'learn'
    with BagWriter(folder) as bag:
        write_sweep(bag, START, full_turn())
        write_sweep(bag, START + 60 * SECOND, full_turn())
    path = folder / 'learn.mcap'
    whole = path.read_bytes()
    needle = whole.rindex(camera_image(9).tobytes())
    path.write_bytes(whole[: needle + 100])
    warnings = []
    (sweep,) = read_sweeps(Bag(folder, warnings.append), MOUNT)
    assert sweep.stamp_ns == START
    assert any('was cut off' in w for w in warnings)


def test_a_folder_of_images_is_a_sweep(tmp_path):
    rows = ['file,pan_rad,focal_px,width,height']
    for k, pan in enumerate(full_turn(6)):
        cv2.imwrite(str(tmp_path / f'{k}.png'), camera_image(k * 10))
        rows.append(f'{k}.png,{pan},{50 + k},64,48')
    (tmp_path / 'frames.csv').write_text('\n'.join(rows))
    sweep = read_sweep_folder(tmp_path)
    np.testing.assert_allclose([f.pan_rad for f in sweep.frames], full_turn(6))
    assert sweep.frames[3].camera == CameraModel(64, 48, 53.0, 53.0, 31.5, 23.5)
    assert sweep.frames[3].image[0, 0, 0] == 30

    def refused(line, match):
        (tmp_path / 'frames.csv').write_text('\n'.join([*rows, line]))
        with pytest.raises(LandmarkNavError, match=match):
            read_sweep_folder(tmp_path)

    refused('gone.png,0.1,50,64,48', r'line 8: .*gone\.png: cannot be read: No such file')
    refused('1.png,abc,50,64,48', "line 8: pan_rad is 'abc', not a number")
    refused('1.png,nan,50,64,48', "line 8: pan_rad is 'nan', not a number")
    refused('1.png,0.1,50,wide,48', "line 8: width is 'wide', not a number")
    refused('1.png,0.1,50,64', 'line 8: height is None, not a number')
    refused('frames.csv,0.1,50,64,48', r'line 8: .*frames\.csv: is neither a PNG nor a JPEG')
    refused('1.png,0.1,50,65,48', "line 8: '1.png' is 64 x 48, not 65 x 48")
    refused('1.png,0.1,-50,64,48', 'line 8: .*not a calibrated camera')
    refused('1.png,90,50,64,48', r'frames.csv: pan_rad: the pan goes over 93 rad: are these deg')
    (tmp_path / 'frames.csv').write_text('file,pan\n1.png,0')
    with pytest.raises(LandmarkNavError, match='lacks pan_rad, focal_px, width, height'):
        read_sweep_folder(tmp_path)


def test_study_bags_are_read(shared_data):
    learn = list(read_sweeps(Bag(shared_data / 'study' / 'learn'), MOUNT))
    assert [len(s.frames) for s in learn] == [72, 72]
    assert learn[0].frames[0].image.shape == (512, 512, 3)
    bag = Bag(shared_data / 'study' / 'drive')
    assert bag.counts['/camera/image_raw/compressed'] == 184


@pytest.mark.parametrize('name', ['grail', 'parrington'])
def test_photographed_sweeps_are_read(shared_data, name):
    assert len(read_sweep_folder(shared_data / 'pan_sweeps' / name).frames) == 18
