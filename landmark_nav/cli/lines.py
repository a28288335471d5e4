"""Lines and progress bars for a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sized
import logging
from pathlib import Path
import shlex
import shutil
import sys
from textwrap import fill
import time
from typing import TypeVar

from tqdm import tqdm

from landmark_nav.types import FloatArray

_WIDTH = 99
_LEAST_WIDTH = 60


def wrapped(lines: Iterable[str]) -> str:
    """Join lines to a text; long lines are wrapped with a deeper indent."""
    columns = shutil.get_terminal_size((_WIDTH, 24)).columns
    width = min(max(columns, _LEAST_WIDTH), _WIDTH)
    return '\n'.join(
        fill(
            line,
            width,
            subsequent_indent=' ' * (len(line) - len(line.lstrip()) + 4),
            break_long_words=False,
            break_on_hyphens=False,
        )
        for line in lines
    )


def evaluate_line(
    bag: Path, map_folder: Path, robot: Path, start: FloatArray, config: Path | None = None
) -> str:
    """Return the shell command that evaluates a drive with a map from a pose (3,)."""
    words = ['landmark-nav', 'evaluate', str(bag), '--map', str(map_folder)]
    words += ['--robot', str(robot), *(['--config', str(config)] if config else [])]
    return shlex.join([*words, '--start', *(f'{value:.4f}' for value in start)])


T = TypeVar('T')

# Delay of the progress bar on a terminal; interval of the lines elsewhere.
_FIRST_S, _LINE_EVERY_S = 2.0, 10.0


def progress(iterable: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
    """
    Yield items, and show progress and remaining time on stderr.

    A terminal shows a bar after two seconds; other outputs get a line every ten seconds. If
    warnings are disabled, nothing is shown.
    """
    if not logging.getLogger().isEnabledFor(logging.WARNING):
        yield from iterable
    elif sys.stderr is not None and sys.stderr.isatty():
        yield from tqdm(
            iterable, desc=description, total=total, delay=_FIRST_S, leave=False, file=sys.stderr
        )
    else:
        begin = shown = time.monotonic()
        total = len(iterable) if total is None and isinstance(iterable, Sized) else total
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
