"""Parameters of `landmark_nav.parameters` as ROS parameters of a node."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
import dataclasses
import sys
from typing import Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from landmark_nav.errors import LandmarkNavError, shown
from landmark_nav.former_parameters import settled
from landmark_nav.parameters import changed, is_of, leaves, unit_hint, unit_of

T = TypeVar('T')

# Type of a parameter -> field of its descriptor, type of its range, largest value.
_RANGES: dict[type, tuple[str, Any, float]] = {
    int: ('integer_range', IntegerRange, 2**63 - 1),
    float: ('floating_point_range', FloatingPointRange, sys.float_info.max),
}


def settle(node: Node, config: Any) -> Mapping[str, Any]:
    """
    Map former names of parameters to new ones; warn of unknown parameters.

    `config` has all parameters, with those of other nodes, since files may be for several nodes.
    Returns fields of `robot.yaml` that were parameters in the last release.
    """
    overrides = getattr(node, '_parameter_overrides', {})  # not public in rclpy
    # Parameters of rclpy itself are left out.
    own = {
        key: value
        for key, value in overrides.items()
        if not node.has_parameter(key) and not key.startswith('qos_overrides.')
    }
    known = [name for name, _, _ in leaves(config)]
    given = settled({name: parameter.value for name, parameter in own.items()}, known)
    for warning in given.warnings:
        node.get_logger().warning(warning)
    for name, meant in given.unknown.items():
        node.get_logger().warning(f'no parameter {shown(name)}{meant}')
    for name, value in given.values.items():
        overrides.setdefault(name, Parameter(name, value=value))
    return given.robot


def declare(node: Node, config: T, names: Collection[str], live: Collection[str] = ()) -> T:
    """
    Declare parameters of a dataclass and return it with their values.

    Values come from a parameter file or the command line; other parameters keep their defaults.
    Parameters that are already declared keep their values. `names` are the parameters and sections
    that the node reads, of which `live` may be set later, see `follow`.

    Raises `LandmarkNavError`: a value has the wrong type, is out of range, or contradicts others.
    """
    return changed(
        config,
        {
            name: _declared(node, name, field, default, is_of(name, live))
            for name, field, default in leaves(config)
            if is_of(name, names)
        },
    )


def follow(
    node: Node, config: T, live: Collection[str], take: Callable[[T], None]
) -> Callable[[], None]:
    """
    Let parameters of a node be set while it runs; invalid values are refused with the reason.

    `take` is called with the configuration that contains the new values. Returns a function that
    ends this.
    """

    def on_set(parameters: Sequence[Parameter[Any]]) -> SetParametersResult:
        nonlocal config
        values = {one.name: _plain(one.value) for one in parameters if is_of(one.name, live)}
        # rclpy also calls this when it declares other parameters, such as qos_overrides.
        if values:
            try:
                config = changed(config, values)
            except LandmarkNavError as error:
                return SetParametersResult(successful=False, reason=str(error))
            take(config)
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(on_set)
    return lambda: node.remove_on_set_parameters_callback(on_set)


def _plain(value: Any) -> Any:
    """Convert an array of rclpy to a list; return other values unchanged."""
    return value if isinstance(value, str | int | float) else list(value)


def _declared(
    node: Node, name: str, field: dataclasses.Field[Any], default: Any, is_live: bool
) -> Any:
    if node.has_parameter(name):
        return _plain(node.get_parameter(name).value)
    example = list(default) if isinstance(default, tuple) else default
    descriptor = _descriptor(name, field, default, is_live)
    where = f'parameter {name} of {node.get_name()}'
    try:
        return _plain(node.declare_parameter(name, example, descriptor).value)
    except InvalidParameterTypeException as error:
        raise LandmarkNavError(f'{where} has the wrong type: write it like {example!r}') from error
    except InvalidParameterValueException as error:
        words = f'{where}: {" ".join(str(error).split())}{unit_hint(name)}'
        raise LandmarkNavError(words) from error


def _descriptor(
    name: str, field: dataclasses.Field[Any], default: Any, is_live: bool
) -> ParameterDescriptor:
    choices, unit = field.metadata['choices'], unit_of(name)
    descriptor = ParameterDescriptor(
        description=field.metadata['description'] + (f' [{unit}]' if unit else ''),
        additional_constraints=f'one of {", ".join(choices)}' if choices else '',
        read_only=not is_live,
    )
    low, high = field.metadata['minimum'], field.metadata['maximum']
    kind: Any = type(default)
    if kind not in _RANGES or (low is None and high is None):
        return descriptor
    range_of, make, largest = _RANGES[kind]
    low, high = (-largest if low is None else low), (largest if high is None else high)
    setattr(descriptor, range_of, [make(from_value=kind(low), to_value=kind(high))])
    return descriptor
