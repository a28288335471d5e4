"""The files that a bag consists of, whichever way it was recorded, split and compressed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any
from weakref import finalize

from landmark_nav.errors import LandmarkNavError
from landmark_nav.storage.bags.container import McapFile
from landmark_nav.storage.bags.foreign import RosbagsFile
from landmark_nav.storage.bags.unpack import unpack_file
from landmark_nav.storage.reading import read_yaml_mapping

__all__ = ['BagFile', 'open_files']

BagFile = McapFile | RosbagsFile

_MCAP, _OTHERS = b'\x89MCAP0\r\n', (b'SQLite format 3\0', b'#ROSBAG')
_PACKED = (b'\x28\xb5\x2f\xfd', b'\x04\x22\x4d\x18')
_SUFFIXES = ('.mcap', '.db3', '.bag')
_PACKED_SUFFIXES = ('.zstd', '.zst', '.lz4')
_WHAT = 'give a rosbag2 folder or a file .mcap, .db3 or .bag'


def open_files(path: Path, on_warning: Callable[[str], None]) -> tuple[list[BagFile], bool]:
    """
    Files of a bag, and whether each of their messages is compressed by itself.

    Parameters
    ----------
    path : Path
        A rosbag2 folder, a folder of bag files, or such a file, itself perhaps compressed.
    on_warning : callable
        Gets what had to be passed over, in one line each.

    Raises
    ------
    LandmarkNavError
        There is no bag, or a file of it is missing or damaged.

    """
    paths, by_message = _paths(path, on_warning)
    return [_opened(file, on_warning) for file in paths], by_message


def _opened(path: Path, on_warning: Callable[[str], None]) -> BagFile:
    """File of a bag, by its first bytes; a compressed one is unpacked while it is used."""
    with path.open('rb') as stream:
        head = stream.read(16)
    if not head.startswith(_PACKED):
        return _storage(path, path, head, on_warning)
    with NamedTemporaryFile(prefix='landmark_nav_', delete=False) as unpacked:
        content = Path(unpacked.name)
        remove = partial(content.unlink, missing_ok=True)
        try:
            unpack_file(path, unpacked)
            unpacked.seek(0)
            file = _storage(content, path, unpacked.read(16), on_warning)
        except BaseException:
            remove()
            raise
    finalize(file, remove)
    return file


def _storage(path: Path, name: Path, head: bytes, on_warning: Callable[[str], None]) -> BagFile:
    if head.startswith(_MCAP):
        return McapFile(path, on_warning, name)
    if head.startswith(_OTHERS):
        return RosbagsFile(path, name)
    if not head:
        raise LandmarkNavError(f'{name}: empty, nothing was recorded')
    raise LandmarkNavError(f'{name}: not a bag (it begins with {head[:8]!r}): {_WHAT}')


def _paths(path: Path, on_warning: Callable[[str], None]) -> tuple[list[Path], bool]:
    """Files of a bag, and whether their messages are compressed one by one."""
    if not path.exists():
        raise LandmarkNavError(f'{path}: no bag there: {_WHAT}')
    if path.name == 'metadata.yaml':
        raise LandmarkNavError(f'{path}: give the folder it lies in, {path.parent}')
    if not path.is_dir():
        return [path], False
    if not (path / 'metadata.yaml').is_file():
        return _without_metadata(path, on_warning), False
    metadata = path / 'metadata.yaml'
    information = read_yaml_mapping(metadata).get('rosbag2_bagfile_information')
    if not isinstance(information, dict):
        raise LandmarkNavError(f'{metadata}: not the description of a rosbag2 bag')
    names = list(_names(information.get('relative_file_paths')))
    # A file may have been compressed after its name was written down.
    found = {
        name: _first(path / f'{name}{end}' for end in ('', *_PACKED_SUFFIXES)) for name in names
    }
    missing = [name for name, file in found.items() if file is None]
    if missing or not names:
        raise LandmarkNavError(
            f'{metadata}: names {", ".join(missing[:3]) or "no file"}, which is not there'
        )
    # Compressed files are known by their first bytes.
    by_message = str(information.get('compression_mode')).lower() == 'message'
    return [file for file in found.values() if file is not None], by_message


def _names(listed: Any) -> Iterator[str]:
    """Names of files in a bag's folder; only there they are looked for."""
    for name in listed if isinstance(listed, list) else ():
        if isinstance(name, str) and Path(name).name:
            yield Path(name).name


def _first(paths: Iterator[Path]) -> Path | None:
    return next((path for path in paths if path.is_file()), None)


def _without_metadata(path: Path, on_warning: Callable[[str], None]) -> list[Path]:
    if found := _bag_files(path):
        on_warning(f'{path}: metadata.yaml is missing: reading its {len(found)} bag files by name')
        return found
    inside = sorted(
        folder.name
        for folder in path.iterdir()
        if folder.is_dir() and ((folder / 'metadata.yaml').is_file() or _bag_files(folder))
    )
    if inside:
        raise LandmarkNavError(
            f'{path}: holds {len(inside)} bags ({", ".join(inside[:5])}): give one of them, '
            f'such as {path / inside[0]}'
        )
    raise LandmarkNavError(
        f'{path}: not a bag: a folder without metadata.yaml and without bag files: {_WHAT}'
    )


def _bag_files(folder: Path) -> list[Path]:
    ends = tuple(f'{end}{packed}' for end in _SUFFIXES for packed in ('', *_PACKED_SUFFIXES))
    return sorted(file for file in folder.iterdir() if file.name.endswith(ends) and file.is_file())
