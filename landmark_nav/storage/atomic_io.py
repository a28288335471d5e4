"""Atomic writing of files and folders: they appear complete or not at all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
import errno
import fnmatch
from glob import escape
import json
import os
from pathlib import Path
import re
import shutil
import stat
import sys

from landmark_nav.errors import LandmarkNavError, why

# Target of /dev/stdout or /dev/fd/3: an open file of this process, which has no name.
_DESCRIPTOR = re.compile(rf'/(?:dev|proc/(?:self|thread-self|{os.getpid()}))/fd/(\d+)')


@contextmanager
def atomic_folder(folder: Path, own: Sequence[str], overwrite: bool) -> Iterator[Path]:
    """
    Provide a hidden folder to fill, which replaces `folder` if no exception is raised.

    An existing folder is replaced as a whole, if `overwrite` and if it holds a match of the first
    pattern of `own`, the files that this program writes there; other files, of the user, are kept.
    Raises `LandmarkNavError`: `folder` is a file or holds other files, exists although `overwrite`
    is false, or cannot be written.
    """
    if folder.is_dir() and any(folder.iterdir()) and not list(folder.glob(own[0])):
        raise LandmarkNavError(f'{folder}: holds other files and no {own[0]}: take a new folder')
    if folder.exists() and not folder.is_dir():
        raise LandmarkNavError(f'{folder}: is a file: take another name')
    if any(folder.glob(own[0])):
        check_new(overwrite, folder)
    target = Path(os.path.realpath(folder))
    growing = target.with_name(f'.{target.name}.part-{os.getpid()}')
    try:
        for begun in _of_the_dead(target, 'part'):
            shutil.rmtree(begun, ignore_errors=True)
        for old in _of_the_dead(target, 'old') if target.exists() else ():
            with suppress(OSError):
                _succeed(old, target, own)
        growing.mkdir(parents=True)
        yield growing
        _swap(growing, target, own)
    except OSError as error:
        raise LandmarkNavError(f'{folder}: cannot be written: {why(error)}') from error
    except LandmarkNavError as error:
        if str(growing) not in str(error):
            raise
        raise LandmarkNavError(str(error).replace(str(growing), str(folder))) from error
    finally:
        shutil.rmtree(growing, ignore_errors=True)


def check_new(overwrite: bool, *outputs: Path) -> None:
    """Raise `LandmarkNavError` if one of the outputs exists, and `overwrite` is false."""
    there = [path for path in outputs if path.is_file() or path.is_dir()]
    if there and not overwrite:
        raise LandmarkNavError(
            f'{there[0]}: is there already: add --overwrite to replace it, or take another name'
        )


def write_atomically(path: Path, content: str | bytes) -> None:
    """
    Write or replace a file atomically; missing parent folders are made.

    A symbolic link stays, and its target is replaced. The content of a pipe, a device or an open
    file of this process (``/dev/stdout``) is written directly.

    Raises `LandmarkNavError`: the file cannot be written.
    """
    # The text may contain names of files that are not UTF-8.
    data = content.encode('utf-8', 'backslashreplace') if isinstance(content, str) else content
    try:
        if (descriptor := _descriptor(path)) is not None:
            for stream in filter(None, (sys.stdout, sys.stderr)):
                stream.flush()
            with os.fdopen(os.dup(descriptor), 'wb') as opened:
                opened.write(data)
        elif _is_stream(path):
            # Without O_NONBLOCK, opening a pipe without a reader would block.
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_NONBLOCK), 'wb') as opened:
                os.set_blocking(opened.fileno(), True)
                opened.write(data)
        else:
            _replace(Path(os.path.realpath(path)), data)
    except OSError as error:
        reason = 'nobody reads it' if error.errno == errno.ENXIO else why(error)
        raise LandmarkNavError(f'{path}: cannot be written: {reason}') from error


def write_json(path: Path | None, document: object) -> None:
    """Write a document as JSON; do nothing if `path` is None."""
    if path:
        write_atomically(path, json.dumps(document, indent=2) + '\n')


def _replace(target: Path, data: bytes) -> None:
    """Write a temporary file and rename it to `target`; permissions of the old file are kept."""
    growing = target.with_name(f'.{target.name[:40]}.part-{os.getpid()}')
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        growing.write_bytes(data)
        with suppress(OSError):  # there is no old file, or the file system has no permissions
            shutil.copymode(target, growing)
        growing.replace(target)
    finally:
        growing.unlink(missing_ok=True)


def _descriptor(path: Path) -> int | None:
    """Descriptor of the open file of this process that a path leads to; None for other files."""
    for _ in range(40):  # the greatest number of links that Linux follows
        if found := _DESCRIPTOR.fullmatch(os.path.abspath(path)):
            return int(found[1])
        if not path.is_symlink():
            break
        path = path.parent / path.readlink()
    return None


def _is_stream(path: Path) -> bool:
    """Whether a path leads to a pipe, a socket or a device."""
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def check_writable(*files: Path | None) -> None:
    """
    Check that output files can be written, before they are computed; None stands for no output.

    Raises `LandmarkNavError`: one of the files cannot be written.
    """
    for path in files:
        if path is None or _descriptor(path) is not None:
            continue
        if path.is_dir():
            raise LandmarkNavError(f'{path}: is a folder: take another name')
        target = Path(os.path.realpath(path))
        needed = [target] if target.exists() else []
        if not _is_stream(path):
            folder = next(place for place in target.parents if os.path.exists(place))
            if not folder.is_dir():
                raise LandmarkNavError(f'{folder}: is a file: take another name')
            needed.append(folder)
        for place in needed:
            if not os.access(place, os.W_OK):
                raise LandmarkNavError(f'{path}: cannot be written: no permission for {place}')


def left_over(folder: Path) -> Path | None:
    """Old folder that `atomic_folder` moved aside before it was killed; None if there is none."""
    target = Path(os.path.realpath(folder))
    aside = [] if target.exists() else sorted(_temporaries(target, 'old'))
    return aside[-1] if aside else None


def _temporaries(target: Path, kind: str) -> Iterator[Path]:
    # A name may hold characters of patterns, as [2].
    return target.parent.glob(f'.{escape(target.name)}.{kind}-*')


def _of_the_dead(target: Path, kind: str) -> Iterator[Path]:
    """Yield temporary folders of one kind (`part` or `old`) of processes that have ended."""
    for path in _temporaries(target, kind):
        number = path.name.rpartition('-')[2]
        if not number.isdecimal():
            continue
        try:
            os.kill(int(number), 0)
        except ProcessLookupError:
            yield path
        except OSError:
            continue


def _swap(growing: Path, target: Path, own: Sequence[str]) -> None:
    """Replace `target` by `growing`; `target` is restored if that fails."""
    if not target.exists():
        growing.rename(target)
        return
    old = target.with_name(f'.{target.name}.old-{os.getpid()}')
    target.rename(old)
    try:
        growing.rename(target)
    except OSError:
        old.rename(target)
        raise
    _succeed(old, target, own)


def _succeed(old: Path, target: Path, own: Sequence[str]) -> None:
    """Move files of the user from `old` to `target` and remove `old`; stop if a name is taken."""
    for kept in list(old.iterdir()):
        if any(fnmatch.fnmatch(kept.name, pattern) for pattern in own):
            continue
        if (target / kept.name).exists():
            return
        kept.rename(target / kept.name)
    shutil.rmtree(old)
