from dataclasses import replace
import re

from builders import bare_landmark, patch_points, walls_of
import cv2
import numpy as np
import pytest

from landmark_nav.cli.main import main
from landmark_nav.cli.map import describe_comparison
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.storage.maps import save_map
from landmark_nav.types import LandmarkMap, PoseEstimate
from landmark_nav.upkeep.comparison import compare_maps, problems_of_map, Texture
from landmark_nav.upkeep.frames import align_frames, FrameAlignment, in_frame_of, merge_maps

WALLS = walls_of([(0, 0), (6, 0), (6, 4), (0, 4)], ('south', 'east', 'north', 'west'), 2.6)
TEXEL_M = 0.01
SIGMA_M = 0.004


def wallpaper(seed):
    """A texture (height, length) of one wall, 1 cm a pixel."""
    noise = np.random.default_rng(seed).normal(size=(260, 600)).astype(np.float32)
    blurred = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return 128 + 40 * blurred / blurred.std()


def landmark(identity, true_xz, *, texel_m=TEXEL_M, error_m=(0.0, 0.0), paper=0):
    """A patch of the south wall whose map puts it `error_m` (right, down) from where it is."""
    normal = WALLS[0].normal
    center = np.array([true_xz[0], 0.0, true_xz[1]])
    count = round(0.32 / texel_m)
    points = patch_points(center, normal, (count, count), texel_m)
    texture = cv2.GaussianBlur(wallpaper(paper), (0, 0), max(0.1, 0.4 * texel_m / TEXEL_M))
    patch = cv2.remap(
        texture,
        (points[..., 0] / TEXEL_M).astype(np.float32),
        (points[..., 2] / TEXEL_M).astype(np.float32),
        cv2.INTER_LINEAR,
    )
    loading = np.array([[1e-3, 0.0], [0.0, 1e-3], [0.0, 0.0]])
    return bare_landmark(
        identity, center - [error_m[0], 0.0, error_m[1]], np.eye(3) * SIGMA_M**2,
        shared_loading=loading, normal=normal, width_m=count * texel_m, height_m=count * texel_m,
        patch=np.clip(patch, 0, 255).astype(np.uint8), viewpoint=np.array([3.0, 2.0, 1.2]),
        wall_id='south', saliency=0.5,
    )  # fmt: skip


def make_map(*landmarks, stamp_ns=1):
    place = PoseEstimate(stamp_ns, np.array([3.0, 2.0, 0.0]), np.eye(3) * 1e-6)
    return LandmarkMap(tuple(landmarks), 'map', WALLS, (place,), {'bag': f'of {stamp_ns}'})


PLACES = [(1.0, 1.2), (2.0, 1.4), (3.0, 1.0), (4.0, 1.3), (5.0, 1.5)]


def hung(count=5, stamp_ns=1, **given):
    """Map of the first places."""
    members = (landmark(k, place, **given) for k, place in enumerate(PLACES[:count]))
    return make_map(*members, stamp_ns=stamp_ns)


@pytest.mark.parametrize('texel_m', [0.008, 0.01, 0.013])
def test_a_comparison_finds_what_the_maps_disagree_on_whatever_was_cut_out(texel_m):
    rng = np.random.default_rng(4)
    errors = rng.uniform(-0.02, 0.02, (5, 2))
    a = hung()
    b = make_map(
        *(
            landmark(k, np.add(place, rng.uniform(-0.06, 0.06, 2)), texel_m=texel_m, error_m=error)
            for k, (place, error) in enumerate(zip(PLACES, errors, strict=True))
        )
    )
    comparison = compare_maps(a, b)
    same = comparison.of(Texture.SAME)
    assert [(p.a.id, p.b.id) for p in same] == [(k, k) for k in range(5)]
    np.testing.assert_allclose([p.disagreement_m for p in same], errors, atol=1e-3)
    # Four standard deviations of one map's 4 mm, in one direction.
    assert same[0].sigmas == pytest.approx(np.hypot(*errors[0]) / (np.sqrt(2) * SIGMA_M), rel=0.1)


def test_changed_landmarks_and_those_of_one_map_alone_are_distinguished():
    a = hung(4)
    b = make_map(landmark(0, PLACES[0]), landmark(1, PLACES[1], paper=9), landmark(2, PLACES[4]))
    comparison = compare_maps(a, b)
    assert [p.a.id for p in comparison.of(Texture.SAME)] == [0]
    assert [p.a.id for p in comparison.of(Texture.CHANGED)] == [1]
    assert [k.id for k in comparison.only_a] == [2, 3]
    assert [k.id for k in comparison.only_b] == [2]
    # Another choice of landmarks is no change of the room.
    *lines, last = describe_comparison(comparison).splitlines()
    assert sum(line.startswith('only A   ') for line in lines) == 2
    assert sum(line.startswith('only B   ') for line in lines) == 1
    assert last == '1 changed, 2 only in A, 1 only in B, 0 unclear'


def test_a_merged_map_keeps_the_better_of_each_place_and_independent_errors():
    better = replace(landmark(1, PLACES[1]), covariance=np.eye(3) * 1e-6)
    older = hung(4)
    newer = make_map(
        landmark(0, PLACES[0]), better, landmark(2, PLACES[2], paper=9), landmark(3, PLACES[4]),
        stamp_ns=2,
    )  # fmt: skip
    merged = merge_maps(older, newer)
    assert merged.ids.tolist() == [0, 3, 4, 5, 6]
    assert np.trace(merged.landmarks[2].covariance) == pytest.approx(3e-6)
    np.testing.assert_array_equal(merged.landmarks[3].patch, newer.landmarks[2].patch)
    assert [p.stamp_ns for p in merged.panorama_poses] == [1, 2]
    joint = merged.joint_covariance_xy
    np.testing.assert_allclose(joint[:4, 4:], 0.0)  # of the older and of the newer map
    np.testing.assert_allclose(joint[0, 2], 1e-6)
    assert problems_of_map(merged) == []


@pytest.mark.parametrize(
    ('newer', 'match'),
    [
        (make_map(landmark(0, PLACES[0]), stamp_ns=1), 'not independent'),
        (replace(make_map(stamp_ns=2), frame_id='odom'), 'frames map and odom'),
        (replace(make_map(stamp_ns=2), walls=WALLS[:3]), 'wall west is in one of the maps'),
        # Another room, whatever the time of its sweeps.
        (replace(make_map(stamp_ns=1), walls=WALLS[:3]), 'wall west is in one of the maps'),
        (
            hung(stamp_ns=2, error_m=(0.04, 0.0)),
            r'contradict each other: 5 of the 5 .*up to 4\.0 cm',
        ),
        (
            hung(stamp_ns=2, paper=9),
            '5 of the 5 places that both maps know look different',
        ),
    ],
)  # fmt: skip
def test_maps_that_do_not_belong_together_are_not_merged(newer, match):
    older = hung()
    with pytest.raises(LandmarkNavError, match=match):
        merge_maps(older, newer)


@pytest.mark.parametrize(
    ('changes', 'match'),
    [
        ({'position': np.array([1.0, 0.3, 1.2])}, '30.0 cm off the plane of wall south'),
        ({'position': np.array([-0.5, 0.0, 1.2])}, r'-0\.50 m along wall south'),
        ({'position': np.array([1.0, 0.0, 3.0])}, r'3\.00 m high'),
        ({'normal': np.array([1.0, 0.0, 0.0])}, 'turned by 90.0 deg'),
        ({'wall_id': 'attic'}, "wall 'attic' is not in the map"),
        ({'threshold': 1.5}, 'threshold is 1.5'),
        ({'patch': np.full((32, 32), 7, np.uint8)}, 'blank'),
        ({'width_m': 0.8}, 'do not fit a patch of 32 x 32 texels'),
        ({'covariance': np.eye(3)}, 'of no use'),
        ({'covariance': np.zeros((3, 3))}, 'singular'),
        ({'viewpoint': np.array([3.0, -2.0, 1.2])}, 'from behind its wall'),
    ],
)
def test_a_check_states_what_cannot_be(changes, match):
    good = list(hung().landmarks)
    assert problems_of_map(make_map(*good)) == []
    good[0] = replace(good[0], **changes)
    problems = '\n'.join(problems_of_map(make_map(*good)))
    assert 'landmark 0' in problems
    assert re.search(match, problems)


def test_the_commands_report_it_by_their_exit_status(tmp_path, capsys):
    a, b, out = (str(tmp_path / name) for name in ('a', 'b', 'out'))
    save_map(hung(), a)
    save_map(
        make_map(landmark(0, PLACES[0], error_m=(0.03, 0.0)),
                 *(landmark(k, p) for k, p in enumerate(PLACES) if k), stamp_ns=2), b,
    )  # fmt: skip
    assert main(['map', 'check', a]) == 0
    assert main(['map', 'diff', a, b]) == 0
    printed = capsys.readouterr().out
    assert 'moved    0 on south' in printed
    assert '+3.0 cm right' in printed
    assert '5 in both' in printed
    assert 'no landmark moved' not in printed
    assert main(['map', 'diff', a, a]) == 0
    printed = capsys.readouterr().out
    assert '0.0 mm at most' in printed
    assert 'no landmark moved or changed' in printed
    assert main(['map', 'merge', a, b, '--out', out]) == 0
    assert main(['map', 'merge', a, b, '--out', out]) == 1
    assert '--overwrite' in capsys.readouterr().err
    (tmp_path / 'out' / 'map.png').write_bytes(b'figure')
    assert main(['map', 'migrate', out]) == 0
    assert (tmp_path / 'out' / 'map.png').read_bytes() == b'figure'
    assert main(['map', 'check', out]) == 0
    save_map(make_map(replace(landmark(0, PLACES[0]), wall_id='attic')), a)
    assert main(['map', 'check', a]) == 1
    assert 'attic' in capsys.readouterr().out


POSE, RISE_M, SCALE = np.array([1.5, -2.0, 2.1]), -0.033, 1.03


def in_own_frame(learned):
    """The same map as if it had been learned without a plan: in another frame and metre."""
    moved = in_frame_of(FrameAlignment(POSE, RISE_M, SCALE, 1e-16 * np.eye(5), 0), learned)
    own = {'frame': 'base_link at the first sweep', 'scale': 'odom', 'scale_sigma': '0.02'}
    return replace(moved, provenance=own)


def test_frames_and_metres_of_maps_are_found_by_their_landmarks():
    rng = np.random.default_rng(7)
    errors = rng.normal(0.0, SIGMA_M, (2, 5, 2))
    shifts = rng.uniform(-0.04, 0.04, (5, 2))
    a = make_map(
        *(
            landmark(k, p, error_m=e)
            for k, (p, e) in enumerate(zip(PLACES, errors[0], strict=True))
        )
    )
    b = make_map(
        *(
            landmark(k, np.add(p, shift), error_m=e)
            for k, (p, shift, e) in enumerate(zip(PLACES, shifts, errors[1], strict=True))
        ),
        stamp_ns=2,
    )
    found = align_frames(a, in_own_frame(b))
    back = se2.inverse(POSE)
    expected = np.array([*back[:2] / SCALE, back[2]])
    x, y, turn = found.pose - expected
    rise, growth = found.rise_m + RISE_M / SCALE, np.log(found.scale * SCALE)
    off = np.array([x, y, rise, turn, growth])
    assert off @ np.linalg.solve(found.covariance, off) < 20.5  # chi square of 5, 0.1 %
    assert np.hypot(x, y) < 0.03
    assert abs(growth) < 0.005
    merged = merge_maps(a, in_own_frame(b))
    assert 5 <= len(merged.landmarks) <= 10
    assert np.abs(merged.positions[:, 1]).max() < 0.03
    assert not problems_of_map(merged)
    # What an alignment is off by, all landmarks that came by it share.
    for k in merged.landmarks:
        own = k.covariance - k.shared_loading @ k.shared_loading.T
        assert np.linalg.eigvalsh(own)[0] > -1e-12


def test_maps_that_can_not_be_aligned_are_refused():
    here = hung()
    foreign = hung(stamp_ns=2, paper=9)
    with pytest.raises(LandmarkNavError, match='are they of one room'):
        align_frames(here, in_own_frame(foreign))
    # The same posters hang a second time, two metres on.
    again = [landmark(5 + k, p, error_m=(-2.0, 0.0)) for k, p in enumerate(PLACES)]
    with pytest.raises(LandmarkNavError, match='textures repeat'):
        align_frames(replace(here, landmarks=(*here.landmarks, *again)), in_own_frame(here))
