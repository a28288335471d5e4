"""Progress on the terminal, for what takes longer than two seconds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
import sys
from typing import TypeVar

from tqdm import tqdm

__all__ = ['progress']

T = TypeVar('T')


def progress(iterable: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
    """
    Pass items through and show how far it is.

    Yields
    ------
    object
        Each item. A bar is drawn on stderr after two seconds, if that is a terminal.

    """
    yield from tqdm(
        iterable,
        desc=description,
        total=total,
        delay=2.0,
        leave=False,
        disable=None,  # tqdm's word for: unless it is a terminal
        file=sys.stderr,
    )
