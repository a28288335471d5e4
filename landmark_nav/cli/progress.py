"""Progress on the terminal, for what takes longer than two seconds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
import logging
import sys
import time
from typing import TypeVar

from tqdm import tqdm

__all__ = ['progress']

T = TypeVar('T')

_FIRST_S, _LINE_EVERY_S = 2.0, 10.0


def progress(iterable: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
    """
    Pass items through and show on stderr how far it is and how long it takes yet.

    On a terminal that is a bar, drawn after two seconds; elsewhere a line every ten seconds;
    nothing where warnings are not wanted either.

    Yields
    ------
    object
        Each item.

    """
    if not logging.getLogger().isEnabledFor(logging.WARNING):
        yield from iterable
    elif sys.stderr is not None and sys.stderr.isatty():
        yield from tqdm(
            iterable, desc=description, total=total, delay=_FIRST_S, leave=False, file=sys.stderr
        )
    else:
        begin = shown = time.monotonic()
        for count, item in enumerate(iterable):
            now = time.monotonic()
            if now - shown > _LINE_EVERY_S and sys.stderr is not None:
                line = tqdm.format_meter(
                    count,
                    total,  # type: ignore[arg-type]
                    now - begin,
                    prefix=description,
                    ncols=80,
                )
                print(line, file=sys.stderr, flush=True)
                shown = now
            yield item
