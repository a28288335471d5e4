"""Pages from the results of a run: their data, as plain rounded values, and their files."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from datetime import datetime
from importlib.resources import files
import json
from pathlib import Path
from typing import Any, TypedDict

import cv2
from jinja2 import Environment
import numpy as np
import numpy.typing as npt

from landmark_nav.calibration import Calibration
from landmark_nav.errors import release, UsageError
from landmark_nav.evaluation.calibration_run import Residuals
from landmark_nav.evaluation.metrics import pose_errors
from landmark_nav.evaluation.replay import Replay
from landmark_nav.evaluation.report import tables
from landmark_nav.evaluation.run_report import errors_by_axis, path_of, Smoothed
from landmark_nav.geometry.walls import Marker, Paper
from landmark_nav.image_codec import encode_image
from landmark_nav.learning.pipeline import LearningResult
from landmark_nav.localization.localizer import LocalizationUpdate
from landmark_nav.storage.atomic_io import write_atomically
from landmark_nav.storage.bags import SensorEvent
from landmark_nav.types import CameraFrame, FloatArray, Landmark, LandmarkMap, Refusal

# Greatest size of all copies: 11 MB in base64, for a page of 15 MB with 4 MB of other data.
_BUDGET_BYTES = 8_000_000
_WIDTH_PX = 480
_COPY_QUALITY = 60


class FrameStrip:
    """
    Small JPEG copies of images, evenly thinned to `budget_bytes` for a drive of any length.

    `frames` holds all frames without their pixels, `jpegs` the kept copies; both by stamp in
    nanoseconds.
    """

    def __init__(self, budget_bytes: int = _BUDGET_BYTES) -> None:
        self.frames: dict[int, CameraFrame] = {}
        self.jpegs: dict[int, bytes] = {}
        self._budget, self._bytes, self._stride = budget_bytes, 0, 1

    def watch(self, events: Iterable[SensorEvent]) -> Iterator[SensorEvent]:
        """Yield the events unchanged, and keep copies of their images."""
        for event in events:
            if isinstance(event, CameraFrame):
                self.add(event)
            yield event

    def add(self, frame: CameraFrame) -> None:
        """Keep a copy of an image if its index is a multiple of the stride."""
        if len(self.frames) % self._stride == 0:
            self.jpegs[frame.stamp_ns] = copied = jpeg(frame.image, _WIDTH_PX, _COPY_QUALITY)
            self._bytes += len(copied)
        self.frames[frame.stamp_ns] = replace(frame, image=np.empty((0, 0), np.uint8))
        while self._bytes > self._budget and len(self.jpegs) > 1:
            self.jpegs = dict(list(self.jpegs.items())[::2])
            self._stride *= 2
            self._bytes = sum(map(len, self.jpegs.values()))


def jpeg(image: np.ndarray, most_px: int, quality: int) -> bytes:
    """Encode an image, grey or BGR, reduced to a width of at most `most_px`."""
    scale = min(1.0, most_px / image.shape[1])
    if scale < 1.0:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return encode_image(image, '.jpg', (cv2.IMWRITE_JPEG_QUALITY, quality)).tobytes()


# Greatest number of images that are shown; more are thinned.
_MOST_MOMENTS = 2000
# Greatest number of points of a line of the plan.
_MOST_POINTS = 2000
_PATCH_PX, _PANORAMA_PX, _QUALITY = 96, 2400, 75
# Quantile of the residuals that the axes show; least weight of residuals, without outliers.
_REACH, _LEAST_WEIGHT = 0.99, 0.1


class Page(TypedDict):
    """A page: its verdict, tables, and the data that its script draws."""

    verdict: dict[str, str]
    tables: list[dict[str, Any]]
    charts_title: str
    data: dict[str, Any]


def drive_page(
    report: Mapping[str, Any],
    run: Replay,
    landmarks: LandmarkMap,
    calibration: Calibration,
    strip: FrameStrip,
    smoothed: Smoothed | None = None,
    papers: Iterable[Paper | Marker] = (),
) -> Page:
    """
    Page of a drive: `report` is that of `run_report`, with ``spells``.

    Landmarks are projected into the images by `calibration`.
    """
    # Images by time, thinned, with all changes of the state.
    order = np.argsort(run.stamps_ns, kind='stable')
    status = np.array([run.updates[k].status for k in order])
    shown = np.arange(len(order)) % -(-len(order) // _MOST_MOMENTS) == 0
    shown[1:] |= status[1:] != status[:-1]
    chosen = np.asarray(order[shown])
    found = Counter(int(k) for u in run.updates for k in u.observation.detections.ids)
    missed = (u.observation.detections.missed for u in run.updates)
    expected = found + Counter(int(k) for ids in missed for k in ids)
    data = {
        'map': _map(landmarks, papers, found, expected),
        'run': _drive(run, chosen, landmarks, calibration, strip, smoothed),
        'images': [_base64(copied) for _, copied in sorted(strip.jpegs.items())],
        'charts': _charts(run, chosen),
    }
    title = 'Errors over time' if len(run.truth) else 'Claimed errors over time'
    return _page(tables.drive_verdict(report), tables.drive_tables(report), data, title)


def _page(
    verdict: dict[str, str], rows: list[dict[str, Any]], data: dict[str, Any], title: str = ''
) -> Page:
    return {'verdict': verdict, 'tables': rows, 'charts_title': title, 'data': data}


def learning_page(
    report: Mapping[str, Any], result: LearningResult, papers: Iterable[Paper | Marker] = ()
) -> Page:
    """Page of a learned map; `report` is that of `learning_report`."""
    verdict = tables.learning_verdict(report, result.warning)
    data = {'map': _map(result.map, papers), 'panoramas': panoramas(result)}
    return _page(verdict, tables.learning_tables(report), data)


def calibration_page(
    report: Mapping[str, Any], residuals: tuple[Residuals, Residuals] | None
) -> Page:
    """Page of a calibration; `residuals` are those of the last drive before and after."""
    verdict, rows = tables.calibration_verdict(report), tables.calibration_tables(report)
    data = {'charts': _residual_charts(*residuals) if residuals else []}
    return _page(verdict, rows, data, 'Landmarks in images, measured minus predicted')


def _numbers(values: npt.ArrayLike, digits: int) -> Any:
    """Round to nested lists; values that are not finite are None."""
    array = np.asarray(values, dtype=np.float64)
    known = np.isfinite(array)
    rounded = np.round(np.where(known, array, 0.0), digits)
    plain = rounded.astype(object)
    plain[~known] = None
    return plain.tolist()


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode('ascii')


def _ellipse(covariance: FloatArray) -> Any:
    """Variances and covariance [mm^2] of x and y, (..., 3), of covariances (..., m, m)."""
    parts = [covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]]
    return _numbers(1e6 * np.stack(parts, -1), 4)


def _map(
    landmarks: LandmarkMap,
    papers: Iterable[Paper | Marker],
    found: Mapping[int, int] | None = None,
    expected: Mapping[int, int] | None = None,
) -> dict[str, Any]:
    """Walls, papers, landmarks and sweeps; `found` and `expected` count images by landmark."""
    return {
        'walls': [{'id': w.id, 'ends': _numbers([w.start, w.end], 4)} for w in landmarks.walls],
        'papers': [
            {'rgb': [round(c) for c in p.bgr[::-1]], 'at': _numbers(p.center[:2], 4)}
            for p in papers
        ],
        'landmarks': [
            {
                'id': k.id,
                'at': _numbers(k.position, 4),
                'normal': _numbers(k.normal[:2], 4),
                'size': _numbers([k.width_m, k.height_m], 3),
                'ellipse': _ellipse(k.covariance),
                'sigma_mm': _numbers(1e3 * np.sqrt(np.diag(k.covariance)), 2),
                'threshold': round(float(k.threshold), 3),
                'wall': k.wall_id,
                'patch': _base64(jpeg(k.patch, _PATCH_PX, _QUALITY)) if k.patch.size else '',
                'found': None if found is None else found.get(k.id, 0),
                'expected': None if expected is None else expected.get(k.id, 0),
            }
            for k in landmarks.landmarks
        ],
        'sweeps': [
            {'pose': _numbers(p.pose, 4), 'ellipse': _ellipse(p.covariance)}
            for p in landmarks.panorama_poses
        ],
    }


def _drive(
    run: Replay,
    chosen: npt.NDArray[np.intp],
    landmarks: LandmarkMap,
    calibration: Calibration,
    strip: FrameStrip,
    smoothed: Smoothed | None,
) -> dict[str, Any]:
    """Data of the player, one entry for each chosen update."""
    updates = [run.updates[k] for k in chosen]
    stamps = run.stamps_ns[chosen]
    mount = calibration.mount
    frames = [strip.frames.get(int(stamp)) for stamp in stamps]
    azimuths = [
        np.nan if frame is None else float(mount.azimuth_base_rad(frame.pan_rad))
        for frame in frames
    ]
    camera = next((frame.camera for frame in frames if frame is not None), None)
    # Index of the last copy before each update.
    kept = np.array(sorted(strip.jpegs), dtype=np.int64)
    image = np.searchsorted(kept, stamps, 'right') - 1
    levels = [(np.nan, np.nan) if u.level is None else tuple(u.level) for u in updates]
    reasons = [update.reason for update in updates]
    known = list(dict.fromkeys(reasons))
    lines = {'odometry': run.odometry.poses[:, :2], 'truth': run.truth.poses[:, :2]}
    if smoothed is not None:
        lines['smoothed'] = path_of(run, smoothed.stamps_ns, smoothed.poses).T
    lines['fused'] = path_of(run, run.stamps_ns, run.fused).T
    return {
        't': _numbers(1e-9 * (stamps - run.begin_ns), 3),
        'pose': _numbers(run.fused[chosen], 4),
        'ellipse': _ellipse(run.fused_covariances[chosen]),
        'heading_sigma': _numbers(np.sqrt(run.fused_covariances[chosen, 2, 2]), 5),
        'level': _numbers(levels, 4),
        'truth': _numbers(run.truth.at(stamps), 4),
        'fix': _numbers(run.fixes[chosen, :2], 4),
        'status': [update.status for update in updates],
        'reason': [known.index(reason) for reason in reasons],
        'reasons': known,
        'camera': _numbers(azimuths, 4),
        'half_view': None if camera is None else round(camera.half_fov_rad, 4),
        'image_size': None if camera is None else [camera.width, camera.height],
        'image': image.tolist(),
        'image_moment': np.searchsorted(stamps, kept).clip(0, len(stamps) - 1).tolist(),
        'axis': _numbers(mount.axis_xyz[:2], 4),
        'seen': [
            _seen(update, frame, landmarks, calibration)
            for update, frame in zip(updates, frames, strict=True)
        ],
        'lines': {
            name: _numbers(line[:: -(-len(line) // _MOST_POINTS) or 1], 3)
            for name, line in lines.items()
        },
    }


def _seen(
    update: LocalizationUpdate,
    frame: CameraFrame | None,
    landmarks: LandmarkMap,
    calibration: Calibration,
) -> list[dict[str, Any]]:
    """Landmarks of one image: found and used, found and not used, or not found."""
    # `outline` are the corners of the patch as predicted by the fused pose, pixels.
    observation, found = update.observation, update.observation.detections
    # Landmarks that corrected the pose: a recording of the nodes contains the detections only.
    used, why = set(found.ids.tolist()), ''
    if isinstance(update.taken, Refusal):
        used, why = set(), str(update.taken)
    elif update.taken is not None:
        used, why = set(landmarks.ids[update.taken.used].tolist()), 'outlier'
    reasons = {**dict.fromkeys(found.missed.tolist(), 'not found'), **observation.refused}
    entries = [
        {
            'id': int(k),
            'bearing': round(float(bearing), 4),
            'score': round(float(score), 3),
            'uv': _numbers(uv, 1),
            'used': k in used,
            'reason': '' if k in used else why,
        }
        for k, bearing, score, uv in zip(
            found.ids.tolist(), found.bearing_rad, found.score, found.uv_px, strict=True
        )
    ]
    listed = {entry['id'] for entry in entries}
    entries += [{'id': int(k), 'reason': str(r)} for k, r in reasons.items() if k not in listed]
    if frame is None or not entries:
        return entries
    mapped = set(landmarks.ids.tolist())
    inside = [entry for entry in entries if entry['id'] in mapped]
    corners = landmarks.corners[landmarks.indices(np.array([e['id'] for e in inside], np.int64))]
    rotation, center = calibration.mount.camera_pose_map(
        update.fused.pose, frame.pan_rad, frame.tilt_rad, frame.roll_rad
    )
    pixels = calibration.camera(frame.camera).project((corners - center) @ rotation)
    for entry, outline in zip(inside, pixels, strict=True):
        if np.isfinite(outline).all() and frame.camera.contains(outline).any():
            entry['outline'] = _numbers(outline, 1)
    return entries


def _charts(run: Replay, chosen: npt.NDArray[np.intp]) -> list[dict[str, Any]]:
    """Errors ahead, to the left and in heading, +-3 sigma and protection levels."""
    # Without ground truth, triangulated poses are compared with the fused ones.
    known = len(run.truth) > 0
    off = run.errors.triangulation if known else pose_errors(run.fixes, run.fused)
    levels = np.array([(np.nan,) * 2 if u.level is None else tuple(u.level) for u in run.updates])
    seconds = _numbers(1e-9 * (run.stamps_ns[chosen] - run.begin_ns), 3)
    charts = []
    for k, one in enumerate(errors_by_axis(run, off)):
        series = [
            ('±3 sigma', 'band', 'fused', one.band),
            ('protection level', 'level', 'level', one.factor * levels[:, max(k - 1, 0)]),
            ('triangulated' if known else 'triangulated minus fused', 'dots', 'fix',
             one.fixes),
            ('fused', 'line', 'fused', one.fused),
        ]  # fmt: skip
        shown = [
            {'name': name, 'kind': kind, 'color': color, 'y': _numbers(y[chosen], 4)}
            for name, kind, color, y in series
            if np.isfinite(y).any()
        ]
        limit = round(one.limit, 4)
        charts.append({'label': one.label, 'limit': limit, 't': seconds, 'series': shown})
    return charts


def _residual_charts(before: Residuals, after: Residuals) -> list[dict[str, Any]]:
    charts = []
    for k, where in enumerate(('to the right', 'down')):
        every = np.concatenate([before.points_px[:, k], after.points_px[:, k], [1.0]])
        series = []
        for found, color, name in ((before, 'odometry', 'before'), (after, 'fused', 'after')):
            kept = found.weights > _LEAST_WEIGHT
            t, y = _numbers(found.seconds[kept], 3), _numbers(found.points_px[kept, k], 2)
            series.append({'name': name, 'kind': 'dots', 'color': color, 't': t, 'y': y})
        limit = 1.2 * float(np.quantile(np.abs(every), _REACH))
        rms = f'RMS {before.rms_px[k]:.2f} before, {after.rms_px[k]:.2f} after'
        label = f'residual {where} [px], {rms}'
        charts.append({'label': label, 'limit': limit, 't': [], 'series': series})
    return charts


def panoramas(result: LearningResult) -> list[dict[str, Any]]:
    """Panoramas with the outcome of every candidate, in pixels of the panorama."""
    shown = []
    for view, candidates, outcomes in zip(
        result.panoramas, result.candidates, result.outcomes, strict=True
    ):
        rows, columns = view.image.shape[:2]
        shown.append(
            {
                'image': _base64(jpeg(view.image, _PANORAMA_PX, _QUALITY)),
                'size': [columns, rows],
                'elected': sum(isinstance(outcome, Landmark) for outcome in outcomes),
                'candidates': [
                    {
                        'at': _numbers([c.column, c.row, c.width_px, c.height_px], 1),
                        'saliency': round(c.saliency, 3),
                        'id': outcome.id if isinstance(outcome, Landmark) else None,
                        'reason': '' if isinstance(outcome, Landmark) else str(outcome),
                    }
                    for c, outcome in zip(candidates, outcomes, strict=True)
                ],
            }
        )
    return shown


def check_report(path: Path | None) -> None:
    """Refuse a file name that browsers do not open as a page."""
    if path and path.suffix.lower() not in ('.html', '.htm'):
        raise UsageError(f'--report {path}: reports are written as .html')


def write_report(
    path: Path, page: Page, title: str, command: str, inputs: Mapping[str, object]
) -> None:
    """
    Write a page with its title, the command, and the inputs of the command by name.

    Raises `LandmarkNavError`: the file cannot be written.
    """
    write_atomically(path, page_html(page, title, command, inputs))


def page_html(page: Page, title: str, command: str, inputs: Mapping[str, object]) -> str:
    """Return the page; all inserted values are escaped."""
    now = datetime.now().astimezone().strftime('%Y-%m-%d %H:%M %z')
    # Only a `<` in the data could end the script element.
    data = json.dumps(page['data'], separators=(',', ':'), allow_nan=False)
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(_resource('page.html.j2')).render(
        page=page,
        title=title,
        command=command,
        inputs={name: str(value) for name, value in inputs.items() if value is not None},
        data=data.replace('<', '\\u003c'),
        css=_resource('page.css'),
        js=_resource('page.js'),
        made={'date': now, 'landmark_nav': release()},
    )


def _resource(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding='utf-8')
