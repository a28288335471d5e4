"""Write a page to a self-contained file with its style and script."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from functools import cache
from importlib.resources import files
import json
from pathlib import Path

from jinja2 import Environment, Template

from landmark_nav.errors import release, UsageError
from landmark_nav.evaluation.report.collect import Page
from landmark_nav.storage.atomic_io import write_atomically


def check_report(path: Path | None) -> None:
    """Refuse a file name that browsers do not open as a page."""
    if path and path.suffix.lower() not in ('.html', '.htm'):
        raise UsageError(f'--report {path}: reports are written as .html')


def write_report(
    path: Path, page: Page, title: str, command: str, inputs: Mapping[str, object]
) -> None:
    """
    Write a page with its title, the command, and the inputs of the command by name.

    Raises `LandmarkNavError`: the file cannot be written.
    """
    write_atomically(path, page_html(page, title, command, inputs))


def page_html(page: Page, title: str, command: str, inputs: Mapping[str, object]) -> str:
    """Return the page; all inserted values are escaped."""
    now = datetime.now().astimezone().strftime('%Y-%m-%d %H:%M %z')
    # Only a `<` in the data could end the script element.
    data = json.dumps(page['data'], separators=(',', ':'), allow_nan=False)
    return _template().render(
        page=page,
        title=title,
        command=command,
        inputs={name: str(value) for name, value in inputs.items() if value is not None},
        data=data.replace('<', '\\u003c'),
        css=_resource('page.css'),
        js=_resource('page.js'),
        made={'date': now, 'landmark_nav': release()},
    )


@cache
def _template() -> Template:
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(_resource('page.html.j2'))


def _resource(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding='utf-8')
