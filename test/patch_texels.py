"""Where the texels of a patch lie on its wall; for the tests."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.patches import patch_axes
from landmark_nav.types import FloatArray


def patch_points(
    position: npt.ArrayLike, normal: npt.ArrayLike, shape: tuple[int, int], texel_m: float
) -> FloatArray:
    """Points (rows, columns, 3) in map of the texels of a patch centred on `position`."""
    right, down = patch_axes(normal)
    column = (np.arange(shape[1]) - (shape[1] - 1) / 2.0) * texel_m
    row = (np.arange(shape[0]) - (shape[0] - 1) / 2.0) * texel_m
    return np.asarray(
        np.asarray(position) + column[None, :, None] * right + row[:, None, None] * down
    )
