"""Names of array types."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

BoolArray = npt.NDArray[np.bool_]
FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
ImageArray = npt.NDArray[np.uint8]
# What `numpy` indexes by; `IntArray` counts, such as nanoseconds.
IndexArray = npt.NDArray[np.intp]
IntArray = npt.NDArray[np.int64]
