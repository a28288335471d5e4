"""`landmark-nav batch`: learn, calibrate and evaluate many recordings; one table of results."""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path
import re

from landmark_nav.batch import results
from landmark_nav.batch.jobs import read_runs, Run, run_all, stage_arguments
from landmark_nav.cli.options import add, progress, within
from landmark_nav.errors import LandmarkNavError, release, UsageError
from landmark_nav.storage.atomic_io import check_writable, write_atomically


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.description = (
        'Run simulate, learn, calibrate and evaluate over many recordings at once, on the cores '
        'of this machine or on a scheduler of dask.distributed, and write table.csv, '
        'table.parquet and index.html. What an earlier call has done in DIR is not repeated.'
    )
    text = 'the runs (docs/batch.md), or a pattern of folders as of simulate, such as "rooms/*"'
    parser.add_argument('jobs', metavar='JOBS.yaml', type=Path, help=text)
    add(parser, '--out', default=Path('batch'), help='results (default batch)')
    text = 'of a scheduler that runs, such as tcp://host:8786; its workers need the same files'
    add(parser, '--scheduler', metavar='ADDRESS', help=text)
    text = 'processes on this machine, without --scheduler (default: one a core)'
    add(parser, '--workers', type=within(int, 1, 1024), metavar='N', help=text)
    text = 'compare with an earlier batch run by run; exit status 1 where it got worse'
    add(parser, '--against', metavar='RESULTS', type=Path, help=text)


def run(args: argparse.Namespace) -> int:
    """Run all; a failed run does not end the others."""
    runs = read_runs(args.jobs, release())
    for one in runs:
        _check_options(one, args.jobs)
    before = results.read_table(args.against) if args.against else None
    if args.scheduler and not re.fullmatch(r'\w+://\S+', args.scheduler):
        raise UsageError(f'--scheduler {args.scheduler}: write tcp://HOST:PORT')
    args.out.mkdir(parents=True, exist_ok=True)
    check_writable(args.out / 'table.csv')
    outcomes = {}
    ended = run_all(runs, args.out, args.scheduler, args.workers)
    for one, outcome in progress(ended, 'runs', len(runs)):
        outcomes[one.name] = outcome
    rows = [results.row(one, outcomes[one.name], args.out) for one in runs]
    changes = results.compare(rows, before) if before else []
    write_atomically(args.out / 'table.csv', results.table_csv(rows))
    results.write_parquet(rows, args.out / 'table.parquet')
    title = f'{args.jobs.stem}: {len(runs)} runs'
    write_atomically(args.out / 'index.html', results.page(title, runs, rows, changes, args.out))
    failed = [entry for entry in rows if entry['failure']]
    for entry in failed:
        print(f'{entry["run"]}: failed: {entry["failure"]}')
    for change in changes:
        print(
            f'{change.name}: {change.before:.4g} before, {change.after:.4g} now, change '
            f'{change.low:+.3g} to {change.high:+.3g} ({change.runs} runs, 95 %)'
            + (': worse' if change.worse else '')
        )
    print(
        f'{len(rows) - len(failed)} of {len(rows)} runs done: index.html, table.csv and '
        f'table.parquet in {args.out}'
    )
    return int(bool(failed) or any(change.worse for change in changes))


def _check_options(one: Run, jobs: Path) -> None:
    """Check the arguments of all commands before any of them runs."""
    for stage in one.stages:
        parser = _Parser(prog=stage.command)
        import_module(f'landmark_nav.cli.{stage.command}').add_arguments(parser)
        try:
            parser.parse_args(stage_arguments(stage, Path(), Path())[1:])
        except LandmarkNavError as error:
            raise UsageError(f'{jobs}: {one.name}: {stage.command}: {error}') from error


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> None:  # type: ignore[override]
        raise LandmarkNavError(message)
