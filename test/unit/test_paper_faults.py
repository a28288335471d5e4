"""The single fault that keeps reference papers from fitting together is named, with its size."""

from dataclasses import replace

import numpy as np
from paper_sweeps import CONFIG, EAST
import pytest
from scenes import rectangle_room

from landmark_nav.learning.reference_area.edges import PaperOutlines
from landmark_nav.learning.reference_area.faults import paper_faults, PaperView

EYE_M = 1.1
POSES = np.array([[3.5, 2.0, 0.3], [2.2, 3.6, -0.8]])
ROOM = rectangle_room(papers=EAST)
# Along the east wall, as seen from inside, left is +y.
LEFT = np.array([0.0, 1.0, 0.0])
SIGMA_RAD = 5e-4
NONE = PaperOutlines(np.zeros((0, 4)), np.zeros(0), np.zeros((0, 4)), np.zeros((0, 4)))


def outlines_of(paper, pose, rng):
    """What is seen of a paper on the east wall from a pose of the pan axis, exactly but noise."""
    center = np.array(paper.center)
    ends = [center + side * 0.5 * paper.width * LEFT for side in (-1.0, 1.0)]
    azimuth = [np.arctan2(end[1] - pose[1], end[0] - pose[0]) - pose[2] for end in ends]
    # Where the bisector of the two directions meets the wall.
    middle = pose[2] + 0.5 * sum(azimuth)
    distance = (center[0] - pose[0]) / np.cos(middle)
    tangent = [(center[2] + up * 0.5 * paper.height - EYE_M) / distance for up in (-1.0, 1.0)]
    seen = np.array([[*azimuth, *tangent]]) + SIGMA_RAD * rng.standard_normal((1, 4))
    return PaperOutlines(seen, np.zeros(1), np.full((1, 4), SIGMA_RAD), np.zeros((1, 4)))


def views_of(papers, seed=0):
    rng = np.random.default_rng(seed)
    return [
        PaperView({p.color: outlines_of(p, pose, rng) for p in papers}, EYE_M) for pose in POSES
    ]


def judged(papers, given=ROOM):
    return paper_faults(views_of(papers), given, CONFIG)


def hung(k, left_m=0.0, up_m=0.0):
    x, y, z = EAST[k].center
    moved = replace(EAST[k], center=(x, y + left_m, z + up_m))
    return (*EAST[:k], moved, *EAST[k + 1 :])


@pytest.mark.parametrize('seed', range(6))
def test_papers_that_hang_as_given_fit(seed):
    found = paper_faults(views_of(EAST, seed), ROOM, CONFIG)
    assert found.fits
    assert not found.faults
    assert found.text == ''


@pytest.mark.parametrize(
    ('kind', 'off_m', 'k'),
    [
        *(('along', off_m, k) for off_m, k in ((0.05, 0), (-0.1, 1), (0.2, 2))),
        *(('height', off_m, k) for off_m, k in ((0.05, 2), (-0.1, 0), (0.2, 1))),
    ],
)
def test_a_paper_that_hangs_elsewhere_is_named_with_how_far(kind, off_m, k):
    papers = hung(k, left_m=off_m) if kind == 'along' else hung(k, up_m=off_m)
    found = judged(papers)
    assert not found.fits
    best = found.faults[0]
    assert (best.kind, best.paper) == (kind, k)
    assert abs(best.value - off_m) < max(4.0 * best.sigma, 0.01)
    assert EAST[k].color in found.text
    # Whatever else explains it as well is another value, not another direction of this one.
    assert all((other.kind, other.paper) != (kind, k) for other in found.faults[1:])


def test_papers_that_changed_colours_are_named():
    swapped = (EAST[0], replace(EAST[1], color='blue'), replace(EAST[2], color='green'))
    assert judged(swapped).faults[0].kind == 'swapped'


def in_unit(length_m):
    """The room in another unit."""
    papers = tuple(
        replace(
            paper,
            center=tuple(at / length_m for at in paper.center),
            width=paper.width / length_m,
            height=paper.height / length_m,
        )
        for paper in EAST
    )
    walls = tuple(
        replace(
            wall,
            start=tuple(at / length_m for at in wall.start),
            end=tuple(at / length_m for at in wall.end),
            height=wall.height / length_m,
        )
        for wall in ROOM.walls
    )
    return replace(ROOM, walls=walls, papers=papers)


def test_papers_given_on_the_opposite_wall_are_named():
    # At their distances along the wall, which are not those of two papers that are exchanged.
    opposite = tuple(replace(paper, center=(0.0, *paper.center[1:])) for paper in EAST)
    assert [f.kind for f in judged(EAST, replace(ROOM, papers=opposite)).faults] == ['mirrored']


def test_a_room_in_feet_is_named():
    assert [fault.kind for fault in judged(EAST, in_unit(0.3048)).faults] == ['feet']


def test_a_paper_that_nobody_sees_is_not_laid_to_others_colours():
    # Two faults: green is covered, blue and red hang on each other's places.
    papers = (replace(EAST[0], color='blue'), replace(EAST[2], color='red'))
    views = [PaperView({'green': NONE, **view.outlines}, EYE_M) for view in views_of(papers)]
    found = paper_faults(views, ROOM, CONFIG)
    assert not found.fits
    assert 'swapped' not in [fault.kind for fault in found.faults]


def test_a_paper_of_another_size_and_one_that_is_turned_are_distinguished():
    larger = replace(EAST[1], width=1.414 * EAST[1].width, height=1.414 * EAST[1].height)
    found = judged((EAST[0], larger, EAST[2])).faults[0]
    assert (found.kind, found.paper) == ('size', 1)
    assert found.value == pytest.approx(0.414, abs=0.05)
    turned = replace(EAST[1], width=EAST[1].height, height=EAST[1].width)
    found = judged((EAST[0], turned, EAST[2])).faults[0]
    assert (found.kind, found.paper) == ('turned', 1)


def test_two_papers_or_nothing_seen_give_no_fault():
    assert judged(EAST, replace(ROOM, papers=EAST[:2])).fits
    assert paper_faults([PaperView({p.color: NONE for p in EAST}, EYE_M)], ROOM, CONFIG).fits
