"""Processes that belong together."""

from __future__ import annotations

import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import time

import pytest

from landmark_nav.demo.supervisor import ProcessEndedError, Supervisor

SLEEP = [*(sys.executable, '-S', '-c'), 'import time; print("up", flush=True); time.sleep(60)']
STUBBORN = [
    *(sys.executable, '-S', '-c'),
    'import signal, time\n'
    'signal.signal(signal.SIGTERM, signal.SIG_IGN)\n'
    'print("up", flush=True)\n'
    'time.sleep(60)',
]
FAILING = [
    *(sys.executable, '-S', '-c'),
    'print("first", flush=True); raise SystemExit("the wheel fell off")',
]


def wait_for(log: Path, word: str) -> None:
    deadline = time.monotonic() + 10.0
    while word not in log.read_text():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def check_until_something_happens(supervisor: Supervisor) -> None:
    for _ in range(500):
        supervisor.check()
        time.sleep(0.02)


@pytest.fixture
def supervisor(tmp_path: Path) -> Supervisor:
    return Supervisor(tmp_path, os.environ, grace_s=0.5)


def test_who_died_and_its_last_words(supervisor: Supervisor, tmp_path: Path) -> None:
    with supervisor:
        supervisor.start('sleeper', SLEEP)
        supervisor.check()
        supervisor.start('wheel', FAILING)
        with pytest.raises(
            ProcessEndedError, match=r'wheel ended with exit status 1: first \| the'
        ):
            check_until_something_happens(supervisor)
        wait_for(tmp_path / 'sleeper.log', 'up')
        assert supervisor.stop()['sleeper'] == -signal.SIGTERM


def test_a_killed_one_is_recognized_by_its_signal(supervisor: Supervisor) -> None:
    killer = 'import os, signal; os.kill(os.getpid(), signal.SIGKILL)'
    with supervisor:
        supervisor.start('short', [sys.executable, '-S', '-c', killer])
        with pytest.raises(ProcessEndedError, match='signal SIGKILL: it printed nothing'):
            check_until_something_happens(supervisor)


def test_all_end_however_stubborn(supervisor: Supervisor, tmp_path: Path) -> None:
    with supervisor:
        supervisor.start('sleeper', SLEEP)
        supervisor.start('stubborn', STUBBORN)
        for name in ('sleeper', 'stubborn'):
            wait_for(tmp_path / f'{name}.log', 'up')
        statuses = supervisor.stop()
    assert statuses == {'sleeper': -signal.SIGTERM, 'stubborn': -signal.SIGKILL}


def test_leaving_the_block_ends_them(tmp_path: Path) -> None:
    with Supervisor(tmp_path, os.environ) as supervisor:
        supervisor.start(
            'sleeper',
            [*SLEEP[:-1], 'import os, time; print(os.getpid(), flush=True); time.sleep(60)'],
        )
        wait_for(tmp_path / 'sleeper.log', '\n')
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / 'sleeper.log').read_text().split()[0]), 0)


def is_running(process_id: int) -> bool:
    """A zombie that nobody asked for its status has no command line any more."""
    try:
        return bool(Path(f'/proc/{process_id}/cmdline').read_bytes())
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.skipif(shutil.which('setpriv') is None, reason='no setpriv (util-linux)')
def test_who_is_killed_leaves_nobody_behind(tmp_path: Path) -> None:
    conductor = (
        'import os, signal, sys, time\n'
        'from pathlib import Path\n'
        'from landmark_nav.demo.supervisor import Supervisor\n'
        f'child = Supervisor(Path({str(tmp_path)!r}), os.environ).start("sleeper", {SLEEP!r})\n'
        'print(child.pid, flush=True)\n'
        f'while "up" not in Path({str(tmp_path / "sleeper.log")!r}).read_text():\n'
        '    time.sleep(0.01)\n'
        'os.kill(os.getpid(), signal.SIGKILL)\n'
    )
    killed = subprocess.run(
        [sys.executable, '-c', conductor], capture_output=True, text=True, timeout=30
    )
    assert killed.returncode == -signal.SIGKILL
    deadline = time.monotonic() + 10.0
    while is_running(int(killed.stdout)):
        assert time.monotonic() < deadline
        time.sleep(0.01)
