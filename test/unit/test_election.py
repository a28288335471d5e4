from dataclasses import replace

from builders import patch_points
import numpy as np
import pytest
from scenes import draw_panorama, rectangle_room, textured_room

from landmark_nav.geometry import se2
from landmark_nav.learning.adjustment.solution import Adjustment
from landmark_nav.learning.election import elect, ElectionConfig
from landmark_nav.learning.stereo.wall_patch import PatchMeasurement, WallPatch
from landmark_nav.types import Candidate, Landmark, Refusal

ROOM = rectangle_room(6.0, 5.0)
CENTERS = (np.array([2.2, 2.0, 1.1]), np.array([3.6, 2.9, 1.1]))
HEADINGS = (0.4, -2.0)
SCENE = textured_room(ROOM, seed=3, feature_m=0.05)
SOUTH, EAST = 0, 1


@pytest.fixture(scope='module')
def panoramas():
    return views_of(SCENE)


def views_of(scene):
    return [draw_panorama(scene, c, h) for c, h in zip(CENTERS, HEADINGS, strict=True)]


def patch_at(position, *, saliency=0.5, size_px=30, wall=EAST):
    candidate = Candidate(0.0, 0.0, size_px, size_px, saliency)
    normal = ROOM.normals[wall]
    return WallPatch(candidate, 0, wall, np.array(position), normal, (30, 30), 0.015)


def perfect(patches, **changes):
    """Adjustment that left the patches where they are, each known to 5 mm and on its wall."""
    n = len(patches)
    found = Adjustment(
        np.array([p.position for p in patches]),
        np.tile(np.eye(3) * 0.004**2, (n, 1, 1)),
        np.tile(np.eye(3) * 0.003, (n, 1, 1)),
        np.array([[*c, h] for c, h in zip(CENTERS, HEADINGS, strict=True)]),
        np.tile(np.eye(4) * 1e-4, (2, 1, 1)),
        np.zeros(n),
        np.ones(n),
        np.ones(4),
    )
    return replace(found, **changes)


def direction_of(patch, k):
    away = patch.position - CENTERS[k]
    return np.arctan2(away[1], away[0]) - HEADINGS[k], away[2] / np.hypot(*away[:2])


def elect_from(panoramas, patches, adjustment=None, config=None, scores=None, free=None):
    scores = scores or [0.9] * len(patches)
    measurements = [
        [
            PatchMeasurement(0, *direction_of(patch, 0), 0.0, 0.0, 1.0),
            PatchMeasurement(1, *direction_of(patch, 1), 1e-4, 1e-4, score),
        ]
        for patch, score in zip(patches, scores, strict=True)
    ]
    return elect(
        patches, measurements, adjustment or perfect(patches), free or perfect(patches), panoramas,
        ROOM, config or ElectionConfig(),
    )  # fmt: skip


def check_texture(patch, image, texel_m, within):
    """An image shows the texture of the wall where the patch is."""
    points = patch_points(patch.position, patch.normal, image.shape, texel_m)
    inwards = np.broadcast_to(-patch.normal, points.shape)
    truth = SCENE.look(points + 0.1 * patch.normal, inwards)[0][..., 0]
    assert np.abs(image - truth).mean() < within


def test_a_good_patch_becomes_a_landmark(panoramas):
    patch = patch_at((6.0, 2.4, 1.2), saliency=0.8)
    (landmark,) = elect_from(panoramas, [patch])
    assert (landmark.id, landmark.wall_id, landmark.saliency) == (1, 'e', 0.8)
    assert (landmark.width_m, landmark.height_m) == (pytest.approx(0.45), pytest.approx(0.45))
    np.testing.assert_allclose(landmark.covariance, np.eye(3) * (0.004**2 + 0.003**2))
    np.testing.assert_allclose(landmark.shared_loading, np.eye(3) * 0.003)
    np.testing.assert_array_equal(landmark.viewpoint, CENTERS[0])
    check_texture(patch, landmark.patch, 0.015, 3.0)


@pytest.mark.parametrize('off_m', [(0.0, 0.0, 0.0), (0.02, -0.01, 0.02)])
def test_a_landmark_keeps_what_the_other_panoramas_show_of_it(panoramas, off_m):
    patch = patch_at((6.0, 2.4, 1.2), saliency=0.8)
    # The measurements say where a panorama shows it that leans, or whose place is a little off.
    off = replace(panoramas[1], center_map=panoramas[1].center_map + off_m)
    (landmark,) = elect_from([panoramas[0], off], [patch])
    (view,) = landmark.views
    np.testing.assert_array_equal(view.viewpoint, off.center_map)
    rows, columns = view.patch.shape
    # As fine as that panorama shows it, and of the same piece of wall.
    reach = np.hypot(*(off.center_map - patch.position)[:2])
    texel = landmark.width_m / columns
    assert texel == pytest.approx(reach / off.cylinder.fy, rel=0.05)
    assert rows * texel == pytest.approx(landmark.height_m, abs=texel)
    check_texture(patch, view.patch, texel, 4.0)


GOOD = patch_at((6.0, 2.4, 1.2))


@pytest.mark.parametrize(
    ('patch', 'changes', 'reason', 'detail'),
    [
        (GOOD, {'off_wall_m': np.array([0.2])}, 'not on a wall', '20 cm off'),
        (GOOD, {'off_wall_m': np.array([-0.1])}, 'not on a wall', '-10 cm off'),
        (GOOD, {'chi_square': np.array([50.0])}, 'not on a wall', 'misfit 50'),
        (
            GOOD,
            {'own_covariance': np.diag([0.05, 0.001, 0.001])[None] ** 2},
            'place too uncertain',
            '5.0 cm',
        ),
        (patch_at((5.8, 0.0, 1.2), wall=SOUTH), {}, 'too oblique', '61 deg'),
        (patch_at((6.0, 2.4, 1.2), size_px=12), {}, 'too small', ''),
        (patch_at((6.0, 2.4, 2.45)), {}, 'runs out of its panorama', ''),
    ],
)
def test_what_is_badly_seen_or_reconstructed_is_refused(panoramas, patch, changes, reason, detail):
    (outcome,) = elect_from(panoramas, [patch], perfect([patch], **changes))
    assert outcome.reason == reason
    assert detail in outcome.detail


@pytest.mark.parametrize(
    ('sigma_m', 'share', 'refused'),
    [
        ((0.01, 0.01, 0.005), 0.0, None),
        ((0.12, 0.01, 0.005), 0.0, 'too little parallax'),
        ((0.12, 0.01, 0.005), 0.05, None),
        ((0.01, 0.05, 0.005), 0.05, 'place too uncertain'),
    ],
)
def test_on_a_plane_of_its_own_a_patch_needs_a_bearing_only(panoramas, sigma_m, share, refused):
    patch = replace(patch_at((6.0, 2.0, 1.2)), on_wall=False)
    # Across and along the view that it was proposed in.
    away = patch.position - CENTERS[0]
    turn = np.eye(3)
    turn[:2, :2] = se2.rotation(float(np.arctan2(away[1], away[0])))
    own = turn @ np.diag(sigma_m) ** 2 @ turn.T
    found = perfect([patch], own_covariance=own[None], off_wall_m=np.array([0.5]))
    config = ElectionConfig(max_range_share=share)
    (outcome,) = elect_from(panoramas, [patch], found, config, free=found)
    assert isinstance(outcome, Refusal if refused else Landmark)
    assert (outcome.reason if refused else outcome.wall_id) == (refused or '')


@pytest.mark.parametrize(('apart_m', 'elected'), [(0.1, 1), (0.24, 1), (0.3, 2), (0.6, 2)])
def test_what_a_stronger_landmark_covers_is_refused(panoramas, apart_m, elected):
    # Patches of 0.45 m: 0.27 m apart leave 40 % common.
    patches = [
        patch_at((6.0, 2.4, 1.2), saliency=0.3),
        patch_at((6.0, 2.4 + apart_m, 1.2), saliency=0.9),
    ]
    outcomes = elect_from(panoramas, patches)
    assert isinstance(outcomes[1], Landmark)
    assert sum(isinstance(o, Landmark) for o in outcomes) == elected
    if elected == 1:
        assert isinstance(outcomes[0], Refusal)
        assert outcomes[0].reason == 'covered by a stronger landmark'


def test_no_more_than_the_strongest_are_kept(panoramas):
    patches = [patch_at((6.0, 0.8 + 0.6 * k, 1.2), saliency=0.1 * k) for k in range(6)]
    outcomes = elect_from(panoramas, patches, config=ElectionConfig(max_count=4))
    # Ids count from the most salient.
    assert [o.id for o in outcomes if isinstance(o, Landmark)] == [4, 3, 2, 1]
    assert isinstance(outcomes[0], Refusal)
    assert outcomes[0].reason == 'enough landmarks'


def test_what_its_measurements_alone_do_not_place_is_refused(panoramas):
    # The wall makes its place look certain, whatever stands there.
    patch = patch_at((6.0, 2.4, 1.2))
    spread = np.diag([0.025, 0.002, 0.002])
    free = perfect([patch], own_covariance=(spread**2)[None])
    (outcome,) = elect_from(panoramas, [patch], free=free)
    assert (outcome.reason, outcome.detail) == ('too little parallax', '2.5 cm sigma of its depth')
    # It is the depth that counts: along the wall nothing is drawn to anything.
    free = perfect([patch], own_covariance=(spread[::-1, ::-1] ** 2)[None])
    assert isinstance(elect_from(panoramas, [patch], free=free)[0], Landmark)
