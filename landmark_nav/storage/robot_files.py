"""Parameter files of nodes, and the calibration, with its sigmas, in `robot.yaml`."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
import logging
from pathlib import Path
import sys
from typing import Any, TypeVar

import numpy as np
import yaml

from landmark_nav.calibration import Calibration, LENS, NAMES, UNITS
from landmark_nav.errors import inside, LandmarkNavError, shown
from landmark_nav.parameters import changed
from landmark_nav.storage.atomic_io import write_atomically
from landmark_nav.storage.reading import array_field, number_field, read_yaml_mapping
from landmark_nav.storage.setup_files import MOUNT_FIELDS, mount_of, read_robot, ROBOT_FIELDS
from landmark_nav.types import FloatArray

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
            raise LandmarkNavError(f'{path}: {_SECTION} is {shown(parameters)}, not a mapping')
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


T = TypeVar('T')

# Field with sigmas -> its quantities; a single number applies to all of them.
_SIGMAS = {
    'xyz_sigma': ('axis_x', 'axis_y', 'axis_z'),
    'rpy_sigma': ('axis_roll', 'axis_pitch', 'axis_yaw'),
    'optical_center_offset_sigma': ('center_x', 'center_y', 'center_z'),
    'camera_roll_sigma': ('camera_roll',),
}
# Quantities that a mount does not hold. Their fields have their names; sigmas end in `_sigma`.
_SCALARS = ('camera_tilt', 'pan_scale', *LENS, 'joint_delay', 'row_delay')
_SIGMAS |= {f'{name}_sigma': (name,) for name in _SCALARS}
_OF_AXIS = ('xyz_sigma', 'rpy_sigma')
# Greatest sigma by unit; a larger one is given in another unit.
_LARGEST = {'m': 1.0, 'rad': 3.2, '1': 1.0, 's': 10.0}
# Least absolute correlation that is written.
_LEAST_CORRELATION = 1e-6
# Greatest absolute value of a quantity by unit; a larger one is given in another unit.
_LARGEST_SCALAR = {'rad': 1.0, '1': 0.5, 's': 1.0}


def load_calibration(path: Path | str, former: Mapping[str, Any] | None = None) -> Calibration:
    """
    Read the calibration of a robot: the mount, the other quantities, and the covariance.

    An absent sigma defaults to that of a measurement with tape and spirit level. A sigma of 0
    declares a value exact. `former` is as for `load_robot`.

    Raises `LandmarkNavError`: a field is missing or malformed; a sigma is negative or in another
    unit.
    """
    path = Path(path)
    document = read_robot(path, former or {})
    mount = mount_of(document, path)
    if strange := [str(key) for key in document if key not in ROBOT_FIELDS]:
        _LOG.warning('%s: no fields of it, not used: %s', path, ', '.join(strange[:5]))
    axis = document['pan_axis']
    sigmas: dict[str, float] = {}
    values: dict[str, float] = {}
    with inside(path):
        for key, names in _SIGMAS.items():
            where, mapping = ('pan_axis', axis) if key in _OF_AXIS else ('robot', document)
            if key in mapping:
                sigmas |= zip(names, _spread(mapping, key, names, where), strict=True)
        for name in _SCALARS:
            if name in document:
                values[name] = number_field(document, name, 'robot')
                if abs(values[name]) > _LARGEST_SCALAR[UNITS[name]]:
                    unit = UNITS[name].replace('1', 'a fraction')
                    raise LandmarkNavError(f'robot: {name} is {values[name]:g}: give it in {unit}')
        alone = Calibration.of_mount(mount, sigmas, values)
        together = _correlations(document.get('correlations', []))
        return replace(alone, covariance=np.outer(alone.sigmas, alone.sigmas) * together)


def load_odometry(path: Path | str, default: T, former: Mapping[str, Any] | None = None) -> T:
    """
    Read the noise of the odometry, section ``odometry``; absent values are those of `default`.

    `former` is as for `load_robot`.

    Raises `LandmarkNavError`: a field is unknown, or a value is out of its range.
    """
    given = read_robot(Path(path), former or {}).get('odometry', {})
    if not isinstance(given, Mapping):
        raise LandmarkNavError(f'{path}: odometry is {shown(given)}, not a mapping')
    try:
        return changed(default, flat(given))
    except LandmarkNavError as error:
        where = f'{path}, or a file of parameters' if 'odometry' in (former or {}) else path
        raise LandmarkNavError(f'{where}: odometry: {error}') from error


def _correlations(entries: Any) -> FloatArray:
    """Return the correlation matrix (17, 17) of entries [name, name, number]."""
    together = np.eye(len(NAMES))
    wrong = f'correlations: give [name, name, -1 to 1], with two of {", ".join(NAMES[:2])}, ...'
    if not isinstance(entries, list) or len(entries) > len(NAMES) ** 2:
        raise LandmarkNavError(wrong)
    for entry in entries:
        if not isinstance(entry, list) or len(entry) != 3:
            raise LandmarkNavError(wrong)
        first, second, value = entry
        real = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= 1
        if first not in NAMES or second not in NAMES or first == second or not real:
            raise LandmarkNavError(wrong)
        i, k = NAMES.index(first), NAMES.index(second)
        together[i, k] = together[k, i] = value
    return together


def _spread(mapping: dict[str, Any], key: str, names: tuple[str, ...], where: str) -> list[float]:
    """Sigmas of some quantities, from a field with one number for all or one for each."""
    single = not isinstance(mapping[key], list)
    given = array_field(mapping, key, () if single else (len(names),), where)
    spread = np.broadcast_to(given, len(names)).tolist()
    largest = _LARGEST[UNITS[names[0]]]
    if min(spread) < 0.0 or max(spread) > largest:
        unit = UNITS[names[0]].replace('1', 'a fraction')
        how = f'give sigmas of 0 to {largest:g}, in {unit}'
        raise LandmarkNavError(f'{where}: {key} is {mapping[key]!r}: {how}')
    return list(spread)


def save_calibration(
    calibration: Calibration, path: Path | str, odometry: Mapping[str, Any] | None = None
) -> None:
    """
    Write a `robot.yaml` with all values and sigmas, atomically.

    `odometry` is the content of the section of the same name, the noise of the odometry.
    """
    base = calibration.base

    def both(name: str, first: str) -> dict[str, list[float]]:
        """Fields of three quantities: values and sigmas."""
        three = slice(NAMES.index(first), NAMES.index(first) + 3)
        values, sigmas = calibration.values[three], calibration.sigmas[three]
        return {name: [*map(_rounded, values)], f'{name}_sigma': [*map(_rounded, sigmas)]}

    document: dict[str, Any] = {
        **{name: getattr(base, name) for name in ('base_frame', 'pan_joint', 'tilt_joint')},
        'pan_axis': both('xyz', 'axis_x') | both('rpy', 'axis_roll'),
        **both('optical_center_offset', 'center_x'),
        'pan_sigma': float(base.pan_sigma_rad),
        **{key: float(getattr(base, argument)) for key, (argument, *_) in MOUNT_FIELDS.items()},
    }
    if odometry:
        document['odometry'] = dict(odometry)
    for name in ('camera_roll', *_SCALARS):
        document[name], document[f'{name}_sigma'] = map(_rounded, calibration[name])
    spread = np.maximum(calibration.sigmas, 1e-12)
    together = calibration.covariance / np.outer(spread, spread)
    # Correlations are rounded toward zero, so that the matrix stays positive semi-definite.
    document['correlations'] = [
        [NAMES[i], NAMES[k], float(np.trunc(together[i, k] * 1e9) / 1e9)]
        for i, k in zip(*np.triu_indices(len(NAMES), 1), strict=True)
        if abs(together[i, k]) > _LEAST_CORRELATION
    ]
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, allow_unicode=True)
    write_atomically(Path(path), text)


def _rounded(value: float) -> float:
    """Round to nine decimals (a nanometre or nanoradian), with plus zero for minus zero."""
    return round(float(value), 9) + 0.0
