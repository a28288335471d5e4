from dataclasses import replace

import numpy as np
import pytest
from scenes import Board, draw_panorama, rectangle_room, smooth_texture, textured_room
from wall_views import candidate_at

from landmark_nav.geometry import se2
from landmark_nav.learning.stereo.found_again import find_again
from landmark_nav.learning.stereo.own_plane import match_freely
from landmark_nav.learning.stereo.wall_patch import StereoConfig, WallPatch
from landmark_nav.learning.stereo.wall_stereo import hypothesize, match_in
from landmark_nav.types import Refusal

ROOM = rectangle_room(6.0, 5.0)
CONFIG = StereoConfig()
# Not equally high: epipolar curves run up and down as well.
CENTERS = (np.array([2.2, 2.0, 1.1]), np.array([3.0, 3.1, 1.2]))
HEADINGS = (0.4, -2.0)
SCENE = textured_room(ROOM, seed=2, feature_m=0.05)
EAST = ROOM.normals[1]


def views_of(*scenes):
    rng = np.random.default_rng(0)
    return [
        draw_panorama(scene, center, heading, rng=rng)
        for scene, center, heading in zip(scenes, CENTERS, HEADINGS, strict=True)
    ]


def patch_at(panorama, point):
    patch = hypothesize(candidate_at(panorama, point, 30), 0, panorama, ROOM, CONFIG)
    assert isinstance(patch, WallPatch)
    return patch


def board(center, normal, seed):
    texture = smooth_texture(np.random.default_rng(seed), 0.7, 0.7, 0.04)
    return Board(np.array(center), normal, 0.7, 0.7, texture)


def freely(panoramas, point, depths=None):
    candidate = candidate_at(panoramas[0], point, 30)
    return match_freely(candidate, 0, panoramas, CONFIG, depths)


@pytest.mark.parametrize(
    ('center', 'angle'), [((4.6, 2.6, 1.1), 0.0), ((4.1, 2.3, 1.3), 0.0), ((4.4, 2.9, 1.1), 0.4)]
)
def test_what_stands_before_a_wall_is_found_at_its_depth(center, angle):
    normal = np.append(se2.rotation(angle) @ EAST[:2], 0.0)
    furnished = replace(SCENE, boards=(*SCENE.boards, board(center, normal, 8)))
    panoramas = views_of(furnished, furnished)
    patch = patch_at(panoramas[0], np.array(center))
    assert isinstance(match_in(patch, 1, panoramas, ROOM, CONFIG), Refusal)
    candidates = [[candidate_at(panoramas[0], np.array(center), 30)], []]
    found = find_again(panoramas, candidates, ROOM, CONFIG)
    assert found.walls == [-1]
    (patch,) = found.patches
    assert patch.position == pytest.approx(np.array(center), abs=0.03)
    assert patch.normal @ normal > np.cos(0.25)
    assert [s.panorama for s in found.measurements[0]] == [0, 1]


@pytest.mark.parametrize('east_m', [5.3, 6.9])
def test_a_wall_that_is_reported_too_near_or_too_far_is_found_where_it_is(east_m):
    given = rectangle_room(east_m, 5.0)
    panoramas = views_of(SCENE, SCENE)
    points = [np.array([6.0, y, z]) for y in (1.6, 2.2, 2.8) for z in (1.0, 1.3)]
    candidates = [[candidate_at(panoramas[0], point, 30) for point in points], []]
    found = find_again(panoramas, candidates, given, CONFIG)
    own = [patch for patch in found.patches if not patch.on_wall]
    assert len(own) >= 4
    for patch in own:
        assert patch.position[0] == pytest.approx(6.0, abs=0.04)
        assert patch.wall == 1


def test_what_is_gone_is_found_at_no_depth():
    # A person who stood there at the first sweep alone.
    furnished = replace(SCENE, boards=(*SCENE.boards, board((4.3, 2.5, 1.1), EAST, 8)))
    panoramas = views_of(furnished, SCENE)
    assert isinstance(freely(panoramas, np.array([4.3, 2.5, 1.1])), Refusal)
