"""Frozen dataclasses of `landmark_nav.parameters` as read-only ROS parameters."""

from __future__ import annotations

import dataclasses
import difflib
import sys
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from landmark_nav.errors import LandmarkNavError
from landmark_nav.parameters import former_name, renamed, unit_hint

__all__ = ['declare', 'misspelt']

T = TypeVar('T')

_LARGEST_INTEGER = 2**63 - 1
# Names that share so much of their letters differ by a slip of the pen.
_ALIKE = 0.85


def declare(node: Node, config_class: type[T], prefix: str = '') -> T:
    """
    Declare the fields of a dataclass as parameters and return it filled.

    A field that is a dataclass itself becomes a section: ``prefix.field.name``. Values come from
    the node's parameter file or the command line; fields without one keep their defaults.

    Raises
    ------
    LandmarkNavError
        A value has the wrong type, is out of range, or does not agree with the others.

    """
    values: dict[str, Any] = {}
    for field in dataclasses.fields(config_class):  # type: ignore[arg-type]
        name = prefix + field.name
        default = _default(field)
        if dataclasses.is_dataclass(default):
            values[field.name] = declare(node, type(default), f'{name}.')
            continue
        if former := former_name(field):
            _take_former(node, prefix + former, name)
        listed = isinstance(default, tuple)
        try:
            # A node that is configured again has them.
            value = (
                node.get_parameter(name)
                if node.has_parameter(name)
                else node.declare_parameter(
                    name, list(default) if listed else default, _descriptor(field, default)
                )
            ).value
        except InvalidParameterTypeException as error:
            example = list(default) if listed else default
            raise LandmarkNavError(
                f'parameter {name} of {node.get_name()} has the wrong type: '
                f'write it like {example!r}'
            ) from error
        except InvalidParameterValueException as error:
            raise LandmarkNavError(
                f'parameter {name} of {node.get_name()}: {" ".join(str(error).split())}'
                f'{unit_hint(name)}'
            ) from error
        values[field.name] = tuple(value) if listed else value
    return config_class(**values)


def misspelt(node: Node) -> dict[str, str]:
    """
    Names that were given values and that no parameter has -> the parameter that looks like it.

    Files may be for several nodes, so that what looks like none may well be another's.
    """
    given = getattr(node, '_parameter_overrides', {})  # rclpy has them nowhere else
    unset = [name for name in node.get_parameters_by_prefix('') if name not in given]
    meant = {
        name: difflib.get_close_matches(name, unset, 1, _ALIKE)
        for name in given
        if not node.has_parameter(name)
    }
    return {name: names[0] for name, names in meant.items() if names}


def _take_former(node: Node, former: str, name: str) -> None:
    """Give a parameter the value that is given by its former name, unless it has one itself."""
    given = getattr(node, '_parameter_overrides', {})
    if former in given:
        node.get_logger().warning(renamed(former, name))
        value = given.pop(former).value
        given.setdefault(name, Parameter(name, value=value))


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def _descriptor(field: dataclasses.Field[Any], default: Any) -> ParameterDescriptor:
    choices = field.metadata.get('choices')
    low, high = field.metadata.get('minimum'), field.metadata.get('maximum')
    descriptor = ParameterDescriptor(
        description=field.metadata.get('description', ''),
        additional_constraints=f'one of {", ".join(choices)}' if choices else '',
        read_only=True,
    )
    if (low is None and high is None) or isinstance(default, bool):
        return descriptor
    if isinstance(default, int):
        descriptor.integer_range = [
            IntegerRange(
                from_value=-_LARGEST_INTEGER if low is None else int(low),
                to_value=_LARGEST_INTEGER if high is None else int(high),
                step=0,
            )
        ]
    elif isinstance(default, float):
        descriptor.floating_point_range = [
            FloatingPointRange(
                from_value=-sys.float_info.max if low is None else float(low),
                to_value=sys.float_info.max if high is None else float(high),
                step=0.0,
            )
        ]
    return descriptor
