"""What `landmark-nav bench` times of simulation and learning, and beside what."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import cv2
import numpy as np

from landmark_nav.cli.bench_world import Comparison, MOUNT, STEP_RAD, World
from landmark_nav.learning.attention import AttentionConfig, select_candidates
from landmark_nav.learning.calibration import calibrate_sweep, CalibrationConfig
from landmark_nav.learning.panorama import PanoramaConfig, synthesize_cylinder
from landmark_nav.learning.panorama.photometry import even_out, measure_photometry
from landmark_nav.learning.stereo import hypothesize, match_in, StereoConfig
from landmark_nav.learning.stereo.wall_patch import WallPatch
from landmark_nav.types import ImageArray

__all__ = ['learning_comparisons']

_COLUMNS, _ROWS = np.meshgrid(
    np.arange(512, dtype=np.float32) + np.float32(0.3), np.arange(512, dtype=np.float32)
)


def learning_comparisons(world: World) -> Iterator[Comparison]:
    """Renderer, panorama, attention and stereo."""
    yield _renderer(world)
    yield from _panorama(world)
    yield _attention(world)
    yield _stereo(world)


def _bare_remap(image: ImageArray) -> object:
    """All that resampling a picture takes at least."""
    return cv2.remap(image, _COLUMNS, _ROWS, cv2.INTER_LINEAR)


def _renderer(world: World) -> Comparison:
    pose = world.poses[0]
    image = world.frame(pose, 0.0).image
    return Comparison(
        'simulated picture, 512 x 512',
        lambda: [world.frame(pose, pan) for pan in 9.0 * STEP_RAD * np.arange(8)],
        'cv2.remap of as many pixels',
        lambda: [_bare_remap(image) for _ in range(8)],
        count=8,
    )


def _panorama(world: World) -> Iterator[Comparison]:
    sweep = world.sweeps[0]

    def bare() -> object:
        return [_bare_remap(frame.image) for frame in sweep.frames]

    reference = 'bare cv2.remap of the same frames'
    for blend in ('median', 'feather', 'mean'):
        yield Comparison(
            f'panorama of 72 frames, {blend}',
            partial(synthesize_cylinder, sweep, MOUNT, PanoramaConfig(blend=blend)),
            reference,
            bare,
        )
    yield Comparison(
        'exposures and vignetting evened out',
        lambda: even_out(sweep, measure_photometry(sweep, MOUNT)),
        reference,
        bare,
    )
    yield Comparison(
        'calibration out of a sweep',
        lambda: calibrate_sweep(sweep, MOUNT, CalibrationConfig()),
        reference,
        bare,
    )


def _attention(world: World) -> Comparison:
    panorama, grey = world.panoramas[0], world.greys[0].astype(np.uint8)
    return Comparison(
        'attention in a panorama',
        lambda: select_candidates(panorama, AttentionConfig()),
        'SIFT key points of the same panorama',
        lambda: cv2.SIFT.create().detect(grey),
    )


def _stereo(world: World) -> Comparison:
    config, room = StereoConfig(), world.scene.room
    here, there = world.greys
    found = [
        hypothesize(c, 0, world.panoramas[0], room, config) for c in world.learned.candidates[0]
    ]
    patches = [patch for patch in found if isinstance(patch, WallPatch)]
    height, width = here.shape

    def everywhere() -> None:
        for patch in patches:
            candidate = patch.candidate
            column = int(np.clip(candidate.column - candidate.width_px / 2, 0, width - 64))
            row = int(np.clip(candidate.row - candidate.height_px / 2, 0, height - 64))
            template = here[row : row + candidate.height_px, column : column + candidate.width_px]
            cv2.matchTemplate(there, template, cv2.TM_CCOEFF_NORMED)

    return Comparison(
        'stereo match of a candidate',
        lambda: [match_in(p, 1, world.panoramas, world.greys, room, config) for p in patches],
        'cv2.matchTemplate over the other panorama',
        everywhere,
        count=len(patches),
    )
