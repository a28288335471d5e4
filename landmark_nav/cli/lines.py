"""Lines for a terminal."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
import shlex
import shutil
from textwrap import fill

from landmark_nav.types import FloatArray

__all__ = ['evaluate_line', 'wrapped']

_WIDTH = 99
_LEAST_WIDTH = 60


def wrapped(lines: Iterable[str]) -> str:
    """Lines as one text; what is too long goes on in the next line, further to the right."""
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
    """Return the command that drives with a map from a pose (3,), for a shell."""
    words = ['landmark-nav', 'evaluate', str(bag), '--map', str(map_folder)]
    words += ['--robot', str(robot), *(['--config', str(config)] if config else [])]
    return shlex.join([*words, '--start', *(f'{value:.4f}' for value in start)])
