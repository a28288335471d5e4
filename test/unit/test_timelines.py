"""Pan and tilt at the stamp of an image: interpolated, or refused with the reason."""

import numpy as np
import pytest

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.simulation.pan_tilt_unit import PanTiltConfig, PanTiltUnit
from landmark_nav.storage.bags.timelines import JointHistory
from landmark_nav.types import JointSample, Refusal

MS = 1_000_000
RATE = 0.9


def turning(*stamps_ms):
    return JointHistory(JointSample(t * MS, 1e-3 * RATE * t, -2e-4 * t) for t in stamps_ms)


@pytest.mark.parametrize(
    ('known_ms', 'at_ms', 'words'),
    [
        ((), 100, 'no joint_states'),
        ((100, 120), 172, 'joint_states are 52 ms behind'),
        ((100,), 105, 'joint_states are 5 ms behind'),
        ((100, 120), 80, 'joint_states begin 20 ms later'),
        ((100, 1300), 150, 'no joint_states for 1.2 s'),
    ],
)
def test_what_no_joint_state_gives_is_refused(known_ms, at_ms, words):
    refusal = turning(*known_ms).at(at_ms * MS)
    assert isinstance(refusal, Refusal)
    assert str(refusal) == words


@pytest.mark.parametrize('period_ms', [10, 20, 50])
def test_what_interpolation_leaves_open_is_claimed(period_ms):
    """A unit that turns here and there, and swings after each stop."""
    rng, step_ms = np.random.default_rng(1), 5
    unit, true = PanTiltUnit(PanTiltConfig(encoder_step_rad=0.0)), []
    for k in range(4000):
        if k % 250 == 0:
            unit.command(rng.uniform(-2.0, 2.0))
        unit.step(1e-3 * step_ms)
        true.append(unit.angles_rad[0])
    off, sigma = interpolated(np.array(true), step_ms, period_ms)
    every = period_ms // step_ms
    assert not sigma[::every].any()
    between = np.arange(len(off)) % every > 0
    normalized = (off / np.hypot(sigma, 1e-4))[between]
    assert np.sqrt(np.mean(np.square(normalized))) < 1.0
    assert np.mean(np.abs(normalized) > 3.0) < 0.01


def interpolated(true, step_ms, period_ms, shift_ms=0):
    """Errors and sigmas (n,) of pans that are known each `period_ms`, at all steps between."""
    every, first = period_ms // step_ms, shift_ms // step_ms
    known = [JointSample(k * step_ms * MS, true[k]) for k in range(first, len(true), every)]
    history, found = JointHistory(known), []
    for k in range(first + every, len(true) - 3 * every):
        sample = history.at(k * step_ms * MS)
        assert isinstance(sample, JointSample)
        found.append((sample.pan_rad - true[k], sample.pan_sigma_rad))
    off, sigma = np.array(found).T
    return off, sigma


@pytest.mark.parametrize(('period_ms', 'shift_ms'), [(100, 0), (100, 30), (200, 0), (200, 70)])
def test_what_few_joint_states_do_not_show_is_claimed(period_ms, shift_ms):
    """A unit that is sent on ten times a second turns unevenly; it starts, stops and swings."""
    rng, step_ms, goal, rate = np.random.default_rng(2), 5, 0.0, 0.0
    unit, smooth = PanTiltUnit(PanTiltConfig(encoder_step_rad=0.0, pan_limit_rad=6.3)), []
    for k in range(24_000):
        if k % 300 == 0:
            rate = float(rng.choice([0.0, 0.2, 0.4])) * (-1.0 if goal > 0.0 else 1.0)
        goal += 1e-3 * step_ms * rate
        unit.command(goal)
        unit.step(1e-3 * step_ms)
        smooth.append(unit.angles_rad[0])
    # Ten times a second faster and slower by a quarter.
    phase = 2.0 * np.pi * 10.0 * 1e-3 * step_ms * np.arange(len(smooth))
    true = smooth + 0.25 * np.gradient(smooth) / np.diff(phase)[0] * np.sin(phase)
    off, sigma = interpolated(true, step_ms, period_ms, shift_ms)
    normalized = off / np.hypot(sigma, 2e-4)
    assert np.sqrt(np.mean(np.square(normalized))) < 1.0
    assert np.mean(np.abs(normalized) > 5.0) < 0.002


@pytest.mark.parametrize('period_ms', [20, 200])
def test_a_driver_that_reports_the_pan_within_half_a_turn(period_ms):
    stamps_ms = range(0, 20_000, period_ms)
    true = [1e-3 * RATE * t for t in stamps_ms]
    known = zip(stamps_ms, wrap_rad(true).tolist(), strict=True)
    history = JointHistory(JointSample(t * MS, pan) for t, pan in known)
    for t in range(1000, 19_000, 7):
        found = history.at(t * MS)
        assert isinstance(found, JointSample)
        assert wrap_rad(found.pan_rad - 1e-3 * RATE * t) == pytest.approx(0.0, abs=1e-9)
        assert abs(found.pan_rad) < np.pi + 1e-3 * RATE * period_ms
        assert found.pan_rate_rad_s == pytest.approx(RATE)
        assert found.pan_track is not None
        turned = found.pan_track.at([-0.3, 0.0, 0.3]) - found.pan_rad
        np.testing.assert_allclose(turned, [-0.3 * RATE, 0.0, 0.3 * RATE], atol=1e-9)


def test_a_tilt_of_another_driver_is_interpolated_and_stays():
    samples = [JointSample(t * MS, 0.1) for t in range(0, 500, 20)]
    history = JointHistory(samples, [(250 * MS, 0.5), (150 * MS, 0.3)])
    for at_ms, tilt in ((100, 0.3), (150, 0.3), (175, 0.35), (230, 0.46), (400, 0.5)):
        found = history.at(at_ms * MS)
        assert isinstance(found, JointSample)
        assert found.tilt_rad == pytest.approx(tilt, abs=1e-6)
