"""Files and folders that appear whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
import fnmatch
import os
from pathlib import Path
import shutil

from landmark_nav.errors import LandmarkNavError, why

__all__ = ['check_writable', 'left_over', 'whole_folder', 'write_whole']


@contextmanager
def whole_folder(folder: Path, own: Sequence[str]) -> Iterator[Path]:
    """
    Fill a hidden folder, which takes the place of `folder` if nothing goes wrong.

    Parameters
    ----------
    folder : Path
        What to write. If it is there already it is replaced as a whole; what the user keeps in
        it beside `own` stays.
    own : sequence of str
        Patterns of what this program writes there; the first must be in any folder that may be
        replaced.

    Yields
    ------
    Path
        The folder to fill.

    Raises
    ------
    LandmarkNavError
        `folder` is something else, or cannot be written.

    """
    if folder.is_dir() and any(folder.iterdir()) and not list(folder.glob(own[0])):
        raise LandmarkNavError(
            f'{folder}: holds other files and no {own[0]}: take an empty or a new folder'
        )
    if folder.exists() and not folder.is_dir():
        raise LandmarkNavError(f'{folder}: is a file: take another name')
    target = folder.resolve()
    growing = target.with_name(f'.{target.name}.part-{os.getpid()}')
    try:
        _clear_dead(target, own)
        growing.mkdir(parents=True)
        yield growing
        _swap(growing, target, own)
    except OSError as error:
        raise LandmarkNavError(f'{folder}: cannot be written: {why(error)}') from error
    finally:
        shutil.rmtree(growing, ignore_errors=True)


def write_whole(path: Path, content: str | bytes) -> None:
    """
    Write a file, in place of the one that is there, and the folders above it.

    Raises
    ------
    LandmarkNavError
        It cannot be written.

    """
    if path.parent.is_file():
        raise LandmarkNavError(f'{path.parent}: is a file: take another name')
    data = content.encode('utf-8') if isinstance(content, str) else content
    growing = path.with_name(f'.{path.name}.part-{os.getpid()}')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        growing.write_bytes(data)
        growing.replace(path)
    except OSError as error:
        with suppress(OSError):
            growing.unlink()
        raise LandmarkNavError(f'{path}: cannot be written: {why(error)}') from error


def check_writable(*files: Path | None) -> None:
    """
    Refuse at the start what could not be written in the end; None stands for what is not wanted.

    Raises
    ------
    LandmarkNavError
        One of them cannot be written.

    """
    for path in files:
        if path is None:
            continue
        if path.is_dir():
            raise LandmarkNavError(f'{path}: is a folder: take another name')
        there = next(folder for folder in path.absolute().parents if folder.exists())
        if not there.is_dir():
            raise LandmarkNavError(f'{there}: is a file: take another name')
        if not os.access(there, os.W_OK):
            raise LandmarkNavError(f'{path}: cannot be written: no permission to write in {there}')


def left_over(folder: Path) -> Path | None:
    """What `whole_folder` moved aside for a new one that never came: it was killed in between."""
    target = folder.resolve()
    aside = [] if target.exists() else sorted(target.parent.glob(f'.{target.name}.old-*'))
    return aside[-1] if aside else None


def _clear_dead(target: Path, own: Sequence[str]) -> None:
    """Remove what processes that are gone had begun to write, and what they had replaced."""
    for begun in _of_the_dead(target, 'part'):
        shutil.rmtree(begun, ignore_errors=True)
    for old in _of_the_dead(target, 'old') if target.exists() else ():
        with suppress(OSError):
            _succeed(old, target, own)


def _of_the_dead(target: Path, kind: str) -> Iterator[Path]:
    for path in target.parent.glob(f'.{target.name}.{kind}-*'):
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
    """Put `growing` in the place of `target`, which comes back if that fails."""
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
    """Take over what the user kept in `old`, and remove that; not where something is in both."""
    for kept in list(old.iterdir()):
        if any(fnmatch.fnmatch(kept.name, pattern) for pattern in own):
            continue
        if (target / kept.name).exists():
            return
        kept.rename(target / kept.name)
    shutil.rmtree(old)
