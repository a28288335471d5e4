"""A file of runs becomes stages, each done once; two tables are compared run by run."""

from pathlib import Path

import numpy as np
import pytest

from landmark_nav.batch.jobs import Outcome, read_runs
from landmark_nav.batch.results import compare, read_table
from landmark_nav.cli import batch
from landmark_nav.cli.main import main
from landmark_nav.configuration import load_configuration
from landmark_nav.errors import LandmarkNavError

RUN = """
runs:
  - folder: rooms/*
    robot: robot.yaml
    learn: {bag: sweeps, room: room.yaml}
    evaluate: {bag: drive, start: [1.0, 2.0, 0.5]}
grid:
  evaluate.config.estimator.learning_sigma: [0.5, 1.0]
"""
HUGE_GRID = {f'simulate.x{k}': list(range(10)) for k in range(9)}
LONG_FIELD = f'run,failure\na,{"x" * 200_000}'


@pytest.fixture
def recordings(tmp_path):
    for room in ('attic', 'hall'):
        for name in ('sweeps', 'drive'):
            (tmp_path / 'rooms' / room / name).mkdir(parents=True)
        for name in ('robot.yaml', 'room.yaml'):
            (tmp_path / 'rooms' / room / name).write_text(room)
    return tmp_path


def runs_of(folder, text):
    file = folder / 'jobs.yaml'
    file.write_text(text)
    return read_runs(file, '1')


def test_parameters_of_a_grid_and_contents_of_files_make_a_stage(recordings):
    robot, path = recordings / 'bare.yaml', recordings / 'config.yaml'
    robot.write_text('pan_axis: {xyz: [0, 0, 1]}')
    found = set()
    for run in runs_of(recordings, RUN):
        path.write_text(run.stages[-1].config)
        found.add(load_configuration(path, robot, 'odometry_fusion').estimator.learning_sigma)
    assert found == {0.5, 1.0}
    before = runs_of(recordings, RUN)
    (recordings / 'rooms' / 'attic' / 'room.yaml').write_text('another room')
    after = runs_of(recordings, RUN)
    same = [old.stages == new.stages for old, new in zip(before, after, strict=True)]
    assert same == [False, False, True, True]


def test_folders_as_of_simulate_need_no_file(recordings):
    for room in (recordings / 'rooms').iterdir():
        (room / 'sweeps').rename(room / 'learn')
    (recordings / 'rooms' / 'notes').mkdir()
    runs = read_runs(recordings / 'rooms' / '*', '1')
    assert [run.name for run in runs] == ['attic', 'hall']
    assert [stage.command for stage in runs[0].stages] == ['learn', 'evaluate']


@pytest.mark.parametrize(
    'text',
    [
        'runs: []',
        'runs: 5',
        'runs: [{robot: robot.yaml}]',
        'runs: [{learn: {bag: nowhere, robot: nothing}}]',
        'runs: [{folder: nowhere/*, learn: {}}]',
        'runs: [{lern: {bag: sweeps}}]',
        'runs: [{learn: {out: here}}]',
        'runs: [{lern: {}, evaluate: {}}]',
        'runs: [{simulate: {}}]\ngrid: {seed: [1]}',
        'runs: [{simulate: {}}]\ngrid: {simulate.seed: 1}',
        'runs: [{simulate: {}}, {simulate: {seed: 2}}]',
        'runs: [{folder: a**b, simulate: {}}]',
        'runs: [{folder: /**, simulate: {}}]',
        'runs: [{learn: {bag: /, robot: nothing}}]',
        'runs: [{folder: rooms/**/*, simulate: {}}]',
        'runs: [{simulate: {config: [1]}}]',
        'runs: [{simulate: {config: nowhere.yaml}}]',
        'runs: [{simulate: {seed: 1}, reasoning: quick}]',
        'runs: [{simulate: 3}]',
        'runs: [3]',
        'runs: [{simulate: {}}]\ngrid: 3',
        'runs: [{simulate: {seed: 1}}]\ngrid: {simulate.seed.x: [1]}',
        'runs: [{folder: nowhere, simulate: {}}]',
        "runs: [{simulate: {room: ''}}]",
        'runs: [{learn: {bag: , robot: robot.yaml}}]',
        f'runs: [{{simulate: {{}}}}]\ngrid: {HUGE_GRID}',
    ],
)
def test_a_wrong_file_is_refused_in_a_line(tmp_path, text):
    with pytest.raises(LandmarkNavError):
        runs_of(tmp_path, text)


@pytest.mark.parametrize('text', ['', 'a,b', 'run,failure\na,"', LONG_FIELD])
def test_a_wrong_table_is_refused_in_a_line(tmp_path, text):
    (tmp_path / 'table.csv').write_text(text, newline='')
    with pytest.raises(LandmarkNavError, match=r'table\.csv'):
        read_table(tmp_path)


def table(errors_m, failure=''):
    return [
        {'run': str(k), 'position_rmse_m': error, 'failure': failure}
        for k, error in enumerate(errors_m)
    ]


def test_only_a_change_beyond_its_interval_is_worse():
    rng = np.random.default_rng(5)
    wrong, low = 0, []
    for _ in range(400):
        before, after = rng.normal(0.01, 0.002, (2, 12))
        (_, change) = compare(table(after), table(before))
        wrong += change.worse
        low.append(change.low <= 0.0 <= change.high)
    assert 0.92 < np.mean(low) < 0.98
    assert wrong < 0.05 * 400
    (_, change) = compare(table(before + 0.004), table(before))
    assert change.worse
    assert not compare(table(before - 0.004), table(before))[1].worse


def test_one_run_that_fails_now_is_worse():
    failures, *_ = compare(table([0.01], 'no place found'), table([0.01]))
    assert failures.worse


def test_a_batch_prints_what_failed_and_what_got_worse(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path('jobs.yaml').write_text('runs: [{simulate: {}}]\ngrid: {simulate.seed: [1, 2]}')
    command = ['batch', 'jobs.yaml', '--out']

    def ended(*reasons):
        monkeypatch.setattr(
            batch, 'run_all', lambda runs, *_: zip(runs, map(Outcome, reasons), strict=True)
        )

    ended('', '')
    assert main([*command, 'before']) == 0
    ended('', 'no place <found>')
    assert main([*command, 'now', '--against', 'before']) == 1
    printed = capsys.readouterr().out
    assert 'seed=2: failed: no place <found>' in printed
    assert 'worse' in printed
    assert '1 of 2 runs done' in printed
    assert 'no place &lt;found&gt;' in Path('now/index.html').read_text()
    assert main([*command, 'now', '--scheduler', 'nowhere']) == 2
    Path('jobs.yaml').write_text('runs: [{simulate: {sede: 1}}]')
    assert main([*command, 'now']) == 2
