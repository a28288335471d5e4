"""`landmark-nav batch` on a scheduler and workers as real processes, one of them killed."""

import csv
import json
import os
import subprocess
import sys
import time

from harness import SETUPS
import pytest

pytest.importorskip('distributed', reason='the extra batch is not installed')

DASK = [sys.executable, '-m', 'dask']
SMALL = f'camera: {SETUPS}/camera_quarter_vga.yaml, room: {SETUPS}/room_small.yaml'
JOBS = f"""
runs:
  - name: room
    simulate: {{frames: 8, sweeps: 1, drive-seconds: 0.5, {SMALL}}}
  - name: no robot
    simulate: {{robot: jobs.yaml}}
grid:
  simulate.seed: [1, 2]
"""


@pytest.fixture
def cluster(tmp_path):
    """Address of a scheduler and its two workers."""
    file = tmp_path / 'scheduler.json'
    words = ['scheduler', '--port', '0', '--no-dashboard', '--scheduler-file', str(file)]
    processes = [subprocess.Popen([*DASK, *words], stderr=subprocess.DEVNULL)]
    deadline = time.monotonic() + 60.0
    while not file.exists():
        assert time.monotonic() < deadline, 'the scheduler did not start'
        time.sleep(0.1)
    words = ['worker', '--no-nanny', '--nthreads', '1', '--no-dashboard']
    words += ['--scheduler-file', str(file), '--local-directory', str(tmp_path)]
    workers = [subprocess.Popen([*DASK, *words], stderr=subprocess.DEVNULL) for _ in range(2)]
    yield json.loads(file.read_text())['address'], workers
    for process in (*workers, *processes):
        process.kill()
        process.wait()


def test_a_worker_is_killed_and_nothing_is_lost(tmp_path, cluster):
    address, workers = cluster
    (tmp_path / 'jobs.yaml').write_text(JOBS)
    words = ['batch', 'jobs.yaml', '--out', 'out', '--scheduler', address]
    command = [sys.executable, '-m', 'landmark_nav', *words]
    batch = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    mark = f'-{workers[0].pid}'
    deadline = time.monotonic() + 120.0
    while not list((tmp_path / 'out').glob(f'stages/.*{mark}')):
        assert batch.poll() is None
        assert time.monotonic() < deadline, 'the worker got no work'
        time.sleep(0.02)
    workers[0].kill()
    workers[0].wait()
    said, _ = batch.communicate(timeout=240.0)
    # That robot.yaml is none.
    assert batch.returncode == 1, said
    rows = list(csv.DictReader((tmp_path / 'out' / 'table.csv').open()))
    assert [bool(row['failure']) for row in rows] == [False] * 2 + [True] * 2
    assert all(len(row['failure']) < 200 for row in rows)
    assert not list((tmp_path / 'out' / 'stages').glob(f'.*{mark}'))
    page = (tmp_path / 'out' / 'index.html').read_text()
    assert all(row['run'] in page for row in rows)

    done = sorted((tmp_path / 'out' / 'stages').glob('simulate-*/done.json'))
    done[1].write_text('{"reason": "", "cpu_s": "much"}')
    before = [os.stat(path).st_mtime_ns for path in done]
    again = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=240)
    assert again.returncode == 1
    after = [os.stat(path).st_mtime_ns for path in done]
    assert len(before) == 2
    assert after[0] == before[0]
    assert after[1] > before[1]
    assert json.loads(done[1].read_text())['cpu_s'] > 0.0
