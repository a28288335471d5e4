"""A plan replaces the walls found only if the sweeps see its walls where it states them."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.geometry.walls import Room, Wall
from landmark_nav.learning.facades.planes import SeenPoints
from landmark_nav.learning.unmeasured import Located, with_plan

# A corridor whose long walls are bare, in the frame of the first of two sweeps.
CORNERS = np.array([[-3.6, -0.95], [5.4, -0.95], [5.4, 0.95], [-3.6, 0.95]])
SWEEPS = np.array([[0.0, 0.0], [1.8, -0.05]])


def plan(corners):
    ends = np.roll(corners, -1, axis=0)
    walls = [
        Wall(str(k), tuple(map(float, a)), tuple(map(float, b)), 2.5)
        for k, (a, b) in enumerate(zip(corners, ends, strict=True))
    ]
    return Room(tuple(walls))


def located(points_xy, scale_sigma):
    states = np.pad(SWEEPS, ((0, 0), (0, 4)))
    count = len(points_xy)
    points = SeenPoints(
        np.column_stack([points_xy, np.full(count, 1.4)]),
        np.zeros((count, 2, 2)),
        np.zeros((count, 3)),
    )
    poses: Any = SimpleNamespace(states=states, scale_sigma=scale_sigma)
    nothing: Any = None
    return Located((), (), nothing, np.eye(8), poses, nothing, points)


def seen(seed, scale=1.0):
    """Points at both ends of the corridor, on things that stand in it, and false ones."""
    rng = np.random.default_rng(seed)
    ends = np.concatenate([rng.normal(x, 0.02, 40) for x in (-3.6, 5.4)])
    on_ends = np.column_stack([ends, rng.uniform(-0.9, 0.9, len(ends))])
    others = rng.uniform([-3.4, -0.7], [5.0, 0.7], (30, 2))
    false = rng.uniform(-9.0, 9.0, (20, 2))
    return scale * np.vstack([on_ends, others, false])


@pytest.mark.parametrize('seed', [1, 2])
def test_a_plan_that_is_seen_is_used_whatever_the_error_of_the_scale(seed):
    right = plan(CORNERS)
    assert with_plan(located(seen(seed, 0.95), 0.05), right).room is right


@pytest.mark.parametrize(
    'pose', [(3.6, 0.95, 0.0), (1.2, 0.3, 0.0), (0.2, 0.0, 1.57), (-0.8, 0.0, 0.06)]
)
def test_a_plan_in_another_frame_is_refused_though_no_facade_was_found(pose):
    moved = plan(se2.transform_points(np.array(pose), CORNERS))
    with pytest.raises(LandmarkNavError, match='--room'):
        with_plan(located(seen(3), 0.05), moved)


def test_a_plan_of_which_nothing_is_seen_is_refused():
    bare = located(seen(4), 0.05)
    nothing = np.zeros(len(bare.points), dtype=bool)
    with pytest.raises(LandmarkNavError, match='--room'):
        with_plan(replace(bare, points=bare.points.chosen(nothing)), plan(CORNERS))
