"""
Parameters: fields of frozen dataclasses with a description and a range.

The same dataclass configures a stage offline and is declared as ROS parameters by its node. Fields
without a description can be changed by code only, for example in tests. Names of parameters in
nested dataclasses have dots: ``capture.frames``.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
import dataclasses
import difflib
from typing import Any, TypeVar

import numpy as np

from landmark_nav.errors import LandmarkNavError, shown

T = TypeVar('T')

# Metadata of a field whose values come from `robot.yaml`: it holds no parameters.
OF_ROBOT = {'of_robot': True}
# Suffixes of names and their units.
_UNITS = {
    '_rad_s': 'rad/s',
    '_m_s': 'm/s',
    '_rad': 'rad',
    '_m': 'm',
    '_s': 's',
    '_hz': 'Hz',
    '_px': 'px',
}
# For longer names no similar one is searched.
_MAX_NAME_LENGTH = 100
_KINDS = {
    bool: 'true or false',
    int: 'a whole number',
    float: 'a number',
    str: 'a word',
    tuple: 'a list',
}


def parameter(
    default: T,
    description: str,
    *,
    minimum: float | None = None,
    maximum: float | None = None,
    choices: Sequence[str] | None = None,
) -> T:
    """Dataclass field with a description and its allowed values (inclusive range or choices)."""
    return dataclasses.field(
        default=default,
        metadata={
            'description': description,
            'minimum': minimum,
            'maximum': maximum,
            'choices': tuple(choices) if choices is not None else None,
        },
    )


@dataclasses.dataclass(frozen=True)
class Config:
    """Base class of dataclasses with parameters; values are checked against their metadata."""

    def __post_init__(self) -> None:
        """
        Check every field.

        Raises `LandmarkNavError`: a value is not finite, outside its range, or not one of the
        choices.
        """
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            where = f'parameter {field.name}'
            choices = field.metadata.get('choices')
            if choices is not None and value not in choices:
                allowed = f'take one of {", ".join(choices)}'
                raise LandmarkNavError(f'{where} is {shown(value)}: {allowed}')
            if isinstance(value, bool) or not isinstance(value, int | float):
                continue
            low, high = field.metadata.get('minimum'), field.metadata.get('maximum')
            if not abs(value) < np.inf:
                raise LandmarkNavError(f'{where} is {value}: take a number')
            if (low is not None and value < low) or (high is not None and value > high):
                raise LandmarkNavError(
                    f'{where} is {value:g}: take {"any" if low is None else f"{low:g}"} '
                    f'to {"any" if high is None else f"{high:g}"}{unit_hint(field.name)}'
                )


def leaves(config: Any, prefix: str = '') -> Iterator[tuple[str, dataclasses.Field[Any], Any]]:
    """Yield name, field and value of each parameter."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if field.metadata == OF_ROBOT:
            continue
        if dataclasses.is_dataclass(value):
            yield from leaves(value, f'{prefix}{field.name}.')
        elif 'description' in field.metadata:
            yield prefix + field.name, field, value


def is_of(name: str, sections: Collection[str]) -> bool:
    """Whether a parameter is one of these, or in one of these sections."""
    return name in sections or any(name.startswith(f'{section}.') for section in sections)


def changed(config: T, values: Mapping[str, Any]) -> T:
    """
    Return a copy with other values of some parameters.

    Raises `LandmarkNavError`: there is no such parameter, or the value is not allowed.
    """
    known = {name: value for name, _, value in leaves(config)}
    changes: dict[str, Any] = {}
    sections: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        if name not in known:
            raise LandmarkNavError(f'no parameter {shown(name)}{resembling(name, known)}')
        section, _, rest = name.partition('.')
        if rest:
            sections.setdefault(section, {})[rest] = value
        else:
            changes[name] = _converted(value, known[name], name)
    for section, inside in sections.items():
        try:
            changes[section] = changed(getattr(config, section), inside)
        except LandmarkNavError as error:
            raise LandmarkNavError(f'{section}: {error}') from error
    return dataclasses.replace(config, **changes) if changes else config  # type: ignore[type-var]


def _converted(value: Any, old: Any, name: str) -> Any:
    """Convert a value to the type of the old one: int to float, list to tuple."""
    if isinstance(old, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(old, tuple) and isinstance(value, list):
        return tuple(value)
    if type(value) is not type(old):
        raise LandmarkNavError(f'{name} is {shown(value)}: take {_KINDS[type(old)]}')
    return value


def resembling(name: str, known: Collection[str]) -> str:
    """What an unknown name may mean, a section or a similar name, as text; '' if it is neither."""
    if any(is_of(one, (name,)) for one in known):
        return f': {name} is a section: write its parameters below it, each with a value'
    short = len(name) <= _MAX_NAME_LENGTH
    like = difflib.get_close_matches(name, list(known), 1) if short else []
    return f': did you mean {like[0]}?' if like else ''


def unit_of(name: str) -> str:
    """Unit of a parameter by the suffix of its name; '' for counts, ratios and words."""
    if '_per_' in name:
        return ''
    return next((unit for end, unit in _UNITS.items() if name.endswith(end)), '')


def unit_hint(name: str) -> str:
    """Remark on the unit of a parameter out of its range: angles are often given in degrees."""
    return '; it is in radians' if name.endswith('_rad') else ''
