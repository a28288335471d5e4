"""What a candidate shows lies on a wall where its ray meets it, and looks alike from anywhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from patch_texels import patch_points
import pytest
from scenes import draw_panorama, rectangle_room, Scene, textured_room
from stereo_room import CENTERS, CONFIG, direction_to, EAST, patch_at, ROOM, views_of
from wall_views import candidate_at, greys_of

from landmark_nav.learning.stereo import hypothesize
from landmark_nav.learning.stereo.wall_patch import own_measurement, wall_texture, WallPatch
from landmark_nav.types import Panorama, Refusal


@pytest.fixture(scope='module')
def scene() -> Scene:
    return textured_room(ROOM, seed=2, feature_m=0.05)


@pytest.fixture(scope='module')
def panoramas(scene: Scene) -> list[Panorama]:
    return views_of(scene)


@pytest.mark.parametrize(
    ('point', 'wall'),
    [
        ((6.0, 2.5, 1.2), 1),
        ((3.0, 5.0, 1.0), 2),
        ((0.0, 1.5, 0.9), 3),
        ((2.5, 0.0, 1.3), 0),
    ],
)
def test_a_candidate_lies_where_its_ray_meets_the_wall(
    panoramas: list[Panorama], point: tuple[float, ...], wall: int
) -> None:
    patch = patch_at(panoramas[0], np.array(point))
    assert isinstance(patch, WallPatch)
    assert patch.wall == wall
    np.testing.assert_allclose(patch.normal, ROOM.normals[wall])
    # Within half a pixel, which is 1 to 2 cm here.
    np.testing.assert_allclose(patch.position, point, atol=0.02)
    seen = own_measurement(patch, panoramas[0])
    expected = direction_to(panoramas[0], patch.position)
    expected[0] += 2.0 * np.pi * np.round((seen.azimuth_rad - expected[0]) / (2.0 * np.pi))
    np.testing.assert_allclose([seen.azimuth_rad, seen.tangent], expected, atol=1e-9)


def test_a_slanted_patch_is_wide_on_the_wall(panoramas: list[Panorama]) -> None:
    ahead = patch_at(panoramas[0], np.array([6.0, 2.0, 1.1]))
    aside = patch_at(panoramas[0], np.array([5.2, 0.0, 1.1]))
    assert isinstance(ahead, WallPatch)
    assert isinstance(aside, WallPatch)
    assert ahead.shape == (32, 32)
    slant = np.hypot(3.0, 2.0) / 2.0
    assert aside.shape[1] == pytest.approx(32 * slant, abs=1.5)


@pytest.mark.parametrize(
    ('point', 'reason'),
    [
        ((6.0, 2.5, 0.0), 'floor or ceiling'),
        ((6.0, 2.5, 2.49), 'floor or ceiling'),
        ((6.0, 0.1, 1.1), 'across the corner'),
    ],
)
def test_what_is_no_patch_of_wall_is_refused(
    panoramas: list[Panorama], point: tuple[float, ...], reason: str
) -> None:
    found = patch_at(panoramas[0], np.array(point))
    assert isinstance(found, Refusal)
    assert reason in found.reason


def test_a_wall_seen_along_is_refused() -> None:
    long = rectangle_room(12.0, 3.0)
    panorama = replace(
        draw_panorama(Scene(()), np.array([1.0, 1.0, 1.1]), 0.0), center_map=CENTERS[0] * 0.5
    )
    candidate = candidate_at(panorama, np.array([9.0, 0.0, 1.1]))
    found = hypothesize(candidate, 0, panorama, long, CONFIG)
    assert isinstance(found, Refusal)
    assert found.reason == 'too oblique'


def test_a_wall_looks_the_same_from_both_places(panoramas: list[Panorama], scene: Scene) -> None:
    point, normal = np.array([6.0, 2.4, 1.15]), ROOM.normals[EAST]
    first, second = (
        wall_texture(panorama, grey, point, normal, (40, 60), 0.014)
        for panorama, grey in zip(panoramas, greys_of(panoramas), strict=True)
    )
    points = patch_points(point, normal, (40, 60), 0.014)
    truth, _ = scene.look(points + 0.1 * normal, np.broadcast_to(-normal, points.shape))
    for texture in (first, second):
        assert texture is not None
        assert np.abs(texture - truth[..., 0]).mean() < 4.0


def test_the_seam_of_a_panorama_does_not_show(scene: Scene) -> None:
    point, normal = np.array([6.0, 2.4, 1.15]), ROOM.normals[EAST]
    textures = []
    # The point ahead, and right behind, where the panorama is cut.
    for heading in (0.0, np.pi):
        toward = float(np.arctan2(*(point - CENTERS[0])[1::-1]))
        panorama = draw_panorama(scene, CENTERS[0], toward + heading)
        grey = greys_of([panorama])[0]
        textures.append(wall_texture(panorama, grey, point, normal, (40, 60), 0.014))
    assert textures[0] is not None
    assert textures[1] is not None
    assert np.abs(textures[0] - textures[1]).max() < 3.0


def test_a_patch_out_of_the_image_has_no_texture(panoramas: list[Panorama]) -> None:
    grey = greys_of(panoramas)[0]
    high = np.array([6.0, 2.0, 2.6])
    assert wall_texture(panoramas[0], grey, high, ROOM.normals[EAST], (40, 40), 0.014) is None
    blind = replace(panoramas[0], mask=np.zeros_like(panoramas[0].mask))
    point = np.array([6.0, 2.4, 1.15])
    assert wall_texture(blind, grey, point, ROOM.normals[EAST], (40, 40), 0.014) is None
