"""`landmark-nav bench`: time of every stage and of a reference, measured in the same run."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, cycle
import platform
import time
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares

from landmark_nav.calibration import Calibration
from landmark_nav.cli.options import add, aligned, progress, within
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.learning.adjustment.problem import AdjustmentConfig
from landmark_nav.learning.adjustment.solution import adjust
from landmark_nav.learning.attention.maps import AttentionConfig
from landmark_nav.learning.attention.selection import attend
from landmark_nav.learning.calibration.sweep_calibration import calibrate_sweep
from landmark_nav.learning.capture.frames import look_at, relative_sharpness
from landmark_nav.learning.election import elect, ElectionConfig
from landmark_nav.learning.panorama.photometry import even_out, measure_photometry
from landmark_nav.learning.panorama.synthesis import synthesize_cylinder
from landmark_nav.learning.pipeline import learn_from_panoramas, LearningConfig
from landmark_nav.learning.reference_area.common_errors import joint_covariance
from landmark_nav.learning.reference_area.location import PaperSearch
from landmark_nav.learning.reference_area.model import ReferenceAreaConfig
from landmark_nav.learning.stereo import wall_patch
from landmark_nav.learning.stereo.wall_stereo import hypothesize, match_in
from landmark_nav.learning.sweep_pipeline import panorama_from_sweep
from landmark_nav.localization.detection.correlation import detect_landmarks
from landmark_nav.localization.detection.expectation import DetectionConfig, View
from landmark_nav.localization.fusion import Fusion
from landmark_nav.localization.localizer import LocalizationConfig, Localizer
from landmark_nav.localization.triangulation.robust import triangulate
from landmark_nav.localization.triplet.planning_scene import CameraState
from landmark_nav.localization.triplet.search import mean_variance, pair_tables
from landmark_nav.localization.triplet.selection import rank_triplets
from landmark_nav.localization.triplet.visibility import TripletConfig, visible_landmarks
from landmark_nav.planning.planner import forecast, plan_positions
from landmark_nav.planning.views import free_floor, PlanConfig
from landmark_nav.simulation.furnishing import generate_scene
from landmark_nav.simulation.renderer import Renderer
from landmark_nav.simulation.scene import sweep_places
from landmark_nav.storage.atomic_io import check_writable, write_json
from landmark_nav.types import (
    CameraFrame,
    Detections,
    FloatArray,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Sweep,
)

_LENS = (-0.12, 0.03, 0.0005, -0.0003, 0.0)
CAMERA = CameraModel(512, 512, 573.0, 573.0, 255.5, 255.5, 'plumb_bob', _LENS)
_MOUNT = PanTiltMount(axis_xyz=(0.08, 0.0, 1.1))
_STEP_RAD = np.radians(5.0)
_BEARING_SIGMA_RAD = 1e-3
_PIXELS = np.arange(512, dtype=np.float32)
_COLUMNS, _ROWS = np.meshgrid(_PIXELS + np.float32(0.3), _PIXELS)
_HEAD = ('stage', 'ms', '95 % ms', 'ref ms', 'ratio', 'reference')


@dataclass(frozen=True)
class _Comparison:
    """A stage and its reference; both process `count` items in a call."""

    # If the duration of a stage varies between calls, `calls` calls are timed separately.

    stage: str
    ours: Callable[[], object]
    reference_name: str
    reference: Callable[[], object]
    count: int = 1
    calls: int = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.description = (
        'Time every stage on simulated data, and beside it, in the same run and on '
        'the same data, a reference. The ratio of the two can be compared between machines.'
    )
    add(parser, '--json', help='write the times to F')
    add(parser, '--seed', default=0, help='of the simulated data')
    text = 'how often, of which the median is taken'
    add(parser, '--repeats', type=within(int, 1, 1000), default=7, metavar='N', help=text)


def run(args: argparse.Namespace) -> int:
    """Time all stages, print a table, and write it."""
    check_writable(args.json)
    cv2.setNumThreads(1)
    rows = [_timed(each, args.repeats) for each in progress(_comparisons(args.seed), 'timing')]
    cells = []
    for row in rows:
        times = [row[key] for key in ('seconds', 'p95_seconds', 'reference_seconds')]
        shown = ('' if seconds is None else f'{1e3 * seconds:.4g}' for seconds in times)
        cells.append([row['stage'], *shown, f'{row["ratio"]:.2f}', row['reference']])
    print('\n'.join(aligned(_HEAD, cells)))
    versions = {'python': platform.python_version(), 'numpy': np.__version__}
    versions |= {'machine': platform.machine(), 'opencv': cv2.__version__}
    write_json(args.json, {'schema': 1, **versions, 'stages': rows})
    return 0


def _timed(comparison: _Comparison, repeats: int) -> dict[str, Any]:
    """Time both in turn, so that other load affects both; discard the first of several runs."""
    works = (comparison.ours, comparison.reference)
    taken: tuple[list[float], list[float]] = ([], [])
    for repeat in range(repeats if repeats == 1 else repeats + 1):
        for work, seconds in zip(works, taken, strict=True):
            for _ in range(comparison.calls):
                start = time.perf_counter()
                work()
                seconds.append((time.perf_counter() - start) / comparison.count)
            if repeat == 0 and repeats > 1:
                seconds.clear()
    ours, reference = (float(np.median(seconds)) for seconds in taken)
    return {
        'stage': comparison.stage,
        'seconds': ours,
        # For stages whose duration varies between calls.
        'p95_seconds': float(np.percentile(taken[0], 95)) if comparison.calls > 1 else None,
        'reference': comparison.reference_name,
        'reference_seconds': reference,
        'ratio': ours / reference,
    }


def _estimate(pose: FloatArray, sigma_m: float) -> PoseEstimate:
    return PoseEstimate(0, pose, np.diag([sigma_m, sigma_m, 0.5 * sigma_m]) ** 2)


def _comparisons(seed: int) -> Iterator[_Comparison]:
    """Yield stages of simulation, learning, planning and localization in a room."""
    scene = generate_scene(seed)
    places = sweep_places(scene)
    renderer = Renderer(scene, CAMERA)

    def frame(pose: FloatArray, pan_rad: float) -> CameraFrame:
        rotation, center = _MOUNT.camera_pose_map(pose, pan_rad)
        return CameraFrame(0, renderer.render(rotation, center), CAMERA, pan_rad)

    sweeps = []
    for pose in places.poses:
        frames = tuple(frame(pose, pan) for pan in _STEP_RAD * np.arange(72))
        sweeps.append(Sweep(0, frames, _estimate(pose, 1e-3)))
    image = sweeps[0].frames[0].image
    yield _Comparison(
        'simulated image, 512 x 512',
        partial(frame, places.poses[0], 0.0),
        'cv2.remap of as many pixels',
        lambda: cv2.remap(image, _COLUMNS, _ROWS, cv2.INTER_LINEAR),
    )
    yield from _of_sweep(sweeps[0])
    room = scene.room
    config, view = ReferenceAreaConfig(), synthesize_cylinder(sweeps[0], _MOUNT)
    unplaced = replace(sweeps[0], pose_map_base=None)
    yield _Comparison(
        'place of a sweep by its papers',
        lambda: PaperSearch(unplaced, view, room, _MOUNT, config).located(),
        'its frames in HSV, a mask for each of three colours',
        lambda: [
            cv2.inRange(cv2.cvtColor(one.image, cv2.COLOR_BGR2HSV), (hue, 90, 40), (hue, 255, 255))
            for one in unplaced.frames
            for hue in (0, 60, 120)
        ],
    )
    panoramas = [panorama_from_sweep(s, room, _MOUNT) for s in sweeps]
    greys = [np.asarray(cv2.cvtColor(p.image, cv2.COLOR_BGR2GRAY), np.uint8) for p in panoramas]
    yield _Comparison(
        'attention in a panorama',
        lambda: attend(panoramas[0], AttentionConfig()),
        'SIFT key points of the same panorama',
        lambda: cv2.SIFT.create().detect(greys[0]),
    )
    learned = learn_from_panoramas(panoramas, room, LearningConfig())
    yield from _of_stereo(panoramas, learned.candidates, room)
    plan = PlanConfig(spacing_m=0.5, random_sets=10)
    floor = free_floor(room, plan.clearance_m, plan.spacing_m, 200)
    yield _Comparison(
        'plan of two places',
        lambda: plan_positions(room, _MOUNT, 2, plan, np.random.default_rng(0)),
        'forecast for two places that are given',
        lambda: forecast([places.poses], floor, room, _MOUNT, plan),
    )
    prior = _estimate(np.array([*places.poses[:, :2].mean(axis=0), 0.3]), 0.03)

    def expected(pan_rad: float) -> Any:
        view = CAMERA, _MOUNT, pan_rad, 0.0, TripletConfig()
        return visible_landmarks(prior, learned.map, *view)

    best = max(4.0 * _STEP_RAD * np.arange(18), key=lambda pan: len(expected(float(pan))))
    seen = frame(prior.pose, float(best))
    yield _triplet('choice of the triplet', learned.map, prior)
    for count in (40, 200, 1000):
        yield _triplet(f'triplet among {count}', _crowded(learned.map, count), prior)
    yield from _of_drive(learned.map, prior, seen, expected(seen.pan_rad))


def _of_sweep(sweep: Sweep) -> Iterator[_Comparison]:
    """Yield capture, panorama, photometry and calibration."""

    def judge() -> None:
        """Compare each image with the four previous ones, like capture."""
        looks = [look_at(frame.image, frame.camera) for frame in sweep.frames[:24]]
        for k, look in enumerate(looks):
            for n in range(max(0, k - 4), k):
                relative_sharpness(look, looks[n], (k - n) * _STEP_RAD)

    yield _Comparison(
        'judgement of an image in capture',
        judge,
        'cv2.Laplacian of the image alone',
        lambda: [cv2.Laplacian(frame.image, cv2.CV_32F) for frame in sweep.frames[:24]],
        count=24,
    )

    def remap() -> None:
        for frame in sweep.frames:
            cv2.remap(frame.image, _COLUMNS, _ROWS, cv2.INTER_LINEAR)

    reference, prior = 'bare cv2.remap of the same frames', Calibration.of_mount(_MOUNT)
    for stage, work in (
        ('panorama of 72 frames', lambda: synthesize_cylinder(sweep, _MOUNT)),
        ('exposures evened out', lambda: even_out(sweep, measure_photometry(sweep, _MOUNT))),
        ('calibration out of a sweep', lambda: calibrate_sweep(sweep, prior)),
    ):
        yield _Comparison(stage, work, reference, remap)


def _of_stereo(panoramas: list[Any], candidates: Any, room: Any) -> Iterator[_Comparison]:
    """Yield stereo, adjustment and election of the candidates."""
    config = wall_patch.StereoConfig()
    greys = [view.grey for view in panoramas]
    proposed = [
        [hypothesize(c, k, panoramas[k], room, config) for c in group]
        for k, group in enumerate(candidates)
    ]
    hypotheses = [[p for p in group if isinstance(p, wall_patch.WallPatch)] for group in proposed]
    small = greys[0][:40, :40]
    yield _Comparison(
        'stereo match of a candidate',
        lambda: [match_in(p, 1, panoramas, room, config) for p in hypotheses[0]],
        'cv2.matchTemplate over the other panorama',
        lambda: [cv2.matchTemplate(greys[1], small, cv2.TM_CCOEFF_NORMED) for _ in hypotheses[0]],
        count=len(hypotheses[0]),
    )
    patches: list[wall_patch.WallPatch] = []
    measurements: list[list[wall_patch.PatchMeasurement]] = []
    for k, group in enumerate(hypotheses):
        for patch in group:
            found = match_in(patch, 1 - k, panoramas, room, config)
            if isinstance(found, wall_patch.PatchMeasurement):
                patches.append(patch)
                measurements.append([wall_patch.own_measurement(patch, panoramas[k]), found])
    start = np.array([patch.position for patch in patches])
    covariance = joint_covariance(panoramas, room)
    walls = [patch.wall for patch in patches]
    places = panoramas, covariance, room, AdjustmentConfig()
    run = partial(adjust, measurements, walls, start, *places)
    adjustment = run()
    # Two rows for each measurement and one for each wall; three unknowns for each landmark and
    # four for each panorama.
    dense = np.random.default_rng(0).normal(size=(5 * len(patches), 3 * len(patches) + 8))
    yield _Comparison(
        'adjustment of landmarks and places',
        run,
        f'numpy.linalg.lstsq, dense, {dense.shape[0]} x {dense.shape[1]}, once',
        lambda: np.linalg.lstsq(dense, dense[:, 0], rcond=None),
    )
    grid, twice = (_COLUMNS[:30, :30], _ROWS[:30, :30]), range(2 * len(patches))
    after = adjustment, adjustment, panoramas, room, ElectionConfig()
    yield _Comparison(
        'election of a patch',
        lambda: elect(patches, measurements, *after),
        'two cv2.remap of 30 x 30 px',
        lambda: [cv2.remap(greys[0], *grid, cv2.INTER_LINEAR) for _ in twice],
        count=len(patches),
    )


def _triplet(name: str, landmark_map: LandmarkMap, prior: PoseEstimate) -> _Comparison:
    count = len(landmark_map.landmarks)
    few = np.array(list(combinations(range(min(count, 40)), 3)))
    tables = pair_tables(prior.pose[None, :2], landmark_map, np.arange(count), 4e-4)
    view = CAMERA, _MOUNT, TripletConfig(), CameraState(0.0)
    return _Comparison(
        name,
        lambda: rank_triplets(prior, landmark_map, *view),
        f'variances of {len(few)} triplets, all at once',
        lambda: mean_variance(tables, few),
    )


def _crowded(landmark_map: LandmarkMap, count: int) -> LandmarkMap:
    """Return `count` landmarks, within half a metre of those of a map."""
    rng, crowd = np.random.default_rng(count), []
    for k, one in zip(range(count), cycle(landmark_map.landmarks), strict=False):
        crowd.append(replace(one, id=k, position=one.position + rng.uniform(-0.5, 0.5, 3)))
    return LandmarkMap(tuple(crowd))


def _of_drive(
    learned: LandmarkMap, prior: PoseEstimate, seen: CameraFrame, expected: Any
) -> Iterator[_Comparison]:
    """Yield detection, triangulation, fusion, and a complete update."""
    # Images from bags and topics are decoded to grey.
    grey = np.asarray(cv2.cvtColor(seen.image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    patches = [cv2.resize(learned.landmarks[k].patch, (32, 32)) for k in expected]
    yield _Comparison(
        'detection of a landmark',
        lambda: detect_landmarks(View(seen, prior, _MOUNT), learned, DetectionConfig(), expected),
        'cv2.matchTemplate over the whole image',
        lambda: [cv2.matchTemplate(grey, patch, cv2.TM_CCOEFF_NORMED) for patch in patches],
        count=max(len(expected), 1),
    )
    positions = learned.positions[:, :2]
    # Bearings at the pan axis.
    bearings = se2.bearings(_MOUNT.axis_pose_map(prior.pose), positions)
    variances = np.full(len(positions), _BEARING_SIGMA_RAD**2)

    def residuals(pose: FloatArray) -> FloatArray:
        return wrap_rad(bearings[:8] - se2.bearings(pose, positions[:8])) / _BEARING_SIGMA_RAD

    yield _Comparison(
        'triangulation of 8 bearings',
        lambda: triangulate(positions[:8], bearings[:8], variances[:8]),
        'scipy.optimize.least_squares from near by',
        lambda: least_squares(residuals, se2.compose(prior.pose, [0.1, -0.1, 0.05])),
    )
    calibration = Calibration.of_mount(_MOUNT)
    samples = [OdometrySample(50_000_000 * k, np.array([0.0, 0.0, 1e-6 * k])) for k in range(21)]

    def fuse() -> None:
        """Fuse 20 odometry samples and 5 images of three landmarks."""
        fusion = Fusion(learned, calibration)
        fusion.add_odometry(samples[0])
        fusion.initialize(prior)
        for k, sample in enumerate(samples[1:], 1):
            fusion.add_odometry(sample)
            if k % 4 == 0:
                found = (learned.ids[:3], bearings[:3], variances[:3], np.ones(3))
                fusion.add_detections(Detections(sample.stamp_ns, *found, np.zeros((3, 2))))

    transition = np.eye(20) + 1e-3
    yield _Comparison(
        'fusion, a second of a drive',
        fuse,
        'covariances of an EKF with 20 states, 35 steps',
        lambda: [transition @ transition @ transition.T for _ in range(35)],
    )
    config = LocalizationConfig(detection=DetectionConfig(max_count=3))
    localizer = Localizer(learned, calibration, config)
    localizer.add_odometry(OdometrySample(0, np.zeros(3)))
    localizer.initialize(prior)
    stamps = iter(range(66_000_000, 10**15, 66_000_000))
    sift = cv2.SIFT.create()

    def update() -> None:
        stamp_ns = next(stamps)
        localizer.add_odometry(OdometrySample(stamp_ns, np.zeros(3)))
        localizer.add_frame(replace(seen, image=grey, stamp_ns=stamp_ns))

    # One second of a drive, in which the triplet is chosen twice.
    yield _Comparison(
        'one update, three patches',
        update,
        'SIFT of the image alone (OpenCV)',
        lambda: sift.detectAndCompute(grey, None),
        calls=15,
    )
