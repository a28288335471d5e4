"""Commands and nodes keep to one thread, unless the user says otherwise."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

COMMAND = 'import landmark_nav.cli.main as m; seen = early(); m.main(["map", "--help"])'
NODE = 'import landmark_nav.nodes; seen = early()'


def after(start: str, **environment: str) -> list[str]:
    """Threads that are allowed then, by each variable, and whether NumPy was there too early."""
    names = ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS')
    inherited = {key: value for key, value in os.environ.items() if key not in names}
    lines = ('import os, sys', 'def early(): return "numpy" in sys.modules', start)
    reported = f'print(*(os.environ[n] for n in {names}), seen)'
    done = subprocess.run(
        [sys.executable, '-c', '\n'.join((*lines, reported))],
        env={**inherited, **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.splitlines()[-1].split()


@pytest.mark.parametrize('start', [COMMAND, NODE])
def test_one_thread_unless_set_otherwise(start: str) -> None:
    if start is NODE:
        pytest.importorskip('rclpy', reason='ROS 2 is not installed')
    assert after(start) == ['1', '1', 'False']
    assert after(start, OPENBLAS_NUM_THREADS='2') == ['2', '1', 'False']
