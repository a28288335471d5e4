"""Threads, signals and processes end as they should."""

import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import textwrap
from threading import Event
import time

import pytest

from landmark_nav.demo.supervisor import Interruption, ProcessEndedError, Supervisor
from landmark_nav.ros.health import Latency
from landmark_nav.ros.run import LatestOnlyWorker, ShutdownGuard
from landmark_nav.signals import interrupting

pytest.importorskip('rclpy', reason='ROS 2 is not installed')


def test_what_waits_makes_way_for_what_is_newer():
    done: list[int] = []
    go, began = Event(), Event()

    def work(number):
        began.set()
        go.wait(5.0)
        done.append(number)

    worker = LatestOnlyWorker(work)
    worker.take(0)
    assert began.wait(5.0)
    for number in range(1, 6):
        worker.take(number)
    go.set()
    wait_until(lambda: len(done) == 2)
    assert done == [0, 5]
    assert worker.dropped == 4


def test_ages_by_another_clock_are_none():
    latency = Latency()
    assert latency.values() == {}
    latency.note(10**18)
    assert latency.values() == {}
    for age_ms in range(1, 101):
        latency.note(age_ms * 10**6)
    assert latency.values() == {'latency_median_ms': '50', 'latency_p95_ms': '95'}


SIGNALS = [signal.SIGINT, signal.SIGTERM]


def run(body):
    """A process that sends itself the signals; SIGINT is ignored as in a shell's background."""
    head = """
        import os, signal, threading
        from landmark_nav.ros.run import ShutdownGuard
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    """
    return subprocess.run(
        [sys.executable, '-c', textwrap.dedent(head) + textwrap.dedent(body)],
        capture_output=True,
        text=True,
        timeout=30,
    )


@pytest.mark.parametrize('number', SIGNALS)
def test_a_signal_asks_the_work_to_end_once(number):
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
def test_a_process_that_does_not_end_is_killed(number):
    # The signal comes in another thread, while the main one waits for good.
    done = run(f"""
        with ShutdownGuard(lambda: print('asked', flush=True), 0.2):
            threading.Timer(0.1, os.kill, (os.getpid(), {int(number)})).start()
            signal.pthread_sigmask(signal.SIG_BLOCK, {{ {int(number)} }})
            threading.Event().wait()
    """)
    assert (done.returncode, done.stdout, done.stderr) == (0, 'asked\n', '')


def test_afterwards_signals_are_what_they_were():
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


def program(text):
    return [sys.executable, '-S', '-c', textwrap.dedent(text)]


SLEEP = program('import time; print("up", flush=True); time.sleep(60)')
STUBBORN = program("""
    import signal, time
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    print("up", flush=True)
    time.sleep(60)
""")
FAILING = program('print("first", flush=True); raise SystemExit("the wheel fell off")')
KILLED = program('import os, signal; os.kill(os.getpid(), signal.SIGKILL)')


def wait_until(condition):
    deadline = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def wait_for(log, word):
    wait_until(lambda: word in log.read_text())


@pytest.fixture
def supervisor(tmp_path):
    return Supervisor(tmp_path, os.environ, grace_s=0.5)


@pytest.mark.parametrize(
    ('command', 'words'),
    [
        (FAILING, r'wheel ended with exit status 1: first \| the'),
        (KILLED, 'wheel ended with signal SIGKILL: it printed nothing'),
    ],
)
def test_a_dead_process_is_reported_with_its_last_lines(supervisor, tmp_path, command, words):
    with supervisor:
        supervisor.start('sleeper', SLEEP)
        supervisor.check()
        supervisor.start('wheel', command)
        with pytest.raises(ProcessEndedError, match=words):
            wait_until(supervisor.check)
        wait_for(tmp_path / 'sleeper.log', 'up')
        assert supervisor.stop()['sleeper'] == -signal.SIGTERM


def test_all_processes_end_even_if_they_ignore_signals(supervisor, tmp_path):
    with supervisor:
        supervisor.start('sleeper', SLEEP)
        supervisor.start('stubborn', STUBBORN)
        for name in ('sleeper', 'stubborn'):
            wait_for(tmp_path / f'{name}.log', 'up')
        statuses = supervisor.stop()
    assert statuses == {'sleeper': -signal.SIGTERM, 'stubborn': -signal.SIGKILL}


def is_running(process_id):
    """A zombie that nobody asked for its status has no command line any more."""
    try:
        return bool(Path(f'/proc/{process_id}/cmdline').read_bytes())
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.skipif(shutil.which('setpriv') is None, reason='no setpriv (util-linux)')
def test_a_killed_supervisor_leaves_no_process_behind(tmp_path):
    conductor = textwrap.dedent(f"""
        import os, signal, time
        from pathlib import Path
        from landmark_nav.demo.supervisor import Supervisor
        child = Supervisor(Path({str(tmp_path)!r}), os.environ).start("sleeper", {SLEEP!r})
        print(child.pid, flush=True)
        while "up" not in Path({str(tmp_path / 'sleeper.log')!r}).read_text():
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGKILL)
    """)
    killed = subprocess.run(
        [sys.executable, '-c', conductor], capture_output=True, text=True, timeout=30
    )
    assert killed.returncode == -signal.SIGKILL
    wait_until(lambda: not is_running(int(killed.stdout)))


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
@pytest.mark.parametrize('number', SIGNALS)
@pytest.mark.parametrize(
    ('words', 'status'), [(('', 'simulate', '--out'), 128), (('.nodes.room_simulator',), 0)]
)
def test_commands_and_nodes_end_quietly(words, status, number, after_s, tmp_path):
    module, *arguments = words
    folder = [str(tmp_path / 'room')] if arguments else []
    command = [sys.executable, '-m', f'landmark_nav{module}', *arguments, *folder]
    assert signalled(command, number, after_s) == (status and status + number, '')


@pytest.mark.parametrize('number', SIGNALS)
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
    assert {int(number) for number in blocked.split()} >= set(SIGNALS)
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


@pytest.mark.parametrize('number', SIGNALS)
def test_a_signal_in_a_destructor_is_not_lost(number):
    handlers = [signal.getsignal(each) for each in SIGNALS]
    with pytest.raises(KeyboardInterrupt) as raised:
        interrupted(number)
    assert raised.value.args == (number,)
    assert [signal.getsignal(each) for each in SIGNALS] == handlers


@pytest.mark.parametrize(
    ('then', 'raised'), [(None, KeyboardInterrupt), (ZeroDivisionError, ZeroDivisionError)]
)
def test_a_pending_signal_is_raised_at_the_end_and_hides_no_error(then, raised):
    def end():
        with Interruption():
            os.kill(os.getpid(), signal.SIGTERM)
            if then is not None:
                raise then

    with pytest.raises(raised):
        end()
