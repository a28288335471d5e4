"""Jumps of odometry, and paths whose axes disagree with the yaw."""

import numpy as np
import pytest

from landmark_nav.diagnosis.odometry import check_jumps, check_path
from landmark_nav.diagnosis.streams import Stream

TIMES = np.arange(0.0, 20.0, 0.05)
YAW = 1.2 * np.sin(0.4 * TIMES)
SPEED = 0.4 * np.sign(np.sin(0.5 * TIMES) + 0.6)


def driven(side_rad=0.0):
    """x, y, yaw, speed and yaw rate of a drive forwards and backwards, so far beside the yaw."""
    steps = 0.05 * SPEED[:, None] * np.stack([np.cos(YAW + side_rad), np.sin(YAW + side_rad)], 1)
    return np.column_stack([np.cumsum(steps, axis=0), YAW, SPEED, np.gradient(YAW, TIMES)])


def stream_of(values):
    stamps = np.round(1e9 * TIMES).astype(np.int64)
    return Stream('odom', 'odom', stamps, stamps, values)


# Backwards, to all sides, and straight on, which does not show a mirrored path.
@pytest.mark.parametrize('side_rad', [0.0, np.pi, 3.0 * np.sin(1.7 * TIMES), np.pi / 2 - YAW])
def test_a_path_in_its_own_axes_passes(side_rad):
    assert check_path(stream_of(driven(side_rad))) is None


@pytest.mark.parametrize('side_rad', [0.5 * np.pi, -0.8])
def test_a_path_that_is_turned_is_named_and_turned_back(side_rad):
    found = check_path(stream_of(driven(side_rad)))
    assert found is not None
    assert found.finding.values['aside_rad'] == pytest.approx(side_rad, abs=0.01)
    assert found.mended == pytest.approx(driven(), abs=0.05)


@pytest.mark.parametrize(
    ('axes', 'reported'),
    [
        ([[1, 0], [0, -1]], 'y has'),
        ([[-1, 0], [0, 1]], 'x has'),
        ([[0, 1], [1, 0]], 'x and y are exchanged'),
    ],
)
def test_a_mirrored_path_is_named(axes, reported):
    values = driven()
    values[:, :2] = values[:, :2] @ np.array(axes)
    found = check_path(stream_of(values))
    assert found is not None
    assert reported in found.finding.measured
    assert found.mended == pytest.approx(driven())


def test_jumps_are_found_with_their_size_and_time():
    assert check_jumps(stream_of(driven())) is None
    values = driven()
    values[200:, 0] += 0.8
    found = check_jumps(stream_of(values))
    assert found is not None
    assert found.values['metres'] == pytest.approx(0.8, abs=0.05)
    assert f'{TIMES[200]:.1f} s' in found.measured


def test_a_gap_or_a_robot_that_drives_off_is_no_jump():
    kept = np.r_[0:150, 250:400]
    assert check_jumps(stream_of(driven()).only(kept)) is None
    values = driven()
    values[:300, :2] = 0.0
    values[300:, :2] -= values[300, :2]
    assert check_jumps(stream_of(values)) is None
