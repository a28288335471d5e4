"""Table of a batch, and comparison of two tables run by run."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
import csv
from dataclasses import dataclass
from importlib.resources import files
from io import StringIO
import json
from math import isfinite
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy import stats

from landmark_nav.batch.jobs import COSTS, Outcome, Run
from landmark_nav.errors import LandmarkNavError
from landmark_nav.storage.reading import read_text

Row = dict[str, Any]


# Command -> columns: function that reads the value from the report, and sign of a change for the
# worse (0: neither).
_FIGURES: dict[str, dict[str, tuple[Callable[[Mapping[str, Any]], Any], int]]] = {
    'learn': {'elected': (lambda r: r['elected'], -1)},
    'evaluate': {
        'position_rmse_m': (lambda r: r['fused']['position_rmse_m'], 1),
        'position_max_m': (lambda r: r['fused']['position_max_m'], 1),
        'heading_rmse_deg': (lambda r: r['fused']['heading_rmse_deg'], 1),
        'availability': (lambda r: r['availability'], -1),
        'nees': (lambda r: r['nees']['mean'], 0),
        'undetected_wrong': (lambda r: r.get('silently_wrong'), 1),
        'result_hash': (lambda r: r['result_hash'], 0),
    },
}
_WORSE = {name: worse for group in _FIGURES.values() for name, (_, worse) in group.items()}
_THUMBNAIL_PX = 240


def row(run: Run, outcome: Outcome, results: Path) -> Row:
    """Return the row of a run: values of the grid, figures, cost, reason of a failure."""
    figures: Row = {}
    for stage in run.stages:
        wanted = _FIGURES.get(stage.command, {})
        report: Mapping[str, Any] = {}
        if wanted and not outcome.reason:
            path = results / 'stages' / stage.key / 'result.json'
            try:
                report = json.loads(read_text(path))
                figures |= {name: read(report) for name, (read, _) in wanted.items()}
            except (ValueError, TypeError, KeyError, AttributeError) as error:
                raise LandmarkNavError(f'{path}: no report: remove its folder') from error
        else:
            figures |= dict.fromkeys(wanted)
    costs = {name: round(getattr(outcome, name), 3) for name in COSTS}
    return {'run': run.name, **run.values, **figures, **costs, 'failure': outcome.reason}


def table_csv(rows: Sequence[Row]) -> str:
    """Return rows as CSV; numbers have all digits, so that equal figures give equal tables."""
    text = StringIO()
    writer = csv.DictWriter(text, _columns(rows), lineterminator='\n')
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def write_parquet(rows: Sequence[Row], path: Path) -> None:
    """Write rows as a Parquet file."""
    from pyarrow import parquet, Table

    columns = _columns(rows)
    parquet.write_table(Table.from_pydict({c: [r.get(c) for r in rows] for c in columns}), path)


def _columns(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(name for row in rows for name in row))


def read_table(path: Path) -> list[Row]:
    """
    Read ``table.csv`` of an earlier batch; `path` is the file or its folder.

    Raises `LandmarkNavError`: the file is not such a table.
    """
    path = path / 'table.csv' if path.is_dir() else path
    try:
        rows = list(csv.DictReader(StringIO(read_text(path), newline=''), strict=True))
    except csv.Error as error:
        raise LandmarkNavError(f'{path}: is no table of landmark-nav batch: {error}') from error
    if not rows or 'run' not in rows[0] or 'failure' not in rows[0]:
        raise LandmarkNavError(f'{path}: is no table of landmark-nav batch')
    return [dict(row) for row in rows]


@dataclass(frozen=True)
class Change:
    """
    Difference of a figure between two batches, over the runs that have it in both.

    `before` and `after` are means; `change` is the mean of after minus before, within its 95 %
    interval (Student's t for pairs); `worse` if that lies on the worse side as a whole.
    """

    name: str
    runs: int
    before: float
    after: float
    change: float
    low: float
    high: float
    worse: bool


def compare(after: Sequence[Row], before: Sequence[Row]) -> list[Change]:
    """Compare two tables run by run; failures count as a figure of 0 or 1."""
    earlier = {str(row['run']): row for row in before}
    pairs = [(earlier[row['run']], row) for row in after if row['run'] in earlier]
    if not pairs:
        raise LandmarkNavError('--against: no run has the name of one of these runs')
    failed = [(float(bool(old['failure'])), float(bool(new['failure']))) for old, new in pairs]
    changes = [_change('failures', np.array(failed), 1)]
    for name, worse in _WORSE.items():
        both = [(_number(old.get(name)), _number(new.get(name))) for old, new in pairs]
        values = np.array([pair for pair in both if None not in pair], dtype=float)
        if len(values):
            changes.append(_change(name, values, worse))
    return changes


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if isfinite(number) else None


def _change(name: str, pairs: np.ndarray[Any, Any], worse: int) -> Change:
    difference = pairs[:, 1] - pairs[:, 0]
    mean, count = float(difference.mean()), len(difference)
    half = np.inf
    if count > 1:
        spread = float(difference.std(ddof=1)) / np.sqrt(count)
        half = float(stats.t.ppf(0.975, count - 1)) * spread
    is_worse = bool(worse * mean - half > 0.0)
    if name == 'failures':  # even a single new failure is worse
        is_worse = bool((difference > 0.0).any())
    before, after = (float(side.mean()) for side in pairs.T)
    return Change(name, count, before, after, mean, mean - half, mean + half, is_worse)


def page(
    title: str, runs: Sequence[Run], rows: Sequence[Row], changes: Sequence[Change], results: Path
) -> str:
    """Return one HTML page: changes, failures with their reasons, the table with thumbnails."""
    from jinja2 import Environment

    by_name = {run.name: run for run in runs}
    good = [row for row in rows if not row['failure']]
    columns = [name for name in _columns(rows) if name not in ('run', 'failure', 'result_hash')]
    shown = [(row, _thumbnails(by_name[row['run']], results)) for row in good]
    failures = [row for row in rows if row['failure']]
    values = {'title': title, 'shown': shown, 'columns': columns, 'changes': changes}
    source = files(__package__).joinpath('page.html.j2').read_text(encoding='utf-8')
    template = Environment(autoescape=True).from_string(source)
    return template.render(values, failures=failures, cell=_cell)


def _cell(value: Any) -> str:
    return f'{value:.4g}' if isinstance(value, float) else '' if value is None else str(value)


def _thumbnails(run: Run, results: Path) -> list[tuple[str, str]]:
    """Link targets of the figures of a run, and thumbnails of the figures in base64."""
    images = []
    for stage in run.stages:
        folder = results / 'stages' / stage.key
        file = folder / 'out' / {'learn': 'map.png'}.get(stage.command, 'trajectory.png')
        if (image := cv2.imread(str(file)) if file.is_file() else None) is None:
            continue
        size = (_THUMBNAIL_PX, round(_THUMBNAIL_PX * image.shape[0] / image.shape[1]))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        data = base64.b64encode(cv2.imencode('.png', small)[1].tobytes()).decode('ascii')
        report = folder / 'report.html'
        target = report if report.is_file() else file
        images.append((str(target.relative_to(results)), data))
    return images
