"""Numbers of the command line."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from math import inf


def within(
    kind: type[int] | type[float], least: float, most: float = inf
) -> Callable[[str], float]:
    """Argument type: a number from `least` to `most`; any other is wrong usage."""

    def number(text: str) -> float:
        value = kind(text)
        if not least <= value <= most or value == inf:
            what = f'{least:g} or more' if most == inf else f'from {least:g} to {most:g}'
            raise argparse.ArgumentTypeError(f'{text} is not {what}')
        return value

    return number
