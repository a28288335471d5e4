from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.localization.odometry.commanded import command_delay_s, integrate_commands
from landmark_nav.localization.odometry.noise import twist_motion
from landmark_nav.types import Detections

BEGIN_NS = 1_248_444_175_000_000_000
STEP_NS = 20_000_000


def test_constant_commands_make_an_arc_that_starts_later() -> None:
    stamps = BEGIN_NS + STEP_NS * np.arange(101)
    commands = np.tile([0.3, 0.5], (101, 1))
    samples = integrate_commands(stamps, commands, 0.25)
    assert samples[0].stamp_ns == BEGIN_NS + 250_000_000
    np.testing.assert_allclose(samples[-1].pose_odom_base, twist_motion(0.3, 0.5, 2.0))
    assert (samples[7].linear_m_s, samples[7].angular_rad_s) == (0.3, 0.5)


def late_robot(delay_s: float) -> tuple[np.ndarray, np.ndarray, list[Detections]]:
    """A robot that turns to and fro, at random, `delay_s` after the command, 4 m from posts."""
    rng = np.random.default_rng(3)
    stamps = BEGIN_NS + STEP_NS * np.arange(6000)
    turns = np.repeat(rng.uniform(-0.6, 0.6, 150), 40)
    commands = np.column_stack([np.full(6000, 0.05), turns])
    samples = integrate_commands(stamps, commands, delay_s)
    posts = np.array([[4.0, 0.0], [0.0, 4.0], [-4.0, -1.0]])
    detections = []
    for sample in samples[::10]:
        bearing = se2.bearings(sample.pose_odom_base, posts)
        seen = np.abs(bearing) < 0.9
        bearing = bearing + rng.normal(0.0, 0.01, 3)
        none = np.zeros(3)
        found = Detections(
            sample.stamp_ns, np.arange(3), bearing, none, none, np.zeros((3, 2))
        ).chosen(seen)
        detections.append(found)
    return stamps, commands, detections


@pytest.mark.parametrize('delay_s', [0.0, 0.13, 0.4])
def test_the_delay_is_found_without_truth(delay_s: float) -> None:
    assert command_delay_s(*late_robot(delay_s)) == pytest.approx(delay_s, abs=0.011)


def test_mistaken_landmarks_do_not_matter() -> None:
    stamps, commands, detections = late_robot(0.2)
    rng = np.random.default_rng(4)
    mixed = [
        replace(seen, ids=(seen.ids + 1) % 3) if rng.random() < 0.15 else seen
        for seen in detections
    ]
    assert command_delay_s(stamps, commands, mixed) == pytest.approx(0.2, abs=0.02)


def test_nothing_seen_twice_or_never_turned() -> None:
    stamps, commands, detections = late_robot(0.2)
    with pytest.raises(LandmarkNavError, match='delay of the commands cannot be found'):
        command_delay_s(stamps, commands, detections[:5])
    with pytest.raises(LandmarkNavError, match='give it'):
        command_delay_s(stamps, commands * [1.0, 0.0], detections)
    with pytest.raises(LandmarkNavError, match='0 bearings'):
        command_delay_s(stamps, commands, [])
