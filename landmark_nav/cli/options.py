"""Options that several commands take."""

from __future__ import annotations

import argparse

__all__ = ['add_overwrite']


def add_overwrite(parser: argparse.ArgumentParser) -> None:
    """Declare ``--overwrite``: without it, what ``--out`` names is not replaced."""
    parser.add_argument(
        '--overwrite', action='store_true', help='replace what --out names, if it is there'
    )
