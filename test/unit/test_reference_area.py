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
from scenes import rectangle_room

from landmark_nav.geometry.walls import Paper
from landmark_nav.simulation.setup_documents import moved_paper


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
