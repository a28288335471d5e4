"""Parameter files in the format of ROS (``--params-file``), and installed configuration files."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
import logging
from pathlib import Path
import sys
from typing import Any

from landmark_nav.errors import LandmarkNavError, shown
from landmark_nav.storage.reading import read_yaml_mapping

_LOG = logging.getLogger(__name__)

_SECTION = 'ros__parameters'
# Parameters that rclpy declares for every node.
_OF_ROS = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')


def read_parameters(path: Path | str, nodes: Collection[str]) -> dict[str, Any]:
    """
    Read the parameters of nodes from a file with ``ros__parameters`` below their names or ``/**``.

    They are by full names, without those of ROS itself; parameters of wildcards apply too, and of
    repeated ones the last. For one release, a file that holds the parameters alone is read too,
    with a warning. Raises `LandmarkNavError`: the file cannot be read, or is not YAML of this
    format.
    """
    path = Path(path)
    document = read_yaml_mapping(path)
    sections = list(_sections(document))
    if document and not sections:
        _LOG.warning('%s: write /**: {ros__parameters: ...} around it, for ROS takes it too', path)
        sections = [('**', document)]
    values: dict[str, Any] = {}
    applied = [section for section in sections if section[0] in (*nodes, '*', '**')]
    if sections and not applied:
        others = ', '.join(dict.fromkeys(node for node, _ in sections))
        _LOG.warning('%s: nothing is for %s, but for %s', path, ', '.join(nodes), others)
    for _, parameters in applied:
        if not isinstance(parameters, Mapping):
            raise LandmarkNavError(
                f'{path}: {_SECTION} is {shown(parameters)}, not a mapping of parameters'
            )
        values |= flat(parameters)
    return {name: value for name, value in values.items() if not name.startswith(_OF_ROS)}


def flat(parameters: Mapping[Any, Any], prefix: str = '') -> dict[str, Any]:
    """Values of nested parameters by full name, with a dot between sections."""
    values: dict[str, Any] = {}
    for key, value in parameters.items():
        if isinstance(value, Mapping):
            values |= flat(value, f'{prefix}{key}.')
        else:
            values[f'{prefix}{key}'] = value
    return values


def _sections(document: Mapping[Any, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the last part of the name of each node or wildcard, and its parameters, in order."""
    for key, value in document.items():
        if isinstance(value, Mapping):
            if _SECTION in value:
                yield str(key).rpartition('/')[2], value[_SECTION] or {}
            else:
                yield from _sections(value)


def shipped_config(name: str) -> Path:
    """Path of a file below ``config/``, in the source tree or in the installation."""
    package = Path(__file__).resolve().parents[1]
    shares = [folder / 'share' / package.name for folder in (Path(sys.prefix), *package.parents)]
    # An installation keeps the folders of viewers beside `config`.
    places = [package.parent / 'config', *(share / 'config' for share in shares), *shares]
    for folder in places:
        if (folder / name).is_file():
            return folder / name
    raise LandmarkNavError(f'{name}: not among the installed files: install landmark_nav again')
