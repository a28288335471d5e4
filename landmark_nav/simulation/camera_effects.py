"""What lens and sensor do to a clean image: vignetting, exposure, blur, noise."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from landmark_nav.geometry.camera import CameraModel
from landmark_nav.parameters import Config
from landmark_nav.simulation.surfaces import light_of, values_of
from landmark_nav.types import ImageArray


@dataclass(frozen=True)
class CameraEffectsConfig(Config):
    """How good the camera is; brightness in grey levels of 255."""

    # Loss of light in the corners, share.
    vignetting: float = 0.25
    # Gain of the whole image.
    exposure: float = 1.0
    # How far the gain follows the mean brightness: 0 not at all, 1 all the way.
    auto_exposure: float = 0.5
    # Mean brightness that auto exposure aims at.
    target_brightness: float = 120.0
    # Point spread of lens and sensor, pixels.
    blur_sigma_px: float = 0.5
    # Standard deviation in the dark, grey levels.
    read_noise: float = 2.0
    # Growth of the variance with brightness, grey levels.
    shot_noise: float = 0.06


class CameraEffects:
    """
    Turns clean images into what a camera delivers.

    Parameters
    ----------
    rng : numpy.random.Generator
        Noise. It is cut out of one large field at random places, which is much quicker than
        drawing it anew and differs from frame to frame all the same.
    """

    def __init__(
        self, camera: CameraModel, config: CameraEffectsConfig, rng: np.random.Generator
    ) -> None:
        """Prepare the maps."""
        self._config = config
        self._rng = rng
        square = np.sum(camera.ray_grid.astype(np.float64) ** 2, -1)
        falloff = 1.0 - config.vignetting * square / square.max()
        self._vignette = np.repeat(falloff.astype(np.float32)[..., None], 3, axis=2)
        field = (2 * camera.height + 64, camera.width + 512, 3)
        self._noise = rng.standard_normal(field, dtype=np.float32)
        level = np.arange(256, dtype=np.float32)
        self._sigma = np.sqrt(config.read_noise**2 + config.shot_noise * level).astype(np.float32)

    def apply(self, image: ImageArray) -> ImageArray:
        """Image (height, width, 3), BGR, as the camera delivers it."""
        config = self._config
        if config.blur_sigma_px > 0.0:
            sigma = config.blur_sigma_px
            side = 2 * int(np.ceil(2.5 * sigma)) + 1
            image = values_of(
                np.asarray(cv2.GaussianBlur(light_of(image), (side, side), sigma), np.uint16)
            )
        mean = max(float(image[::8, ::8].mean()), 1.0)
        gain = config.exposure * (config.target_brightness / mean) ** config.auto_exposure
        clean = cv2.multiply(image, self._vignette, scale=gain, dtype=cv2.CV_32F)
        if config.read_noise == 0.0 and config.shot_noise == 0.0:
            return np.clip(np.rint(clean), 0, 255).astype(np.uint8)
        rows, columns = image.shape[:2]
        top = int(self._rng.integers(self._noise.shape[0] - rows + 1))
        left = int(self._rng.integers(self._noise.shape[1] - columns + 1))
        noise = self._noise[top : top + rows, left : left + columns]
        sigma_map = cv2.LUT(cv2.convertScaleAbs(clean), self._sigma)
        return np.asarray(
            cv2.add(clean, cv2.multiply(noise, sigma_map), dtype=cv2.CV_8U), dtype=np.uint8
        )
