"""Poses of sweeps by papers, in any light and with any mount."""

from dataclasses import replace
import re

import numpy as np
from paper_sweeps import (
    CAMERA,
    CONFIG,
    CORNER,
    deviations,
    EAST,
    error_of,
    locate,
    MOUNT,
    scene_of,
    sweep_at,
)
import pytest
from scenes import Board, flat_texture, rectangle_room

from landmark_nav.geometry.walls import Paper
from landmark_nav.simulation.setup_documents import moved_paper

OFF_AXIS = replace(MOUNT, optical_center_offset=(0.07, 0.01, 0.03))
UPSIDE_DOWN = replace(MOUNT, axis_rpy=(np.pi, 0.0, 0.0))
# Papers, pose, mount, tilt of the joint.
PLACES = {
    'one wall': (EAST, (3.5, 2.0, 0.3), MOUNT, 0.0),
    'one wall, turned away': (EAST, (4.2, 3.2, -2.6), MOUNT, 0.0),
    'two walls': (CORNER, (3.5, 2.0, 0.3), MOUNT, 0.0),
    'papers across the seam of the panorama': (EAST, (3.6, 2.3, np.pi), MOUNT, 0.0),
    'tilted up, off the axis': (EAST, (3.4, 2.2, -0.6), OFF_AXIS, 0.15),
    'upside down': (EAST, (3.4, 2.2, -0.6), UPSIDE_DOWN, 0.0),
    'upside down, off the axis': (
        EAST,
        (3.4, 2.2, -0.6),
        replace(UPSIDE_DOWN, optical_center_offset=(0.05, 0.0, 0.04)),
        -0.1,
    ),
    'camera alone upside down': (
        EAST,
        (3.5, 2.0, 0.3),
        replace(MOUNT, camera_roll_rad=np.pi),
        0.0,
    ),
    'tilted, as given': (EAST, (3.4, 2.2, -0.6), replace(MOUNT, axis_rpy=(0.04, -0.05, 0.0)), 0.0),
}


@pytest.mark.parametrize('name', PLACES)
def test_the_place_is_recovered_without_noise(name):
    papers, pose, mount, tilt = PLACES[name]
    room = rectangle_room(papers=papers)
    sweep = sweep_at(scene_of(room), np.array(pose), mount=mount, tilt_rad=tilt, towards=papers)
    place = locate(sweep, room, mount)
    error = error_of(place, np.array(pose))
    assert np.hypot(error[0], error[1]) < 0.006
    assert abs(error[2]) < np.radians(0.12)
    assert deviations(place, pose).max() < 3.0
    pans = np.array([frame.pan_rad for frame in sweep.frames])
    height = mount.camera_pose_base(pans, tilt)[1][:, 2].mean()
    assert place.height_m == pytest.approx(height, abs=0.004)


def test_noise_and_papers_that_hang_askew_stay_within_the_covariance():
    rng = np.random.default_rng(4)
    room = rectangle_room(papers=CORNER)
    nees = []
    for _ in range(4):
        pose = np.array([*rng.uniform((2.8, 1.6), (4.2, 3.6)), rng.uniform(-np.pi, np.pi)])
        hung = tuple(
            moved_paper(p, room, rng.normal(0.0, CONFIG.paper_sigma_m, 2)) for p in CORNER
        )
        rise = float(rng.normal(0.0, CONFIG.height_sigma_m))
        sweep = sweep_at(
            scene_of(room, hung),
            pose,
            rng,
            rise_m=rise,
            towards=CORNER,
            pan_sigma_rad=MOUNT.pan_sigma_rad,
        )
        place = locate(sweep, room)
        height_error = place.height_m - MOUNT.axis_xyz[2] - rise
        error = np.insert(error_of(place, pose), 2, height_error)
        nees.append(float(error @ np.linalg.solve(place.covariance, error)))
        sigma = np.sqrt(np.diag(place.covariance))
        assert np.max(np.abs(error) / sigma) < 3.5
        assert sigma[:2].max() < 0.02
        assert sigma[3] < np.radians(0.3)
    assert 0.3 < np.mean(nees) / 4.0 < 2.0


@pytest.mark.parametrize(('scale', 'words'), [(1.0, ''), (1.03, 'larger'), (0.975, 'smaller')])
def test_a_room_that_is_scaled_with_its_papers_is_reported(scale, words):
    room, pose = rectangle_room(papers=EAST), np.array([3.5, 2.0, 0.3])
    sweep = sweep_at(scene_of(room), pose, np.random.default_rng(7))
    papers = tuple(
        replace(p, center=(scale * p.center[0], scale * p.center[1], p.center[2])) for p in EAST
    )
    given = rectangle_room(6.0 * scale, 5.0 * scale, papers)
    place = locate(sweep, given)
    if not words:
        assert not place.warning
        return
    share = re.search(rf'look (\S+) % {words} than given', place.warning)
    assert share is not None
    assert float(share[1]) == pytest.approx(100.0 * abs(scale - 1.0), abs=0.8)
    # The place is right in the room as it is given.
    assert np.hypot(*error_of(place, pose * [scale, scale, 1.0])[:2]) < 0.02


def test_a_shadow_beside_a_paper_does_not_move_the_place():
    room = rectangle_room(papers=EAST)
    scene = scene_of(room)
    shadows = tuple(
        Board(
            # A dark strip across the left edge, behind the paper.
            np.array([p.center[0] - 5e-6, p.center[1] + p.width / 2.0, p.center[2]]),
            np.array([-1.0, 0.0, 0.0]),
            0.06,
            p.height + 0.06,
            flat_texture((110.0, 110.0, 110.0)),
        )
        for p in EAST
    )
    pose = np.array([3.6, 2.2, 0.4])
    place = locate(sweep_at(replace(scene, boards=scene.boards + shadows), pose), room)
    error = error_of(place, pose)
    assert np.hypot(error[0], error[1]) < 0.01
    assert abs(error[2]) < np.radians(0.15)


def response(image, gamma):
    return np.asarray(255.0 * (image / 255.0) ** (1.0 / gamma))


def lit(image, *light):
    """Brighter on one side."""
    return np.asarray(image * np.linspace(0.8, 1.2, CAMERA.width)[None, :, None] * light)


@pytest.mark.parametrize(
    'change',
    [
        # What blurs edges blurs light; most cameras write its root: dark papers seem to shrink.
        lambda image: response(image, 1.0),
        lambda image: response(image, 1.8),
        # Dim, warm and cold.
        lambda image: lit(image, 0.35, 0.33, 0.3),
        lambda image: lit(image, 0.6, 0.85, 1.15),
    ],
    ids=['linear', 'gamma', 'dim', 'warm'],
)
def test_other_light_and_response_change_nothing(change):
    room = rectangle_room(papers=EAST)
    pose = np.array([3.4, 2.4, 0.2])
    sweep = sweep_at(scene_of(room), pose)
    images = [np.clip(np.rint(change(f.image)), 0, 255).astype(np.uint8) for f in sweep.frames]
    frames = tuple(replace(f, image=i) for f, i in zip(sweep.frames, images, strict=True))
    place = locate(replace(sweep, frames=frames), room)
    assert np.hypot(*error_of(place, pose)[:2]) < 0.012
    assert deviations(place, pose).max() < 3.0


def test_other_things_in_the_papers_colours_do_not_mislead():
    room = rectangle_room(papers=EAST)
    others = tuple(
        Paper(color, center, width, height)
        for color, center, width, height in (
            ('red', (0.0, 2.0, 1.2), 0.4, 0.3),
            ('red', (6.0, 1.9, 1.3), 0.21, 0.297),
            ('green', (6.0, 3.0, 1.2), 0.21, 0.297),
            ('green', (6.0, 4.4, 1.2), 0.15, 0.2),
            ('blue', (4.0, 5.0, 1.2), 0.3, 0.3),
            ('blue', (6.0, 0.7, 1.3), 0.21, 0.297),
        )
    )
    pose = np.array([3.2, 2.4, 1.0])
    sweep = sweep_at(scene_of(room, EAST + others), pose, np.random.default_rng(1))
    place = locate(sweep, room)
    assert np.hypot(*error_of(place, pose)[:2]) < 0.02
    assert deviations(place, pose).max() < 3.5


SIX = (
    *EAST,
    Paper('#d07010', (3.0, 5.0, 1.3), 0.21, 0.297),
    Paper('blue', (4.6, 5.0, 1.2), 0.297, 0.21),
    Paper('hsv(280, 60, 60)', (5.2, 0.0, 1.25), 0.3, 0.3),
)


def test_six_papers_on_three_walls_two_of_a_colour():
    room = rectangle_room(papers=SIX)
    pose = np.array([3.3, 2.6, 0.4])
    sweep = sweep_at(scene_of(room), pose, towards=SIX)
    place = locate(sweep, room)
    assert np.hypot(*error_of(place, pose)[:2]) < 0.006
    assert deviations(place, pose).max() < 3.0
    # One of six may be gone.
    fewer = sweep_at(scene_of(room, SIX[1:]), pose, towards=SIX)
    assert np.hypot(*error_of(locate(fewer, room), pose)[:2]) < 0.008
