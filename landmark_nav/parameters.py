"""
Parameters: frozen dataclasses whose fields carry a description and a range.

The same dataclass configures a stage offline and is declared as ROS parameters by its node.
"""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
from typing import Any, TypeVar

import numpy as np

from landmark_nav.errors import LandmarkNavError, shown

__all__ = ['Config', 'check_order', 'former_name', 'parameter', 'renamed', 'unit_hint']

T = TypeVar('T')


def parameter(
    default: T,
    description: str,
    *,
    minimum: float | None = None,
    maximum: float | None = None,
    choices: Sequence[str] | None = None,
    formerly: str = '',
) -> T:
    """
    Dataclass field with a description and what it may be (inclusive range or choices).

    `formerly` is its name in the last release, which files may still give.
    """
    return dataclasses.field(
        default=default,
        metadata={
            'description': description,
            'minimum': minimum,
            'maximum': maximum,
            'choices': tuple(choices) if choices is not None else None,
            'formerly': formerly,
        },
    )


def former_name(field: dataclasses.Field[Any]) -> str:
    """Name of a parameter in the last release, '' if it is the same."""
    return str(field.metadata.get('formerly', ''))


def renamed(former: str, name: str) -> str:
    """Warning about a parameter that is given by its former name."""
    return f'parameter {former} is now called {name}: its old name ends with the next release'


@dataclasses.dataclass(frozen=True)
class Config:
    """Base of all that has parameters: each is checked against its metadata."""

    def __post_init__(self) -> None:
        """
        Check every field.

        Raises
        ------
        LandmarkNavError
            A value is not a number, outside its range, or none of its choices.

        """
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            where = f'parameter {field.name} of {type(self).__name__}'
            choices = field.metadata.get('choices')
            if choices is not None and value not in choices:
                raise LandmarkNavError(
                    f'{where} is {shown(value)}: take one of {", ".join(choices)}'
                )
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


def unit_hint(name: str) -> str:
    """What to say of the unit of a parameter out of its range: angles are mistaken for degrees."""
    return '; it is in radians' if name.endswith('_rad') else ''


def check_order(config: Any, least: str, largest: str) -> None:
    """
    Check that one field is not greater than another.

    Raises
    ------
    LandmarkNavError
        It is.

    """
    low, high = getattr(config, least), getattr(config, largest)
    if low > high:
        raise LandmarkNavError(
            f'parameter {least} of {type(config).__name__} is {low:g}, more than {largest}, '
            f'{high:g}: swap them'
        )
