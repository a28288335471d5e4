"""Sphinx and rosdoc2 read this."""

from pathlib import Path
import sys
from typing import Any

project = 'landmark_nav'
copyright = 'landmark_nav maintainers, Apache-2.0'
extensions = ['myst_parser']
exclude_patterns = ['_build']
nitpicky = True
html_theme = 'furo'
html_title = 'landmark_nav'
myst_heading_anchors = 3


def _write_reference(app: Any) -> None:
    sys.path.insert(0, str(app.srcdir))
    from generate_reference import write_reference

    write_reference(Path(app.srcdir) / 'reference')


def setup(app: Any) -> None:
    """Make the reference out of the code before pages are read."""
    app.connect('builder-inited', _write_reference)
