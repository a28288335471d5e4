"""Parameters in a YAML file, in sections named as in the code."""

from __future__ import annotations

from collections.abc import Mapping
import dataclasses
import logging
from pathlib import Path
import sys
from typing import Any, TypeVar

from landmark_nav.errors import LandmarkNavError, shown
from landmark_nav.parameters import former_name, renamed
from landmark_nav.storage.reading import read_yaml_mapping

__all__ = ['load_config', 'shipped_config']

T = TypeVar('T')

_LOG = logging.getLogger(__name__)

_KINDS = {
    bool: 'true or false',
    int: 'a whole number',
    float: 'a number',
    str: 'a word',
    tuple: 'a list',
}


def load_config(path: Path | str, default: T) -> T:
    """
    Read parameters; what a file does not name stays as in `default`.

    Parameters
    ----------
    path : path-like
        YAML; its keys are the fields of `default`, and theirs where those are dataclasses too.
    default : dataclass instance
        What to start from.

    Raises
    ------
    LandmarkNavError
        No YAML, a parameter that does not exist, or a value that it may not take.

    """
    path = Path(path)
    values = read_yaml_mapping(path)
    if any(isinstance(value, Mapping) and 'ros__parameters' in value for value in values.values()):
        raise LandmarkNavError(
            f'{path}: is a file for ROS: here the sections under ros__parameters stand alone'
        )
    return _changed(default, values, str(path))


def _changed(config: T, values: Any, where: str) -> T:
    if not isinstance(values, Mapping):
        raise LandmarkNavError(f'{where}: is {shown(values)}, not a mapping of parameters')
    fields = dataclasses.fields(config)  # type: ignore[arg-type]
    known = {field.name for field in fields}
    current = {former_name(field): field.name for field in fields} | {name: name for name in known}
    changes: dict[str, Any] = {}
    for given, value in values.items():
        name = current.get(given, given)
        if name != given:
            _LOG.warning('%s: %s', where, renamed(str(given), str(name)))
            if name in values:
                continue
        if name not in known:
            raise LandmarkNavError(
                f'{where}: no parameter {shown(name)}: there are {", ".join(sorted(known))}'
            )
        old = getattr(config, name)
        if dataclasses.is_dataclass(old):
            changes[name] = _changed(old, value, f'{where}: {name}')
        else:
            changes[name] = _converted(value, old, f'{where}: {name}')
    try:
        return dataclasses.replace(config, **changes)  # type: ignore[type-var]
    except LandmarkNavError as error:
        raise LandmarkNavError(f'{where}: {error}') from error


def _converted(value: Any, old: Any, where: str) -> Any:
    """Value of the type of the one it replaces; an integer will do for a float."""
    if isinstance(old, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(old, tuple) and isinstance(value, list):
        return tuple(value)
    if type(value) is not type(old):
        raise LandmarkNavError(f'{where} is {shown(value)}: take {_KINDS[type(old)]}')
    return value


def shipped_config(name: str) -> Path:
    """Path of a file below ``config/``: in the source tree, or where it was installed to."""
    package = Path(__file__).resolve().parents[1]
    shares = [folder / 'share' / package.name for folder in (Path(sys.prefix), *package.parents)]
    # The folders of viewers lie beside `config` there.
    places = [package.parent / 'config', *(share / 'config' for share in shares), *shares]
    for folder in places:
        if (folder / name).is_file():
            return folder / name
    raise LandmarkNavError(f'{name}: not among the installed files: install landmark_nav again')
