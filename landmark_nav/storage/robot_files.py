"""Parameter files of nodes, and `robot.yaml`: mount and calibration, with its sigmas."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
import logging
from pathlib import Path
import sys
from typing import Any, TypeVar

import numpy as np
import yaml

from landmark_nav.calibration import Calibration, NAMES, UNITS
from landmark_nav.errors import inside, LandmarkNavError, shown
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.parameters import changed
from landmark_nav.storage.atomic_io import write_atomically
from landmark_nav.storage.reading import Entry, read_text, read_yaml_mapping
from landmark_nav.storage.urdf import robot_of_urdf
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
    document = read_yaml_mapping(path, 'config')
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

# Field of a robot -> argument of a mount, range and unit. A pan of greater sigma gives no
# information. A joint may make a full turn to both sides; rates and accelerations beyond the range
# are given in another unit. Images are never early.
MOUNT_FIELDS = {
    'pan_sigma': ('pan_sigma_rad', 0.0, 0.1, 'radians'),
    'pan_min': ('pan_min_rad', -6.2832, 6.2832, 'radians'),
    'pan_max': ('pan_max_rad', -6.2832, 6.2832, 'radians'),
    'pan_rate': ('pan_rate_rad_s', 0.01, 100.0, 'radians a second'),
    'pan_acceleration': ('pan_acceleration_rad_s2', 0.01, 1e4, 'radians a second, each second'),
    'image_delay': ('image_delay_s', 0.0, 1.0, 'seconds'),
}
# Field of a robot -> quantities of its calibration. FIELD_sigma has their sigmas, one for each, or
# one for all.
QUANTITIES: dict[str, tuple[str, ...]] = {
    'xyz': NAMES[0:3],
    'rpy': NAMES[3:6],
    'optical_center_offset': NAMES[6:9],
    **{name: (name,) for name in NAMES[9:]},
}
# Those in the section ``pan_axis``, and those that a mount holds.
_OF_AXIS, _OF_MOUNT = ('xyz', 'rpy'), ('xyz', 'rpy', 'optical_center_offset', 'camera_roll')
# Greatest absolute value by unit or field: half a turn, rounded up, and a camera that is aimed at
# the floor. Greatest sigma. Larger ones are given in another unit.
_LARGEST = {'m': 10.0, 'rad': 3.15, '1': 0.5, 's': 1.0, 'camera_tilt': 1.0}
_LARGEST_SIGMA = {'m': 1.0, 'rad': 3.2, '1': 1.0, 's': 10.0}
_HOW = {
    'm': 'lengths are metres',
    'rad': 'give it in radians',
    '1': 'give it as a fraction',
    's': 'give it in seconds',
}

_URDF = '.urdf'
_AXIS_FIELDS = tuple(f'{field}{end}' for field in _OF_AXIS for end in ('', '_sigma'))
ROBOT_FIELDS = (
    *('base_frame', 'pan_joint', 'tilt_joint', 'pan_axis', 'correlations', 'odometry'),
    *(f'{field}{end}' for field in QUANTITIES if field not in _OF_AXIS for end in ('', '_sigma')),
    *MOUNT_FIELDS,
)
# Least absolute correlation that is written.
_LEAST_CORRELATION = 1e-6


def read_robot(path: Path, former: Mapping[str, Any]) -> dict[str, Any]:
    """
    Content of `robot.yaml`, or of a URDF, completed by `former` parameters for absent fields.

    A path ``FILE.urdf:FRAME`` names the optical frame of the camera.
    """
    name, _, camera_frame = path.name.partition(f'{_URDF}:')
    if camera_frame or path.suffix == _URDF:
        file = path.with_name(f'{name}{_URDF}') if camera_frame else path
        text = read_text(file)
        with inside(file):
            document = robot_of_urdf(text, camera_frame)
        # Limits that mean none, as of a simulator, are left out.
        for key in document.keys() & MOUNT_FIELDS.keys():
            _, low, high, _ = MOUNT_FIELDS[key]
            if not low <= document[key] <= high:
                del document[key]
    else:
        document = read_yaml_mapping(path, 'robot')
    for key, value in former.items():
        own = document.get(key, {} if isinstance(value, Mapping) else value)
        document[key] = {**value, **own} if isinstance(own, dict) else own
    return document


def load_robot(path: Path | str, former: Mapping[str, Any] | None = None) -> PanTiltMount:
    """
    Read the extrinsics of the camera on the robot, and the limits of its pan joint.

    `former` are fields given by parameters of the last release; the file takes precedence.

    Raises `LandmarkNavError`: a field is missing or malformed.
    """
    path = Path(path)
    document = read_robot(path, former or {})
    with inside(path):
        return _mount(Entry(document, 'robot', ROBOT_FIELDS))


def _mount(robot: Entry) -> PanTiltMount:
    robot.section('pan_axis', _AXIS_FIELDS).field('xyz')  # all else has a default
    x = [*(dict.fromkeys(NAMES[:10], 0.0) | _quantities(robot, _OF_MOUNT)).values()]
    pan, tilt = (robot.name(name, name) for name in ('pan_joint', 'tilt_joint'))
    if pan == tilt:
        raise robot.refused(f'pan_joint and tilt_joint are both {pan}: rename one')
    return PanTiltMount(
        axis_xyz=(x[0], x[1], x[2]),
        axis_rpy=(x[3], x[4], x[5]),
        optical_center_offset=(x[6], x[7], x[8]),
        camera_roll_rad=x[9],
        base_frame=robot.name('base_frame', 'base_link'),
        pan_joint=pan,
        tilt_joint=tilt,
        has_tilt='tilt_joint' in robot,
        **{
            argument: robot.number(key, low, high, f'take {low:g} to {high:g}, in {unit}')
            for key, (argument, low, high, unit) in MOUNT_FIELDS.items()
            if key in robot
        },
    )


def _quantities(
    robot: Entry, fields: Iterable[str] = QUANTITIES, *, sigmas: bool = False
) -> dict[str, float]:
    """Quantities that some fields give, by name, or their sigmas; absent ones are left out."""
    axis = robot.section('pan_axis')
    found: dict[str, float] = {}
    for field in fields:
        names, entry = QUANTITIES[field], axis if field in _OF_AXIS else robot
        key = f'{field}_sigma' if sigmas else field
        if key not in entry:
            continue
        unit = UNITS[names[0]]
        most = _LARGEST_SIGMA[unit] if sigmas else _LARGEST.get(field, _LARGEST[unit])
        least, how = -most, f'{_HOW[unit]}, {most:g} at most'
        if sigmas:
            least, how = 0.0, f'must be 0 to {most:g} {unit}'.removesuffix(' 1')
        # A single sigma is that of all quantities of the field.
        several = isinstance(entry.field(key), list) if sigmas else len(names) > 1
        shape = (len(names),) if several else ()
        given = entry.array(key, shape, least, most, how)
        found |= zip(names, np.broadcast_to(given, len(names)).tolist(), strict=True)
    return found


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
    with inside(path):
        robot = Entry(document, 'robot', ROBOT_FIELDS)
        mount = _mount(robot)
        if strange := [str(key) for key in document if key not in ROBOT_FIELDS]:
            _LOG.warning('%s: no fields of it, not used: %s', path, ', '.join(strange[:5]))
        sigmas, values = (_quantities(robot, sigmas=which) for which in (True, False))
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


def save_calibration(
    calibration: Calibration, path: Path | str, odometry: Mapping[str, Any] | None = None
) -> None:
    """
    Write a `robot.yaml` with all values and sigmas, atomically.

    `odometry` is the content of the section of the same name, the noise of the odometry.
    """
    base = calibration.base

    def both(field: str) -> dict[str, Any]:
        """Field of a value or several, and that of their sigmas."""
        values, sigmas = zip(
            *(map(_rounded, calibration[k]) for k in QUANTITIES[field]), strict=True
        )
        if len(values) == 1:
            return {field: values[0], f'{field}_sigma': sigmas[0]}
        return {field: [*values], f'{field}_sigma': [*sigmas]}

    document: dict[str, Any] = {
        **{name: getattr(base, name) for name in ('base_frame', 'pan_joint')},
        **({'tilt_joint': base.tilt_joint} if base.has_tilt else {}),
        'pan_axis': both('xyz') | both('rpy'),
        **both('optical_center_offset'),
        **{key: float(getattr(base, argument)) for key, (argument, *_) in MOUNT_FIELDS.items()},
    }
    if odometry:
        document['odometry'] = dict(odometry)
    for name in NAMES[9:]:
        document |= both(name)
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
