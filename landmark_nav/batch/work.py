"""Execution of stages as processes on workers of dask.distributed; results are kept."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
import json
import logging
import os
from pathlib import Path
import shutil
import subprocess
import sys
import time
from typing import Any

from landmark_nav.batch.jobs import Run, Stage
from landmark_nav.errors import LandmarkNavError

_DONE = 'done.json'


@dataclass(frozen=True)
class Outcome:
    """Outcome of a stage or a run: reason of its failure, if it failed, and its costs."""

    reason: str = ''
    cpu_s: float = 0.0
    wall_s: float = 0.0
    memory_mb: float = 0.0


def stage_arguments(stage: Stage, stages: Path, folder: Path) -> list[str]:
    """Arguments of `landmark-nav` for a stage, with results of other stages in `stages`."""
    given = [str(stages / word[1:]) if word.startswith('@') else word for word in stage.arguments]
    words = [stage.command, *given, '--out', str(folder / 'out')]
    if stage.config:
        words += ['--config', str(folder / 'config.yaml')]
    if stage.command != 'simulate':
        words += ['--json', str(folder / 'result.json')]
    if stage.command == 'evaluate':
        words += ['--report', str(folder / 'report.html')]
    return words


def run_all(
    runs: Sequence[Run], results: Path, scheduler: str | None, workers: int | None
) -> Iterator[tuple[Run, Outcome]]:
    """
    Execute the stages that have no results yet; ``stages/KEY`` in `results` is the folder of one.

    Yields runs as they end, with the sum of the costs of their stages and the first failure. By
    default there is one local worker for each core; `scheduler` is the address of a running one.
    """
    # Imported here, as the import is slow; the package has no types.
    distributed: Any = import_module('distributed')

    logging.getLogger('distributed').setLevel(logging.ERROR)
    stages = (results / 'stages').resolve()
    stages.mkdir(parents=True, exist_ok=True)
    open_runs: list[Run] = []
    for run in runs:
        done = [_done(stages / stage.key) for stage in run.stages]
        if None in done:
            open_runs.append(run)
        else:
            yield run, _sum([outcome for outcome in done if outcome])
    if not open_runs:
        return
    if scheduler is None:
        cluster: Any = distributed.LocalCluster(
            n_workers=min(workers or os.cpu_count() or 1, len(open_runs)),
            threads_per_worker=1,
            memory_limit=0,
            silence_logs=logging.ERROR,
            scheduler_kwargs={'dashboard': False},
        )
    else:
        cluster = scheduler
    try:
        client = distributed.Client(cluster, timeout='20s')
    except (OSError, ValueError) as error:
        raise LandmarkNavError(f'--scheduler {scheduler}: cannot be reached: {error}') from error
    try:
        futures: dict[str, Any] = {}
        ends: dict[Any, Run] = {}
        for run in open_runs:
            for stage in run.stages:
                if stage.key not in futures:
                    needed = [futures[key] for key in stage.after]
                    futures[stage.key] = client.submit(
                        _run_stage, stage, stages, needed, key=stage.key
                    )
            chain = [futures[stage.key] for stage in run.stages]
            ends[client.submit(_sum, chain, key=f'run {run.name}')] = run
        for end in distributed.as_completed(ends):
            lost = end.exception()
            yield ends[end], Outcome(f'the worker failed: {lost}') if lost else end.result()
    finally:
        client.close()
        if scheduler is None:
            cluster.close()


def _done(folder: Path) -> Outcome | None:
    """Outcome of a finished stage, also of an earlier batch; None if it is not finished."""
    try:
        return Outcome(**json.loads((folder / _DONE).read_text(encoding='utf-8')))
    except (OSError, ValueError, TypeError):
        return None


def _sum(outcomes: Sequence[Outcome]) -> Outcome:
    """Outcome of a run: sum of those of its stages."""
    return Outcome(
        next((outcome.reason for outcome in outcomes if outcome.reason), ''),
        sum(outcome.cpu_s for outcome in outcomes),
        sum(outcome.wall_s for outcome in outcomes),
        max(outcome.memory_mb for outcome in outcomes),
    )


def _run_stage(stage: Stage, stages: Path, needed: Sequence[Outcome]) -> Outcome:
    """Execute a stage in a temporary folder, which is renamed when the stage has finished."""
    if failed := [outcome.reason for outcome in needed if outcome.reason]:
        return Outcome(failed[0])
    target = stages / stage.key
    if done := _done(target):
        return done
    # The name is unique, as another worker may have been lost during the same stage.
    folder = stages / f'.{stage.key}.{os.uname().nodename}-{os.getpid()}'
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if stage.config:
        (folder / 'config.yaml').write_text(stage.config, encoding='utf-8')
    words = stage_arguments(stage, stages, folder)
    begin = time.monotonic()
    with (folder / 'log.txt').open('wb') as log:
        process = subprocess.Popen(
            [sys.executable, '-m', 'landmark_nav', *words],
            stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
        )  # fmt: skip
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    outcome = Outcome(
        _reason(folder) if process.returncode else '',
        usage.ru_utime + usage.ru_stime,
        time.monotonic() - begin,
        usage.ru_maxrss / 1024.0,
    )
    if outcome.reason:
        _replace(folder, stages / f'{stage.key}.failed')
        return outcome
    (folder / _DONE).write_text(json.dumps(asdict(outcome)), encoding='utf-8')
    _replace(folder, target)
    return outcome


def _reason(folder: Path) -> str:
    """Last line of the log of a command, which has the reason of a failure."""
    lines = (folder / 'log.txt').read_text(encoding='utf-8', errors='replace').splitlines()
    said = next((line for line in reversed(lines) if line.strip()), 'it was killed')
    return said.removeprefix('landmark-nav ').replace(f'{folder}/', '')


def _replace(folder: Path, target: Path) -> None:
    shutil.rmtree(target, ignore_errors=True)
    folder.rename(target)
