"""Checked access to the fields of a YAML document; complaints say where."""

from __future__ import annotations

from collections.abc import Collection, Mapping
import difflib
from typing import Any

import numpy as np

from landmark_nav.errors import LandmarkNavError, shown
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
# To compare letters takes long; what has more strange fields was not mistyped.
_MOST_COMPARED = 100
_MAX_NAME_LENGTH = 100
# No length, angle or variance is larger; squares of what is overflow.
_LARGEST = 1e12


def field(mapping: Any, key: str, where: str) -> Any:
    """Value of `key`; `LandmarkNavError` where `mapping` is none or lacks it."""
    if not isinstance(mapping, Mapping):
        raise LandmarkNavError(f'{where} is {shown(mapping)}, not a mapping')
    if key not in mapping:
        raise LandmarkNavError(f'{where}: {key} is missing')
    return mapping[key]


def check_spelling(mapping: Any, known: Collection[str], where: str) -> None:
    """`LandmarkNavError` where a key looks like one of `known` that is not there."""
    absent = [key for key in known if key not in mapping]
    strange = [key for key in mapping if key not in known and len(str(key)) < _MAX_NAME_LENGTH]
    for key in strange[:_MOST_COMPARED]:
        meant = difflib.get_close_matches(str(key), absent, 1, _ALIKE)
        if meant:
            raise LandmarkNavError(f'{where}: {key} is no field: write {meant[0]}')


def list_field(mapping: Any, key: str, where: str, longest: int | None = None) -> list[Any]:
    """Value of `key`, a list of at most `longest` items."""
    value = field(mapping, key, where)
    if not isinstance(value, list):
        raise LandmarkNavError(f'{where}: {key} is {shown(value)}, not a list')
    if longest is not None and len(value) > longest:
        raise LandmarkNavError(f'{where}: {key} has {len(value)} entries: {longest} at most')
    return value


def name_field(
    mapping: Any, key: str, where: str, default: str | None = None, *, blank: bool = False
) -> str:
    """Value of `key`, a word or a whole number; `default`, if there is one, where it is not."""
    if default is not None and key not in mapping:
        return default
    value = field(mapping, key, where)
    name = str(value)
    word = isinstance(value, str | int) and not isinstance(value, bool)
    fits = (blank or name) and len(name) <= _MAX_NAME_LENGTH and name.isprintable()
    if not (word and fits):
        raise LandmarkNavError(f'{where}: {key} is {shown(value)}, not a name')
    return name


def integer_field(mapping: Any, key: str, where: str) -> int:
    """Value of `key`, an integer from 0 on."""
    value = field(mapping, key, where)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**63:
        raise LandmarkNavError(f'{where}: {key} is {shown(value)}, not an integer from 0 on')
    return value


def number_field(mapping: Any, key: str, where: str) -> float:
    """Value of `key`, a finite number."""
    return float(array_field(mapping, key, (), where))


def array_field(mapping: Any, key: str, shape: tuple[int | None, ...], where: str) -> FloatArray:
    """Value of `key`, finite numbers of `shape`; None in it stands for any length."""
    value = field(mapping, key, where)
    wanted = ' x '.join('n' if length is None else str(length) for length in shape)
    what = f'{key} is {shown(value)}'
    kind = f'not {wanted} numbers' if shape else 'not a number'
    try:
        array = np.asarray(value)
    except (ValueError, OverflowError) as error:
        raise LandmarkNavError(f'{where}: {what}, {kind}') from error
    fits = array.ndim == len(shape) and all(
        wanted in (None, length) for wanted, length in zip(shape, array.shape, strict=True)
    )
    if not fits or (array.dtype.kind not in 'iuf' and array.size):
        raise LandmarkNavError(f'{where}: {what}, {kind}')
    numbers = array.astype(np.float64)
    if not np.all(np.isfinite(numbers)):
        raise LandmarkNavError(f'{where}: {what}: not finite')
    if np.any(np.abs(numbers) > _LARGEST):
        raise LandmarkNavError(f'{where}: {what}: larger than {_LARGEST:g}')
    return numbers


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
