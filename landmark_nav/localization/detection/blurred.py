"""Detection in images that are more, or less, blurred than those that were learned from."""

from __future__ import annotations

from statistics import median

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.detection.config import DetectionConfig
from landmark_nav.localization.detection.correlation import detect_landmarks, DetectionResult
from landmark_nav.types import CameraFrame, FloatArray, LandmarkMap, PoseEstimate

__all__ = ['detect_blurred']

# It takes so many landmarks to measure the blur.
_LEAST = 3
# An image is searched again, so often in all, if its blur is not the assumed one.
_LOOKS, _SAME_PX2 = 3, 0.7
# Limits of the blur.
_SHARPEST_PX2, _BLURRIEST_PX2 = -4.0, 25.0


def detect_blurred(
    frame: CameraFrame,
    prior: PoseEstimate,
    landmark_map: LandmarkMap,
    mount: PanTiltMount,
    config: DetectionConfig,
    indices: npt.NDArray[np.intp],
    blur_px2: FloatArray,
) -> tuple[DetectionResult, FloatArray]:
    """
    Find landmarks as `detect_landmarks` does, with the blur that is measured from those found.

    Parameters
    ----------
    frame, prior, landmark_map, mount, config, indices
        Those of `detect_landmarks`.
    blur_px2 : ndarray, shape (2,)
        Blur to begin with, such as that of the image before.

    Returns
    -------
    DetectionResult
    blur_px2 : ndarray, shape (2,)
        Blur that was found.

    """
    for _ in range(_LOOKS):
        result = detect_landmarks(frame, prior, landmark_map, mount, config, indices, blur_px2)
        if len(result.detections) < _LEAST:
            # They may be missed because the blur has gone.
            return result, 0.5 * blur_px2
        before = blur_px2
        found = [median(part) for part in result.blur_px2.T.tolist()]
        blur_px2 = np.clip(found, _SHARPEST_PX2, _BLURRIEST_PX2)
        if np.abs(blur_px2 - before).max() < _SAME_PX2:
            break
    return result, blur_px2
