"""
Detection: landmarks are re-mapped to the expected view and found in the image by correlation.

The plane of each patch and the expected pose give the template (Livatino and Madsen, section
2.1). It is rendered in the pixels of the raw image, with the lens distortion: the image is not
undistorted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import Float32Array
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.detection.appearance import draw
from landmark_nav.localization.detection.expectation import (
    DetectionConfig,
    expect,
    Expectation,
    HALF_PIXEL,
    quadratic,
    View,
)
from landmark_nav.localization.detection.rows import RowModel, RowResiduals
from landmark_nav.matching.alignment import blur_by, blur_sigmas, Match, match_template, sigmas_of
from landmark_nav.types import Detections, FloatArray, Landmark, LandmarkMap, Refusal

_SHARP = np.zeros(2)
# Blur mixes the surroundings into a patch, which shifts matches by this share of its sigma
# (measured: 0.03 to 0.04 in the study and in simulated rooms, at 1.5 and 3 pixels).
_BLURRED_IN = 0.04


@dataclass(frozen=True, eq=False)
class DetectionResult:
    """
    Landmarks found in an image, and by id why the others were not.

    `rays` (n, 3, 3) are at the landmarks found, and half a pixel right of and below each;
    `blur_px2` (n, 2) is the variance of the blur at each, relative to the images of the map.
    `heights` has all matches, with those refused for their height. `expected` is where each
    landmark was searched, by id.
    """

    detections: Detections
    refused: Mapping[int, Refusal]
    rays: FloatArray
    blur_px2: FloatArray
    heights: RowResiduals
    expected: Mapping[int, Expectation]


def detect_landmarks(
    view: View,
    landmark_map: LandmarkMap,
    config: DetectionConfig,
    indices: npt.NDArray[np.intp],
    blur_px2: FloatArray = _SHARP,
) -> DetectionResult:
    """
    Find landmarks in an image.

    Parameters
    ----------
    indices : ndarray of int, shape (n,)
        Landmarks of the map to search: those expected in this view.
    blur_px2 : ndarray, shape (2,)
        Variance of the image's blur relative to the images of the map, across and down; negative
        if the image is sharper.
    """
    refused: dict[int, Refusal] = {}
    expected: dict[int, Expectation] = {}
    looked: list[Landmark] = []
    for k, place in zip(indices, expect(landmark_map, indices, view, config), strict=True):
        landmark = landmark_map.landmarks[k]
        if (refusal := place.refusal(config.min_size_px)) is not None:
            refused[landmark.id] = refusal
        else:
            looked.append(landmark)
            expected[landmark.id] = place
    found: list[_Found] = []
    matches = _detect(looked, list(expected.values()), view, config, blur_px2)
    for landmark, match in zip(looked, matches, strict=True):
        if isinstance(match, Refusal):
            refused[landmark.id] = match
        else:
            found.append(match)
    covariance = np.array([f.match.covariance for f in found]).reshape(-1, 2, 2)
    covariance += np.diag(config.lens_sigma_px**2 + _BLURRED_IN**2 * np.maximum(blur_px2, 0.0))
    heights = _heights(found, covariance[:, 1, 1], landmark_map, view)
    wrong = heights.wrong(config.vertical_sigma_px / view.camera.fy)
    if wrong.any():
        refused |= {
            f.landmark.id: Refusal('wrong height', f'{f.down_px:+.1f} px off')
            for f in compress(found, wrong)
        }
        found, covariance = list(compress(found, ~wrong)), covariance[~wrong]
    uv = np.array([f.uv for f in found]).reshape(-1, 2)
    rays = view.camera.unproject(uv[:, None] + HALF_PIXEL)
    bearing, variance = _bearings([f.landmark for f in found], rays, covariance, view)
    return DetectionResult(
        Detections(
            view.stamp_ns,
            np.array([f.landmark.id for f in found], dtype=np.int64),
            bearing,
            variance,
            np.array([f.match.score for f in found], dtype=np.float64),
            uv,
            covariance_px2=covariance,
        ),
        refused,
        rays,
        blur_px2 + np.array([f.match.blur_px2 for f in found]).reshape(-1, 2),
        heights,
        expected,
    )


class _Found(NamedTuple):
    """A landmark, the pixel (2,) of its centre, its match, and the row minus the expected row."""

    landmark: Landmark
    uv: FloatArray
    match: Match
    down_px: float


def _detect(
    landmarks: Sequence[Landmark],
    expected: Sequence[Expectation],
    view: View,
    config: DetectionConfig,
    blur_px2: FloatArray,
) -> list[_Found | Refusal]:
    """Match the templates of landmarks."""
    if not landmarks:
        return []
    grid = view.camera.ray_grid
    drawings = draw(
        landmarks,
        view.center,
        [grid[place.top : place.bottom + 1, place.left : place.right + 1] for place in expected],
        np.array([place.ray_to_patch for place in expected]),
    )
    outcome: list[_Found | Refusal] = []
    for landmark, place, drawing in zip(landmarks, expected, drawings, strict=True):
        across, down = place.window
        x0, y0 = max(0, place.left - across), max(0, place.top - down)
        search = view.grey[y0 : place.bottom + down + 1, x0 : place.right + across + 1]
        # Of image and template, the sharper one is blurred to match the other.
        search_blur, template_blur = _blurs(drawing.finer, blur_px2)
        match = match_template(
            blur_by(search.astype(np.float32), search_blur),
            _inner(blur_by(drawing.image, template_blur), template_blur),
            min_score=landmark.threshold,
            max_second_ratio=config.max_second_ratio,
            search_blur=search_blur,
            edge=landmark.edge,
        )
        if isinstance(match, Refusal):
            outcome.append(match)
            continue
        middle = (place.left + place.right) / 2.0 - x0, (place.top + place.bottom) / 2.0 - y0
        shift = match.xy - middle
        outcome.append(_Found(landmark, place.uv + shift, match, float(shift[1])))
    return outcome


def _blurs(
    finer: tuple[float, float], blur_px2: FloatArray
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Sigmas of the blurs that make search image and template equally sharp."""
    across, down = (np.square(blur_sigmas(finer)) - blur_px2).tolist()
    return sigmas_of(across, down), sigmas_of(-across, -down)


def _inner(template: Float32Array, blur: tuple[float, float]) -> Float32Array:
    """Cut off the border of a template, where a blurred image mixes in the surroundings."""
    height, width = template.shape
    u, v = min(round(blur[0]), width // 5), min(round(blur[1]), height // 5)
    return template[v : height - v, u : width - u]


def _heights(
    found: Sequence[_Found], variance_px2: FloatArray, landmark_map: LandmarkMap, view: View
) -> RowResiduals:
    """Residuals of the rows of matches, which are measured with variances (n,)."""
    index = landmark_map.indices(np.array([f.landmark.id for f in found], dtype=np.int64))
    points = landmark_map.positions[index]
    rows = RowModel.of(
        points, view.prior.pose, view.rotation, view.center, view.camera, view.roll_rad
    )
    off_px = np.array([f.down_px for f in found])
    covariance = rows.covariance(
        view.prior.covariance, landmark_map.covariances[index], landmark_map.shared_loadings[index]
    )
    return RowResiduals(off_px, rows.by_tilt_roll, covariance + np.diag(variance_px2), points)


def _bearings(
    landmarks: Sequence[Landmark], rays: FloatArray, covariance: FloatArray, view: View
) -> tuple[FloatArray, FloatArray]:
    """Bearings (n,) at the pan axis in the base, and variances, by `rays` and pixel covariance."""
    if not landmarks:
        return np.empty(0), np.empty(0)
    directions = rays @ (view.rotation @ np.linalg.inv(view.shear)).T
    azimuth = np.arctan2(directions[..., 1], directions[..., 0])
    by_uv = 2.0 * wrap_rad(azimuth[:, 1:] - azimuth[:, :1])
    # The expected range transfers the bearing from the optical centre to the pan axis. Its error
    # matters little, as the two are close to each other.
    reach = np.hypot(*(np.array([k.position[:2] for k in landmarks]) - view.center[:2]).T)
    toward = np.array([np.cos(azimuth[:, 0]), np.sin(azimuth[:, 0])]).T
    at_axis = view.center[:2] + reach[:, None] * toward - view.axis
    bearing = wrap_rad(np.arctan2(at_axis[:, 1], at_axis[:, 0]) - view.prior.pose[2])
    return bearing, quadratic(by_uv, covariance)


# Fewest landmarks that measure the blur.
_LEAST = 3
# Most searches of an image; it is searched again if the blur differs from that assumed by more.
_LOOKS, _SAME_PX2 = 3, 0.7
# Limits of the blur's variance.
_SHARPEST_PX2, _BLURRIEST_PX2 = -4.0, 25.0


def detect_blurred(
    view: View,
    landmark_map: LandmarkMap,
    config: DetectionConfig,
    indices: npt.NDArray[np.intp],
    blur_px2: FloatArray,
) -> tuple[DetectionResult, FloatArray]:
    """
    Find landmarks as `detect_landmarks` does, with the blur estimated from those found.

    `blur_px2` (2,) is the initial value of the blur, such as that of the image before; the
    estimated blur is returned.
    """
    for _ in range(_LOOKS):
        result = detect_landmarks(view, landmark_map, config, indices, blur_px2)
        if len(result.detections) < _LEAST:
            # They may be missed because the image is sharp again.
            return result, 0.5 * blur_px2
        before = blur_px2
        found = np.median(result.blur_px2, axis=0)
        blur_px2 = np.clip(found, _SHARPEST_PX2, _BLURRIEST_PX2)
        if np.abs(blur_px2 - before).max() < _SAME_PX2:
            break
    return result, blur_px2
