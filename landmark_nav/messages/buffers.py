"""Raw message fields, whoever deserialised them, as NumPy arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError

__all__ = ['bytes_array']


def bytes_array(data: Any) -> npt.NDArray[np.uint8]:
    """
    View a ``uint8[]`` field (ndarray, array.array, bytes or list) as an array (n,).

    Raises
    ------
    LandmarkNavError
        It holds no bytes, as a stranger defined the message.

    """
    try:
        if isinstance(data, np.ndarray):
            return np.ascontiguousarray(data).reshape(-1).view(np.uint8)
        if isinstance(data, list | tuple):
            return np.array(data, dtype=np.uint8)
        return np.frombuffer(data, dtype=np.uint8)
    except (TypeError, ValueError, OverflowError):
        raise LandmarkNavError(
            f'the data of the message are {type(data).__name__}, not bytes: record it again'
        ) from None
