"""Conversion of a file of runs to stages, commands of `landmark-nav`, and their execution."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from glob import escape, glob
import hashlib
from importlib import import_module
from itertools import islice, product
import json
import logging
import math
import os
from pathlib import Path
import shutil
import subprocess
import sys
import time
from typing import Any

from landmark_nav.errors import LandmarkNavError, shown, why
from landmark_nav.signals import tied_to_parent
from landmark_nav.storage.reading import Entry, read_yaml_mapping

# Commands in the order of a run, and default inputs from earlier commands: option -> sources
# (command, path in its folder), of which the first available one is used.
COMMANDS: dict[str, dict[str, tuple[tuple[str, str], ...]]] = {
    'simulate': {},
    'learn': {
        'bag': (('simulate', 'out/learn'),),
        'room': (('simulate', 'out/room.yaml'),),
        'robot': (('simulate', 'out/robot.yaml'),),
    },
    'calibrate': {
        'bags': (('simulate', 'out/drive'),),
        'map': (('learn', 'out'),),
        'robot': (('simulate', 'out/robot.yaml'),),
    },
    'evaluate': {
        'bag': (('simulate', 'out/drive'),),
        'map': (('learn', 'out'),),
        'robot': (('calibrate', 'out'), ('simulate', 'out/robot.yaml')),
    },
}
# Options of a run -> the commands that they apply to.
_SHARED = {'robot': ('learn', 'calibrate', 'evaluate'), 'room': ('learn', 'calibrate')}
# Options with names of files or folders.
_PATHS = ('bag', 'bags', 'room', 'robot', 'map', 'camera')
# Options that the batch sets.
_OWN = ('out', 'json', 'report', 'overwrite')
_MOST_RUNS = 100_000
# Greatest number of files of a bag or map.
_MOST_FILES = 10_000


@dataclass(frozen=True)
class Stage:
    """
    One command of a run; its outputs are not among the `arguments`.

    ``@KEY/PLACE`` there is a file of another stage. `config` is the content of the file for
    ``--config``, or empty; `after` are the keys of the stages whose results it reads; `key` is the
    command and a hash of everything that the result depends on: version, arguments, state of
    files, `config`, `after`.
    """

    command: str
    arguments: tuple[str, ...]
    config: str
    after: tuple[str, ...]
    key: str


@dataclass(frozen=True)
class Run:
    """A row of the table: stages in order, and the values of the grid for this run."""

    name: str
    values: dict[str, Any]
    stages: tuple[Stage, ...]


def read_runs(path: Path, version: str) -> list[Run]:
    """
    Read a file of runs: YAML with `runs`, a list of mappings (docs/batch.md), and `grid`.

    A path with ``*`` is of folders instead, a run each, with names as `simulate` gives them.
    Results of other versions of the package are not reused. Raises `LandmarkNavError`: the file is
    invalid or holds no run.
    """
    document = _of_folders(path) if '*' in str(path) else read_yaml_mapping(path)
    listed = Entry(document, str(path), ('runs', 'grid'))
    grid = _grid(document.get('grid', {}), str(path))
    runs: dict[str, Run] = {}
    for number, entry in enumerate(listed.list_of('runs'), 1):
        where = f'{path}: run {number}'
        known = ('name', 'folder', *_SHARED, *COMMANDS)
        if isinstance(entry, Mapping):
            Entry(entry, where, known)  # checks the spelling
        if not isinstance(entry, Mapping) or not set(COMMANDS) & set(entry):
            raise LandmarkNavError(f'{where}: names none of {", ".join(COMMANDS)}')
        if strange := [key for key in entry if key not in known]:
            raise LandmarkNavError(f'{where}: {shown(strange[0])} is none of {", ".join(known)}')
        for folder in _folders(path.parent, entry, where):
            for values in grid:
                run = _run(entry, folder, values, version, where)
                # Runs that differ in grid values for other commands only are identical.
                if runs.setdefault(run.name, run) != run:
                    raise LandmarkNavError(f'{where}: another run is called {run.name}')
                if len(runs) > _MOST_RUNS:
                    raise LandmarkNavError(f'{path}: more than {_MOST_RUNS} runs')
    if not runs:
        raise LandmarkNavError(f'{path}: holds no run')
    return list(runs.values())


def _of_folders(pattern: Path) -> dict[str, Any]:
    """Runs of the folders of a pattern: of sweeps in ``learn`` and a drive in ``drive``."""
    runs = []
    for folder in map(Path, sorted(glob(str(pattern)))):
        run: dict[str, Any] = {
            name: f'{name}.yaml' for name in _SHARED if (folder / f'{name}.yaml').is_file()
        }
        for command, bag in ('learn', 'learn'), ('evaluate', 'drive'):
            if (folder / bag).exists():
                run[command] = {'bag': bag}
        if COMMANDS.keys() & run:
            runs.append({'folder': escape(str(folder.absolute())), **run})
    return {'runs': runs}


def _grid(given: Any, where: str) -> list[dict[str, Any]]:
    """All combinations of the values of a grid."""
    if not isinstance(given, Mapping):
        raise LandmarkNavError(f'{where}: grid is {shown(given)}, not a mapping of lists')
    for name in given:
        command, _, option = str(name).partition('.')
        if command not in COMMANDS or not option:
            how = 'write COMMAND.OPTION or COMMAND.config.NAME'
            raise LandmarkNavError(f'{where}: grid: {shown(name)}: {how}')
    columns = [Entry(given, f'{where}: grid').list_of(name) for name in given]
    if math.prod(map(len, columns)) > _MOST_RUNS:
        raise LandmarkNavError(f'{where}: grid has more than {_MOST_RUNS} combinations')
    return [dict(zip(map(str, given), row, strict=True)) for row in product(*columns)]


def _folders(base: Path, entry: Mapping[str, Any], where: str) -> Iterator[Path]:
    """Yield the folders that match `folder` of an entry; relative paths of a run start there."""
    pattern = Entry(entry, where).name('folder', '.')
    if Path(pattern).is_absolute():
        base, pattern = Path(Path(pattern).anchor), str(Path(pattern).relative_to('/'))
    if '**' in pattern:
        how = 'write a * for each level of folders'
        raise LandmarkNavError(f'{where}: folder {pattern}: ** is not taken: {how}')
    folders = [base] if pattern in ('.', '') else sorted(base.glob(pattern))
    folders = [folder for folder in folders if folder.is_dir()]
    if not folders:
        raise LandmarkNavError(f'{where}: no folder is like {pattern} in {base}')
    yield from folders


def _run(
    entry: Mapping[str, Any], folder: Path, values: dict[str, Any], version: str, where: str
) -> Run:
    """Build the run of an entry in a folder, with the values of the grid for its commands."""
    values = {name: value for name, value in values.items() if name.partition('.')[0] in entry}
    known = Entry(entry, where)
    name = known.name('name', '') or folder.resolve().name
    if known.name('folder', '.') not in ('.', '') and 'name' in entry:
        name += f' {folder.name}'
    name += ''.join(f' {key}={value}' for key, value in values.items())
    stages: dict[str, Stage] = {}
    for command in COMMANDS:
        if command in entry:
            where_it_is = f'{where}: {command}'
            options = _options(entry, command, values, where_it_is)
            stages[command] = _stage(command, options, stages, folder, version, where_it_is)
    return Run(name, values, tuple(stages.values()))


def _options(
    entry: Mapping[str, Any], command: str, values: Mapping[str, Any], where: str
) -> dict[str, Any]:
    """Return the options of a command: those of its run, its own, and those of the grid."""
    given = entry[command] or {}
    if not isinstance(given, Mapping):
        raise LandmarkNavError(f'{where} is {shown(given)}, not a mapping of options')
    options = {key: entry[key] for key, users in _SHARED.items() if key in entry}
    options = {key: value for key, value in options.items() if command in _SHARED[key]}
    options |= json.loads(json.dumps(given, default=str))
    for name, value in values.items():
        path = name.split('.')
        if path[0] != command:
            continue
        at = options
        for part in path[1:-1]:
            at = at.setdefault(part, {})
            if not isinstance(at, dict):
                raise LandmarkNavError(f'{where}: grid: {name}: {part} is no mapping')
        at[path[-1]] = value
    if own := [key for key in options if key in _OWN]:
        raise LandmarkNavError(f'{where}: {own[0]}: the batch chooses it')
    return options


def _stage(
    command: str,
    options: dict[str, Any],
    before: Mapping[str, Stage],
    folder: Path,
    version: str,
    where: str,
) -> Stage:
    config = options.pop('config', None) or {}
    if isinstance(config, str):
        options['config'] = config
    elif not isinstance(config, dict):
        raise LandmarkNavError(f'{where}: config is {shown(config)}: give a file or a mapping')
    after = {}
    for option, sources in COMMANDS[command].items():
        for source, place in sources if option not in options else ():
            if source in before:
                options[option] = f'@{before[source].key}/{place}'
                after[source] = before[source].key
                break
    arguments: list[str] = []
    content = hashlib.sha256(version.encode())
    for option, value in options.items():
        words = [str(word) for word in (value if isinstance(value, list) else [value])]
        if option in _PATHS and value in (None, '', []):
            raise LandmarkNavError(f'{where}: {option} is {shown(value)}, not a path')
        if option in (*_PATHS, 'config'):
            words = [word if word.startswith('@') else str(folder / word) for word in words]
            for word in words:
                _add_content(content, Path(word), where)
        if option in ('bag', 'bags'):
            arguments = words + arguments
        elif value is True:
            arguments.append(_flag(option))
        elif value is not False and value is not None:
            arguments += [_flag(option), *words]
    text = ''
    if config and isinstance(config, dict):
        text = json.dumps({'/**': {'ros__parameters': config}}, sort_keys=True)
    content.update(json.dumps([command, arguments, text, sorted(after.values())]).encode())
    key = f'{command}-{content.hexdigest()[:16]}'
    return Stage(command, tuple(arguments), text, tuple(after.values()), key)


def _flag(option: str) -> str:
    return '--' + option.replace('_', '-')


def _add_content(content: Any, path: Path, where: str) -> None:
    """Add names, sizes and times of change of a file, or of those in a folder, to a hash."""
    if str(path).startswith('@'):
        return
    try:
        inside = islice(path.rglob('*'), _MOST_FILES + 1) if path.is_dir() else [path]
        found = sorted(inside)
        if len(found) > _MOST_FILES:
            raise LandmarkNavError(f'{where}: {path}: over {_MOST_FILES} files: not a bag or map')
        for file in found:
            status = file.stat()
            content.update(f'{file.name} {status.st_size} {status.st_mtime_ns}\n'.encode())
    except (OSError, ValueError) as error:
        raise LandmarkNavError(f'{where}: {path}: cannot be read: {why(error)}') from error


_DONE = 'done.json'


@dataclass(frozen=True)
class Outcome:
    """Outcome of a stage or a run: reason of its failure, if it failed, and its costs."""

    reason: str = ''
    cpu_s: float = 0.0
    wall_s: float = 0.0
    memory_mb: float = 0.0


COSTS = ('cpu_s', 'wall_s', 'memory_mb')


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
    cluster: Any = scheduler
    if scheduler is None:
        count = min(workers or os.cpu_count() or 1, len(open_runs))
        cluster = distributed.LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            memory_limit=0,
            silence_logs=logging.ERROR,
            scheduler_kwargs={'dashboard': False},
        )
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
                    work = client.submit(_run_stage, stage, stages, needed, key=stage.key)
                    futures[stage.key] = work
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
        found = json.loads((folder / _DONE).read_text(encoding='utf-8'))
        return Outcome(str(found['reason']), *(float(found[name]) for name in COSTS))
    except (OSError, ValueError, TypeError, KeyError):
        return None


def _sum(outcomes: Sequence[Outcome]) -> Outcome:
    """Outcome of a run: sum of those of its stages."""
    reasons, cpu_s, wall_s, memory_mb = zip(*map(astuple, outcomes), strict=True)
    return Outcome(next(filter(None, reasons), ''), sum(cpu_s), sum(wall_s), max(memory_mb))


def _run_stage(stage: Stage, stages: Path, needed: Sequence[Outcome]) -> Outcome:
    """Execute a stage in a temporary folder, which is renamed when the stage has finished."""
    if failed := [outcome.reason for outcome in needed if outcome.reason]:
        return Outcome(failed[0])
    target = stages / stage.key
    if done := _done(target):
        return done
    # The name is unique, as another worker may be at the same stage; if it was lost, this removes
    # what it left.
    begun = f'.{stage.key}.{os.uname().nodename}-'
    for left in stages.glob(f'{begun}*'):
        pid = left.name.removeprefix(begun)
        if pid.isdigit() and not Path('/proc', pid).exists():
            shutil.rmtree(left, ignore_errors=True)
    folder = stages / f'{begun}{os.getpid()}'
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if stage.config:
        (folder / 'config.yaml').write_text(stage.config, encoding='utf-8')
    words = stage_arguments(stage, stages, folder)
    begin = time.monotonic()
    with (folder / 'log.txt').open('wb') as log:
        process = subprocess.Popen(
            tied_to_parent([sys.executable, '-m', 'landmark_nav', *words]),
            stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
        )  # fmt: skip
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    reason, cpu_s = _reason(folder) if process.returncode else '', usage.ru_utime + usage.ru_stime
    outcome = Outcome(reason, cpu_s, time.monotonic() - begin, usage.ru_maxrss / 1024.0)
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
