"""Blur that makes images alike which resolve as much."""

from __future__ import annotations

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array, FloatArray

Pair = tuple[float, float] | FloatArray

# Bilinear interpolation of raw pixels pulls the optimum towards whole pixels; this blur of both
# images takes that below 0.01 px (Gaussian sigma, pixels).
MATCHED_PX = 0.8
# Blur that a pixel stands for, as a share of its width (Gaussian sigma).
_SHARE = 0.5
_LEAST_PX = 0.3


def for_matching(image: Float32Array) -> Float32Array:
    """Blur an image by what alignment to sub-pixel takes."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), MATCHED_PX), dtype=np.float32)


def blur_to(image: Float32Array, step: Pair, own_step: Pair = (1.0, 1.0)) -> Float32Array:
    """
    Blur an image that resolves `own_step` pixels to one that resolves `step`, across and down.

    Where `step` is not the wider one nothing is to do; without it, sampling wider would alias.
    """
    return blur_by(image, blur_sigmas(step, own_step))


def blur_by(image: Float32Array, sigmas: Pair) -> Float32Array:
    """
    Blur an image by Gaussian sigmas across and down, pixels; where both are 0, not at all.

    As distance and lens do it: they mix light, of which a camera's values are about the root
    (sRGB: the power 0.45). Values mixed by themselves would move outlines to their bright side.
    """
    across, down = sigmas
    if max(across, down) == 0.0:
        return image
    light = image * image
    blurred = cv2.GaussianBlur(light, (0, 0), sigmaX=max(across, 0.01), sigmaY=max(down, 0.01))
    return np.asarray(np.sqrt(blurred), dtype=np.float32)


def blur_sigmas(step: Pair, own_step: Pair = (1.0, 1.0)) -> tuple[float, float]:
    """Sigmas of the blur of `blur_to`, pixels; zero where it would do next to nothing."""
    share = _SHARE**2
    across = share * (float(step[0]) ** 2 - float(own_step[0]) ** 2)
    down = share * (float(step[1]) ** 2 - float(own_step[1]) ** 2)
    return sigmas_of(across, down)


def sigmas_of(across_px2: float, down_px2: float) -> tuple[float, float]:
    """Sigmas of a blur with these variances, if any; zero where it would do next to nothing."""
    across, down = max(across_px2, 0.0) ** 0.5, max(down_px2, 0.0) ** 0.5
    return (across, down) if max(across, down) >= _LEAST_PX else (0.0, 0.0)
