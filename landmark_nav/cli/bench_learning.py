"""What `landmark-nav bench` times of simulation, learning and planning, and beside what."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from landmark_nav.cli.bench_world import Comparison, MOUNT, STEP_RAD, World
from landmark_nav.learning.adjustment import adjust, AdjustmentConfig
from landmark_nav.learning.attention import attend, AttentionConfig
from landmark_nav.learning.calibration import calibrate_sweep, CalibrationConfig
from landmark_nav.learning.capture.frames import look_at, relative_sharpness
from landmark_nav.learning.election import elect, ElectionConfig
from landmark_nav.learning.panorama import PanoramaConfig, synthesize_cylinder
from landmark_nav.learning.panorama.photometry import even_out, measure_photometry
from landmark_nav.learning.reference_area import (
    joint_covariance,
    locate_sweep,
    ReferenceAreaConfig,
)
from landmark_nav.learning.stereo import hypothesize, match_in, StereoConfig
from landmark_nav.learning.stereo.wall_patch import own_measurement, PatchMeasurement, WallPatch
from landmark_nav.planning.config import PlanConfig
from landmark_nav.planning.planner import forecast, plan_positions
from landmark_nav.planning.views import free_floor
from landmark_nav.types import ImageArray

_COLUMNS, _ROWS = np.meshgrid(
    np.arange(512, dtype=np.float32) + np.float32(0.3), np.arange(512, dtype=np.float32)
)


def learning_comparisons(world: World) -> Iterator[Comparison]:
    """Renderer, capture, panorama, reference area, attention, stereo to election, planner."""
    yield _renderer(world)
    yield _capture(world)
    yield from _panorama(world)
    yield _reference_area(world)
    yield _attention(world)
    yield _stereo(world)
    yield from _adjustment_and_election(world)
    yield _planner(world)


def _bare_remap(image: ImageArray) -> object:
    """All that resampling an image takes at least."""
    return cv2.remap(image, _COLUMNS, _ROWS, cv2.INTER_LINEAR)


def _renderer(world: World) -> Comparison:
    pose = world.poses[0]
    image = world.frame(pose, 0.0).image
    return Comparison(
        'simulated image, 512 x 512',
        lambda: [world.frame(pose, pan) for pan in 9.0 * STEP_RAD * np.arange(8)],
        'cv2.remap of as many pixels',
        lambda: [_bare_remap(image) for _ in range(8)],
        count=8,
    )


def _capture(world: World) -> Comparison:
    """Each image beside the four before it, as capture judges it."""
    frames = world.sweeps[0].frames[:24]

    def judge() -> None:
        looks = [look_at(frame.image, frame.camera) for frame in frames]
        for k, frame in enumerate(frames):
            for n in range(max(0, k - 4), k):
                relative_sharpness(looks[k], looks[n], frame.pan_rad - frames[n].pan_rad)

    def focus() -> None:
        for frame in frames:
            grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
            cv2.meanStdDev(cv2.Laplacian(grey, cv2.CV_32F))

    return Comparison(
        'judgement of an image in capture',
        judge,
        'variance of cv2.Laplacian of the image alone',
        focus,
        count=len(frames),
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


def _reference_area(world: World) -> Comparison:
    sweep, config = replace(world.sweeps[0], pose_map_base=None), ReferenceAreaConfig()
    view = synthesize_cylinder(sweep, MOUNT, PanoramaConfig())

    def components() -> None:
        for frame in sweep.frames:
            hsv = cv2.cvtColor(frame.image, cv2.COLOR_BGR2HSV)
            for hue in (0, 60, 120):
                mask = cv2.inRange(hsv, (max(hue - 10, 0), 90, 40), (hue + 10, 255, 255))
                cv2.connectedComponentsWithStats(mask)

    return Comparison(
        'place of a sweep by its papers',
        lambda: locate_sweep(sweep, view, world.scene.room, MOUNT, config),
        'coloured blobs of its frames, without edges and place',
        components,
    )


def _attention(world: World) -> Comparison:
    panorama, grey = world.panoramas[0], world.greys[0].astype(np.uint8)
    return Comparison(
        'attention in a panorama',
        lambda: attend(panorama, AttentionConfig()),
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


def _adjustment_and_election(world: World) -> Iterator[Comparison]:
    config, room = StereoConfig(), world.scene.room
    panoramas, greys = world.panoramas, world.greys
    patches: list[WallPatch] = []
    measurements: list[list[PatchMeasurement]] = []
    for k, candidates in enumerate(world.learned.candidates):
        for candidate in candidates:
            patch = hypothesize(candidate, k, panoramas[k], room, config)
            if isinstance(patch, WallPatch):
                seen = match_in(patch, 1 - k, panoramas, greys, room, config)
                if isinstance(seen, PatchMeasurement):
                    patches.append(patch)
                    measurements.append([own_measurement(patch, panoramas[k]), seen])
    walls = [patch.wall for patch in patches]
    start = np.array([patch.position for patch in patches])
    places = joint_covariance(panoramas, room, ReferenceAreaConfig())
    run = partial(adjust, measurements, walls, start, panoramas, places, room, AdjustmentConfig())
    adjustment = run()
    # Two numbers a measurement and one a wall; three unknowns a landmark and four a panorama.
    rng = np.random.default_rng(0)
    dense = rng.normal(size=(5 * len(patches), 3 * len(patches) + 8))
    yield Comparison(
        'adjustment of landmarks and places',
        run,
        f'numpy.linalg.lstsq, dense, {dense.shape[0]} x {dense.shape[1]}, once',
        lambda: np.linalg.lstsq(dense, dense[:, 0], rcond=None),
    )
    across, down = _COLUMNS[:30, :30], _ROWS[:30, :30]
    yield Comparison(
        'election of a patch',
        lambda: elect(
            patches, measurements, adjustment, adjustment, panoramas, greys, room, ElectionConfig()
        ),
        'two cv2.remap of 30 x 30 px',
        lambda: [
            cv2.remap(greys[0], across, down, cv2.INTER_LINEAR) for _ in range(2 * len(walls))
        ],
        count=len(patches),
    )


def _planner(world: World) -> Comparison:
    room, config = world.scene.room, PlanConfig(spacing_m=0.5, random_sets=10)
    floor = free_floor(room, config.clearance_m, config.spacing_m, 200)
    return Comparison(
        'plan of two places',
        lambda: plan_positions(room, MOUNT, 2, config, np.random.default_rng(0)),
        'forecast for two places that are given',
        lambda: forecast([world.poses], floor, room, MOUNT, config),
    )
