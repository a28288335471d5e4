"""A robot that is lost turns its camera all around, within the joint limits."""

import numpy as np
import pytest

from landmark_nav.localization.triplet.look_around import (
    is_known,
    LookAround,
    LookAroundConfig,
    views_around,
)
from landmark_nav.types import PoseEstimate

FULL = (-np.pi, np.pi)
FOV = np.radians(50.0)


@pytest.mark.parametrize('limits', [FULL, (-2.0, 0.5), (0.0, 1.0), (-6.0, 6.0)])
@pytest.mark.parametrize('pan', [-1.5, 0.0, 0.4, 3.0])
def test_the_views_show_all_that_the_joint_reaches_once(limits, pan):
    views = np.array(views_around(limits, FOV, pan))
    assert views.min() >= limits[0]
    assert views.max() <= limits[1]
    shown = np.abs((np.linspace(*limits, 400)[:, None] - views + np.pi) % (2 * np.pi) - np.pi)
    assert shown.min(axis=1).max() <= 0.5 * FOV
    apart = np.abs((views[:, None] - views + np.pi) % (2 * np.pi) - np.pi)
    assert apart[~np.eye(len(views), dtype=bool)].min(initial=1.0) > 0.5 * FOV
    assert np.argmin(np.abs(views - pan)) == 0
    # From one view to the next, with one way back over what has been seen.
    assert np.count_nonzero(np.abs(np.diff(views)) > 1.01 * FOV) <= 1


def run(around, seconds, limit_rad=10.0):
    """Targets, in order, of a joint that follows at 2 rad/s and stops at a limit."""
    pan, targets = 0.0, list[float]()
    for tick in range(round(seconds / 0.1)):
        target = around.pan_at(0.1 * tick, pan, FOV)
        if target is None:
            continue
        if not targets or target != targets[-1]:
            targets.append(target)
        pan = float(np.clip(pan + np.clip(target - pan, -0.2, 0.2), -limit_rad, limit_rad))
    return targets


def test_it_waits_then_goes_round_and_round():
    around = LookAround(LookAroundConfig(after_s=1.0), FULL)
    assert run(around, 0.9) == []
    around.end()
    once = run(around, 14.0)
    assert len({round(target, 6) for target in once}) == 10
    assert len(run(LookAround(LookAroundConfig(after_s=0.0), FULL), 30.0)) > 20


def test_it_goes_on_where_the_joint_is_stuck():
    stuck = run(LookAround(LookAroundConfig(after_s=0.0), FULL), 40.0, limit_rad=1.0)
    assert min(stuck) < -1.0
    assert max(stuck) > 1.0


@pytest.mark.parametrize(
    ('sigma', 'known'),
    [((0.1, 0.1, 0.1), True), ((0.4, 0.4, 0.1), False), ((0.1, 0.1, 0.6), False)],
)
def test_what_counts_as_known(sigma, known):
    pose = PoseEstimate(0, np.zeros(3), np.diag(np.square(sigma)))
    assert is_known(pose) is known
