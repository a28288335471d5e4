"""Checked access to the fields of a YAML document; complaints say where."""

from __future__ import annotations

from collections.abc import Collection, Mapping
import difflib
import reprlib
from typing import Any

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.types import FloatArray

__all__ = [
    'array_field',
    'check_spelling',
    'covariance_field',
    'field',
    'integer_field',
    'list_field',
    'name_field',
    'number_field',
]

# A covariance may miss being positive semi-definite by this share of its largest eigenvalue.
_ROUNDING = 1e-9
# Names that share so much of their letters differ by a slip of the pen.
_ALIKE = 0.8


def field(mapping: Any, key: str, where: str) -> Any:
    """Value of `key`; `LandmarkNavError` where `mapping` is none or lacks it."""
    if not isinstance(mapping, Mapping):
        raise LandmarkNavError(f'{where} is {reprlib.repr(mapping)}, not a mapping')
    if key not in mapping:
        raise LandmarkNavError(f'{where}: {key} is missing')
    return mapping[key]


def check_spelling(mapping: Any, known: Collection[str], where: str) -> None:
    """`LandmarkNavError` where a key looks like one of `known` that is not there."""
    absent = [key for key in known if key not in mapping]
    for key in (key for key in mapping if key not in known):
        meant = difflib.get_close_matches(str(key), absent, 1, _ALIKE)
        if meant:
            raise LandmarkNavError(f'{where}: {key} is no field: write {meant[0]}')


def list_field(mapping: Any, key: str, where: str) -> list[Any]:
    """Value of `key`, a list."""
    value = field(mapping, key, where)
    if not isinstance(value, list):
        raise LandmarkNavError(f'{where}: {key} is {reprlib.repr(value)}, not a list')
    return value


def name_field(mapping: Any, key: str, where: str, default: str | None = None) -> str:
    """Value of `key`, a word or a whole number; `default`, if there is one, where it is not."""
    if default is not None and key not in mapping:
        return default
    value = field(mapping, key, where)
    if isinstance(value, bool) or not isinstance(value, str | int) or value == '':
        raise LandmarkNavError(f'{where}: {key} is {reprlib.repr(value)}, not a name')
    return str(value)


def integer_field(mapping: Any, key: str, where: str) -> int:
    """Value of `key`, an integer from 0 on."""
    value = field(mapping, key, where)
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise LandmarkNavError(f'{where}: {key} is {value!r}, not an integer from 0 on')
    return value


def number_field(mapping: Any, key: str, where: str) -> float:
    """Value of `key`, a finite number."""
    return float(array_field(mapping, key, (), where))


def array_field(mapping: Any, key: str, shape: tuple[int | None, ...], where: str) -> FloatArray:
    """Value of `key`, finite numbers of `shape`; None in it stands for any length."""
    value = field(mapping, key, where)
    wanted = ' x '.join('n' if length is None else str(length) for length in shape)
    what = f'{key} is {reprlib.repr(value)}'
    kind = f'not {wanted} numbers' if shape else 'not a number'
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise LandmarkNavError(f'{where}: {what}, {kind}') from error
    fits = array.ndim == len(shape) and all(
        wanted in (None, length) for wanted, length in zip(shape, array.shape, strict=True)
    )
    if not fits or (array.dtype.kind not in 'iuf' and array.size):
        raise LandmarkNavError(f'{where}: {what}, {kind}')
    if not np.all(np.isfinite(array.astype(np.float64))):
        raise LandmarkNavError(f'{where}: {what}: not finite')
    return array.astype(np.float64)


def covariance_field(mapping: Any, key: str, size: int, where: str) -> FloatArray:
    """Value of `key`, a covariance matrix (size, size)."""
    matrix = array_field(mapping, key, (size, size), where)
    eigenvalues = np.linalg.eigvalsh(matrix)
    slack = _ROUNDING * max(float(eigenvalues[-1]), 0.0)
    if np.abs(matrix - matrix.T).max() > slack or eigenvalues[0] < -slack:
        raise LandmarkNavError(
            f'{where}: {key} is no covariance: it must be symmetric without negative eigenvalues'
        )
    return matrix
