"""SIGINT and SIGTERM end commands quietly, while they import and while they work."""

import os
from pathlib import Path
import signal
import subprocess
import sys
import textwrap
import time

import pytest

from landmark_nav.demo.supervisor import Interruption
from landmark_nav.signals import interrupting

NUMBERS = [signal.SIGINT, signal.SIGTERM]


def heeds_signals(process):
    """Whether a process has a handler for SIGTERM, as Python by itself has not."""
    status = Path(f'/proc/{process.pid}/status').read_text()
    caught = next(line for line in status.splitlines() if line.startswith('SigCgt'))
    return bool(int(caught.split()[1], 16) >> (signal.SIGTERM - 1) & 1)


def signalled(command, number, after_s):
    """Status and complaints of a process that is signalled so long after it heeds signals."""
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            while process.poll() is None and not heeds_signals(process):
                time.sleep(0.001)
            time.sleep(after_s)
            process.send_signal(number)
            complaints = process.communicate(timeout=30.0)[1]
        finally:
            process.kill()
    return process.returncode, complaints


@pytest.mark.parametrize('after_s', [0.0, 0.3])
@pytest.mark.parametrize('number', NUMBERS)
def test_a_command_ends_quietly(number, after_s, tmp_path):
    command = [sys.executable, '-m', 'landmark_nav', 'simulate', '--out', str(tmp_path / 'room')]
    assert signalled(command, number, after_s) == (128 + number, '')


@pytest.mark.parametrize('after_s', [0.0, 0.3])
@pytest.mark.parametrize('number', NUMBERS)
def test_a_node_ends_quietly(number, after_s, tmp_path):
    pytest.importorskip('rclpy', reason='ROS 2 is not installed')
    command = [sys.executable, '-m', 'landmark_nav.nodes.room_simulator']
    assert signalled(command, number, after_s) == (0, '')


def test_importing_nodes_leaves_signals_alone():
    pytest.importorskip('rclpy', reason='ROS 2 is not installed')
    before = [signal.getsignal(number) for number in NUMBERS]
    import landmark_nav.nodes  # noqa: F401

    assert [signal.getsignal(number) for number in NUMBERS] == before


@pytest.mark.parametrize('number', NUMBERS)
def test_work_that_is_interrupted_cleans_up(number):
    cleaned = []

    def work():
        try:
            os.kill(os.getpid(), number)
        finally:
            cleaned.append('first')
            os.kill(os.getpid(), number)

    before = signal.signal(number, lambda *_: cleaned.append('second'))
    try:
        with pytest.raises(KeyboardInterrupt) as interrupt, interrupting():
            work()
    finally:
        signal.signal(number, before)
    assert interrupt.value.args == (number,)
    assert cleaned == ['first', 'second']


def test_signals_blocked_by_the_parent_are_handled():
    script = """
        import os, signal, sys
        from landmark_nav.signals import end_at_once
        end_at_once(7)
        print('went on')
    """
    process = subprocess.Popen(
        [sys.executable, '-c', textwrap.dedent(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.pthread_sigmask(signal.SIG_BLOCK, NUMBERS),
    )
    process.send_signal(signal.SIGINT)
    output, complaint = process.communicate(timeout=30)
    assert (process.returncode, output, complaint) == (7, '', '')


def test_an_executable_blocks_signals_until_its_program_handles_them(tmp_path):
    env = ['env', '--block-signal=INT,TERM', 'true']
    if subprocess.run(env, check=False, capture_output=True).returncode:
        pytest.skip('env of this system cannot block signals')
    executable, program = tmp_path / 'lib' / 'landmark_nav' / 'node', tmp_path / 'bin' / 'node'
    for file in (executable, program):
        file.parent.mkdir(parents=True)
    executable.symlink_to(Path(__file__).resolve().parents[2] / 'resource' / 'run_executable')
    program.write_text(
        f'#!{sys.executable}\nimport signal, sys\n'
        'print(*map(int, signal.pthread_sigmask(signal.SIG_BLOCK, ())))\nprint(*sys.argv[1:])\n'
    )
    program.chmod(0o755)
    shown = subprocess.run([executable, 'one', 'two three'], capture_output=True, text=True)
    blocked, arguments = shown.stdout.splitlines()
    assert {int(number) for number in blocked.split()} >= set(NUMBERS)
    assert arguments == 'one two three'


class Signalled:
    """A signal comes as it is taken away, where an exception would be lost."""

    def __init__(self, number):
        self.number = number

    def __del__(self):
        os.kill(os.getpid(), self.number)


def interrupted(number):
    """Be signalled in a destructor, go on, and heed it."""
    with Interruption() as interruption:
        interruption.check()
        thing = Signalled(number)
        del thing
        interruption.check()
        pytest.fail('it was not raised')


def interrupted_at_its_end(then=None):
    with Interruption():
        os.kill(os.getpid(), signal.SIGTERM)
        if then is not None:
            raise then


@pytest.mark.parametrize('number', NUMBERS)
def test_a_signal_in_a_destructor_is_not_lost(number):
    handlers = [signal.getsignal(each) for each in NUMBERS]
    with pytest.raises(KeyboardInterrupt) as raised:
        interrupted(number)
    assert raised.value.args == (number,)
    assert [signal.getsignal(each) for each in NUMBERS] == handlers


def test_a_pending_signal_is_raised_at_the_end():
    with pytest.raises(KeyboardInterrupt):
        interrupted_at_its_end()


def test_an_error_is_not_hidden_by_a_signal():
    with pytest.raises(ZeroDivisionError):
        interrupted_at_its_end(ZeroDivisionError)
