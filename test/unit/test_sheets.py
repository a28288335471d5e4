"""Sheets of a known size: where panoramas show them, and the scale that they give."""

import colorsys
import contextlib
from dataclasses import replace
from itertools import combinations

from builders import panorama_of
import cv2
import numpy as np
import pytest
from scenes import rectangle_room

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.se2 import rot_z
from landmark_nav.geometry.walls import Marker, marker_count, NAMED_HUES_DEG, paper_bgr
from landmark_nav.learning.panorama.synthesis import CylinderImage
from landmark_nav.learning.reference_area.blobs import ColorSearch, hue_direction
from landmark_nav.learning.reference_area.edges import locate_edges, PROFILES
from landmark_nav.learning.reference_area.markers import fit_markers
from landmark_nav.learning.reference_area.model import ReferenceAreaConfig
from landmark_nav.learning.relative_pose.epipolar import center, STATE
from landmark_nav.learning.relative_pose.scale import (
    contradiction,
    odd_source,
    PlaceSource,
    scale_sigma,
    ScaleShare,
    SheetSource,
)
from landmark_nav.learning.relative_pose.sheet_tracks import FINE, sheet_misses, sheet_tracks
from landmark_nav.learning.relative_pose.two_views import two_views_of, TwoViews
from landmark_nav.learning.sheets import find_sheets, SheetsConfig, SheetView
from landmark_nav.types import PlaceChain

CYLINDER = Cylinder.with_resolution(550.0, -0.4, 0.4)
A4 = SheetsConfig(paper_width_m=0.21, paper_height_m=0.297)


def with_sheet(texture, size, middle, slant_rad):
    """A grey panorama with an upright sheet at `middle` (3,), turned from facing the viewpoint."""
    facing = np.arctan2(-middle[1], -middle[0]) + slant_rad
    normal = np.array([np.cos(facing), np.sin(facing), 0.0])
    right = np.array([-normal[1], normal[0], 0.0])
    # Four samples a pixel, both ways, as edges lie between pixels; only around the sheet.
    fine, half = 4, 90
    first = int(CYLINDER.column_of(np.arctan2(middle[1], middle[0]))) - half
    column, row = np.meshgrid(
        first + (np.arange(2 * half * fine) + 0.5) / fine - 0.5,
        (np.arange(fine * CYLINDER.height) + 0.5) / fine - 0.5,
    )
    rays = CYLINDER.rays(np.stack([column, row], -1))
    with np.errstate(divide='ignore', invalid='ignore'):
        reach = (middle @ normal) / (rays @ normal)
    hit = reach[..., None] * rays - middle
    across, up = hit @ right / size[0] + 0.5, 0.5 - hit[..., 2] / size[1]
    on = (reach > 0.0) & (np.abs(across - 0.5) < 0.5) & (np.abs(up - 0.5) < 0.5)
    part = np.full((*on.shape, 3), 150, np.uint8)
    at = np.clip((up[on] * len(texture)).astype(int), 0, len(texture) - 1)
    part[on] = texture[at, np.clip((across[on] * texture.shape[1]).astype(int), 0, None)]
    small = cv2.resize(part, (2 * half, CYLINDER.height), interpolation=cv2.INTER_AREA)
    image = np.full((CYLINDER.height, CYLINDER.width, 3), 150, np.uint8)
    image[:, (first + np.arange(2 * half)) % CYLINDER.width] = small
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.7), np.uint8)


def check_seen(image, config, kind, name, middle):
    (seen,) = find_sheets(panorama_of(image, CYLINDER), config)
    assert (seen.kind, seen.name) == (kind, name)
    off = seen.position - middle
    assert np.linalg.norm(off) < 0.03
    assert off @ np.linalg.solve(seen.covariance, off) < 16.0


@pytest.mark.parametrize(('slant_rad', 'azimuth'), [(0.0, 0.4), (0.8, 3.13)])
def test_a_paper_is_found_where_it_hangs(slant_rad, azimuth):
    middle = np.array([2.6 * np.cos(azimuth), 2.6 * np.sin(azimuth), 0.35])
    paper = np.full((4, 4, 3), np.array(paper_bgr('green')), np.uint8)
    check_seen(with_sheet(paper, (0.21, 0.297), middle, slant_rad), A4, 'papers', 'green', middle)


def marker_sheet(number):
    """Print of a marker: 0.15 m of black, 0.2 m with the white all around."""
    if not hasattr(cv2.aruco, 'ArucoDetector'):
        pytest.skip('this OpenCV has no ArUco detector')
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    marker = cv2.aruco.generateImageMarker(dictionary, number, 600)
    sheet = cv2.cvtColor(cv2.copyMakeBorder(marker, *[100] * 4, 0, value=255), cv2.COLOR_GRAY2BGR)
    return np.asarray(sheet)


def marked(room, markers, pose, height_m, turns=(0,) * 5):
    """
    Panorama of a grey room with markers on its walls, seen from a pose (3,) at a height.

    They hang turned to the left by `turns` right angles.
    """
    images = []
    for marker, turn in zip(markers, turns, strict=False):
        seen = (np.array(marker.center) - [*pose[:2], height_m]) @ rot_z(pose[2])
        normal = room.normals[room.nearest_wall(np.array(marker.center[:2]))]
        turned = np.arctan2(normal[1], normal[0]) - pose[2] - np.arctan2(-seen[1], -seen[0])
        images.append(
            with_sheet(np.rot90(marker_sheet(marker.number), turn), (0.2, 0.2), seen, turned)
        )
    image = images[0]
    for other in images[1:]:
        image = np.where(other != 150, other, image)
    return CylinderImage(image, np.ones(image.shape[:2], bool), CYLINDER)


MARKERS = tuple(
    Marker(number, center, 0.15)
    for number, center in enumerate(
        [(1.5, 0.0, 1.3), (4.2, 0.0, 0.9), (6.0, 2.0, 1.2), (3.1, 5.0, 1.4), (0.0, 2.4, 1.0)]
    )
)


@pytest.mark.parametrize('count', [2, 5])
@pytest.mark.parametrize('pose', [(2.4, 2.1, 0.3), (3.5, 2.6, -2.9)])
def test_markers_of_the_room_file_give_the_pose(pose, count):
    room, mount = rectangle_room(6.0, 5.0), PanTiltMount(axis_xyz=(0.08, 0.02, 1.1))
    room = replace(room, markers=MARKERS[:count])
    axis = mount.axis_pose_map(pose)
    view = marked(room, room.markers, axis, 1.103)
    fit, names = fit_markers(view, 1.1, room, mount, ReferenceAreaConfig())
    assert len(names) == count
    off = np.array([*(fit.pose_map_base - pose)[:2], fit.mount[0] - 0.003, 0.0])
    off[3] = wrap_rad(fit.pose_map_base[2] - pose[2])
    assert np.abs(off[:2]).max() < 0.02
    assert off @ np.linalg.solve(fit.covariance, off) < 20.0
    assert fit.misfit < 3.0


def test_a_marker_at_another_place_is_noticed():
    room, mount = rectangle_room(6.0, 5.0), PanTiltMount()
    view = marked(room, MARKERS, (2.4, 2.1, 0.3), 1.1)
    moved = replace(MARKERS[2], center=(6.0, 2.1, 1.2))
    wrong = replace(room, markers=(*MARKERS[:2], moved, *MARKERS[3:]))
    fit, _ = fit_markers(view, 1.1, wrong, mount, ReferenceAreaConfig())
    assert max(fit.misfit / 6.0, np.abs(fit.hang_m).max() / 0.004) > 1.0


def test_a_number_that_is_there_twice_is_not_used():
    room = replace(rectangle_room(6.0, 5.0), markers=MARKERS[:2])
    twins = [*MARKERS[:2], replace(MARKERS[3], number=0)]
    view = marked(room, twins, (2.4, 2.1, 0.3), 1.1)
    with pytest.raises(LandmarkNavError, match='1 of the 2 markers'):
        fit_markers(view, 1.1, room, PanTiltMount(), ReferenceAreaConfig())


@pytest.mark.parametrize(
    ('turns', 'named'),
    [
        ([1, 0, 0, 0, 0], '0 by 90 deg to the left: '),
        ([0, 0, 2, 3, 0], '2 by 180.*3 by 90 .*right'),
    ],
)
def test_markers_that_hang_turned_are_named(turns, named):
    room = replace(rectangle_room(6.0, 5.0), markers=MARKERS)
    view = marked(room, MARKERS, (2.4, 2.1, 0.3), 1.1, turns)
    with pytest.raises(LandmarkNavError, match=f'marker {named}') as error:
        fit_markers(view, 1.1, room, PanTiltMount(), ReferenceAreaConfig())
    assert len(str(error.value)) < 200


@pytest.mark.skipif(not hasattr(cv2, 'aruco'), reason='this OpenCV has no dictionaries')
def test_numbers_of_a_dictionary_are_those_of_opencv():
    names = [name for name in dir(cv2.aruco) if name.startswith('DICT_')]
    known = 0
    for name in names:
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        with contextlib.suppress(LandmarkNavError):
            assert marker_count(name) == len(markers.bytesList)
            known += 1
    assert known >= 20


@pytest.mark.parametrize(('slant_rad', 'azimuth'), [(0.2, 0.4), (-0.7, 3.13)])
def test_a_marker_is_found_with_its_number(slant_rad, azimuth):
    middle = np.array([2.0 * np.cos(azimuth), 2.0 * np.sin(azimuth), -0.2])
    image = with_sheet(marker_sheet(7), (0.2, 0.2), middle, slant_rad)
    check_seen(image, SheetsConfig(marker_size_m=0.15), 'markers', '7', middle)


STATES = np.array([[0.08, 0, 0, 1.1, 0, 0], [1.77, 0.64, 0.5, 1.102, 0.004, -0.003]])
FOUR = np.vstack([STATES, [2.4, -0.9, -2.0, 1.1, 0.0, 0.0], [0.6, 1.4, 1.0, 1.1, 0.0, 0.0]])
NO_ERRORS = np.zeros((STATES.size, 1))
SHEETS = np.array([[2.0, -1.8, 1.6], [3.1, 1.2, 1.4], [0.6, 2.1, 1.7]])


def views(state, rng, size=1.0, names='abc'):
    """Views of SHEETS from a state, `size` times as large as they are given."""
    seen = []
    for name, sheet in zip(names, SHEETS, strict=True):
        tilt = np.array([*state[4:], 0.0])
        true = (sheet - center(state)) @ rot_z(state[2])
        true = true - np.cross(tilt, true)
        reach = np.linalg.norm(true)
        ray = true / reach
        across = 3e-4 * reach * (np.eye(3) - np.outer(ray, ray))
        root = across + 5e-3 * reach * np.outer(ray, ray)
        position = true / size + root @ rng.normal(size=3)
        shared = 0.002 * position[:, None]
        seen.append(SheetView('papers', name, position, root @ root.T, shared))
    return seen


def true_pose():
    way = center(STATES[1]) - center(STATES[0])
    slope = float(way[2] / np.hypot(way[0], way[1]))
    direction = float(np.arctan2(way[1], way[0]))
    return TwoViews(float(STATES[1, 2]), direction, STATES[1, 4:], slope, 100)


def papers(seed, size=1.0):
    rng = np.random.default_rng(seed)
    sheets = [views(state, rng, size) for state in STATES]
    tracks, _ = sheet_tracks(sheets, {(0, 1): true_pose()}, FINE)
    return SheetSource('papers', tracks)


def test_sheets_that_look_alike_are_distinguished_and_false_ones_left_out():
    rng = np.random.default_rng(1)
    sheets = [views(state, rng, names='aaa') for state in STATES]
    for seen in sheets:  # a poster of another size, which both show
        seen.append(replace(seen[0], position=0.7 * seen[0].position))
        seen.append(replace(seen[0], position=rng.normal(0.0, 2.0, 3)))
    tracks, lengths = sheet_tracks(sheets, {(0, 1): true_pose()}, FINE)
    assert len(tracks) == len(SHEETS)
    way = np.linalg.norm(center(STATES[1]) - center(STATES[0]))
    assert lengths[0, 1].length_m == pytest.approx(way, rel=0.01)


def test_a_pair_whose_sheets_contradict_each_other_is_refused_unless_another_shows_some():
    rng = np.random.default_rng(2)
    sheets = [views(state, rng)[:1] for state in (*STATES, *STATES)]
    for seen in sheets[:2]:
        seen.append(replace(seen[0], name='b', position=0.7 * seen[0].position))
    with pytest.raises(LandmarkNavError, match='check the size'):
        sheet_tracks(sheets[:2], {(0, 1): true_pose()}, FINE)
    found = {(0, 1): true_pose(), (2, 3): true_pose()}
    assert list(sheet_tracks(sheets, found, FINE)[1]) == [(2, 3)]


def test_false_sheets_of_one_pair_do_not_change_the_scale_of_all():
    rng = np.random.default_rng(5)
    sheets = [views(state, rng) for state in FOUR]
    for seen, state in zip(sheets[:2], FOUR, strict=False):
        seen[2:] = views(state, rng, size=0.45)  # posters that only two sweeps show
    found = {pair: two_views_of(FOUR, *pair) for pair in combinations(range(4), 2)}
    ways = {(i, j): float(np.hypot(*(FOUR[j] - FOUR[i])[:2])) for i, j in found}
    assert sheet_tracks(sheets, found, FINE)[1][0, 1].length_m > 1.5 * ways[0, 1]
    tracks, lengths = sheet_tracks(sheets, found, FINE, ways)
    share = SheetSource('papers', tracks).share(FOUR, np.zeros((FOUR.size, 1)))
    assert abs(share.scale - 1.0) < 3.0 * share.sigma < 0.05
    assert {pair: length.length_m for pair, length in lengths.items()} == pytest.approx(
        ways, rel=0.02
    )


def test_two_sizes_that_all_sweeps_show_alike_are_refused():
    found = {pair: two_views_of(FOUR, *pair) for pair in combinations(range(4), 2)}
    ways = {(i, j): float(np.hypot(*(FOUR[j] - FOUR[i])[:2])) for i, j in found}
    for seed in range(10):
        rng = np.random.default_rng(seed)
        sheets = [[*views(s, rng)[:2], *views(s, rng, 1.4, 'def')[:2]] for s in FOUR]
        with pytest.raises(LandmarkNavError, match='check the size'):
            sheet_tracks(sheets, found, FINE, ways)


def test_a_sheet_of_another_size_is_left_out_of_several():
    right, wrong = papers(1).tracks, papers(1, size=0.9).tracks
    kept = SheetSource('papers', [*right, wrong[0]]).agreeing(STATES)
    assert [id(track) for track in kept.tracks] == [id(track) for track in right]
    assert len(SheetSource('papers', [right[0], wrong[0]]).agreeing(STATES).tracks) == 2


def test_sheets_that_contradict_the_poses_are_less_certain():
    wrong = STATES.copy()
    wrong[1, 2] += 0.02
    source = papers(2)
    source.inflate(wrong)
    contradicted = source.share(wrong, NO_ERRORS)
    source.inflate(STATES)
    assert source.share(STATES, NO_ERRORS).inflation == 1.0 < contradicted.inflation
    # Shared errors of the poses are errors of the scale.
    turned = np.zeros((STATES.size, 1))
    turned[STATE + 2] = 0.01
    assert source.share(STATES, turned).sigma > source.share(STATES, NO_ERRORS).sigma


def test_the_scale_that_sheets_give_is_consistent():
    shares = [papers(seed).share(STATES, NO_ERRORS) for seed in range(60)]
    # The error of the size given is in sigma, but not in these.
    noise = np.sqrt(np.array([s.sigma for s in shares]) ** 2 - 0.002**2)
    normal = (np.array([s.scale for s in shares]) - 1.0) / noise
    assert 0.6 < np.mean(normal**2) < 1.6


def test_slopes_of_sheets_are_right():
    track = papers(3).tracks[0]
    off, slopes, _ = sheet_misses(STATES, track)
    step = 1e-6 * np.random.default_rng(4).normal(size=STATES.shape)
    ahead, back = (sheet_misses(STATES + sign * step, track)[0] for sign in (1.0, -1.0))
    expected = np.einsum('mvs,vs->m', slopes, step)
    assert np.linalg.norm(0.5 * (ahead - back) - expected) < 0.05 * np.linalg.norm(expected)
    assert len(off) == 3 * len(track.views)


ODD = {(1.0, 1.01, 1.4): 'c', (1.0, 1.4, 1.01): 'b', (1.0, 1.01, 1.02): '', (1.0, 1.3, 1.6): ''}


@pytest.mark.parametrize(('scales', 'odd'), [*ODD.items(), ((1.0, 1.4), '')])
def test_the_one_source_that_contradicts_several_is_known(scales, odd):
    assert odd_source([ScaleShare('abc'[k], s, 0.02) for k, s in enumerate(scales)]) == odd


def test_sources_that_disagree_are_named_with_their_sigmas(caplog):
    def odometry(sigma):
        return PlaceSource(PlaceChain(STATES[:, :3], sigma**2 * np.diag([0, 0, 0, 2, 2, 1.0])))

    right, large = papers(5), papers(5, size=1.1)
    agree = [s.share(STATES, NO_ERRORS) for s in (odometry(0.02), right)]
    assert scale_sigma(agree) < min(share.sigma for share in agree)
    uncertain = [s.share(STATES, NO_ERRORS) for s in (odometry(0.05), large)]
    assert scale_sigma(uncertain) > 0.05
    assert 'by odom the sweeps are' in caplog.text
    # Neither excludes the other, and either may be right.
    apart = [s.share(STATES, NO_ERRORS) for s in (odometry(0.1), large)]
    assert scale_sigma(apart) > abs(apart[0].scale - apart[1].scale) / 3.0
    with pytest.raises(LandmarkNavError, match=r'by odom .* than by papers \(\d'):
        scale_sigma([s.share(STATES, NO_ERRORS) for s in (odometry(0.02), large)])
    # No size is blamed where no sheet was measured.
    given = replace(apart[0], name='sweep/pose', scale=2.0 * apart[0].scale)
    assert 'size' not in contradiction(apart[0], given)


COARSE = Cylinder.with_resolution(200.0, -0.3, 0.3)
SHAPE = (COARSE.height, COARSE.width)


def hue_deg(color):
    blue, green, red = paper_bgr(color)
    return 360.0 * colorsys.rgb_to_hsv(red, green, blue)[0]


def color_of(name, saturation=200, value=190):
    hsv = np.array([[[round(hue_deg(name) / 2.0) % 180, saturation, value]]], np.uint8)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0, 0], dtype=np.float64)


def wall_with(rectangles):
    """Grey wall with rectangles of (colour, left, top, width, height), sub-pixel, wrapped."""
    image = np.full((*SHAPE, 3), 160.0)
    columns, rows = np.arange(SHAPE[1]), np.arange(SHAPE[0])
    for color, left, top, width, height in rectangles:
        # Share of each pixel that the rectangle covers.
        off = np.mod(columns - left + SHAPE[1] / 2.0, SHAPE[1]) - SHAPE[1] / 2.0
        across = np.clip(np.minimum(off + 0.5, width - off + 0.5), 0.0, 1.0)
        down = np.clip(np.minimum(rows - top + 0.5, top + height - rows + 0.5), 0.0, 1.0)
        share = (down[:, None] * across)[..., None]
        image = (1.0 - share) * image + share * color
    return image


def camera_image(image, noise=0.0):
    rng = np.random.default_rng(0)
    noisy = image + noise * rng.standard_normal(image.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def search_in(image, noise=0.0):
    return ColorSearch(CylinderImage(camera_image(image, noise), np.ones(SHAPE, bool), COARSE))


def azimuths(blobs):
    return np.asarray(blobs.edges[:, :2].mean(axis=1))


@pytest.mark.parametrize('light', [(1.0, 1.0, 1.0), (0.5, 0.75, 1.0), (0.25, 0.24, 0.2)], ids=str)
def test_each_colour_is_found_among_the_others_in_any_light(light):
    names = sorted(NAMED_HUES_DEG)
    left = 40.0 + 110.0 * np.arange(len(names))
    image = wall_with(
        [(color_of(n), x, 40.0, 20.0, 28.0) for n, x in zip(names, left, strict=True)]
    )
    search = search_in(image * np.array(light), noise=3.0)
    for color, x in zip(names, left, strict=True):
        blobs = search.blobs(color)
        azimuth = float(COARSE.azimuth_rad(x + 10.0))
        assert azimuths(blobs)[0] == pytest.approx(azimuth, abs=0.006), color
        np.testing.assert_allclose(
            blobs.edges[0, 2:], COARSE.tangent(np.array([68.0, 40.0])), atol=0.009
        )
        # Neighbours in hue are there too, and fit worse.
        assert (blobs.misfit[1:] > blobs.misfit[0] + 1.0).all()


@pytest.mark.parametrize(
    ('color', 'hue'),
    [('#ff8000', 30.1), ('hsv(210, 80%, 70%)', 210.0), (' Green ', NAMED_HUES_DEG['green'])],
)
def test_colours_by_name_and_number(color, hue):
    assert hue_deg(color) == pytest.approx(hue, abs=0.1)


@pytest.mark.parametrize(
    ('color', 'message'),
    [
        ('beige', "'beige' is not known: take one of red"),
        ('#12', 'is not known'),
        ('hsv(20, 10, 90)', 'too grey'),
        ('#0a0000', 'too dark'),
    ],
)
def test_what_is_no_colour_is_refused(color, message):
    with pytest.raises(LandmarkNavError, match=message):
        paper_bgr(color)


def edges_of(image, at, blur_px, guess, side):
    """Offsets outwards (2, n) from the true left (side 0) or top (1) edge, and their sigmas."""
    if blur_px:
        image = cv2.GaussianBlur(image, (0, 0), blur_px)
    jpeg = cv2.imencode('.jpg', camera_image(image, noise=1.0), [cv2.IMWRITE_JPEG_QUALITY, 90])[1]
    decoded = np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), dtype=np.uint8)
    along = 47.0 + np.arange(4 * PROFILES) if side == 0 else 208.0 + np.arange(4 * PROFILES)
    across = np.full(len(along), at + guess)
    points = np.stack([across, along] if side == 0 else [along, across], -1)
    outwards = np.tile([-1.0, 0.0] if side == 0 else [0.0, -1.0], (len(along), 1))
    found = locate_edges(decoded, points, outwards, hue_direction('red'), 7.0, 1.0)
    return found.offset_px - guess, found.sigma_px


@pytest.mark.parametrize('blur_px', [0.0, 0.5, 1.0])
@pytest.mark.parametrize('side', [0, 1], ids=['left', 'top'])
def test_edges_in_jpeg_with_halved_colours_are_unbiased(blur_px, side):
    """However sharp the image, wherever in its pixel the edge lies."""
    means = []
    for shift in np.arange(0.0, 2.0, 0.25):
        place = (200.0 + shift, 40.0) if side == 0 else (200.0, 40.0 + shift)
        image = wall_with([(color_of('red'), *place, 40.0, 40.0)])
        at = place[side]
        for guess in (-1.5, 0.4):
            offset, sigma = edges_of(image, at, blur_px, guess, side)
            assert np.isfinite(offset).all()
            assert (sigma < 0.25).all()
            means.append(offset.mean(axis=1))
    color, bright = np.array(means).T
    assert np.abs(bright).max() < 0.06
    assert abs(np.mean(bright)) < 0.02
    # Colours are halved: an edge between two of their pixels is drawn to one of them.
    assert np.abs(color).max() < 0.3
    assert abs(np.mean(color)) < 0.05
