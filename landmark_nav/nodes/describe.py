"""
Parameter file of a node with its defaults: ``python -m landmark_nav.nodes.describe NODE``.

``config/NODE.yaml`` is its output.
"""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
from importlib import import_module
import sys
from typing import Any

__all__ = ['parameter_file']


def parameter_file(name: str) -> str:
    """YAML of all parameters of the node `name`: description, range and default of each."""
    config = import_module(f'landmark_nav.nodes.{name}').Parameters()
    lines = [
        f'# Parameters of {name} with their defaults.',
        '/**:',
        '  ros__parameters:',
        *_fields(config, '    '),
    ]
    return '\n'.join(lines) + '\n'


def _fields(config: Any, indent: str) -> Iterator[str]:
    """Own parameters first, then the sections."""
    values = [(field, getattr(config, field.name)) for field in dataclasses.fields(config)]
    for field, value in sorted(values, key=lambda pair: dataclasses.is_dataclass(pair[1])):
        if dataclasses.is_dataclass(value):
            yield f'{indent}{field.name}:'
            yield from _fields(value, indent + '  ')
        else:
            yield f'{indent}# {_meaning(field.metadata)}'
            yield f'{indent}{field.name}: {_yaml(value)}'


def _meaning(metadata: Any) -> str:
    text = metadata['description'].rstrip('.')
    low, high = metadata['minimum'], metadata['maximum']
    if metadata['choices']:
        return f'{text}: {", ".join(metadata["choices"])}'
    if low is not None and high is not None:
        return f'{text} [{low:g} to {high:g}]'
    if low is not None:
        return f'{text} [{low:g} or more]'
    return f'{text} [{high:g} or less]' if high is not None else text


def _yaml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        text = repr(value)
        # 1e-05 is a number to ROS but a word to YAML 1.1.
        return text.replace('e', '.0e') if 'e' in text and '.' not in text else text
    if isinstance(value, tuple):
        return f'[{", ".join(_yaml(item) for item in value)}]'
    return f"'{value}'" if isinstance(value, str) else str(value)


if __name__ == '__main__':
    sys.stdout.write(parameter_file(sys.argv[1]))
