"""
Edges of papers in images, to sub-pixel: where colour and brightness change across them.

Both are measured. Brightness has every pixel of its own even in a JPEG, but what lies beside a
paper is often its own shadow, which moves the edge outwards; colour is not deceived by shadows,
but halved in a JPEG, and may lie half a pixel beside.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.types import FloatArray, ImageArray

__all__ = ['PROFILES', 'EdgeSamples', 'locate_edges']

# Profiles that are averaged for one measurement of an edge.
PROFILES = 5

_STEP_PX = 0.25
# Half width of the part of a profile that holds the whole change, and of the levels beside it.
_CHANGE_PX, _LEVEL_PX = 1.75, 2.25

_LEAST_STEP = 9.0
# Brightness from which a wall is burnt out: its edges are uncertain.
_BURNT, _BURNT_SIGMA_PX = 250.0, 0.3
# Farther from the change of colour a step in brightness is another one.
_SAME_PX = 0.7

# The response is varied by so much; an edge that it moves farther is none.
_GAMMA_STEP, _MOST_BY_GAMMA = 0.25, 1.5

_BRIGHTNESS = np.array([0.114, 0.587, 0.299])


@dataclass(frozen=True, eq=False)
class EdgeSamples:
    """
    Where edges were found, arrays (2, n): first by colour, then by brightness, at n places.

    `offset_px` is measured from the expected place outwards, NaN where there is no clear edge;
    `sigma_px` its standard deviation; `by_gamma` its derivative by the camera's response.
    """

    offset_px: FloatArray
    sigma_px: FloatArray
    by_gamma: FloatArray


def locate_edges(
    image: ImageArray,
    points: FloatArray,
    outwards: FloatArray,
    direction: FloatArray,
    reach_px: float,
    gamma: float = 1.0,
    most_by_gamma: float = _MOST_BY_GAMMA,
) -> EdgeSamples:
    """
    Find a paper's edges along short profiles that cross them.

    Parameters
    ----------
    image : ndarray, shape (height, width, 3)
        Image, BGR.
    points : ndarray, shape (n * PROFILES, 2)
        Expected places (column, row); PROFILES in turn make one measurement.
    outwards : ndarray, shape (n * PROFILES, 2)
        Unit directions from the paper to the wall.
    direction : ndarray, shape (3,)
        Of the paper's hue, see `hue_direction`.
    reach_px : float
        How far to both sides the profiles go.
    gamma : float
        Power of the pixels' values that is light: lens and sensor blur light, so that edges of
        what the camera made of it seem moved towards the darker side.
    most_by_gamma : float
        Pixels by which gamma may move an edge, for a unit of it.
    """
    offset = np.arange(-reach_px, reach_px + _STEP_PX / 2, _STEP_PX)
    where = points[:, None] + offset[:, None] * outwards[:, None]
    size = np.array(image.shape[1::-1])
    inside = ((where >= 0.0) & (where <= size - 1.0)).all(axis=(1, 2)).reshape(-1, PROFILES)
    low = np.clip(np.floor(where.min(axis=(0, 1))).astype(int), 0, size - 2)
    high = np.clip(np.ceil(where.max(axis=(0, 1))).astype(int) + 1, low + 2, size)
    part = np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]])
    column, row = np.moveaxis((where - low).astype(np.float32), -1, 0)
    profiles = []
    for power in (gamma, gamma + _GAMMA_STEP):
        light = cv2.LUT(part, _light(power))
        colors = cv2.remap(light, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        colors = colors.reshape(-1, PROFILES, len(offset), 3).mean(axis=1, dtype=np.float64)
        profiles += [colors @ direction, colors @ _BRIGHTNESS]
    burnt = (colors.max(axis=(1, 2)) > _BURNT) * _BURNT_SIGMA_PX

    place, sigma = (v.reshape(2, 2, -1) for v in _edge(np.concatenate(profiles), offset))
    by_gamma = (place[1] - place[0]) / _GAMMA_STEP
    found = inside.all(axis=1) & (np.abs(by_gamma) < most_by_gamma)
    # Both must mean the same edge: a shadow's border is not a change of hue.
    found[1] &= np.abs(place[0, 1] - place[0, 0]) < _SAME_PX
    return EdgeSamples(np.where(found, place[0], np.nan), np.hypot(sigma[0], burnt), by_gamma)


def _light(gamma: float) -> npt.NDArray[np.float32]:
    """Light of each pixel value, scaled to 255."""
    return (255.0 * (np.arange(256) / 255.0) ** gamma).astype(np.float32)


def _edge(profiles: FloatArray, offset: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Place of the edge on profiles (n, m), NaN where there is none that is clear; its sigma."""
    start, clear = _crossing(profiles, offset)
    place, sigma = _area_place(profiles, offset, start)
    return np.where(clear & (np.abs(place - start) < 0.7), place, np.nan), sigma


def _crossing(
    profiles: FloatArray, offset: FloatArray
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Half-way crossing of profiles (n, m), and whether it is clear."""
    reach = offset[-1]
    inner = np.median(profiles[:, offset < -0.6 * reach], axis=1)
    outer = np.median(profiles[:, offset > 0.6 * reach], axis=1)
    step = outer - inner
    share = (profiles - inner[:, None]) / np.where(np.abs(step) < 1e-6, 1e-6, step)[:, None]
    # The last place, going outwards, before which everything is still paper.
    beyond = share > 0.5
    first = np.argmax(beyond, axis=1)
    at = np.clip(first, 1, len(offset) - 1)
    rows = np.arange(len(profiles))
    low, high = share[rows, at - 1], share[rows, at]
    place = offset[at - 1] + (0.5 - low) / np.maximum(high - low, 1e-6) * _STEP_PX
    spread = np.std(profiles[:, offset < -0.6 * reach], axis=1)
    # Past the edge a clear profile stays near the level of the wall: no shadow, no neighbour.
    past = offset[None] > place[:, None] + 2.0
    wander = np.max(np.where(past, np.abs(share - 1.0), 0.0), axis=1)
    clear = (
        (np.abs(step) > np.maximum(_LEAST_STEP, 4.0 * spread))
        & beyond.any(axis=1)
        & (first > 0)
        & (wander < 0.35)
    )
    return place, clear


def _area_place(
    profiles: FloatArray, offset: FloatArray, start: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """
    Edge of profiles (n, m) that leaves as much area on both sides as they have.

    However sharp the image is, and wherever the edge lies in its pixel, that is unbiased; a
    half-way crossing of a sharp edge is up to 0.09 px off (Tabatabai and Mitchell, PAMI 1984).
    """
    place = np.clip(start, offset[0] + 4.0, offset[-1] - 4.0)
    steps = np.arange(-_CHANGE_PX, _CHANGE_PX + _STEP_PX / 2, _STEP_PX)
    weight = np.full(len(steps), _STEP_PX)
    weight[[0, -1]] *= 0.5
    for _ in range(2):
        inner = _level(profiles, offset, place - _CHANGE_PX - _LEVEL_PX)
        outer = _level(profiles, offset, place + _CHANGE_PX)
        step = np.where(np.abs(outer - inner) < 1.0, 1.0, outer - inner)
        change = _at(profiles, offset, place[:, None] + steps)
        # The area under the share that is wall is what lies between the edge and the far end.
        share = (change - inner[:, None]) / step[:, None]
        place = np.clip(place + _CHANGE_PX - share @ weight, offset[0], offset[-1])
    beside = _at(profiles, offset, place[:, None] + _CHANGE_PX + np.arange(0.0, _LEVEL_PX, 0.5))
    noise = np.std(beside, axis=1) + 0.3
    return place, np.hypot(0.05, 1.5 * noise / np.abs(step))


def _level(profiles: FloatArray, offset: FloatArray, start: FloatArray) -> FloatArray:
    """Mean of each profile (n, m) from `start` (n,) on."""
    steps = np.arange(0.0, _LEVEL_PX + _STEP_PX / 2, _STEP_PX)
    return np.asarray(_at(profiles, offset, start[:, None] + steps).mean(axis=1))


def _at(profiles: FloatArray, offset: FloatArray, where: FloatArray) -> FloatArray:
    """Values of profiles (n, m) at places (n, k) along them, interpolated."""
    index = np.clip((where - offset[0]) / _STEP_PX, 0.0, len(offset) - 1.001)
    low = index.astype(np.intp)
    share = index - low
    rows = np.arange(len(profiles))[:, None]
    return np.asarray(profiles[rows, low] * (1.0 - share) + profiles[rows, low + 1] * share)
