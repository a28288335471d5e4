"""Signals end a process wherever its main thread is."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap

import pytest

from landmark_nav.ros.shutdown_guard import ShutdownGuard

SIGNALS = [signal.SIGINT, signal.SIGTERM]


def run(body: str) -> subprocess.CompletedProcess[str]:
    """A process that sends itself the signals; SIGINT is ignored as in a shell's background."""
    head = """
        import os, signal, threading
        from landmark_nav.ros.shutdown_guard import ShutdownGuard
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    """
    return subprocess.run(
        [sys.executable, '-c', textwrap.dedent(head) + textwrap.dedent(body)],
        capture_output=True,
        text=True,
        timeout=30,
    )


@pytest.mark.parametrize('number', SIGNALS)
def test_those_who_wait_are_asked_to_leave(number: signal.Signals) -> None:
    done = run(f"""
        asked = threading.Event()
        with ShutdownGuard(asked.set, 20.0):
            os.kill(os.getpid(), {int(number)})
            asked.wait()
            os.kill(os.getpid(), {int(number)})
        print('left')
    """)
    assert (done.returncode, done.stdout, done.stderr) == (0, 'left\n', '')


@pytest.mark.parametrize('number', SIGNALS)
def test_who_does_not_leave_is_ended(number: signal.Signals) -> None:
    # The signal comes in another thread, while the main one waits for good.
    done = run(f"""
        with ShutdownGuard(lambda: print('asked', flush=True), 0.2):
            threading.Timer(0.1, os.kill, (os.getpid(), {int(number)})).start()
            signal.pthread_sigmask(signal.SIG_BLOCK, {{ {int(number)} }})
            threading.Event().wait()
    """)
    assert (done.returncode, done.stdout, done.stderr) == (0, 'asked\n', '')


def test_who_was_asked_to_leave_without_a_signal_is_ended_too() -> None:
    done = run("""
        with ShutdownGuard(lambda: None, 0.2) as signals:
            signals.expect_end()
            threading.Event().wait()
    """)
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')


def test_who_holds_the_interpreter_is_ended() -> None:
    done = run("""
        import re
        asked = threading.Event()
        with ShutdownGuard(asked.set, 0.2):
            os.kill(os.getpid(), signal.SIGTERM)
            asked.wait()
            re.match('(a|a)*c', 'a' * 60 + 'b')
    """)
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')


def test_afterwards_signals_are_what_they_were() -> None:
    before = {number: signal.getsignal(number) for number in SIGNALS}
    asked: list[int] = []
    for _ in range(3):
        with ShutdownGuard(lambda: asked.append(1), 0.0):
            pass
    assert {number: signal.getsignal(number) for number in SIGNALS} == before
    if callable(before[signal.SIGINT]):
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert asked == []
